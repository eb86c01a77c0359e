//! Laps with their sectors, grip and distance from the raceline.
//!
//! A car reports when a lap has ended and its time. The sector times come from the poses: the moments at which `s` passes
//! each third of the raceline, interpolated linearly between two poses.

use std::collections::VecDeque;

use protocol::{EventKind, Health, Metrics};
use serde::Serialize;

use crate::analysis::{Invalid, LapCheck, PoseSample, Step};

/// Sectors of a lap, of equal length along the raceline.
pub const SECTORS: usize = 3;

/// A completed lap.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Lap {
    /// Its number, from 1.
    pub lap: u32,
    /// Its time \[s\].
    pub time_s: f64,
    /// Why it is void, so that its time does not count; None for a good lap.
    pub void: Option<&'static str>,
    /// The set in force at its end.
    pub set: String,
    /// Sector times \[s\]; None if poses are missing.
    pub sectors_s: [Option<f64>; SECTORS],
    /// Grip and alignment; None without health messages during the lap.
    pub grip: Option<LapGrip>,
    /// Mean distance from the raceline, by the car's own estimate \[m\]; None without poses.
    pub lateral_m: Option<f64>,
}

/// Grip of the wheels and fit of the scans during a lap.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct LapGrip {
    /// Share of the lap with a slip of more than [`LapGrip::SLIPS`], in `[0, 1]`.
    pub slipping: f64,
    /// Maximum absolute slip.
    pub worst_slip: f64,
    /// Mean alignment, in `[0, 1]`.
    pub alignment: f64,
}

impl LapGrip {
    /// Slip above which the wheels slip: the warning limit of the health monitor.
    pub const SLIPS: f32 = 0.08;
}

/// All laps of one car.
#[derive(Debug, Clone, Default)]
pub(crate) struct LapTimer {
    laps: Vec<Lap>,
    /// Laps that have not ended yet or just have, the newest last.
    traces: VecDeque<Trace>,
    last: Option<PoseSample>,
    /// Changes with the laps.
    changes: u64,
}

/// Data of a lap that has not ended.
#[derive(Debug, Clone, Default)]
struct Trace {
    lap: u32,
    check: LapCheck,
    /// When it started \[unix ns\]; None if the start was missed.
    begun: Option<i64>,
    /// When each border between two sectors was passed \[unix ns\].
    borders: [Option<i64>; SECTORS - 1],
    /// True when the next lap has begun.
    ended: bool,
    /// Length of a lap \[m\].
    length: f64,
    poses: u32,
    lateral: f64,
    healths: u32,
    slipping: u32,
    worst_slip: f32,
    alignment: f64,
}

impl LapTimer {
    /// Maximum number of laps kept.
    const MAX_LAPS: usize = 500;
    /// Maximum number of laps whose end is not reported yet.
    const MAX_TRACES: usize = 4;

    pub(crate) fn laps(&self) -> &[Lap] {
        &self.laps
    }

    /// Changes whenever the laps do.
    pub(crate) fn changes(&self) -> u64 {
        self.changes
    }

    /// Adds a pose on a raceline of `length` \[m\].
    pub(crate) fn on_pose(&mut self, here: &PoseSample, length: f64) {
        if self.last.is_some_and(|last| last.at >= here.at) {
            return;
        }
        let before = self.last.replace(*here);
        // A car that restarts counts its laps from the beginning.
        if self.traces.back().is_some_and(|trace| trace.lap > here.lap) {
            self.traces.clear();
        }
        if let Some(trace) = self.traces.back_mut() {
            trace.check.on_pose(before.as_ref(), here);
        }
        let step = before.and_then(|before| Step::between(&before, here, length));
        if self.traces.back().is_none_or(|trace| trace.lap != here.lap) {
            if let (Some(trace), Some(step)) = (self.traces.back_mut(), step) {
                trace.check.on_step(&step, length, false);
            }
            self.close(length);
            if self.traces.len() == Self::MAX_TRACES {
                self.traces.pop_front();
            }
            let mut trace = Trace {
                lap: here.lap,
                begun: step
                    .filter(|step| step.over_line)
                    .and_then(|step| step.when(length)),
                ..Trace::default()
            };
            if let Some(step) = step {
                trace.check.on_step(&step, length, true);
            }
            self.traces.push_back(trace);
        } else if let (Some(trace), Some(step)) = (self.traces.back_mut(), step) {
            trace.check.on_step(&step, length, false);
        }
        let Some(trace) = self.traces.back_mut() else {
            return;
        };
        trace.length = length;
        trace.poses += 1;
        trace.lateral += here.lateral.abs();
        if let Some(step) = step {
            for (i, border) in trace.borders.iter_mut().enumerate() {
                let at = length * (i + 1) as f64 / SECTORS as f64;
                // After the line the step ends beyond a lap's length.
                let passed = step.when(at).or_else(|| step.when(at + length));
                if border.is_none() {
                    *border = passed;
                }
            }
        }
    }

