//! Laps with their sectors, grip and distance from the raceline.
//!
//! A car reports when a lap has ended and its time. The sector times come from the poses: the moments at which `s` passes
//! each third of the raceline, interpolated linearly between two poses.

use std::collections::VecDeque;

use protocol::Metrics;
use serde::Serialize;

/// Sectors of a lap, of equal length along the raceline.
pub const SECTORS: usize = 3;

/// A completed lap.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Lap {
    /// Its number, from 1.
    pub lap: u32,
    /// Its time \[s\].
    pub time_s: f64,
    /// Why the time does not count; None for a good lap.
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
    last: Option<TrackPose>,
}

/// A pose on the raceline.
#[derive(Debug, Clone, Copy)]
pub(crate) struct TrackPose {
    /// When it was true \[unix ns\].
    pub(crate) at: i64,
    /// Arc length on the raceline \[m\].
    pub(crate) s: f64,
    /// Distance from the raceline \[m\].
    pub(crate) d: f64,
    /// Position in the map \[m\].
    pub(crate) position: [f64; 2],
    /// Laps begun.
    pub(crate) lap: u32,
}

/// Data of a lap that has not ended.
#[derive(Debug, Clone, Default)]
struct Trace {
    lap: u32,
    void: Option<&'static str>,
    /// When it started \[unix ns\]; None if the start was missed.
    begun: Option<i64>,
    /// When each border between two sectors was passed \[unix ns\].
    borders: [Option<i64>; SECTORS - 1],
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
    /// A longer time between two poses is a gap \[ns\].
    const GAP: i64 = 1_000_000_000;
    /// Two poses that are further apart than this speed allows are a jump \[m/s\]. No car of this class is that fast.
    const FASTEST: f64 = 25.0;
    /// How far a pose may move beyond that \[m\].
    const LOOSE: f64 = 0.5;

    pub(crate) fn laps(&self) -> &[Lap] {
        &self.laps
    }

    /// Adds a pose on a raceline of `length` \[m\].
    pub(crate) fn on_pose(&mut self, here: TrackPose, length: f64) {
        let before = self.last.replace(here);
        let jumped = before.is_some_and(|before| before.jumps_to(here));
        // A car that restarts counts its laps from the beginning.
        if self.traces.back().is_some_and(|trace| trace.lap > here.lap) {
            self.traces.clear();
        }
        let step = before.and_then(|before| Step::between(before, here, length));
        if self.traces.back().is_none_or(|trace| trace.lap != here.lap) {
            if self.traces.len() == Self::MAX_TRACES {
                self.traces.pop_front();
            }
            self.traces.push_back(Trace {
                lap: here.lap,
                begun: step
                    .filter(|step| step.over_line)
                    .and_then(|step| step.when(length)),
                ..Trace::default()
            });
        }
        let Some(trace) = self.traces.back_mut() else {
            return;
        };
        if jumped {
            trace.void = Some("the pose has jumped");
        }
        trace.poses += 1;
        trace.lateral += here.d.abs();
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

    /// Makes the present lap void: its time does not count.
    pub(crate) fn make_void(&mut self, why: &'static str) {
        if let Some(trace) = self.traces.back_mut() {
            trace.void = Some(why);
        }
    }

    /// The best lap \[s\]. Void laps do not count.
    pub(crate) fn best(laps: &[Lap]) -> Option<f64> {
        let good = laps.iter().filter(|lap| lap.void.is_none());
        good.map(|lap| lap.time_s).min_by(f64::total_cmp)
    }

    /// Takes in what was measured just now.
    pub(crate) fn on_metrics(&mut self, metrics: &Metrics) {
        if let Some(trace) = self.traces.back_mut() {
            trace.healths += 1;
            trace.slipping += u32::from(metrics.slip.abs() > LapGrip::SLIPS);
            trace.worst_slip = trace.worst_slip.max(metrics.slip.abs());
            trace.alignment += f64::from(metrics.alignment);
        }
    }

    /// Adds a completed lap.
    pub(crate) fn on_lap(&mut self, lap: u32, time_s: f64, set: &str) {
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
        self.laps.push(Lap {
            lap,
            time_s,
            void: trace.and_then(|trace| trace.void),
            set: set.to_owned(),
            sectors_s,
            grip: trace.and_then(Trace::grip),
            lateral_m: trace
                .filter(|trace| trace.poses > 0)
                .map(|trace| trace.lateral / f64::from(trace.poses)),
        });
    }
}

impl TrackPose {
    fn jumps_to(self, here: Self) -> bool {
        let seconds = (here.at - self.at).max(0) as f64 * 1e-9;
        let [dx, dy] = [0, 1].map(|i| here.position[i] - self.position[i]);
        dx.hypot(dy) > LapTimer::FASTEST * seconds + LapTimer::LOOSE
    }
}

impl Trace {
    fn grip(&self) -> Option<LapGrip> {
        let share = |sum: f64| sum / f64::from(self.healths);
        (self.healths > 0).then(|| LapGrip {
            slipping: share(f64::from(self.slipping)),
            worst_slip: f64::from(self.worst_slip),
            alignment: share(self.alignment),
        })
    }
}

/// From one pose to the next, forwards.
#[derive(Debug, Clone, Copy)]
struct Step {
    from: (i64, f64),
    /// `s` here may exceed a lap's length.
    to: (i64, f64),
    over_line: bool,
}

impl Step {
    /// None for a jump, a pause, and for driving backwards.
    fn between(before: TrackPose, here: TrackPose, length: f64) -> Option<Self> {
        let mut ahead = here.s - before.s;
        let over_line = ahead < -length / 2.0;
        if over_line {
            ahead += length;
        }
        let in_time = (1..=LapTimer::GAP).contains(&(here.at - before.at));
        (in_time && ahead > 0.0 && ahead < length / 4.0).then_some(Self {
            from: (before.at, before.s),
            to: (here.at, before.s + ahead),
            over_line,
        })
    }

