//! What is measured during a race, and its summary.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use maps::Pose;
use serde::Serialize;
use simulator::Track;
use synpf::{Scan, Stamp, TrackMap};

use super::paper_alignment;
use crate::evaluate::{PoseErrors, StateTruth, States, Summaries};
use crate::health::State;
use crate::statistics::{MeanSigma, mean, percentile};

/// One finished lap.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct LapRecord {
    /// Lap time \[s\].
    pub time_s: f64,
    /// Mean distance of the *estimate* from the raceline, as the paper defines it \[m\].
    pub line_error_m: f64,
    /// Mean distance of the car from the raceline \[m\].
    pub true_line_error_m: f64,
    /// Mean scan alignment by the paper's definition, in [0, 1].
    pub alignment_paper: f64,
}

/// Mean deviations on one stretch of the track.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Stretch {
    /// Arc length of its middle along the raceline \[m\].
    pub s_m: f64,
    /// Mean distance of the *estimate* from the raceline \[m\].
    pub line_error_m: f64,
    /// Mean distance of the car from the raceline \[m\].
    pub true_line_error_m: f64,
}

/// Stretches that a track is cut into.
const STRETCHES: usize = 80;

/// Sums over the stretches of a track: distances of the estimate and of the car from the raceline, and their number.
#[derive(Debug, Clone)]
struct StretchSums {
    length: f64,
    sums: Vec<[f64; 3]>,
}

impl StretchSums {
    fn new(length: f64) -> Self {
        Self {
            length,
            sums: vec![[0.0; 3]; STRETCHES],
        }
    }

    fn add(&mut self, s: f64, line_error: f64, true_line_error: f64) {
        let share = (s / self.length).rem_euclid(1.0);
        if let Some(sums) = self.sums.get_mut((share * STRETCHES as f64) as usize) {
            *sums = [sums[0] + line_error, sums[1] + true_line_error, sums[2] + 1.0];
        }
    }

    /// The stretches that were driven on.
    fn means(&self) -> Vec<Stretch> {
        let per_stretch = self.length / STRETCHES as f64;
        let driven = self.sums.iter().enumerate().filter(|(_, sums)| sums[2] > 0.0);
        driven
            .map(|(i, [estimated, driven, count])| Stretch {
                s_m: (i as f64 + 0.5) * per_stretch,
                line_error_m: estimated / count,
                true_line_error_m: driven / count,
            })
            .collect()
    }
}

/// Means over the cars, stretch by stretch.
fn mean_stretches(cars: &[CarResult]) -> Vec<Stretch> {
    let all = || cars.iter().flat_map(|car| &car.along_track);
    let mut places: Vec<f64> = all().map(|stretch| stretch.s_m).collect();
    places.sort_by(f64::total_cmp);
    places.dedup_by(|a, b| (*a - *b).abs() < 1e-9);
    places
        .into_iter()
        .map(|s_m| {
            let here: Vec<&Stretch> = all().filter(|stretch| (stretch.s_m - s_m).abs() < 1e-9).collect();
            let mean = |value: fn(&Stretch) -> f64| {
                here.iter().map(|stretch| value(stretch)).sum::<f64>() / here.len() as f64
            };
            Stretch {
                s_m,
                line_error_m: mean(|stretch| stretch.line_error_m),
                true_line_error_m: mean(|stretch| stretch.true_line_error_m),
            }
        })
        .collect()
}

/// CPU time of the localizer on this machine.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct LoadSummary {
    /// CPU seconds of the localizer per second of the race.
    pub cpu: f64,
    /// Whole update, median \[us\].
    pub update_us_p50: f64,
    /// Whole update, 99th percentile \[us\].
    pub update_us_p99: f64,
    /// Seconds of the race per second of computing, with the simulator.
    pub real_time_factor: f64,
}

/// The kinds of mishaps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum MishapKind {
    /// The car hit a wall and had to be put back.
    Crash,
    /// The car touched a wall and drove on.
    Scrape,
    /// The car touched another car.
    Collision,
    /// The car spun.
    Spin,
}

