//! Loss detection and recovery: whether the pose is still believed, and where the car is if it is not.
//!
//! One entry point, [`Recovery::update`], once per scan. While a pose is followed, the detectors watch how the scan fits
//! there; when they find it lost, or odometry jumps, a [`Search`] of the whole map goes on until motion has confirmed one
//! of its candidates.

use maps::Pose;

use crate::estimate::Estimate;
use crate::loss_detector::{Doubt, RecoveryParameters};
use crate::preprocessed_scan::PreprocessedScan;
use crate::quality::Quality;
use crate::search::{Candidate, Search, SearchSettings, fit_of};
use crate::surprise::Surprise;
use crate::track_map::TrackMap;

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
    /// Time since the scan before [s].
    pub(crate) seconds: f64,
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

/// Watches the pose that is followed, and searches when it is lost.
#[derive(Debug, Clone)]
pub(crate) struct Recovery {
    parameters: RecoveryParameters,
    settings: SearchSettings,
    detector: Doubt,
    surprise: Surprise,
    search: Option<Search>,
    w_ratio: f64,
    /// Time since the pose was set or found [s].
    followed: f64,
}

/// A pose that was set or found is not doubted for so long: the particles are still contracting [s].
const SETTLING: f64 = 0.25;

impl Recovery {
    pub(crate) fn new(parameters: RecoveryParameters, settings: SearchSettings) -> Self {
        Self {
            parameters,
            settings,
            detector: Doubt::default(),
            surprise: Surprise::default(),
            search: None,
            w_ratio: 1.0,
            followed: 0.0,
        }
    }

    /// Other parameters from now on; what was seen so far stays.
    pub(crate) fn set_parameters(&mut self, parameters: RecoveryParameters, settings: SearchSettings) {
        self.parameters = parameters;
        self.settings = settings;
    }

    /// The pose has been set: watches it from now on.
    pub(crate) fn follow(&mut self) {
        self.detector.clear();
        self.surprise = Surprise::default();
        self.search = None;
        self.followed = 0.0;
    }

    /// Forgets the pose and searches the whole map from the next scan on.
    pub(crate) fn start_search(&mut self) {
        self.begin(Search::default());
    }

    fn begin(&mut self, search: Search) {
        self.detector.clear();
        self.surprise = Surprise::default();
        self.search = Some(search);
    }

    /// The candidates of the search under way, best first.
    pub(crate) fn candidates(&self) -> &[Candidate] {
        self.search.as_ref().map_or(&[], |search| &search.candidates)
    }

    /// `w_fast / w_slow` of augmented MCL (Probabilistic Robotics, table 8.3), over the fit of the scans.
    pub(crate) fn w_ratio(&self) -> f64 {
        self.w_ratio
    }

    /// Takes in a scan and decides on the estimate.
    pub(crate) fn update(&mut self, evidence: &Evidence<'_>) -> Decision {
        let Some(search) = &mut self.search else {
            return self.watch(evidence);
        };
        let Evidence {
            map,
            scan,
            motion,
            seconds,
            ..
        } = *evidence;
        match search.update(map, scan, motion, seconds, &self.settings) {
            Some(found) => {
                self.follow();
                Decision::Found(found)
            }
            None => Decision::Searching(search.best_so_far()),
        }
    }

    /// Judges the pose that is followed; begins a search when it is lost.
    fn watch(&mut self, evidence: &Evidence<'_>) -> Decision {
        let Evidence {
            map, scan, estimate, ..
        } = *evidence;
        self.observe(evidence);
        if !self.parameters.recover {
            return Decision::Keep;
        }
        let search = if let Some(displaced) = evidence.displaced {
            Search::after_jump(map, scan, [estimate.pose, displaced], &self.settings)
        } else if self.followed > SETTLING {
            self.lost(evidence)
        } else {
            None
        };
        match search {
            Some(search) => {
                let best = search.best_so_far();
                self.begin(search);
                Decision::Searching(best)
            }
            None => Decision::Keep,
        }
    }

    /// Takes the scan's fit into the averages.
    fn observe(&mut self, evidence: &Evidence<'_>) {
        self.followed += evidence.seconds;
        let quality = evidence.quality;
        let likelihood = quality.clear_alignment().max(0.02);
        self.w_ratio = self
            .detector
            .push(likelihood, quality.alignment, &self.parameters);
        // The mean of the particles jitters too much for a slight fall to say anything.
        if let Some(correction) = evidence.correction {
            let fit = fit_of(evidence.map, evidence.scan, evidence.estimate.pose);
            let size = [correction.y.abs(), correction.heading.abs()];
            self.surprise.push(fit, size, &self.parameters);
        }
    }

    /// The search to begin with, if the pose is lost: it has looked wrong for long, or the scan fits another place better.
    fn lost(&mut self, evidence: &Evidence<'_>) -> Option<Search> {
        let quality = evidence.quality;
        let alignment = quality.clear_alignment();
        let (parameters, seconds) = (&self.parameters, evidence.seconds);
        if self
            .detector
            .lost(alignment, quality.long, quality.short, seconds, parameters)
        {
            return Some(Search::default());
        }
        let fall = self.surprise.fall();
        if !self
            .detector
            .asks(alignment, self.w_ratio, fall.is_some(), seconds, parameters)
        {
            return None;
        }
        Search::second_opinion(
            evidence.map,
            evidence.scan,
            evidence.estimate.pose,
            self.detector.sudden(),
            fall,
            &self.settings,
        )
    }
}
