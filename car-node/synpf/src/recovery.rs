//! Loss detection and recovery: whether the pose is still believed, and where the car is if it is not.
//!
//! One entry point, [`Recovery::update`], once per scan, and one decision: the odds of the pose that is followed, the
//! incumbent, against the best rival.
//!
//! - [`LossDetector`]: the odds that the incumbent brings from its history. They fall when a scan breaks with those before it.
//! - [`Rivals`]: poses that a look at the whole map has found, followed beside the incumbent. Each different piece
//!   of wall that one explains and the other does not shifts the odds.
//! - The incumbent is published, and said to be in doubt, until a rival has won by the way that the car drove meanwhile. Then a
//!   [`Search`] goes on with the rivals and the incumbent until one of them is confirmed.

mod continuity;
mod fit_change;
mod loss_detector;
mod rivals;
pub(crate) mod scan_likelihood;

use std::sync::Arc;

use maps::Pose;
use nalgebra::Matrix3;
use serde::{Deserialize, Serialize};

use self::continuity::Continuity;
use self::fit_change::FitChangeDetector;
use self::loss_detector::LossDetector;
use self::rivals::{Incumbent, Rival, Rivals};
use self::scan_likelihood::fit_of;
use crate::estimate::Estimate;
use crate::global_search::{
    AfterJump, Candidate, GlobalCheck, GlobalCheckOutcome, Search, SearchSettings, global_check, offset,
};
use crate::preprocessed_scan::PreprocessedScan;
use crate::quality::Quality;
use crate::sensor_check::FASTEST;
use crate::track_map::TrackMap;
use crate::validation::Check;

/// Parameters of recovery.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct RecoveryParameters {
    /// Time over which the fit of the scans is averaged for the long term \[s\].
    pub fit_time_slow: f64,
    /// Time over which it is averaged for the short term \[s\].
    pub fit_time_fast: f64,
    /// Inject particles along the track when the short-term average falls below the long-term one.
    pub injection: bool,
    /// Below this ratio of the averages particles are injected.
    pub injection_ratio: f64,
    /// Most particles that one resampling injects, as a share.
    pub injection_share: f64,
    /// Look for the pose on the whole map when it is in doubt or lost.
    pub recover: bool,
    /// Below this ratio of the averages the rest of the map is looked at.
    pub check_ratio: f64,
    /// Alignment below which the pose of a car that was carried is wrong...
    pub lost_alignment: f64,
    /// ...beside this share of beams that are longer than the map says.
    pub lost_long_beams: f64,
    /// How long both must hold until it is given up, rival or not \[s\].
    pub lost_after: f64,
    /// Log odds that the history of a pose gives it at most, against all other places.
    pub trust_limit: f64,
    /// Log odds that a piece of wall of 0.5 m adds for the pose that explains it. Walls change in stretches, and
    /// opponents stand in front of several pieces: five of them are as unlikely as one in twelve.
    pub piece_odds: f64,
    /// Log odds at which another place is believed.
    pub switch_odds: f64,
    /// Distance that the car must have driven before that \[m\]; half of it where the scans say that the car was carried.
    pub switch_distance: f64,
}

impl Default for RecoveryParameters {
    fn default() -> Self {
        Self {
            fit_time_slow: 2.5,
            fit_time_fast: 0.07,
            injection: true,
            injection_ratio: 0.8,
            injection_share: 0.2,
            recover: true,
            check_ratio: 0.8,
            lost_alignment: 0.45,
            lost_long_beams: 0.15,
            lost_after: 1.0,
            trust_limit: 12.0,
            piece_odds: 0.5,
            switch_odds: 5.0,
            switch_distance: 1.0,
        }
    }
}

impl RecoveryParameters {
    pub(crate) fn validate(&self, check: &mut Check) {
        check.range("fit_time_slow", self.fit_time_slow, 0.01, 100.0);
        check.range("fit_time_fast", self.fit_time_fast, 0.001, 100.0);
        check.that("fit_time_fast", self.fit_time_fast < self.fit_time_slow, || {
            format!(
                "{} is not below fit_time_slow, {}",
                self.fit_time_fast, self.fit_time_slow
            )
        });
        check.range("injection_ratio", self.injection_ratio, 0.0, 1.0);
        check.range("injection_share", self.injection_share, 0.0, 0.9);
        check.range("check_ratio", self.check_ratio, 0.0, 1.0);
        check.range("lost_alignment", self.lost_alignment, 0.0, 1.0);
        check.range("lost_long_beams", self.lost_long_beams, 0.0, 1.0);
        check.range("lost_after", self.lost_after, 0.05, 10.0);
        check.range("trust_limit", self.trust_limit, 0.0, 1000.0);
        check.range("piece_odds", self.piece_odds, 0.01, 10.0);
        check.range("switch_odds", self.switch_odds, 0.1, 100.0);
        check.range("switch_distance", self.switch_distance, 0.0, 100.0);
    }
}