/// A mishap, with values that show its cause.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Mishap {
    /// Time since the start of the race \[s\].
    pub at_s: f64,
    /// Its kind.
    pub kind: MishapKind,
    /// Arc length along the raceline \[m\].
    pub s_m: f64,
    /// Distance from the raceline, left positive \[m\].
    pub d_m: f64,
    /// Speed of the impact [m/s].
    pub impact_mps: f64,
    /// False while the car was being turned round after a spin.
    pub racing: bool,
    /// Error of the estimate at the last scan \[m\]; None without one.
    pub pose_error_m: Option<f64>,
}

/// The result of one car.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CarResult {
    /// True when all laps were driven in time.
    pub finished: bool,
    /// The laps, in order.
    pub laps: Vec<LapRecord>,
    /// Deviation along the track, over all laps.
    pub along_track: Vec<Stretch>,
    /// Crashes: the car hit a wall and had to be put back.
    pub crashes: u32,
    /// Scrapes: the car touched a wall and drove on.
    pub scrapes: u32,
    /// Collisions: the car touched another car.
    pub collisions: u32,
    /// Spins.
    pub spins: u32,
    /// All mishaps, in order.
    pub mishaps: Vec<Mishap>,
    /// Errors of the estimate at the stamps of the scans, without the first 2 s; None without an estimate.
    pub pose_error: Option<Summaries>,
    /// Mean scan alignment by the localizer's own definition (0.10 m), in [0, 1]; None where there is no localizer.
    pub alignment: Option<f64>,
    /// Share of the updates in each health state; empty where there is no localizer.
    pub states: BTreeMap<State, f64>,
    /// How often the states were right.
    pub state_truth: Option<StateTruth>,
    /// Searches of the map: the localizer gave its pose up.
    pub searches: usize,
    /// Duration of the race \[s\].
    pub race_s: f64,
    /// Load on this machine; differs from run to run.
    pub load: LoadSummary,
}

/// The summary of all cars of all seeds.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RaceSummary {
    /// Cars that drove all their laps.
    pub finished: usize,
    /// Cars that started.
    pub started: usize,
    /// Laps driven.
    pub laps: usize,
    /// Lap time \[s\].
    pub lap_time_s: Option<MeanSigma>,
    /// Per lap: mean distance of the estimate from the raceline \[m\].
    pub line_error_m: Option<MeanSigma>,
    /// Per lap: mean distance of the car from the raceline \[m\].
    pub true_line_error_m: Option<MeanSigma>,
    /// Root mean square of the position error over the cars \[m\].
    pub position_rmse_m: Option<f64>,
    /// Largest position error \[m\].
    pub position_max_m: Option<f64>,
    /// Root mean square of the heading error \[rad\].
    pub heading_rmse_rad: Option<f64>,
    /// Scan alignment by the paper's definition, in [0, 1].
    pub alignment_paper: Option<f64>,
    /// Scan alignment by the localizer's own definition, in [0, 1].
    pub alignment: Option<f64>,
    /// Share of the updates in each health state; empty where there is no localizer.
    pub states: BTreeMap<State, f64>,
    /// Updates of all cars in state LOST within 0.2 m and 2 deg of the truth.
    pub false_lost: usize,
    /// Updates of all cars in state LOCALIZED more than 1 m from the truth.
    pub false_localized: usize,
    /// Searches of the map by all cars.
    pub searches: usize,
    /// Crashes of all cars.
    pub crashes: u32,
    /// Scrapes of all cars.
    pub scrapes: u32,
    /// Collisions of all cars; each counts for both cars.
    pub collisions: u32,
    /// Spins of all cars.
    pub spins: u32,
    /// Means over the cars.
    pub load: LoadSummary,
    /// Deviation along the track, mean over the cars.
    pub along_track: Vec<Stretch>,
    /// Every lap of every car, in order.
    pub every_lap: Vec<LapRecord>,
}

