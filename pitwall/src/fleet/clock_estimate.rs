//! The offset between the clocks of a car and the laptop.

/// The result of one clock comparison.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct ClockEstimate {
    /// The car's clock minus the laptop's \[ns\].
    pub(super) offset: i64,
    /// Round-trip time \[ns\]. The offset is exact to within half of it.
    pub(super) round_trip: i64,
    /// When the clocks were compared, by the laptop's clock \[unix ns\].
    pub(super) at: i64,
}

impl ClockEstimate {
    /// After this time a comparison is replaced even by a less exact one, because clocks drift \[ns\].
    const MAX_AGE: i64 = 30_000_000_000;

    /// Clocks that differ by more than this beyond their comparisons' errors were set in between \[ns\].
    const SET: u64 = 50_000_000;

    /// True when this comparison is at least as exact as `old`, or `old` has expired or contradicts it: a car that was
    /// rebooted may have another clock.
    pub(super) fn replaces(&self, old: &Self) -> bool {
        let error = u64::midpoint(self.round_trip.unsigned_abs(), old.round_trip.unsigned_abs());
        self.round_trip <= old.round_trip
            || self.at.saturating_sub(old.at) > Self::MAX_AGE
            || self.offset.abs_diff(old.offset) > error + Self::SET
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_exact_comparison_stays_until_it_expires() {
        let exact = ClockEstimate {
            offset: 5,
            round_trip: 1_000,
            at: 0,
        };
        let mut rough = ClockEstimate {
            offset: 9,
            round_trip: 2_000,
            at: ClockEstimate::MAX_AGE,
        };
        assert!(exact.replaces(&rough) && !rough.replaces(&exact));
        rough.at += 1;
        assert!(rough.replaces(&exact));
    }

    // After a reboot with the clock behind, ages were an hour wrong for half a minute.
    #[test]
    fn a_clock_that_was_set_is_believed_at_once() {
        let old = ClockEstimate {
            offset: 5,
            round_trip: 1_000,
            at: 0,
        };
        let new = ClockEstimate {
            offset: -3_600_000_000_000,
            round_trip: 40_000_000,
            at: 1,
        };
        assert!(new.replaces(&old));
    }
}