    /// When `s` was passed \[unix ns\]; None if it was not.
    fn when(&self, s: f64) -> Option<i64> {
        let (from, to) = (self.from, self.to);
        (from.1 < s && s <= to.1)
            .then(|| from.0 + ((s - from.1) / (to.1 - from.1) * (to.0 - from.0) as f64) as i64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LENGTH: f64 = 30.0;

    /// Drives at 40 poses a second: 5 m/s in the first sector, 10 in the second, 2.5 in the third.
    fn drive(timer: &mut LapTimer, laps: u32) {
        let (mut s, mut at, mut lap) = (29.0, 0, 0);
        while lap < laps + 1 {
            timer.on_pose(on_ring(at, s, lap), LENGTH);
            let speed = [5.0, 10.0, 2.5][(s / 10.0) as usize % SECTORS];
            s += speed / 40.0;
            at += 25_000_000;
            if s >= LENGTH {
                s -= LENGTH;
                lap += 1;
            }
        }
        timer.on_pose(on_ring(at, s, lap), LENGTH);
    }

    #[test]
    fn sectors_add_up_to_the_lap() {
        let mut timer = LapTimer::default();
        drive(&mut timer, 2);
        timer.on_lap(2, 7.0, "hq");
        let lap = &timer.laps()[0];
        let sectors: Vec<f64> = lap.sectors_s.iter().map(|s| s.expect("driven")).collect();
        // Speeds change with the pose after a border: half a step, or 12.5 ms, to either side.
        for (sector, expected) in sectors.iter().zip([2.0, 1.0, 4.0]) {
            assert!((sector - expected).abs() < 0.03, "{sectors:?}");
        }
        assert!((sectors.iter().sum::<f64>() - 7.0).abs() < 0.03, "{sectors:?}");
        assert!(lap.lateral_m.is_some_and(|d| (d - 0.1).abs() < 1e-9));
        assert_eq!(lap.grip, None);
    }

    #[test]
    fn a_lap_whose_news_comes_first_has_its_last_sector() {
        let mut timer = LapTimer::default();
        drive(&mut timer, 1);
        let begun_two = timer.traces.back().expect("a lap").lap;
        timer.traces.pop_back();
        timer.on_lap(begun_two - 1, 7.0, "hq");
        assert!(timer.laps()[0].sectors_s.iter().all(Option::is_some));
    }

    /// A ring of this length.
    fn on_ring(at: i64, s: f64, lap: u32) -> TrackPose {
        let (sin, cos) = (s / LENGTH * std::f64::consts::TAU).sin_cos();
        let radius = LENGTH / std::f64::consts::TAU;
        TrackPose {
            at,
            s,
            d: -0.1,
            position: [radius * cos, radius * sin],
            lap,
        }
    }

    /// In the first lap.
    fn passed(at: i64, s: f64) -> TrackPose {
        on_ring(at, s, 1)
    }

    // A pose that was given in the middle of a lap once made a lap of 3.527 s, the best of the day.
    #[test]
    fn a_lap_with_a_jump_or_a_given_pose_is_void_and_never_the_best() {
        let mut timer = LapTimer::default();
        drive(&mut timer, 1);
        timer.on_lap(1, 7.0, "hq");
        timer.on_pose(on_ring(20_000_000_000, 15.0, 2), LENGTH);
        timer.on_pose(on_ring(20_025_000_000, 25.0, 2), LENGTH);
        timer.on_lap(2, 3.5, "hq");
        timer.on_pose(on_ring(20_050_000_000, 25.1, 3), LENGTH);
        timer.make_void("a pose was given");
        timer.on_lap(3, 3.0, "hq");
        let void: Vec<_> = timer.laps().iter().map(|lap| lap.void).collect();
        assert_eq!(
            void,
            [None, Some("the pose has jumped"), Some("a pose was given")]
        );
        assert_eq!(LapTimer::best(timer.laps()), Some(7.0));
    }

    #[test]
    fn a_jump_passes_no_border() {
        let mut timer = LapTimer::default();
        timer.on_pose(passed(0, 5.0), LENGTH);
        timer.on_pose(passed(25_000_000, 15.0), LENGTH);
        timer.on_pose(passed(9_000_000_000, 16.0), LENGTH);
        timer.on_lap(1, 9.0, "lq");
        assert_eq!(timer.laps()[0].sectors_s, [None; SECTORS]);
    }

    #[test]
    fn slip_is_told_as_a_share_of_the_lap() {
        let mut timer = LapTimer::default();
        timer.on_pose(passed(0, 5.0), LENGTH);
        for slip in [0.0, 0.05, -0.3, 0.1] {
            let alignment = 0.8;
            timer.on_metrics(&Metrics {
                slip,
                alignment,
                ..Metrics::default()
            });
        }
        timer.on_lap(1, 9.0, "lq");
        let grip = timer.laps()[0].grip.expect("known");
        assert!((grip.slipping - 0.5).abs() < 1e-9 && (grip.worst_slip - 0.3).abs() < 1e-6);
        assert!((grip.alignment - 0.8).abs() < 1e-6);
    }
}
