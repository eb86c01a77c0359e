//! Which sensors have stopped sending.

use synpf::Stamp;

use super::CauseKind;

/// When each sensor sent last.
#[derive(Debug, Default)]
pub(super) struct SensorSilence {
    last_scan: Option<Stamp>,
    last_odometry: Option<Stamp>,
}

impl SensorSilence {
    /// A scan came in, usable or not.
    pub(super) fn on_scan(&mut self, now: Stamp) {
        self.last_scan = Some(now);
    }

    /// Odometry came in.
    pub(super) fn on_odometry(&mut self, now: Stamp) {
        self.last_odometry = Some(now);
    }

    /// The clock that `now` is read from was moved \[s\].
    pub(super) fn on_clock_moved(&mut self, by: f64) {
        for last in [&mut self.last_scan, &mut self.last_odometry]
            .into_iter()
            .flatten()
        {
            *last = last.plus(by);
        }
    }

    /// The sensors that have been silent for longer than `limit` \[s\], each with how long \[s\]. A sensor that has never sent
    /// counts as silent since `start`.
    pub(super) fn silent(&self, now: Stamp, start: Stamp, limit: f64) -> Vec<(CauseKind, f64)> {
        [
            (CauseKind::NoScan, self.last_scan),
            (CauseKind::NoOdometry, self.last_odometry),
        ]
        .into_iter()
        .map(|(kind, last)| (kind, now.since(last.unwrap_or(start))))
        .filter(|(_, silence)| *silence > limit)
        .collect()
    }
}
