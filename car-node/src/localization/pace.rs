//! Limits how often something happens, on the sensors' clock.

use synpf::Stamp;

/// Limits something to a given rate.
#[derive(Debug, Default)]
pub(crate) struct Pace {
    next: Option<Stamp>,
}

impl Pace {
    /// True when something at `rate` \[Hz\] is due. The caller then does it.
    pub(crate) fn due(&mut self, now: Stamp, rate: f32) -> bool {
        if rate <= 0.0 {
            return false;
        }
        let period = 1.0 / f64::from(rate);
        // The clock was set back: what was next is far off.
        self.next = self.next.filter(|next| next.since(now) < 2.0 * period);
        // A little early counts as due, so that every fourth of 40 jittering scans a second makes 10 Hz.
        if self.next.is_some_and(|next| now.since(next) < -0.2 * period) {
            return false;
        }
        let next = self.next.unwrap_or(now).plus(period);
        // After a pause the pace starts again, without extra events for the pause.
        self.next = Some(if next <= now { now.plus(period) } else { next });
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pace_of_ten_hertz_takes_every_fourth_of_forty_scans() {
        let mut pace = Pace::default();
        // Scans jitter by up to 2 ms.
        let due = (0..400)
            .filter(|scan| {
                let jitter = 0.002 * f64::from(scan % 3 - 1);
                pace.due(Stamp(0).plus(f64::from(*scan) * 0.025 + jitter), 10.0)
            })
            .count();
        assert_eq!(due, 100);
        assert!(!pace.due(Stamp(0).plus(100.0), 0.0), "a rate of 0 is never due");
        assert!(pace.due(Stamp(0).plus(100.0), 10.0), "due again after a pause");
        assert!(
            !pace.due(Stamp(0).plus(100.01), 10.0),
            "no extra event for the pause"
        );
        assert!(
            pace.due(Stamp(0).plus(50.0), 10.0),
            "due when the clock was set back"
        );
    }
}
