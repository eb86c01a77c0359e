//! The state machine.

use std::collections::HashMap;

use localizer::ScanFit;
use synpf::{Dropped, Mode, SensorFindings, Stamp, Update};

use super::causes::CauseSources;
use super::pose_ages::PoseAges;
use super::rules::{Evidence, Family, Finding, findings};
use super::sensor_silence::SensorSilence;
use super::{Cause, CauseKind, Metrics, State, Thresholds};

/// The state, and what it was concluded from.
#[derive(Debug, Clone, PartialEq)]
pub struct Verdict {
    /// The state.
    pub state: State,
    /// When it was entered, on the sensors' clock.
    pub since: Stamp,
    /// Why, the worst first; empty when nothing is wrong.
    pub causes: Vec<Cause>,
    /// The last update; 0 before the first.
    pub update: u64,
    /// What was measured at it; None before the first.
    pub metrics: Option<Metrics>,
}

/// A jump of the odometry or of the pose stays in the list of causes for this long \[s\].
const JUMP_SHOWN: f64 = 3.0;

/// Judges one localizer, update by update.
#[derive(Debug)]
pub struct Monitor {
    thresholds: Thresholds,
    verdict: Verdict,
    silence: SensorSilence,
    /// Findings of the last update.
    findings: Vec<Finding>,
    /// Since when each kind has been found in every update.
    found_since: HashMap<CauseKind, Stamp>,
    /// The fit, smoothed over the longer and the shorter time.
    fit: Option<[ScanFit; 2]>,
    /// Since when each family of evidence has been against the pose.
    lost_since: [Option<Stamp>; Family::COUNT],
    /// Since when the scan has been so far off the walls that nothing else is needed.
    wrong_since: Option<Stamp>,
    /// The localizer has given its pose up with the last scan.
    gave_up: bool,
    /// The localizer has good reason to believe its pose, however badly scans fit.
    trusted: bool,
    /// Since when nothing has been wrong.
    good_since: Option<Stamp>,
    /// Distance driven since the state was entered and since anything was wrong \[m\].
    driven: f64,
    last_update: Option<Stamp>,
    /// Since when every scan has been refused, and when the last one was.
    refused: Option<[Stamp; 2]>,
    /// Since when scans repeat.
    repeating_since: Option<Stamp>,
    /// What the localizer has found to be wrong with its sensors.
    sensors: SensorFindings,
    ages: PoseAges,
    /// How long a scan takes, from its first beam to its last \[s\].
    sweep: f64,
    /// The last jump of the odometry: when, and how far \[m\].
    odometry_jump: Option<(Stamp, f64)>,
    /// The last jump of a pose that was trusted: when, and how far \[m\].
    pose_jump: Option<(Stamp, f64)>,
    /// When the sensors' clock was set last, and by how much \[s\].
    clock_step: Option<(Stamp, f64)>,
    map_differs: f64,
    /// The state is LOST because the localizer gave its pose up, by a jump or a search, and for nothing else.
    given_up: bool,
    /// The state before STALE.
    before_stale: State,
}

/// A pose at which so much more of a scan lies on walls than before is another one, in [0, 1].
const FOUND: f64 = 0.5;

impl Monitor {
    /// A monitor of a localizer that has no pose yet. `now` is on the sensors' clock.
    pub fn new(thresholds: Thresholds, now: Stamp) -> Self {
        Self {
            thresholds,
            verdict: Verdict {
                state: State::Init,
                since: now,
                causes: Vec::new(),
                update: 0,
                metrics: None,
            },
            silence: SensorSilence::default(),
            findings: Vec::new(),
            found_since: HashMap::new(),
            fit: None,
            lost_since: [None; Family::COUNT],
            wrong_since: None,
            gave_up: false,
            trusted: false,
            good_since: None,
            driven: 0.0,
            last_update: None,
            refused: None,
            repeating_since: None,
            sensors: SensorFindings::default(),
            ages: PoseAges::default(),
            sweep: 0.0,
            odometry_jump: None,
            pose_jump: None,
            clock_step: None,
            map_differs: 0.0,
            given_up: false,
            before_stale: State::Init,
        }
    }

    /// The limits in force.
    pub fn thresholds(&self) -> &Thresholds {
        &self.thresholds
    }

    /// The latest verdict.
    pub fn verdict(&self) -> &Verdict {
        &self.verdict
    }

    /// Odometry came in at `now`.
    pub fn on_odometry(&mut self, now: Stamp) {
        self.silence.on_odometry(now);
    }