impl RaceSummary {
    /// Summarizes any number of cars.
    pub fn of(cars: &[CarResult]) -> Self {
        let laps: Vec<LapRecord> = cars.iter().flat_map(|car| car.laps.iter().copied()).collect();
        let over_laps = |value: fn(&LapRecord) -> f64| laps.iter().map(value).collect::<Vec<_>>();
        let errors: Vec<Summaries> = cars.iter().filter_map(|car| car.pose_error).collect();
        let rms = |value: fn(&Summaries) -> f64| {
            mean(&errors.iter().map(|e| value(e).powi(2)).collect::<Vec<_>>()).map(f64::sqrt)
        };
        let load = |value: fn(&LoadSummary) -> f64| {
            mean(&cars.iter().map(|car| value(&car.load)).collect::<Vec<_>>()).unwrap_or_default()
        };
        let mut states: BTreeMap<State, f64> = BTreeMap::new();
        let watched = cars.iter().filter(|car| !car.states.is_empty()).count();
        for (state, share) in cars.iter().flat_map(|car| &car.states) {
            *states.entry(*state).or_default() += share / watched as f64;
        }
        let wrong = |count: fn(&StateTruth) -> usize| {
            let judged = cars.iter().filter_map(|car| car.state_truth.as_ref());
            judged.map(count).sum()
        };
        let aligned: Vec<f64> = cars.iter().filter_map(|car| car.alignment).collect();
        Self {
            finished: cars.iter().filter(|car| car.finished).count(),
            started: cars.len(),
            laps: laps.len(),
            lap_time_s: MeanSigma::of(&over_laps(|lap| lap.time_s)),
            line_error_m: MeanSigma::of(&over_laps(|lap| lap.line_error_m)),
            true_line_error_m: MeanSigma::of(&over_laps(|lap| lap.true_line_error_m)),
            position_rmse_m: rms(|e| e.position_error_m.rmse),
            position_max_m: errors.iter().map(|e| e.position_error_m.max).reduce(f64::max),
            heading_rmse_rad: rms(|e| e.heading_error_rad.rmse),
            alignment_paper: mean(&over_laps(|lap| lap.alignment_paper)),
            alignment: mean(&aligned),
            states,
            false_lost: wrong(|truth| truth.false_lost),
            false_localized: wrong(|truth| truth.false_localized),
            searches: cars.iter().map(|car| car.searches).sum(),
            crashes: cars.iter().map(|car| car.crashes).sum(),
            scrapes: cars.iter().map(|car| car.scrapes).sum(),
            collisions: cars.iter().map(|car| car.collisions).sum(),
            spins: cars.iter().map(|car| car.spins).sum(),
            load: LoadSummary {
                cpu: load(|l| l.cpu),
                update_us_p50: load(|l| l.update_us_p50),
                update_us_p99: load(|l| l.update_us_p99),
                real_time_factor: load(|l| l.real_time_factor),
            },
            along_track: mean_stretches(cars),
            every_lap: laps,
        }
    }
}

/// The measurements of one car during a race.
pub(super) struct CarMeasurements {
    track: Arc<Track>,
    map: Arc<TrackMap>,
    finished: Vec<LapRecord>,
    mishaps: Vec<Mishap>,
    /// Error of the estimate at the last scan \[m\].
    pose_error: Option<f64>,
    /// True once the car has crossed the start line. The way there belongs to no lap.
    pub(super) on_a_lap: bool,
    pose_errors: PoseErrors,
    states: States,
    along_track: StretchSums,
    /// Of the lap being driven: distances of the estimate and of the car from the raceline.
    line_errors: Vec<f64>,
    true_line_errors: Vec<f64>,
    alignments_paper: Vec<f64>,
    alignments: Vec<f64>,
    update_us: Vec<f64>,
    busy: Duration,
}

impl CarMeasurements {
    pub(super) fn new(track: Arc<Track>, map: Arc<TrackMap>) -> Self {
        Self {
            along_track: StretchSums::new(track.raceline.length()),
            track,
            map,
            finished: Vec::new(),
            mishaps: Vec::new(),
            pose_error: None,
            on_a_lap: false,
            pose_errors: PoseErrors::default(),
            states: States::default(),
            line_errors: Vec::new(),
            true_line_errors: Vec::new(),
            alignments_paper: Vec::new(),
            alignments: Vec::new(),
            update_us: Vec::new(),
            busy: Duration::ZERO,
        }
    }

    pub(super) fn laps(&self) -> usize {
        self.finished.len()
    }