/// One scan as recovery sees it. Poses are in the grid's frame.
#[derive(Debug)]
pub(crate) struct Evidence<'a> {
    pub(crate) map: &'a TrackMap,
    pub(crate) scan: &'a PreprocessedScan,
    /// Where the car is by this scan; during a search, where odometry has carried the last pose.
    pub(crate) estimate: &'a Estimate,
    /// How the scan fits the map there.
    pub(crate) quality: &'a Quality,
    /// How the whole scan moved the prediction, in the prediction's frame; None where it was not fitted.
    pub(crate) correction: Option<Pose>,
    /// Motion of `base_link` since the scan before, by calibrated odometry, without discontinuities.
    pub(crate) motion: Pose,
    /// Where the car would be if odometry's discontinuity since the scan before was a motion of the car; None without one.
    pub(crate) displaced: Option<Pose>,
    /// Time since the scan before \[s\].
    pub(crate) seconds: f64,
    /// How far end points scatter about the walls \[m\].
    pub(crate) scatter: f64,
}

/// What is to be done with the estimate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Decision {
    /// Go on following it.
    Keep,
    /// The pose is not known; this is the best so far, with a covariance as large as the doubt.
    Searching(Option<Estimate>),
    /// The car is here: start anew from it.
    Found(Estimate),
}

/// Why the pose that is followed is in doubt.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct InDoubt {
    /// Probability that the pose is wrong, in [0, 1].
    pub(crate) probability: f64,
    /// The pose that explains the scans as well or better, where there is one.
    pub(crate) rival: Option<Pose>,
}

/// A look at the whole map, on its way.
#[derive(Debug, Clone, Default)]
enum CheckState {
    #[default]
    Idle,
    /// It is wanted, for this scan; the filter does it at the next scan unless a caller takes it.
    Wanted(Box<PreprocessedScan>, Since),
    /// A caller has taken it.
    Taken(Since),
    /// A caller has handed in what it found.
    Done(Vec<Candidate>, Since),
}

/// What has happened since the scan that is looked at.
#[derive(Debug, Clone, Copy)]
struct Since {
    motion: Pose,
    seconds: f64,
    number: u64,
}

/// Watches the pose that is followed, and searches when it is lost.
#[derive(Debug, Clone)]
pub(crate) struct Recovery {
    parameters: RecoveryParameters,
    settings: SearchSettings,
    /// The same with fewer beams, for rivals.
    rival_settings: SearchSettings,
    continuity: Continuity,
    loss: LossDetector,
    fit_change: FitChangeDetector,
    rivals: Rivals,
    search: Option<Search>,
    check: CheckState,
    checks: u64,
    /// Time until the map may be looked at again \[s\], and how long to wait the next time.
    patience: [f64; 2],
    /// Averages of the fit, over the long and the short term.
    averages: Option<[f64; 2]>,
    /// The estimate at the scan before.
    before: Option<Pose>,
    doubt: Option<InDoubt>,
    /// Time since the pose was set or found \[s\].
    followed: f64,
}

/// A pose that was set or found is not doubted for so long: the particles are still contracting \[s\].
const SETTLING: f64 = 0.25;

/// Log odds of a pose that was given, against another place: one in twenty is given wrongly, and then the car may be in
/// any of a few places.
const GIVEN: f64 = 4.0;

/// Alignment of a localized car on a map of usual quality: what the averages start from, so that a pose that was
/// wrong from the start is doubted too.
const USUAL: f64 = 0.8;

/// Clear alignment above which no other place fits much better.
const FITS_WELL: f64 = 0.85;

/// A look at the map takes as long as many updates: after each that changed nothing the next comes twice as late, from the
/// first of these to the second \[s\].
const PATIENCE: [f64; 2] = [0.1, 4.0];

/// A rival that leads by so many pieces of wall explains the scans as well.
const LEADING: f64 = 3.0;

/// A correction larger than this is another place \[m\].
const LEAP: f64 = 0.5;

/// Share of the usual fit that another place must have.
const AS_USUAL: f64 = 0.75;

/// A lead this many times as large as is needed is believed of a car that stands, after so long \[s\].
const STANDING: (f64, f64) = (2.0, 0.3);

/// Log odds beyond which no more is said.
const MOST_TRUST: f64 = 25.0;