    /// A scan came in at `now`, and the localizer refused it. One that repeats the scan before counts as none.
    pub fn on_refused_scan(&mut self, now: Stamp, why: Dropped) {
        if why == Dropped::RepeatedScan {
            self.repeating_since.get_or_insert(now);
            if self.verdict.state == State::Localized {
                self.enter(State::Degraded, now);
            }
            self.verdict.causes = self.causes(self.silent(now), now);
            return;
        }
        self.silence.on_scan(now);
        let [first, _] = self.refused.unwrap_or([now; 2]);
        self.refused = Some([first, now]);
    }

    /// The clock that every `now` is read from was moved forwards by this \[s\]. What is kept of it moves along.
    pub fn on_clock_moved(&mut self, by: f64) {
        self.silence.on_clock_moved(by);
        // These were measured by the clock as it was.
        self.ages = PoseAges::default();
        let kept = [
            Some(&mut self.verdict.since),
            self.repeating_since.as_mut(),
            self.odometry_jump.as_mut().map(|(at, _)| at),
            self.pose_jump.as_mut().map(|(at, _)| at),
            self.clock_step.as_mut().map(|(at, _)| at),
        ];
        for at in kept
            .into_iter()
            .flatten()
            .chain(self.refused.iter_mut().flatten())
        {
            *at = at.plus(by);
        }
    }

    /// The sensors' clock was set by this, back if negative \[s\]; stamps go on as before.
    pub fn on_clock_step(&mut self, now: Stamp, by: f64) {
        self.clock_step = Some((now, by));
    }

    /// The map differs from what the laser sees over this length in all \[m\].
    pub fn on_map_differs(&mut self, length: f64) {
        self.map_differs = length;
    }

    /// The localizer was given a new pose.
    pub fn on_new_pose(&mut self, now: Stamp) {
        self.last_update = None;
        self.enter(State::Converging, now);
    }

    /// A search of the whole map has begun.
    pub fn on_search(&mut self, now: Stamp) {
        self.last_update = None;
        self.enter(State::Relocalizing, now);
    }

    /// The scan of the next update took this long, from its first beam to its last \[s\]. No pose at its first beam can be younger.
    pub fn on_sweep(&mut self, seconds: f64) {
        self.sweep = if seconds.is_finite() {
            seconds.max(0.0)
        } else {
            0.0
        };
    }

    /// A scan led to an update; its pose was ready at `now`.
    pub fn on_update(&mut self, update: &Update, now: Stamp) -> &Verdict {
        self.silence.on_scan(now);
        self.refused = None;
        self.repeating_since = None;
        self.sensors = update.sensors;
        if let Some([distance, _]) = update.odometry_jump {
            self.odometry_jump = Some((now, distance));
        }
        let pose_jump = self.pose_jump(update);
        if let Some(distance) = pose_jump {
            self.pose_jump = Some((now, distance));
        }
        // The fit before a jump is that of another pose; so is that before the localizer gave its pose up for one that fits.
        let fits = |[_, fast]: [ScanFit; 2]| update.alignment > fast.alignment + FOUND;
        if pose_jump.is_some() || self.fit.is_some_and(fits) {
            self.fit = None;
        }
        // STALE ends first, so that this scan already counts for the state after it.
        let silent = self.silent(now);
        self.stale_or_not(!silent.is_empty(), now);
        let mut metrics = Metrics::of(update);
        self.ages.add(update.stamp, now);
        [metrics.age_p50, metrics.age_p99] = self.ages.percentiles();
        let [slow, fast] = self.smooth(update.scan_fit(), update.stamp);
        let evidence = Evidence {
            metrics: &metrics,
            slow,
            fast,
            doubt: update.doubt,
            good: self.verdict.state == State::Localized,
        };
        let limits = Thresholds {
            age: self
                .thresholds
                .age
                .max(self.sweep + self.thresholds.age_after_sweep),
            ..self.thresholds
        };
        self.findings = findings(&evidence, &limits);
        self.note_times(fast, update.stamp);
        // Driven by odometry: a wrong pose moves about even while the car stands.
        if let (Some(_), Some(last)) = (self.good_since, self.last_update) {
            self.driven += update.twist.linear_x.abs() * update.stamp.since(last).max(0.0);
        } else {
            self.driven = 0.0;
        }
        metrics.alignment = slow.alignment;
        metrics.residual = slow.residual;
        self.last_update = Some(update.stamp);
        self.verdict.update = update.number;
        self.verdict.metrics = Some(metrics);
        self.gave_up = update.mode == Mode::Searching;
        self.trusted = update.trust.is_some_and(|trust| trust >= self.thresholds.trusted);
        self.advance(update.mode, pose_jump.is_some(), update.stamp, now);
        self.verdict.causes = self.causes(silent, now);
        &self.verdict
    }

    /// Enters STALE when sensor data is missing at `now`, and renews the causes.
    pub fn tick(&mut self, now: Stamp) -> &Verdict {
        let silent = self.silent(now);
        self.stale_or_not(!silent.is_empty(), now);
        self.verdict.causes = self.causes(silent, now);
        &self.verdict
    }

