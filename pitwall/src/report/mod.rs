//! Reports on a recording: laps, sectors, health over the lap, load, and the true error if the truth was recorded.
//!
//! [`Report::of`] computes the numbers. [`Report::to_html`] writes them with figures into one HTML file.
#![allow(
    clippy::format_push_string,
    reason = "the page is built once, so readability matters more than an allocation"
)]
mod figures;
mod html;
mod svg;
mod timeline;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use protocol::{CarName, MapReply, Pose2, State, Telemetry, Topic};
use serde::Serialize;

use crate::analysis::{AnalysisView, LapBook, LapData, SessionLaps};
use crate::event::{EventPayload, FleetEvent};
use crate::fleet::Fleet;
use crate::fleet::Lap;
use crate::recording::{InOrder, RecordingError, Survey, Unreadable, UnreadableCount, read_in_order};
use timeline::Timeline;

pub use timeline::Alarm;

/// The report on a recording.
#[derive(Debug, Clone, Serialize)]
pub struct Report {
    /// The recording.
    pub file: String,
    /// From the first event to the last \[s\].
    pub duration_s: f64,
    /// Each car by name.
    pub cars: Vec<CarReport>,
    /// Markers and actions of the operators, in order.
    pub notes: Vec<String>,
    /// The messages that cannot be decoded.
    pub unreadable: Vec<Unreadable>,
    #[serde(skip)]
    analysis: Option<(AnalysisView, Vec<(String, LapData)>)>,
}

/// One car.
#[derive(Debug, Clone, Serialize)]
pub struct CarReport {
    /// Its name.
    pub car: CarName,
    /// Its laps.
    pub laps: Vec<Lap>,
    /// Table I of the paper, with a row for each set.
    pub table: Vec<TableRow>,
    /// Share of the time in each state, in `[0, 1]`.
    pub states: BTreeMap<String, f64>,
    /// Critical log entries.
    pub alarms: usize,
    /// Error of the pose against the truth; None if no truth was recorded.
    pub truth: Option<TrueError>,
    /// Mean CPU of the node, 1 being one core; None without load messages.
    pub cpu: Option<f64>,
    /// The worst update time, 99th percentile over a second \[ms\]; None without load messages.
    pub update_p99_ms: Option<f64>,
    /// Messages that were sent and are not in the recording.
    pub missing: u64,
    /// The alarms with time and place.
    pub alarm_list: Vec<Alarm>,
    #[serde(skip)]
    series: Series,
    #[serde(skip)]
    timeline: Timeline,
    #[serde(skip)]
    book: LapBook,
}

/// A row of the paper's table I: the laps on one set.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TableRow {
    /// The set in force at the end of these laps.
    pub set: String,
    /// Number of laps.
    pub laps: usize,
    /// Laps of these that are void: the car stood still, a pose was given or the like. The figures below leave them out,
    /// unless there are no others.
    pub left_out: usize,
    /// Lap time, mean and standard deviation \[s\].
    pub time_s: MeanSigma,
    /// Lap time of the laps that count: quarter, median and three quarters \[s\]; None where no lap counts.
    pub quartiles_s: Option<[f64; 3]>,
    /// Mean distance of the estimate from the raceline, over the laps \[m\]; None without poses.
    pub lateral_m: Option<MeanSigma>,
    /// Mean alignment, in `[0, 1]`; None without health messages.
    pub alignment: Option<f64>,
}

/// A mean and the standard deviation of a sample.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct MeanSigma {
    /// The mean.
    pub mean: f64,
    /// The standard deviation; 0 for a single value.
    pub sigma: f64,
}

/// Error of the published pose against the truth, without the first two seconds of each run.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct TrueError {
    /// Poses compared.
    pub poses: usize,
    /// Root mean square distance \[m\].
    pub rmse_m: f64,
    /// Root mean square along the heading \[m\].
    pub along_m: f64,
    /// Root mean square across the heading \[m\].
    pub across_m: f64,
    /// Root mean square of the heading's error \[rad\].
    pub heading_rad: f64,
    /// Maximum distance \[m\].
    pub max_m: f64,
}