/// A correction of the prediction larger than this is no motion of the car \[m\].
const PLAUSIBLE: f64 = 0.3;

impl Recovery {
    pub(crate) fn new(parameters: RecoveryParameters, settings: SearchSettings) -> Self {
        Self {
            parameters,
            rival_settings: settings.with_fewer_beams(),
            settings,
            continuity: Continuity::default(),
            loss: LossDetector::default(),
            fit_change: FitChangeDetector::default(),
            rivals: Rivals::default(),
            search: None,
            check: CheckState::Idle,
            checks: 0,
            patience: [0.0; 2],
            averages: None,
            before: None,
            doubt: None,
            followed: 0.0,
        }
    }

    /// Other parameters from now on; what was seen so far stays.
    pub(crate) fn set_parameters(&mut self, parameters: RecoveryParameters, settings: SearchSettings) {
        self.parameters = parameters;
        self.rival_settings = settings.with_fewer_beams();
        self.settings = settings;
    }

    /// The pose has been set: watches it from now on.
    pub(crate) fn follow(&mut self) {
        self.forget();
        self.search = None;
        self.followed = 0.0;
        self.loss.start(GIVEN);
    }

    /// The pose has been found by a search, which motion has confirmed.
    pub(crate) fn follow_found(&mut self) {
        self.follow();
        self.loss.start(self.parameters.switch_odds);
    }

    /// Forgets the pose and searches the whole map from the next scan on.
    pub(crate) fn start_search(&mut self) {
        self.begin(Search::default());
    }

    fn begin(&mut self, search: Search) {
        self.forget();
        self.search = Some(search);
    }

    fn forget(&mut self) {
        self.loss.start(0.0);
        self.continuity.clear();
        self.fit_change = FitChangeDetector::default();
        self.rivals.clear();
        self.check = CheckState::Idle;
        self.patience = [0.0; 2];
        self.averages = None;
        self.before = None;
        self.doubt = None;
    }

    /// The candidates of the search under way, best first.
    pub(crate) fn candidates(&self) -> &[Candidate] {
        self.search.as_ref().map_or(&[], |search| &search.candidates)
    }

    /// Why the pose is in doubt; None while it is not.
    pub(crate) fn doubt(&self) -> Option<InDoubt> {
        self.doubt
    }

    /// Log of the odds that the pose is right: by its history, and by the best rival's lead. Negative during a search.
    pub(crate) fn trust(&self) -> f64 {
        if self.search.is_some() {
            return -MOST_TRUST;
        }
        let lead = self.rivals.best().map_or(0.0, |rival| rival.lead().max(0.0));
        (self.loss.odds() - self.parameters.piece_odds * lead).clamp(-MOST_TRUST, MOST_TRUST)
    }

    /// Short-term over long-term average of the clear alignment: below 1 when scans fit worse than they used to. Augmented
    /// MCL (Probabilistic Robotics, table 8.3) has the same of the particles' mean weight.
    pub(crate) fn w_ratio(&self) -> f64 {
        self.averages
            .map_or(1.0, |[slow, fast]| if slow > 0.0 { fast / slow } else { 1.0 })
    }

    /// The look at the whole map that is wanted, for a caller to run elsewhere and hand in with [`Recovery::finish_check`].
    /// What nobody takes is done with the next scan.
    pub(crate) fn take_check(&mut self, map: &Arc<TrackMap>) -> Option<GlobalCheck> {
        match std::mem::take(&mut self.check) {
            CheckState::Wanted(scan, since) => {
                self.check = CheckState::Taken(since);
                Some(GlobalCheck {
                    map: Arc::clone(map),
                    scan: *scan,
                    settings: self.settings.clone(),
                    number: since.number,
                })
            }
            other => {
                self.check = other;
                None
            }
        }
    }

    /// Takes in what a look at the map has found. Outdated ones are ignored.
    pub(crate) fn finish_check(&mut self, outcome: GlobalCheckOutcome) {
        if let CheckState::Taken(since) = self.check
            && since.number == outcome.number
        {
            self.check = CheckState::Done(outcome.candidates, since);
        }
    }

    /// Takes in a scan and decides on the estimate.
    pub(crate) fn update(&mut self, evidence: &Evidence<'_>) -> Decision {
        let found = self.checked(evidence);
        if self.search.is_some() {
            self.searched(evidence, found)
        } else {
            self.watch(evidence, found)
        }
    }