    /// Enters or leaves STALE.
    fn stale_or_not(&mut self, silent: bool, now: Stamp) {
        let stale = self.verdict.state == State::Stale;
        if silent && !stale && self.verdict.state != State::Init {
            self.before_stale = self.verdict.state;
            // What was found before a silence starts anew after it.
            self.found_since.clear();
            self.enter(State::Stale, now);
        } else if !silent && stale {
            // Odometry carries a tracked pose across the gap; anything else starts again.
            let tracked = matches!(self.before_stale, State::Localized | State::Degraded);
            let state = if tracked {
                State::Degraded
            } else {
                State::Converging
            };
            self.enter(state, now);
        }
    }

    fn enter(&mut self, state: State, now: Stamp) {
        if self.verdict.state != state {
            self.verdict.state = state;
            self.verdict.since = now;
        }
        self.driven = 0.0;
        self.good_since = None;
        self.lost_since = [None; Family::COUNT];
        self.wrong_since = None;
    }

    /// Adds a scan's fit to the two averages: the one over the longer and the one over the shorter time.
    fn smooth(&mut self, fit: ScanFit, stamp: Stamp) -> [ScanFit; 2] {
        let t = &self.thresholds;
        let smoothed = match (self.fit, self.last_update) {
            (Some(before), Some(last)) => {
                let seconds = stamp.since(last).max(0.0);
                let step = |before: ScanFit, time: f64| before.towards(fit, 1.0 - (-seconds / time).exp());
                [step(before[0], t.smoothing), step(before[1], t.smoothing_lost)]
            }
            // The fit of the pose before does not count for a new one.
            _ => [fit; 2],
        };
        *self.fit.insert(smoothed)
    }

    /// Notes since when each kind was found, since when each family has been against the pose, and since when nothing has
    /// been wrong.
    fn note_times(&mut self, fit: ScanFit, stamp: Stamp) {
        let findings = &self.findings;
        self.found_since
            .retain(|kind, _| findings.iter().any(|finding| finding.kind == *kind));
        for finding in findings {
            self.found_since.entry(finding.kind).or_insert(stamp);
        }
        let note = |since: &mut Option<Stamp>, holds: bool| {
            if holds {
                since.get_or_insert(stamp);
            } else {
                *since = None;
            }
        };
        for family in Family::ALL {
            let against = findings.iter().any(|finding| finding.lost == Some(family));
            note(&mut self.lost_since[family as usize], against);
        }
        let off_walls = findings
            .iter()
            .any(|finding| finding.kind == CauseKind::Alignment);
        let certain = fit.clear_alignment() < self.thresholds.alignment_wrong;
        note(&mut self.wrong_since, off_walls && certain);
        if findings.iter().any(|finding| finding.degrades) {
            self.good_since = None;
        } else {
            self.good_since.get_or_insert(stamp);
        }
    }

    /// How far a trusted pose jumped with one scan \[m\]; None if it did not. After a silence a jump is no fault.
    fn pose_jump(&self, update: &Update) -> Option<f64> {
        let trusted = matches!(self.verdict.state, State::Localized | State::Degraded);
        let next = self
            .last_update
            .is_some_and(|last| update.stamp.since(last) <= self.thresholds.stale_after);
        let [distance, _] = update.innovation;
        (trusted && next && update.mode == Mode::Tracking && distance > self.thresholds.leap)
            .then_some(distance)
    }

    /// Moves on to the next state.
    fn advance(&mut self, mode: Mode, jumped: bool, stamp: Stamp, now: Stamp) {
        let t = self.thresholds;
        let good = self
            .good_since
            .is_some_and(|since| stamp.since(since) >= t.good_for);
        let lasts = |since: Option<Stamp>, time: f64| since.is_some_and(|since| stamp.since(since) >= time);
        let families = self
            .lost_since
            .iter()
            .filter(|since| lasts(**since, t.lost_after))
            .count();
        // Scans that fit badly are no loss where they go on from those by which the car came here: then the map is wrong.
        let wrong = !self.trusted
            && (families >= 2
                || lasts(self.wrong_since, t.wrong_after)
                || lasts(self.lost_since[Family::EndPoints as usize], t.alone_after));
        let degraded = self.findings.iter().any(|finding| self.lasting(finding));
        let next = match (self.verdict.state, mode) {
            (State::Stale, _) => return,
            // The localizer has given its pose up. LOST comes before RELOCALIZING, so that an operator sees it.
            (State::Converging | State::Localized | State::Degraded, Mode::Searching) => State::Lost,
            (_, Mode::Searching) => State::Relocalizing,
            (_, Mode::Uninitialized) => State::Init,
            (State::Init | State::Relocalizing, Mode::Tracking) => State::Converging,
            (State::Converging | State::Localized | State::Degraded, _) if wrong || jumped => State::Lost,
            (State::Converging, _) if good && self.driven >= t.confirmed_after => State::Localized,
            (State::Localized, _) if degraded => State::Degraded,
            (State::Degraded, _) if good => State::Localized,
            (State::Lost, _) if good => State::Converging,
            // The pose was wrong before. This one is new, and to be confirmed like any other.
            (State::Lost, _) if self.given_up && self.good_since.is_some() => State::Converging,
            (state, _) => state,
        };
        if next != self.verdict.state {
            self.enter(next, now);
            self.given_up = next == State::Lost && (jumped || mode == Mode::Searching) && !wrong;
        }
    }