/// Data of the figures. Times are seconds since the recording's start.
#[derive(Debug, Clone, Default)]
struct Series {
    map: Option<std::sync::Arc<MapReply>>,
    length: Option<f64>,
    poses: Vec<PosePoint>,
    /// The run of the newest pose, and its first pose \[unix ns\].
    run: Option<(u64, i64)>,
    healths: Vec<HealthPoint>,
    loads: Vec<[f64; 3]>,
    truths: Vec<(i64, Pose2)>,
    coverage: Coverage,
}

/// Share of what a car sent that is in the recording, over time.
#[derive(Debug, Clone, Default)]
struct Coverage(Vec<[f64; 2]>);

impl Coverage {
    /// Cells of the curve.
    const CELLS: usize = 200;

    /// The curve over the recording; empty where nothing can be missing.
    fn of(survey: &Survey, car: &CarName) -> Self {
        let (Some((from, to)), Some(_)) = (survey.span, survey.offset(car)) else {
            return Self::default();
        };
        let length = ((to - from) as f64 * 1e-9).max(1e-3);
        let mut missing = vec![0.0; Self::CELLS];
        let mut sent = vec![0.0; Self::CELLS];
        let spread = |cells: &mut Vec<f64>, run_id: u64, begin: i64, end: i64, count: f64| {
            let offset = survey.offset_in(car, run_id);
            let place = |at: i64| {
                let share = at.saturating_sub(offset).saturating_sub(from) as f64 * 1e-9 / length;
                ((share * Self::CELLS as f64).max(0.0) as usize).min(Self::CELLS - 1)
            };
            let (begin, end) = (place(begin), place(end.max(begin)));
            for cell in &mut cells[begin..=end] {
                *cell += count / (end - begin + 1) as f64;
            }
        };
        for gap in survey.gaps(car) {
            let (Some(begin), Some(end)) = (gap.from, gap.to) else {
                continue;
            };
            spread(&mut missing, gap.run_id, begin, end, gap.count as f64);
            spread(&mut sent, gap.run_id, begin, end, gap.count as f64);
        }
        for (run_id, begin, end, count) in survey.received(car) {
            spread(&mut sent, run_id, begin, end, count as f64);
        }
        let cell = |i: usize| (i as f64 + 0.5) / Self::CELLS as f64 * length;
        let shares = (0..Self::CELLS).filter(|i| sent[*i] > 0.0);
        Self(shares.map(|i| [cell(i), 1.0 - missing[i] / sent[i]]).collect())
    }
}

/// A pose.
#[derive(Debug, Clone, Copy)]
struct PosePoint {
    sensor: i64,
    pose: Pose2,
    /// False in the first seconds of a run.
    settled: bool,
}

/// A health message.
#[derive(Debug, Clone, Copy)]
struct HealthPoint {
    at_s: f64,
    state: State,
    alignment: f64,
}

impl MeanSigma {
    /// None without a value.
    fn of(values: &[f64]) -> Option<Self> {
        let count = values.len() as f64;
        let mean = values.iter().sum::<f64>() / count;
        let squares: f64 = values.iter().map(|v| (v - mean).powi(2)).sum();
        (!values.is_empty()).then(|| Self {
            mean,
            sigma: if values.len() > 1 {
                (squares / (count - 1.0)).sqrt()
            } else {
                0.0
            },
        })
    }
}

impl Report {
    /// Reads a whole recording.
    pub fn of(path: &Path) -> Result<Self, RecordingError> {
        Self::with(path, &[])
    }

    /// Reads a whole recording, and from others the laps to compare with.
    pub fn with(path: &Path, others: &[PathBuf]) -> Result<Self, RecordingError> {
        let events = read(path)?.with_copies();
        let mut collector = Collector::new(events.survey());
        for other in others {
            collector.others.push(SessionLaps::of(other)?);
        }
        for event in events {
            collector.add(&event?);
        }
        collector
            .report(path)
            .ok_or_else(|| RecordingError::Empty(path.display().to_string()))
    }