    /// The newest lap has ended: now all is known of it. Its time may have been reported before.
    fn close(&mut self, length: f64) {
        let Some(trace) = self.traces.back_mut() else {
            return;
        };
        (trace.ended, trace.length) = (true, length);
        let void = trace.void().map(Invalid::words);
        let reported = self.laps.iter_mut().rev().take(Self::MAX_TRACES);
        if let Some(lap) = reported
            .into_iter()
            .find(|lap| lap.lap == trace.lap && lap.void != void)
        {
            lap.void = void;
            self.changes += 1;
        }
    }

    /// Adds an event.
    pub(crate) fn on_event(&mut self, event: &EventKind) {
        if let EventKind::Lap {
            lap,
            time: Some(time),
            set,
        } = event
        {
            self.on_lap(*lap, *time, set);
        } else if let Some(trace) = self.traces.back_mut() {
            trace.check.on_event(event);
        }
    }

    /// The best lap \[s\]. Void laps do not count.
    pub(crate) fn best(laps: &[Lap]) -> Option<f64> {
        let good = laps.iter().filter(|lap| lap.void.is_none());
        good.map(|lap| lap.time_s).min_by(f64::total_cmp)
    }

    /// Adds a health message.
    pub(crate) fn on_health(&mut self, health: &Health) {
        if let Some(trace) = self.traces.back_mut() {
            trace.check.on_state(health.state);
            trace.measure(health.metrics.as_ref());
        }
    }

    /// Adds a completed lap.
    fn on_lap(&mut self, lap: u32, time_s: f64, set: &str) {
        let at = self.traces.iter().position(|trace| trace.lap == lap);
        let trace = at.map(|at| &self.traces[at]);
        // The event may arrive before the first pose of the next lap.
        let next = at.and_then(|at| self.traces.get(at + 1));
        let end_time = |begun: i64| begun + (time_s * 1e9) as i64;
        let end = next
            .and_then(|next| next.begun)
            .or_else(|| trace.and_then(|trace| trace.begun).map(end_time));
        let mut sectors_s = [None; SECTORS];
        if let Some(trace) = trace {
            let marks: Vec<Option<i64>> = std::iter::once(trace.begun)
                .chain(trace.borders)
                .chain([end])
                .collect();
            for (sector, pair) in sectors_s.iter_mut().zip(marks.windows(2)) {
                *sector = match pair {
                    [Some(from), Some(to)] if to > from => Some((to - from) as f64 * 1e-9),
                    _ => None,
                };
            }
        }
        if self.laps.len() == Self::MAX_LAPS {
            self.laps.remove(0);
        }
        self.changes += 1;
        self.laps.push(Lap {
            lap,
            time_s,
            // Without a raceline there is no trace of any lap, and nothing to judge by.
            void: trace
                .map_or_else(|| (!self.traces.is_empty()).then_some(Invalid::Gap), Trace::void)
                .map(Invalid::words),
            set: set.to_owned(),
            sectors_s,
            grip: trace.and_then(Trace::grip),
            lateral_m: trace
                .filter(|trace| trace.poses > 0)
                .map(|trace| trace.lateral / f64::from(trace.poses)),
        });
    }
}

impl Trace {
    /// Why it is void, as far as is known.
    fn void(&self) -> Option<Invalid> {
        let found = if self.ended {
            self.check.verdict(self.length)
        } else {
            self.check.so_far()
        };
        found.or(self.begun.is_none().then_some(Invalid::Gap))
    }