    /// True for a finding that has lasted long enough to degrade the state.
    fn lasting(&self, finding: &Finding) -> bool {
        let lasted = || {
            self.found_since
                .get(&finding.kind)
                .zip(self.last_update)
                .is_some_and(|(since, last)| last.since(*since) >= self.thresholds.bad_for)
        };
        finding.degrades && (finding.at_once || lasted())
    }

    /// The sensors that have stopped sending, each with how long ago \[s\].
    fn silent(&self, now: Stamp) -> Vec<(CauseKind, f64)> {
        self.silence
            .silent(now, self.verdict.since, self.thresholds.stale_after)
    }

    fn causes(&self, silent: Vec<(CauseKind, f64)>, now: Stamp) -> Vec<Cause> {
        let recent = |jump: Option<(Stamp, f64)>| {
            jump.filter(|(at, _)| now.since(*at) < JUMP_SHOWN)
                .map(|(_, distance)| distance)
        };
        CauseSources {
            state: self.verdict.state,
            thresholds: &self.thresholds,
            silent,
            scans_refused: self
                .refused
                .is_some_and(|[first, last]| last.since(first) >= self.thresholds.bad_for),
            odometry_jump: recent(self.odometry_jump),
            pose_jump: recent(self.pose_jump),
            clock_step: recent(self.clock_step),
            map_differs: self.map_differs,
            gave_up: self.gave_up,
            repeating: self.repeating_since.map(|since| now.since(since)),
            sensors: self.sensors,
            findings: self
                .findings
                .iter()
                .filter(|finding| !finding.degrades || self.lasting(finding))
                .collect(),
        }
        .causes()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::health::tests_support::good_update;
    use localizer::Doubt;
    use maps::Pose;
    use synpf::{SensorFinding, Twist};

    const SCAN: f64 = 0.025;

    /// A drive at 2 m/s, scan by scan.
    struct Drive {
        monitor: Monitor,
        now: Stamp,
        number: u64,
        /// From one scan to the next \[s\].
        period: f64,
    }

    impl Drive {
        fn new() -> Self {
            Self::at(SCAN)
        }

        fn at(period: f64) -> Self {
            let now = Stamp(1_000_000_000);
            Self {
                monitor: Monitor::new(Thresholds::default(), now),
                now,
                number: 0,
                period,
            }
        }

        fn update(&mut self) -> Update {
            self.number += 1;
            let twist = Twist {
                linear_x: 2.0,
                ..Twist::default()
            };
            Update {
                twist,
                pose: Pose::new(self.number as f64 * 2.0 * self.period, 0.0, 0.0),
                ..good_update(self.now, self.number)
            }
        }

        /// Drives for some seconds on updates changed by `change`; the states on the way.
        fn drive(&mut self, seconds: f64, change: impl Fn(&mut Update)) -> Vec<State> {
            let mut states = vec![self.monitor.verdict().state];
            for _ in 0..(seconds / self.period).round() as usize {
                self.now = self.now.plus(self.period);
                self.monitor.on_odometry(self.now);
                let mut update = self.update();
                change(&mut update);
                let state = self.monitor.on_update(&update, self.now.plus(0.02)).state;
                if states.last() != Some(&state) {
                    states.push(state);
                }
            }
            states
        }

        fn localized() -> Self {
            Self::localized_at(SCAN)
        }

        fn localized_at(period: f64) -> Self {
            let mut drive = Self::at(period);
            assert_eq!(
                drive.drive(2.0, |_| ()),
                [State::Init, State::Converging, State::Localized]
            );
            assert_eq!(drive.monitor.verdict().causes, []);
            drive
        }

        fn kinds(&self) -> Vec<CauseKind> {
            self.monitor
                .verdict()
                .causes
                .iter()
                .map(|cause| cause.kind)
                .collect()
        }
    }

    fn wrong_pose(update: &mut Update) {
        update.alignment = 0.29;
        update.residual = 0.5;
        update.long_beams = 0.4;
        update.w_ratio = 0.2;
    }

    #[test]
    fn standing_still_confirms_no_pose() {
        let mut drive = Drive::new();
        let states = drive.drive(5.0, |update| update.twist = Twist::default());
        assert_eq!(states, [State::Init, State::Converging]);
        assert_eq!(drive.kinds(), [CauseKind::NewPose]);
    }

    #[test]
    fn a_wrong_pose_is_lost_within_half_a_second_and_converges_again() {
        let mut drive = Drive::localized();
        let states = drive.drive(0.5, wrong_pose);
        assert_eq!(states, [State::Localized, State::Degraded, State::Lost]);
        assert!(drive.kinds().contains(&CauseKind::Alignment));
        assert!(drive.kinds().contains(&CauseKind::LongBeams));
        let states = drive.drive(3.0, |_| ());
        assert_eq!(states, [State::Lost, State::Converging, State::Localized]);
    }

    /// Spectators seen through a net fitted as badly as a wrong pose: a right one was LOST for a third of the time.
    #[test]
    fn a_pose_that_the_localizer_has_reason_to_trust_is_degraded_by_its_fit_and_not_lost() {
        let trusted = |trust| {
            move |update: &mut Update| {
                wrong_pose(update);
                update.trust = Some(trust);
            }
        };
        let mut drive = Drive::localized();
        assert_eq!(
            drive.drive(3.0, trusted(8.0)),
            [State::Localized, State::Degraded]
        );
        assert_eq!(drive.drive(0.5, trusted(2.0)), [State::Degraded, State::Lost]);
    }

    #[test]
    fn a_pose_in_doubt_is_degraded_with_the_first_scan_and_not_lost() {
        let doubt = |rival| {
            move |update: &mut Update| {
                update.doubt = Some(Doubt {
                    probability: 0.4,
                    rival,
                });
            }
        };
        for (rival, kind) in [
            (Some(Pose::new(3.0, 0.0, 0.0)), CauseKind::SecondMode),
            (None, CauseKind::Likelihood),
        ] {
            let mut drive = Drive::localized();
            assert_eq!(
                drive.drive(SCAN, doubt(rival)),
                [State::Localized, State::Degraded]
            );
            assert_eq!(drive.kinds(), [kind]);
            assert_eq!(drive.drive(3.0, doubt(rival)), [State::Degraded]);
            assert_eq!(drive.drive(1.0, |_| ()), [State::Degraded, State::Localized]);
        }
    }

    /// Another place explained a little more, and a pose with a long history was DEGRADED for half of a drive.
    #[test]
    fn a_rival_that_is_most_unlikely_is_said_and_degrades_nothing() {
        let mut drive = Drive::localized();
        let states = drive.drive(2.0, |update| {
            update.doubt = Some(Doubt {
                probability: 0.002,
                rival: Some(Pose::new(3.0, 0.0, 0.0)),
            });
        });
        assert_eq!(states, [State::Localized]);
        assert_eq!(drive.kinds(), [CauseKind::SecondMode]);
    }

    #[test]
    fn one_family_alone_degrades_and_is_not_lost() {
        let alone: [fn(&mut Update); 2] = [
            // A map that is out of date: half of the walls have moved.
            |update| {
                update.alignment = 0.5;
                update.residual = 0.3;
                update.w_ratio = 0.5;
                (update.short_beams, update.long_beams) = (0.25, 0.25);
            },
            |update| {
                update.spread = [5.0, 2.0];
                update.second_mode = 0.9;
                update.ess_ratio = 0.001;
            },
        ];
        for change in alone {
            let mut drive = Drive::localized();
            assert_eq!(drive.drive(5.0, change), [State::Localized, State::Degraded]);
        }
    }

    #[test]
    fn a_scan_that_lies_nowhere_near_the_walls_is_lost_without_other_evidence() {
        let nowhere = |update: &mut Update| update.alignment = 0.1;
        let mut drive = Drive::localized();
        assert_eq!(
            drive.drive(0.5, nowhere),
            [State::Localized, State::Degraded, State::Lost]
        );
        // So is a wrong initial pose.
        let mut drive = Drive::new();
        let states = drive.drive(1.0, nowhere);
        assert_eq!(states, [State::Init, State::Converging, State::Lost]);
        let mut drive = Drive::new();
        let states = drive.drive(3.0, |update| update.alignment = 0.4);
        assert_eq!(states, [State::Init, State::Converging, State::Lost]);
    }

    #[test]
    fn missing_walls_are_a_cause_but_do_not_change_the_state() {
        let mut drive = Drive::localized();
        let states = drive.drive(3.0, |update| {
            update.alignment = 0.8;
            update.long_beams = 0.5;
        });
        assert_eq!(states, [State::Localized]);
        assert_eq!(drive.kinds(), [CauseKind::LongBeams]);
    }

    #[test]
    fn one_bad_scan_in_ten_does_not_degrade_and_limits_have_hysteresis() {
        let mut drive = Drive::localized();
        for _ in 0..20 {
            assert_eq!(
                drive.drive(SCAN, |update| update.alignment = 0.4),
                [State::Localized]
            );
            assert_eq!(
                drive.drive(9.0 * SCAN, |update| update.alignment = 0.8),
                [State::Localized]
            );
        }
        drive.drive(1.0, |update| update.alignment = 0.55);
        assert_eq!(drive.monitor.verdict().state, State::Degraded);
        drive.drive(3.0, |update| update.alignment = 0.62);
        assert_eq!(drive.monitor.verdict().state, State::Degraded);
        drive.drive(2.0, |update| update.alignment = 0.7);
        assert_eq!(drive.monitor.verdict().state, State::Localized);
    }

    #[test]
    fn a_pose_given_up_at_the_first_scan_after_a_silence_is_lost_at_once() {
        let mut drive = Drive::localized();
        drive.now = drive.now.plus(2.0);
        assert_eq!(drive.monitor.tick(drive.now).state, State::Stale);
        let searching = |update: &mut Update| update.mode = Mode::Searching;
        assert_eq!(drive.drive(SCAN, searching), [State::Stale, State::Lost]);
    }

    #[test]
    fn a_jump_of_the_odometry_stays_a_cause_for_seconds() {
        let mut drive = Drive::localized();
        drive.drive(SCAN, |update| {
            update.mode = Mode::Searching;
            update.odometry_jump = Some([7.0, 0.1]);
        });
        assert_eq!(drive.monitor.verdict().state, State::Lost);
        let causes = drive.monitor.verdict().causes.iter().map(ToString::to_string);
        let expected = ["searching the whole map", "odometry jump 7.00 m"];
        assert!(causes.eq(expected), "{:?}", drive.kinds());
        drive.drive(5.0, |_| ());
        assert_eq!(drive.monitor.verdict().causes, []);
    }

    #[test]
    fn a_localizer_that_gives_its_pose_up_is_lost_before_it_searches() {
        let mut drive = Drive::localized();
        let searching = |update: &mut Update| update.mode = Mode::Searching;
        assert_eq!(drive.drive(SCAN, searching), [State::Localized, State::Lost]);
        // The scans fit, so nothing else is a cause.
        assert_eq!(drive.kinds(), [CauseKind::Searching]);
        assert_eq!(drive.drive(SCAN, searching), [State::Lost, State::Relocalizing]);
        assert!(drive.kinds().contains(&CauseKind::Searching));
        assert_eq!(
            drive.drive(2.0, |_| ()),
            [State::Relocalizing, State::Converging, State::Localized]
        );
    }

    #[test]
    fn a_pose_is_confirmed_only_by_driving_while_all_is_good() {
        let mut drive = Drive::new();
        // A wrong place that fits now and then.
        for _ in 0..10 {
            drive.drive(0.3, |_| ());
            drive.drive(0.3, |update| update.alignment = 0.3);
        }
        assert_eq!(drive.monitor.verdict().state, State::Converging);
    }

    #[test]
    fn an_opponent_in_view_degrades_once_too_few_beams_are_left() {
        for (share, expected) in [
            (0.3, &[State::Localized][..]),
            (0.5, &[State::Localized]),
            (0.6, &[State::Localized, State::Degraded]),
            (0.9, &[State::Localized, State::Degraded]),
        ] {
            let mut drive = Drive::localized();
            let states = drive.drive(3.0, |update| {
                update.short_beams = share;
                update.alignment = 0.9 * (1.0 - share);
                update.residual = 0.05 + 0.6 * share;
                update.w_ratio = 0.3;
            });
            assert_eq!(states, expected, "{share}");
            assert_eq!(drive.kinds(), [CauseKind::Occluded, CauseKind::Likelihood]);
        }
    }

    #[test]
    fn slip_and_beams_without_a_return_are_causes_but_do_not_change_the_state() {
        let mut drive = Drive::localized();
        let states = drive.drive(2.0, |update| {
            update.slip = 0.25;
            update.no_return = 0.5;
        });
        assert_eq!(states, [State::Localized]);
        assert_eq!(drive.kinds(), [CauseKind::Slip, CauseKind::NoReturn]);
    }

    #[test]
    fn two_bad_scans_at_40_hz_do_not_degrade_and_three_do() {
        let mut drive = Drive::localized();
        let jump = |update: &mut Update| update.innovation = [0.5, 0.0];
        assert_eq!(drive.drive(2.0 * SCAN, jump), [State::Localized]);
        assert_eq!(drive.drive(SCAN, |_| ()), [State::Localized]);
        assert_eq!(drive.drive(3.0 * SCAN, jump), [State::Localized, State::Degraded]);
        assert_eq!(
            drive.drive(1.0, |_| ()),
            [State::Degraded, State::Localized],
            "half a second of good scans is enough"
        );
    }

    /// At 10 Hz, three scans of a bad metric took 0.2 s and at 40 Hz 0.05 s, since the limit was counted in scans.
    #[test]
    fn the_scan_rate_changes_neither_what_degrades_nor_when_a_pose_is_lost() {
        let jump = |update: &mut Update| update.innovation = [0.5, 0.0];
        for hertz in [10.0, 20.0, 40.0] {
            let period = 1.0 / hertz;
            let mut drive = Drive::localized_at(period);
            assert_eq!(
                drive.drive(period, jump),
                [State::Localized],
                "one scan at {hertz} Hz"
            );
            drive.drive(1.0, |_| ());
            assert_eq!(
                drive.drive(0.2, jump),
                [State::Localized, State::Degraded],
                "0.2 s at {hertz} Hz"
            );
            // The time from the first bad scan to DEGRADED: the limit, rounded up to whole scans.
            let mut drive = Drive::localized_at(period);
            let begun = drive.now.plus(period);
            while drive.monitor.verdict().state == State::Localized {
                drive.drive(period, jump);
            }
            let took = drive.now.since(begun);
            assert!((0.04..=0.04 + period).contains(&took), "{took} s at {hertz} Hz");
            let mut drive = Drive::localized_at(period);
            let begun = drive.now.plus(period);
            while drive.monitor.verdict().state != State::Lost {
                drive.drive(period, wrong_pose);
            }
            let took = drive.now.since(begun);
            assert!((0.3..=0.5).contains(&took), "lost after {took} s at {hertz} Hz");
        }
    }

    /// The localizer replaces a pose that it has given up, by none of its corrections.
    #[test]
    fn a_pose_that_was_replaced_is_not_lost_for_the_scans_before() {
        for scans in 1.. {
            let mut drive = Drive::localized();
            drive.drive(f64::from(scans) * SCAN, wrong_pose);
            if drive.monitor.verdict().state == State::Lost {
                assert!(scans > 8, "lost after {scans} scans");
                break;
            }
            let states = drive.drive(1.0, |_| ());
            assert!(!states.contains(&State::Lost), "{scans} scans: {states:?}");
            assert_eq!(states.last(), Some(&State::Localized), "{scans} scans");
        }
    }

    #[test]
    fn a_pose_that_jumps_by_metres_was_lost() {
        let leap = |update: &mut Update| update.innovation = [2.7, 0.0];
        let mut drive = Drive::localized();
        assert_eq!(drive.drive(SCAN, leap), [State::Localized, State::Lost]);
        let causes = drive.monitor.verdict().causes.iter().map(ToString::to_string);
        assert!(
            causes.eq(["large pose correction 2.70 m (limit 1.00 m)"]),
            "{:?}",
            drive.monitor.verdict().causes
        );
        // The pose after the jump is a new one: LOST lasts for one update.
        assert_eq!(drive.drive(SCAN, |_| ()), [State::Lost, State::Converging]);
        assert_eq!(drive.drive(4.0, |_| ()), [State::Converging, State::Localized]);
        assert_eq!(drive.monitor.verdict().causes, []);

        // A jump to a place that does not fit is lost for as long as it does not.
        let mut drive = Drive::localized();
        drive.drive(SCAN, |update| {
            leap(update);
            wrong_pose(update);
        });
        assert_eq!(drive.drive(1.0, wrong_pose), [State::Lost]);

        // A pose that is not trusted yet may jump. So may any pose after a silence.
        let mut drive = Drive::new();
        drive.drive(0.2, |_| ());
        assert_eq!(drive.drive(SCAN, leap), [State::Converging]);
        let mut drive = Drive::localized();
        drive.now = drive.now.plus(1.5);
        drive.monitor.tick(drive.now);
        assert_eq!(drive.drive(SCAN, leap), [State::Stale, State::Degraded]);
    }

    #[test]
    fn a_silent_sensor_is_named_and_the_state_is_stale_until_it_returns() {
        let mut drive = Drive::localized();
        // Odometry continues, scans do not.
        for _ in 0..40 {
            drive.now = drive.now.plus(SCAN);
            drive.monitor.on_odometry(drive.now);
            drive.monitor.tick(drive.now);
        }
        assert_eq!(drive.monitor.verdict().state, State::Stale);
        assert_eq!(drive.kinds(), [CauseKind::NoScan]);
        let states = drive.drive(2.0, |_| ());
        assert_eq!(states, [State::Stale, State::Degraded, State::Localized]);
    }

    #[test]
    fn a_gap_as_in_a_real_log_is_not_stale() {
        let mut drive = Drive::localized();
        drive.now = drive.now.plus(0.14);
        assert_eq!(drive.monitor.tick(drive.now).state, State::Localized);
    }

    #[test]
    fn without_sensor_data_the_state_stays_init_with_the_causes() {
        let now = Stamp(0);
        let mut monitor = Monitor::new(Thresholds::default(), now);
        let verdict = monitor.tick(now.plus(10.0));
        assert_eq!(verdict.state, State::Init);
        let kinds: Vec<_> = verdict.causes.iter().map(|cause| cause.kind).collect();
        assert_eq!(
            kinds,
            [CauseKind::NoScan, CauseKind::NoOdometry, CauseKind::NoInitialPose]
        );
    }

    /// A hanging driver sends its last scan under new stamps: it was taken for a scan, and the pose for a good one.
    #[test]
    fn repeated_scans_degrade_at_once_and_are_stale_after_their_time() {
        let mut drive = Drive::new();
        drive.drive(2.0, |_| {});
        assert_eq!(drive.monitor.verdict().state, State::Localized);
        for scan in 0..40 {
            drive.now = drive.now.plus(SCAN);
            drive.monitor.on_odometry(drive.now);
            drive.monitor.on_refused_scan(drive.now, Dropped::RepeatedScan);
            drive.monitor.tick(drive.now);
            let verdict = drive.monitor.verdict();
            let said = |cause: &Cause| cause.kind == CauseKind::RepeatedScans;
            assert!(verdict.causes.iter().any(said));
            if scan < 10 {
                assert_eq!(verdict.state, State::Degraded, "scan {scan}");
            }
        }
        assert_eq!(drive.monitor.verdict().state, State::Stale);
    }

    #[test]
    fn findings_of_the_sensors_are_causes_with_their_values() {
        let mut drive = Drive::new();
        drive.drive(0.1, |update| {
            update.sensors.insert(SensorFinding::GyroInDegrees, 57.3);
        });
        let causes = &drive.monitor.verdict().causes;
        let said: Vec<_> = causes.iter().map(ToString::to_string).collect();
        let expected = "gyroscope in deg/s, converted: readings per rad/s 57.30";
        assert!(said.contains(&expected.to_owned()), "{said:?}");
    }

    /// A simulator that had paused left DEGRADED behind for as long as it had paused: the ages of poses were kept by a clock that
    /// had gone back.
    #[test]
    fn a_clock_that_is_moved_leaves_no_cause_behind() {
        let start = Stamp(100_000_000_000);
        let mut monitor = Monitor::new(Thresholds::default(), start);
        monitor.on_new_pose(start);
        let scans = |monitor: &mut Monitor, first: u64, late: f64| {
            for number in first..first + 80 {
                let stamp = start.plus(0.025 * number as f64);
                monitor.on_odometry(stamp.plus(late));
                monitor.on_update(&good_update(stamp, number), stamp.plus(late));
            }
        };
        scans(&mut monitor, 0, 0.01);
        // Time stood still for 5 s, and the clock is not yet moved back.
        scans(&mut monitor, 80, 5.01);
        assert!(
            monitor
                .verdict()
                .causes
                .iter()
                .any(|cause| cause.kind == CauseKind::Age)
        );
        monitor.on_clock_moved(-5.0);
        let since = monitor.verdict().since;
        assert!(since < start.plus(4.0), "{since:?}");
        scans(&mut monitor, 160, 0.01);
        monitor.on_clock_step(start.plus(6.0), -0.3);
        let verdict = monitor.tick(start.plus(6.0));
        let kinds: Vec<_> = verdict.causes.iter().map(|cause| cause.kind).collect();
        assert!(
            kinds.contains(&CauseKind::ClockStep) && !kinds.contains(&CauseKind::Age),
            "{kinds:?}"
        );
    }

    #[test]
    fn a_scan_that_takes_long_is_no_late_scan() {
        let causes = |sweep: f64, age: f64| {
            let start = Stamp(1_000_000_000);
            let mut monitor = Monitor::new(Thresholds::default(), start);
            for i in 0..40 {
                let stamp = start.plus(0.1 * i as f64);
                let update = good_update(stamp, i);
                monitor.on_sweep(sweep);
                monitor.on_update(&update, stamp.plus(age));
            }
            let kinds: Vec<_> = monitor.verdict().causes.iter().map(|cause| cause.kind).collect();
            kinds.contains(&CauseKind::Age)
        };
        assert!(causes(0.0, 0.1) && causes(0.0187, 0.1));
        assert!(!causes(0.09, 0.1) && causes(0.09, 0.2));
    }
}