    /// The report as one HTML page with its figures.
    pub fn to_html(&self) -> String {
        html::page(self)
    }
}

/// Reads the events that reports need, by the time of publishing.
pub(crate) fn read(path: &Path) -> Result<InOrder, RecordingError> {
    read_in_order(path, |topic| {
        let large = matches!(
            topic,
            Topic::RecordedOdometry | Topic::RecordedScan | Topic::Cloud
        );
        !large
    })
}

#[derive(Default)]
struct Collector {
    fleet: Fleet,
    timelines: BTreeMap<CarName, Timeline>,
    /// Laps of other recordings.
    others: Vec<SessionLaps>,
    /// Log entries that are noted.
    noted: u64,
    span: Option<(i64, i64)>,
    ticked: i64,
    series: BTreeMap<CarName, Series>,
    missing: BTreeMap<CarName, u64>,
    coverage: BTreeMap<CarName, Coverage>,
    unreadable: UnreadableCount,
}

impl Collector {
    fn new(survey: &Survey) -> Self {
        let mut collector = Self::default();
        for car in &survey.cars() {
            survey.prepare(&mut collector.fleet, car);
            collector.missing.insert(car.clone(), survey.missing_content(car));
            collector.coverage.insert(car.clone(), Coverage::of(survey, car));
        }
        collector
    }

    fn add(&mut self, event: &FleetEvent) {
        const TICK: i64 = 100_000_000;
        const LONG: i64 = 600_000_000_000;
        let (from, _) = *self.span.get_or_insert((event.at, event.at));
        self.span = Some((from, event.at.max(from)));
        // Time passes as it did, so that BLIND cars are noticed.
        self.ticked = self.ticked.max(from);
        while self.ticked + TICK < event.at {
            self.ticked += TICK;
            if event.at - self.ticked > LONG {
                // Everything that happens in silence has happened by then.
                self.ticked = event.at - TICK;
            }
            self.fleet.tick(self.ticked);
            let at_s = (self.ticked - from) as f64 * 1e-9;
            for car in self.fleet.cars() {
                let timeline = self.timelines.entry(car.name.clone()).or_default();
                timeline.note_state(car, self.ticked, at_s);
            }
            self.note_entries(at_s);
        }
        self.fleet.apply(event);
        self.unreadable.add(event);
        let at_s = (event.at - from) as f64 * 1e-9;
        self.note_entries(at_s);
        if let Some(car) = self.fleet.car(&event.car) {
            let timeline = self.timelines.entry(event.car.clone()).or_default();
            timeline.add(event, car, at_s);
        }
        let shows = |topic| self.fleet.car(&event.car).is_some_and(|car| car.shows(topic));
        let series = self.series.entry(event.car.clone()).or_default();
        let EventPayload::Message {
            topic,
            header,
            telemetry,
            ..
        } = &event.payload
        else {
            return;
        };
        match &**telemetry {
            Telemetry::Pose(_) | Telemetry::Health(_) if !shows(*topic) => {}
            Telemetry::Pose(pose) => {
                let first = match series.run {
                    Some((run, first)) if run == header.run_id => first,
                    _ => header.sensor,
                };
                series.run = Some((header.run_id, first));
                series.poses.push(PosePoint {
                    sensor: header.sensor,
                    pose: pose.pose,
                    settled: header.sensor - first >= SETTLING,
                });
            }
            Telemetry::Health(health) => {
                if let Some(metrics) = &health.metrics {
                    series.healths.push(HealthPoint {
                        at_s,
                        state: health.state,
                        alignment: f64::from(metrics.alignment),
                    });
                }
            }
            Telemetry::Load(load) => series.loads.push([
                at_s,
                f64::from(load.cpu_process),
                f64::from(load.update_us.p99) * 1e-3,
            ]),
            Telemetry::Truth(truth) => series.truths.push((header.sensor, truth.pose)),
            _ => {}
        }
    }