    /// Measures the time of a part of an update.
    pub(super) fn timed<T>(&mut self, work: impl FnOnce() -> T) -> T {
        let begin = Instant::now();
        let result = work();
        self.busy += begin.elapsed();
        result
    }

    /// Measures the time of a whole update.
    pub(super) fn timed_update<T>(&mut self, work: impl FnOnce() -> T) -> T {
        let before = self.busy;
        let result = self.timed(work);
        self.update_us
            .push(self.busy.saturating_sub(before).as_secs_f64() * 1e6);
        result
    }

    /// The driver got `estimate`, and the car was at `s` \[m\] along the raceline, `true_d` \[m\] from it.
    pub(super) fn driven(&mut self, estimate: Pose, s: f64, true_d: f64) {
        if !self.on_a_lap {
            return;
        }
        let d = self.track.raceline.project([estimate.x, estimate.y]).d;
        self.line_errors.push(d.abs());
        self.true_line_errors.push(true_d.abs());
        self.along_track.add(s, d.abs(), true_d.abs());
    }

    /// A scan led to `estimate`. Estimate and truth are those at its stamp.
    pub(super) fn scanned(
        &mut self,
        scan: &Scan,
        estimate: Pose,
        twist: [f64; 2],
        truth: Option<Pose>,
        alignment: Option<f64>,
        base_link_from_laser: Pose,
    ) {
        self.pose_errors.push(scan.stamp, estimate, truth);
        self.pose_error = truth.map(|truth| estimate.distance(truth));
        if !self.on_a_lap {
            return;
        }
        self.alignments_paper.push(paper_alignment(
            &self.map,
            scan,
            estimate,
            twist,
            base_link_from_laser,
        ));
        self.alignments.extend(alignment);
    }

    /// The health state of the estimate at a scan's stamp.
    pub(super) fn judged(&mut self, stamp: Stamp, state: State, estimate: Pose, truth: Option<Pose>) {
        self.states.push(stamp, state, estimate, truth);
    }

    /// Records a mishap, and adds the error of the estimate.
    pub(super) fn mishap(&mut self, mishap: Mishap) {
        self.mishaps.push(Mishap {
            pose_error_m: self.pose_error,
            ..mishap
        });
    }

    /// A lap ended.
    pub(super) fn lap(&mut self, time: Duration) {
        let mut taken =
            |values: fn(&mut Self) -> &mut Vec<f64>| mean(&std::mem::take(values(self))).unwrap_or_default();
        let lap = LapRecord {
            time_s: time.as_secs_f64(),
            line_error_m: taken(|r| &mut r.line_errors),
            true_line_error_m: taken(|r| &mut r.true_line_errors),
            alignment_paper: taken(|r| &mut r.alignments_paper),
        };
        self.finished.push(lap);
    }

    pub(super) fn result(mut self, race: Duration, elapsed: Duration, laps: Option<u32>) -> CarResult {
        let laps = laps.map_or(self.finished.len(), |laps| laps as usize);
        let finished = self.finished.len() >= laps;
        self.finished.truncate(laps);
        let count = |kind| self.mishaps.iter().filter(|mishap| mishap.kind == kind).count() as u32;
        CarResult {
            finished,
            laps: self.finished,
            along_track: self.along_track.means(),
            crashes: count(MishapKind::Crash),
            scrapes: count(MishapKind::Scrape),
            collisions: count(MishapKind::Collision),
            spins: count(MishapKind::Spin),
            mishaps: self.mishaps,
            pose_error: self.pose_errors.summaries(),
            alignment: mean(&self.alignments),
            states: self.states.shares(),
            state_truth: self.states.truth(),
            searches: self.states.entered(State::Relocalizing),
            race_s: race.as_secs_f64(),
            load: LoadSummary {
                cpu: self.busy.as_secs_f64() / race.as_secs_f64(),
                update_us_p50: percentile(&self.update_us, 0.5).unwrap_or_default(),
                update_us_p99: percentile(&self.update_us, 0.99).unwrap_or_default(),
                real_time_factor: race.as_secs_f64() / elapsed.as_secs_f64().max(1e-9),
            },
        }
    }
}
