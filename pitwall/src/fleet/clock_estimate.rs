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

    /// True when this comparison is at least as exact as `old`, or `old` has expired.
    pub(super) fn replaces(&self, old: &Self) -> bool {
        self.round_trip <= old.round_trip || self.at - old.at > Self::MAX_AGE
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
}