    /// Notes the alarms that are new in the log.
    fn note_entries(&mut self, at_s: f64) {
        for entry in self.fleet.log().since(self.noted) {
            if let Some(car) = entry.car.as_ref().and_then(|name| self.fleet.car(name)) {
                let timeline = self.timelines.entry(car.name.clone()).or_default();
                timeline.note_entry(entry, car, at_s);
            }
        }
        self.noted = self.fleet.log().last();
    }

    /// Laps and health over the track, with the data of every lap.
    fn analysis(&self, session: &SessionLaps, folder: &Path) -> (AnalysisView, Vec<(String, LapData)>) {
        let sessions: Vec<_> = std::iter::once(session).chain(&self.others).collect();
        let laps: Vec<_> = sessions.iter().flat_map(|session| session.cars()).collect();
        // The sectors that the engineer has kept beside the recordings.
        let tracks = crate::web::Tracks::new(folder);
        let view = AnalysisView::of(&laps, |line| tracks.of(line).sectors);
        let data = view
            .laps
            .iter()
            .filter_map(|lap| Some((lap.id.clone(), AnalysisView::data(&laps, &lap.id)?)));
        let data = data.collect();
        (view, data)
    }

    fn report(mut self, path: &Path) -> Option<Report> {
        let (from, to) = self.span?;
        let session = SessionLaps::new(path, &self.fleet);
        let books: BTreeMap<CarName, LapBook> = session
            .cars()
            .map(|car| (car.car.clone(), car.book.clone()))
            .collect();
        let folder = path.parent().unwrap_or_else(|| Path::new("."));
        let analysis = self.analysis(&session, folder);
        let mut cars = Vec::new();
        for (name, mut series) in self.series {
            let car = self.fleet.car(&name)?;
            series.poses.sort_by_key(|point| point.sensor);
            series.truths.sort_by_key(|(at, _)| *at);
            series.map = car.map.as_ref().map(|(map, _)| map.clone());
            series.length = car.lap_length();
            series.coverage = self.coverage.remove(&name).unwrap_or_default();
            let timeline = self.timelines.remove(&name).unwrap_or_default();
            let book = books.get(&name).cloned().unwrap_or_default();
            let mean = |i: usize| {
                let count = series.loads.len();
                (count > 0).then(|| series.loads.iter().map(|load| load[i]).sum::<f64>() / count as f64)
            };
            cars.push(CarReport {
                laps: car.laps().to_vec(),
                table: table(car.laps()),
                states: states(&series.healths),
                alarms: timeline.alarms.len(),
                alarm_list: timeline.alarms.clone(),
                truth: true_error(&series.poses, &series.truths),
                cpu: mean(1),
                update_p99_ms: series.loads.iter().map(|load| load[2]).max_by(f64::total_cmp),
                missing: self.missing.get(&name).copied().unwrap_or_default(),
                car: name,
                series,
                timeline,
                book,
            });
        }
        let notes = self
            .fleet
            .log()
            .since(0)
            .filter(|line| line.who.is_some() && line.kind != "lap")
            .map(|line| {
                let car = line
                    .car
                    .as_ref()
                    .map_or_else(String::new, |car| format!("{car} "));
                let who = line.who.as_deref().unwrap_or_default();
                format!(
                    "{:.1} s: {car}{} [{who}]",
                    (line.at - from) as f64 * 1e-9,
                    line.text
                )
            })
            .collect();
        Some(Report {
            file: path.display().to_string(),
            duration_s: (to - from) as f64 * 1e-9,
            cars,
            notes,
            unreadable: self.unreadable.list(),
            analysis: Some(analysis),
        })
    }
}