    /// The candidates of a look at the map that is done, carried on to this scan.
    fn checked(&mut self, evidence: &Evidence<'_>) -> Option<Vec<Candidate>> {
        if let CheckState::Wanted(_, since) | CheckState::Taken(since) | CheckState::Done(_, since) =
            &mut self.check
        {
            since.motion = since.motion * evidence.motion;
            since.seconds += evidence.seconds;
        }
        let (mut candidates, since) = match std::mem::take(&mut self.check) {
            CheckState::Wanted(scan, since) => (global_check(evidence.map, &scan, &self.settings), since),
            CheckState::Done(candidates, since) => (candidates, since),
            other => {
                self.check = other;
                return None;
            }
        };
        for candidate in &mut candidates {
            candidate.estimate = candidate.moved(since.motion, since.seconds);
        }
        Some(candidates)
    }

    /// Asks for a look at the map, unless one is on its way.
    fn want_check(&mut self, scan: &PreprocessedScan) -> bool {
        if !matches!(self.check, CheckState::Idle) {
            return false;
        }
        self.checks += 1;
        let since = Since {
            motion: Pose::IDENTITY,
            seconds: 0.0,
            number: self.checks,
        };
        self.check = CheckState::Wanted(Box::new(scan.end_points()), since);
        true
    }

    /// One scan of a search.
    fn searched(&mut self, evidence: &Evidence<'_>, found: Option<Vec<Candidate>>) -> Decision {
        let Evidence {
            map,
            scan,
            motion,
            seconds,
            ..
        } = *evidence;
        let Some(mut search) = self.search.take() else {
            return Decision::Keep;
        };
        let confirmed = search.update(map, scan, motion, seconds, &self.settings);
        if let Some(estimate) = confirmed {
            self.follow_found();
            return Decision::Found(estimate);
        }
        if let Some(candidates) = found {
            search.add(candidates, &self.settings);
        }
        if search.wants_check() {
            self.want_check(scan);
        }
        let best = search.best_so_far();
        self.search = Some(search);
        Decision::Searching(best)
    }

    /// Judges the pose that is followed; begins a search when it has lost against a rival or is contradicted.
    fn watch(&mut self, evidence: &Evidence<'_>, found: Option<Vec<Candidate>>) -> Decision {
        let Evidence {
            map, scan, estimate, ..
        } = *evidence;
        let doubtful = self.observe(evidence);
        if !self.parameters.recover {
            return Decision::Keep;
        }
        let mut found = found;
        if let Some(displaced) = evidence.displaced {
            let reach = FASTEST * evidence.seconds + LEAP;
            match Search::after_jump(map, scan, [estimate.pose, displaced], reach, &self.settings) {
                AfterJump::Stayed => return Decision::Keep,
                AfterJump::Search(search) => return self.give_up(search),
                AfterJump::Rival(rival) => found.get_or_insert_default().push(rival),
            }
        }
        if self.followed <= SETTLING {
            return Decision::Keep;
        }
        let leapt = evidence
            .correction
            .is_some_and(|correction| correction.x.hypot(correction.y) > LEAP);
        if leapt && self.loss.broken(&self.parameters) {
            // The particles have found the place that the car was carried to, perhaps. Motion has to confirm it.
            let found = Candidate::new(map, scan, *estimate);
            let mut search = Search::with(vec![found], 0.0, self.least_fit(), &self.settings);
            search.check_soon();
            return self.give_up(search);
        }
        let incumbent = Incumbent {
            map,
            scan,
            pose: estimate.pose,
            reach: reach(map, evidence.scatter),
        };
        self.rivals
            .follow(incumbent, evidence.motion, evidence.seconds, &self.rival_settings);
        if let Some(candidates) = found {
            self.rivals.add(incumbent, candidates);
        }
        self.ask(scan, doubtful, evidence.seconds);
        if self.lost_to_a_rival() {
            let (candidates, driven) = self.rivals.take(estimate);
            let search = Search::with(candidates, driven, self.least_fit(), &self.settings);
            return self.give_up(search);
        }
        let ratio = self.w_ratio();
        if self
            .loss
            .contradicted(evidence.quality, ratio, evidence.seconds, &self.parameters)
        {
            let (candidates, driven) = self.rivals.take(estimate);
            let mut search = Search::with(candidates, driven, self.least_fit(), &self.settings);
            search.check_soon();
            return self.give_up(search);
        }
        self.doubt = self.judge();
        Decision::Keep
    }

    /// The fit that another place must have to be believed: about as good as usual. A map that is out of date has worse places,
    /// which explain some of what the pose does not.
    fn least_fit(&self) -> f64 {
        self.fit_change.usual().map_or(0.0, |usual| AS_USUAL * usual)
    }

    fn give_up(&mut self, search: Search) -> Decision {
        let best = search.best_so_far();
        self.begin(search);
        Decision::Searching(best)
    }