    fn measure(&mut self, metrics: Option<&Metrics>) {
        let Some(metrics) = metrics else { return };
        self.healths += 1;
        self.slipping += u32::from(metrics.slip.abs() > LapGrip::SLIPS);
        self.worst_slip = self.worst_slip.max(metrics.slip.abs());
        self.alignment += f64::from(metrics.alignment);
    }

    fn grip(&self) -> Option<LapGrip> {
        let share = |sum: f64| sum / f64::from(self.healths);
        (self.healths > 0).then(|| LapGrip {
            slipping: share(f64::from(self.slipping)),
            worst_slip: f64::from(self.worst_slip),
            alignment: share(self.alignment),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::{Pose2, State};

    const LENGTH: f64 = 30.0;

    /// Drives at 40 poses a second: 5 m/s in the first sector, 10 in the second, 2.5 in the third.
    fn drive(timer: &mut LapTimer, laps: u32) {
        let (mut s, mut at, mut lap) = (29.0, 0, 0);
        while lap < laps + 1 {
            timer.on_pose(&on_ring(at, s, lap), LENGTH);
            let speed = [5.0, 10.0, 2.5][(s / 10.0) as usize % SECTORS];
            s += speed / 40.0;
            at += 25_000_000;
            if s >= LENGTH {
                s -= LENGTH;
                lap += 1;
            }
        }
        timer.on_pose(&on_ring(at, s, lap), LENGTH);
    }

    fn on_lap(timer: &mut LapTimer, lap: u32, time_s: f64, set: &str) {
        timer.on_event(&EventKind::Lap {
            lap,
            time: Some(time_s),
            set: set.into(),
        });
    }

    #[test]
    fn sectors_add_up_to_the_lap() {
        let mut timer = LapTimer::default();
        drive(&mut timer, 2);
        on_lap(&mut timer, 2, 7.0, "hq");
        let lap = &timer.laps()[0];
        let sectors: Vec<f64> = lap.sectors_s.iter().map(|s| s.expect("driven")).collect();
        // Speeds change with the pose after a border: half a step, or 12.5 ms, to either side.
        for (sector, expected) in sectors.iter().zip([2.0, 1.0, 4.0]) {
            assert!((sector - expected).abs() < 0.03, "{sectors:?}");
        }
        assert!((sectors.iter().sum::<f64>() - 7.0).abs() < 0.03, "{sectors:?}");
        assert!(lap.lateral_m.is_some_and(|d| (d - 0.1).abs() < 1e-9));
        assert_eq!((lap.grip, lap.void), (None, None));
    }

    #[test]
    fn a_lap_whose_news_comes_first_has_its_last_sector() {
        let mut timer = LapTimer::default();
        drive(&mut timer, 1);
        let begun_two = timer.traces.back().expect("a lap").lap;
        timer.traces.pop_back();
        on_lap(&mut timer, begun_two - 1, 7.0, "hq");
        assert!(timer.laps()[0].sectors_s.iter().all(Option::is_some));
    }

    /// A ring of this length.
    fn on_ring(at: i64, s: f64, lap: u32) -> PoseSample {
        let (sin, cos) = (s / LENGTH * std::f64::consts::TAU).sin_cos();
        let radius = LENGTH / std::f64::consts::TAU;
        PoseSample {
            at,
            s,
            lap,
            speed: 5.0,
            lateral: -0.1,
            heading: 0.0,
            yaw_rate: 0.0,
            sigma: 0.0,
            position: [radius * cos, radius * sin],
        }
    }

    /// In the first lap.
    fn passed(at: i64, s: f64) -> PoseSample {
        on_ring(at, s, 1)
    }

    // A pose that was given in the middle of a lap once made a lap of 3.527 s, the best of the day.
    #[test]
    fn a_lap_with_a_jump_or_a_given_pose_is_void_and_never_the_best() {
        let mut timer = LapTimer::default();
        drive(&mut timer, 1);
        on_lap(&mut timer, 1, 7.0, "hq");
        let pose = |at: i64, s, lap| on_ring(8_000_000_000 + at, s, lap);
        timer.on_pose(&pose(0, 15.0, 2), LENGTH);
        timer.on_pose(&pose(25_000_000, 25.0, 2), LENGTH);
        on_lap(&mut timer, 2, 3.5, "hq");
        timer.on_pose(&pose(50_000_000, 25.1, 3), LENGTH);
        let given = Pose2 {
            x: 0.0,
            y: 0.0,
            heading: 0.0,
        };
        timer.on_event(&EventKind::PoseInitialized {
            before: None,
            pose: given,
        });
        on_lap(&mut timer, 3, 3.0, "hq");
        let void: Vec<_> = timer.laps().iter().map(|lap| lap.void).collect();
        assert_eq!(void, [None, Some("the pose jumped"), Some("a pose was given")]);
        assert_eq!(LapTimer::best(timer.laps()), Some(7.0));
    }

    /// The page counted laps that the report left out.
    #[test]
    fn a_lap_in_which_the_car_stood_or_was_lost_or_that_was_not_seen_is_void() {
        let mut timer = LapTimer::default();
        drive(&mut timer, 1);
        on_lap(&mut timer, 1, 7.0, "hq");
        let begun = timer.last.expect("a pose").at;
        for i in 1..60 {
            let mut here = on_ring(begun + i * 25_000_000, 0.3, 2);
            here.speed = 0.0;
            timer.on_pose(&here, LENGTH);
        }
        on_lap(&mut timer, 2, 9.0, "hq");
        assert_eq!(timer.laps()[1].void, Some("the car stood still"));

        let lost = Health {
            state: State::Lost,
            since: 0,
            causes: Vec::new(),
            update: 1,
            metrics: None,
            proposal: None,
            auto: false,
        };
        timer.on_pose(&on_ring(begun + 60 * 25_000_000, 0.1, 3), LENGTH);
        timer.on_health(&lost);
        on_lap(&mut timer, 3, 9.0, "hq");
        assert!(timer.laps()[2].void.is_some());

        // The news of a lap comes before its last pose: that too little was seen of it is known only with the next one.
        let mut timer = LapTimer::default();
        drive(&mut timer, 1);
        let begun = timer.last.expect("a pose").at;
        for i in 1..10 {
            timer.on_pose(&on_ring(begun + i * 25_000_000, 0.1 * i as f64, 2), LENGTH);
        }
        // A quarter of the lap is not seen, within less than a second.
        let (mut at, mut s) = (begun + 1_000_000_000, 9.0);
        while s < LENGTH - 0.2 {
            timer.on_pose(&on_ring(at, s, 2), LENGTH);
            (at, s) = (at + 25_000_000, s + 0.25);
        }
        on_lap(&mut timer, 2, 9.0, "hq");
        let changes = timer.changes();
        assert_eq!(timer.laps()[0].void, None);
        timer.on_pose(&on_ring(at, 0.1, 3), LENGTH);
        assert_eq!(timer.laps()[0].void, Some("part of the lap is missing"));
        assert!(timer.changes() > changes, "the page asks for the laps again");
    }

    #[test]
    fn a_jump_passes_no_border() {
        let mut timer = LapTimer::default();
        timer.on_pose(&passed(0, 5.0), LENGTH);
        timer.on_pose(&passed(25_000_000, 15.0), LENGTH);
        timer.on_pose(&passed(9_000_000_000, 16.0), LENGTH);
        on_lap(&mut timer, 1, 9.0, "lq");
        assert_eq!(timer.laps()[0].sectors_s, [None; SECTORS]);
    }

    #[test]
    fn slip_is_told_as_a_share_of_the_lap() {
        let mut timer = LapTimer::default();
        timer.on_pose(&passed(0, 5.0), LENGTH);
        for slip in [0.0, 0.05, -0.3, 0.1] {
            timer.on_health(&Health {
                state: State::Localized,
                since: 0,
                causes: Vec::new(),
                update: 1,
                metrics: Some(Metrics {
                    slip,
                    alignment: 0.8,
                    ..Metrics::default()
                }),
                proposal: None,
                auto: false,
            });
        }
        on_lap(&mut timer, 1, 9.0, "lq");
        let grip = timer.laps()[0].grip.expect("known");
        assert!((grip.slipping - 0.5).abs() < 1e-9 && (grip.worst_slip - 0.3).abs() < 1e-6);
        assert!((grip.alignment - 0.8).abs() < 1e-6);
    }
}