fn table(laps: &[Lap]) -> Vec<TableRow> {
    let mut sets: BTreeMap<&str, Vec<&Lap>> = BTreeMap::new();
    for lap in laps {
        sets.entry(&lap.set).or_default().push(lap);
    }
    let row = |(set, laps): (&str, Vec<&Lap>)| {
        let good: Vec<&Lap> = laps.iter().filter(|lap| lap.void.is_none()).copied().collect();
        let counted: Vec<f64> = good.iter().map(|lap| lap.time_s).collect();
        // Void laps have no part in the means, unless there are no others.
        let used = if good.is_empty() { &laps } else { &good };
        let values = |value: &dyn Fn(&Lap) -> Option<f64>| {
            let values: Vec<f64> = used.iter().filter_map(|lap| value(lap)).collect();
            MeanSigma::of(&values)
        };
        Some(TableRow {
            set: set.to_owned(),
            laps: laps.len(),
            left_out: laps.len() - counted.len(),
            time_s: values(&|lap| Some(lap.time_s))?,
            quartiles_s: quartiles(counted),
            lateral_m: values(&|lap| lap.lateral_m),
            alignment: values(&|lap| Some(lap.grip?.alignment)).map(|alignment| alignment.mean),
        })
    };
    sets.into_iter().filter_map(row).collect()
}

/// A quarter, half and three quarters of the values are not greater, interpolated; None without a value.
fn quartiles(mut values: Vec<f64>) -> Option<[f64; 3]> {
    values.sort_by(f64::total_cmp);
    let last = values.len().checked_sub(1)?;
    Some([0.25, 0.5, 0.75].map(|share| {
        let at = share * last as f64;
        let (low, high) = (values[at.floor() as usize], values[at.ceil() as usize]);
        low + at.fract() * (high - low)
    }))
}

/// Share of each state. A state lasts from one health message to the next, but not over a pause.
fn states(healths: &[HealthPoint]) -> BTreeMap<String, f64> {
    const PAUSE_S: f64 = 1.0;
    let mut lasted: BTreeMap<String, f64> = BTreeMap::new();
    for pair in healths.windows(2) {
        let time = pair[1].at_s - pair[0].at_s;
        // In a recording of an older version the laptop's clock may have been set back.
        if (0.0..PAUSE_S).contains(&time) {
            *lasted.entry(pair[0].state.to_string()).or_default() += time;
        }
    }
    let all: f64 = lasted.values().sum();
    lasted
        .into_iter()
        .map(|(state, time)| (state, time / all.max(1e-9)))
        .collect()
}

/// The truth at a time, interpolated linearly; None if a sample is further than 50 ms away.
fn truth_at(truths: &[(i64, Pose2)], at: i64) -> Option<Pose2> {
    const NEAR: i64 = 50_000_000;
    let after = truths.partition_point(|(t, _)| *t < at);
    let (t1, b) = *truths.get(after)?;
    if t1 == at {
        return Some(b);
    }
    let (t0, a) = *truths.get(after.checked_sub(1)?)?;
    let share = (at - t0) as f64 / (t1 - t0) as f64;
    (at - t0 <= NEAR && t1 - at <= NEAR).then(|| Pose2 {
        x: a.x + share * (b.x - a.x),
        y: a.y + share * (b.y - a.y),
        heading: a.heading + share * maps::wrap_angle(b.heading - a.heading),
    })
}

/// `[distance, along, across, heading]` of a pose minus the truth \[m, m, m, rad\].
fn error_of(point: &PosePoint, truths: &[(i64, Pose2)]) -> Option<[f64; 4]> {
    let truth = truth_at(truths, point.sensor)?;
    let (dx, dy) = (point.pose.x - truth.x, point.pose.y - truth.y);
    let (sin, cos) = truth.heading.sin_cos();
    let heading = maps::wrap_angle(point.pose.heading - truth.heading);
    Some([dx.hypot(dy), cos * dx + sin * dy, cos * dy - sin * dx, heading])
}

/// The first poses of a run do not count: the localizer starts from a given pose. `car-node race` and `evaluate` have the same
/// rule \[ns\].
const SETTLING: i64 = 2_000_000_000;