    /// Takes in how the scan fits and goes on from the one before. True when that is a reason to look at the map.
    fn observe(&mut self, evidence: &Evidence<'_>) -> bool {
        let Evidence {
            map,
            scan,
            estimate,
            quality,
            motion,
            seconds,
            ..
        } = *evidence;
        let parameters = &self.parameters;
        self.followed += seconds;
        let fit = quality.clear_alignment().max(0.02);
        let averages = self.averages.get_or_insert([USUAL; 2]);
        for (average, time) in averages
            .iter_mut()
            .zip([parameters.fit_time_slow, parameters.fit_time_fast])
        {
            *average += (1.0 - (-seconds / time).exp()) * (fit - *average);
        }
        // Odometry may err more than the estimate does; a fit that jumped is no motion.
        let plausible = evidence
            .correction
            .is_none_or(|correction| correction.x.hypot(correction.y) < PLAUSIBLE);
        let estimated = self
            .before
            .filter(|_| plausible)
            .map_or(motion, |before| estimate.pose.since(before));
        self.before = Some(estimate.pose);
        let continued = self.continuity.push(scan, [motion, estimated], seconds);
        let leading = self.rivals.best().is_some_and(|rival| rival.lead() > 0.0);
        let way = motion.x.hypot(motion.y);
        self.loss.push(continued, quality, way, leading, parameters);
        // The mean of the particles jitters too much for a slight fall to mean anything.
        let changed =
            evidence.correction.is_some() && self.fit_change.push(fit_of(map, scan, estimate.pose), seconds);
        let broken = self.loss.broken(parameters);
        // A pose that was set and has no history yet is held against the whole map unless it fits well.
        let untested = self.loss.odds() < parameters.switch_odds;
        let fallen =
            quality.clear_alignment() <= FITS_WELL && (untested || self.w_ratio() <= parameters.check_ratio);
        if !broken && !fallen && !changed && self.w_ratio() > 0.95 {
            self.patience[1] = 0.0;
        }
        broken || fallen || changed
    }

    /// Asks for a look at the map when there is doubt, each time after a longer wait.
    fn ask(&mut self, scan: &PreprocessedScan, doubtful: bool, seconds: f64) {
        self.patience[0] = (self.patience[0] - seconds).max(0.0);
        if doubtful && self.patience[0] <= 0.0 && self.want_check(scan) {
            let [first, last] = PATIENCE;
            let wait = (2.0 * self.patience[1]).clamp(first, last);
            self.patience = [wait, wait];
        }
    }

    /// Whether the best rival has won by what was seen while the car drove.
    fn lost_to_a_rival(&self) -> bool {
        let Some(rival) = self.rivals.best() else {
            return false;
        };
        let p = &self.parameters;
        if rival.candidate.fit() < self.least_fit() {
            return false;
        }
        let needed = (self.loss.odds() + p.switch_odds) / p.piece_odds;
        let (times, after) = STANDING;
        // After a break the car is somewhere else in any case.
        let share = if self.loss.broken(p) { 0.5 } else { 1.0 };
        let moved = rival.driven >= share * p.switch_distance;
        let beyond_doubt = rival.lead() >= times * needed && self.rivals.seconds() >= after;
        rival.lead() >= needed && moved || beyond_doubt
    }

    /// Whether the pose is in doubt, and why.
    fn judge(&self) -> Option<InDoubt> {
        let p = &self.parameters;
        let best = self.rivals.best();
        let leading = best.filter(|rival| rival.lead() >= LEADING);
        if leading.is_none() && !self.loss.broken(p) {
            return None;
        }
        let lead = best.map_or(0.0, Rival::lead);
        Some(InDoubt {
            probability: 1.0 / (1.0 + (self.loss.odds() - p.piece_odds * lead).exp()),
            rival: best.map(|rival| rival.candidate.estimate.pose),
        })
    }
}

impl InDoubt {
    /// The covariance of an estimate, widened by the chance that the car is where the rival is.
    pub(crate) fn widened(&self, estimate: &Estimate) -> Matrix3<f64> {
        let Some(rival) = self.rival else {
            return estimate.covariance;
        };
        let off = offset(estimate.pose, rival);
        estimate.covariance + off * off.transpose() * self.probability.min(0.5)
    }
}

/// How far from a wall an end point of it may lie: three times its scatter, and the grain of the map \[m\].
fn reach(map: &TrackMap, scatter: f64) -> f32 {
    (3.0 * scatter).max(1.5 * map.grid().resolution).clamp(0.1, 0.5) as f32
}