fn true_error(poses: &[PosePoint], truths: &[(i64, Pose2)]) -> Option<TrueError> {
    let settled = poses.iter().filter(|point| point.settled);
    let errors: Vec<_> = settled.filter_map(|point| error_of(point, truths)).collect();
    let rms = |i: usize| (errors.iter().map(|e| e[i].powi(2)).sum::<f64>() / errors.len() as f64).sqrt();
    (!errors.is_empty()).then(|| TrueError {
        poses: errors.len(),
        rmse_m: rms(0),
        along_m: rms(1),
        across_m: rms(2),
        heading_rad: rms(3),
        max_m: errors.iter().map(|e| e[0]).fold(0.0, f64::max),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fleet::LapGrip;

    fn lap(lap: u32, time_s: f64, set: &str) -> Lap {
        Lap {
            lap,
            time_s,
            void: None,
            set: set.into(),
            sectors_s: [None; 3],
            grip: Some(LapGrip {
                slipping: 0.0,
                worst_slip: 0.0,
                alignment: 0.9,
            }),
            lateral_m: Some(0.1),
        }
    }

    #[test]
    fn table_one_has_a_row_for_each_set() {
        let laps = [lap(1, 9.0, "hq"), lap(2, 9.2, "hq"), lap(3, 10.0, "lq")];
        let rows = table(&laps);
        assert_eq!(rows.len(), 2);
        assert!(
            rows[0]
                .quartiles_s
                .is_some_and(|[_, median, _]| (median - 9.1).abs() < 1e-9)
        );
        let hq = &rows[0];
        assert_eq!((hq.set.as_str(), hq.laps), ("hq", 2));
        assert!((hq.time_s.mean - 9.1).abs() < 1e-9 && (hq.time_s.sigma - 0.02_f64.sqrt()).abs() < 1e-9);
        assert_eq!(
            rows[1].time_s,
            MeanSigma {
                mean: 10.0,
                sigma: 0.0
            }
        );
        assert!(table(&[]).is_empty());
    }

    /// One lap with a spin made the spread of all laps as large as a lap is long.
    #[test]
    fn a_lap_that_does_not_count_is_left_out_of_the_median() {
        let mut laps: Vec<Lap> = [9.0, 9.1, 15.8, 9.2]
            .iter()
            .zip(1..)
            .map(|(t, i)| lap(i, *t, "hq"))
            .collect();
        laps[2].void = Some("the car stood still");
        let row = &table(&laps)[0];
        assert_eq!((row.laps, row.left_out), (4, 1));
        let [low, median, high] = row.quartiles_s.expect("three laps");
        assert!((median - 9.1).abs() < 1e-9 && (low - 9.05).abs() < 1e-9 && (high - 9.15).abs() < 1e-9);
        assert_eq!(table(&laps[2..3])[0].quartiles_s, None);
    }

    #[test]
    fn error_is_split_along_and_across_the_heading() {
        let quarter = std::f64::consts::FRAC_PI_2;
        let at = |x, y| Pose2 {
            x,
            y,
            heading: quarter,
        };
        let truths = [(0, at(0.0, 0.0)), (20_000_000, at(0.0, 0.2))];
        let point = |sensor, x, y| PosePoint {
            sensor,
            pose: at(x, y),
            settled: true,
        };
        // Half way the truth is at y = 0.1; the pose is 0.03 behind it and 0.04 to its right.
        let error = true_error(&[point(10_000_000, 0.04, 0.07)], &truths).expect("compared");
        assert!((error.along_m - 0.03).abs() < 1e-9 && (error.across_m - 0.04).abs() < 1e-9);
        assert!((error.rmse_m - 0.05).abs() < 1e-9 && error.heading_rad.abs() < 1e-9);
        assert_eq!(
            true_error(&[point(500_000_000, 0.0, 0.0)], &truths),
            None,
            "the truth had ended"
        );
    }

    #[test]
    fn a_state_lasts_until_the_next_message_but_not_over_a_pause() {
        let point = |at_s, state| HealthPoint {
            at_s,
            state,
            alignment: 1.0,
        };
        let shares = states(&[
            point(0.0, State::Localized),
            point(0.3, State::Lost),
            point(0.4, State::Localized),
            point(60.0, State::Localized),
        ]);
        assert!((shares["LOCALIZED"] - 0.75).abs() < 1e-9 && (shares["LOST"] - 0.25).abs() < 1e-9);
    }
}
