//! The search of the whole map: candidates from one scan, told apart by motion.
//!
//! A single scan is not safe: on a track the best and the second-best pose often tie. So the scan is matched
//! against the map everywhere ([`crate::correlative_match`]), the best candidates are kept, and each follows odometry and the
//! next scans on its own until one of them explains all of it clearly better than the rest.
//!
//! Matching takes as long as many updates, so it is a job of its own, [`GlobalCheck`]: the filter goes on meanwhile, and its
//! candidates are carried on by the odometry in between.

use std::sync::Arc;

use maps::{Pose, wrap_angle};
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;

use crate::calibration::WallCalibration;
use crate::correlative_match::seed;
use crate::estimate::{Estimate, are_near};
use crate::preprocessed_scan::PreprocessedScan;
use crate::recovery::scan_likelihood::{INDEPENDENT, score};
use crate::scan_matcher::{RefinementParameters, refine};
use crate::search_parameters::SearchParameters;
use crate::track_map::TrackMap;

/// The parts of a parameter set that a search goes by.
#[derive(Debug, Clone, Default)]
pub(crate) struct SearchSettings {
    pub(crate) search: SearchParameters,
    pub(crate) refinement: RefinementParameters,
}

impl SearchSettings {
    /// The same, with candidates fitted to part of a scan.
    pub(crate) fn with_fewer_beams(&self) -> Self {
        let mut settings = self.clone();
        settings.refinement.refine_beams = settings.refinement.refine_beams.min(FITTED_BEAMS);
        settings
    }
}

/// A pose that the car may be at.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Candidate {
    pub(crate) estimate: Estimate,
    /// Log-likelihood of a scan, averaged over the last ones.
    pub(crate) score: f64,
    /// Log of the prior odds, in the same units: what speaks for it beside the scans.
    pub(crate) prior: f64,
    /// Scans that it was held against, and over how long \[s\].
    scans: u32,
    seconds: f64,
}

/// How long one scan is remembered in a score \[s\].
const MEMORY: f64 = 0.5;

/// Variance that a candidate's position gains with the way, along and across it [m^2 per m], and its heading with the turn
/// [rad^2 per rad]: slip of a fifth of the way over an eighth of a metre, half of that sideways, and gyros of all kinds.
const NOISE_OF_MOTION: [f64; 3] = [0.005, 0.00125, 0.0035];

/// What all three gain with time [m^2 per s], [rad^2 per s].
const NOISE_OF_TIME: f64 = 0.004;

impl Candidate {
    /// A candidate from one scan alone.
    pub(crate) fn new(map: &TrackMap, scan: &PreprocessedScan, estimate: Estimate) -> Self {
        Self {
            estimate,
            score: score(map, scan, estimate.pose),
            prior: 0.0,
            scans: 1,
            seconds: 0.0,
        }
    }

    /// One that was followed for so long, with an averaged score.
    pub(crate) fn followed(estimate: Estimate, score: f64, scans: u32, seconds: f64) -> Self {
        Self {
            estimate,
            score,
            prior: 0.0,
            scans,
            seconds,
        }
    }

    /// How well the end points of the last scans lie on walls, in [0, 1].
    pub(crate) fn fit(&self) -> f64 {
        (self.score / INDEPENDENT).exp()
    }

    /// All that speaks for it.
    pub(crate) fn posterior_score(&self) -> f64 {
        self.score + self.prior
    }

    /// Carried on by a motion.
    pub(crate) fn moved(&self, motion: Pose, seconds: f64) -> Estimate {
        let way = motion.x.hypot(motion.y);
        let [along, across, turn] = NOISE_OF_MOTION;
        let time = NOISE_OF_TIME * seconds;
        let noise = Vector3::new(
            along * way + time,
            across * way + time,
            turn * motion.heading.abs() + time,
        );
        self.estimate.moved(motion, &Matrix3::from_diagonal(&noise))
    }

    /// Carried on by a motion, fitted to the next scan and held against it.
    pub(crate) fn follow(
        &mut self,
        map: &TrackMap,
        scan: &PreprocessedScan,
        motion: Pose,
        seconds: f64,
        settings: &SearchSettings,
    ) {
        let prior = self.moved(motion, seconds);
        self.estimate = refine(
            map.field(),
            &scan.points,
            prior.pose,
            &prior,
            WallCalibration::default(),
            &settings.refinement,
        );
        let score = score(map, scan, self.estimate.pose);
        self.seconds += seconds;
        self.scans = self.scans.saturating_add(1);
        self.score += averaging(seconds, self.scans) * (score - self.score);
    }
}

/// Share by which an average over [`MEMORY`] follows the next of so many scans.
pub(crate) fn averaging(seconds: f64, scans: u32) -> f64 {
    (1.0 - (-seconds / MEMORY).exp()).max(1.0 / f64::from(scans.max(1)))
}

/// A search under way.
#[derive(Debug, Clone)]
pub(crate) struct Search {
    /// Best first.
    pub(crate) candidates: Vec<Candidate>,
    driven: f64,
    /// Time since the last global check joined \[s\].
    since_check: f64,
    /// Fit below which no candidate is confirmed, and for how long the search goes on [s]: it is let go in time.
    least_fit: f64,
    seconds: f64,
}

/// How often new candidates join while none is confirmed [s]: soon if none explains the scan, else seldom.
const CHECK_EVERY: [f64; 2] = [0.3, 1.0];

/// A candidate worse than the best by this is dropped.
const HOPELESS: f64 = 12.0;

/// Candidates nearer than this are one \[m\], \[rad\].
const SAME: [f64; 2] = [0.3, 0.2];

/// Beams that a seed is fitted with: there are many seeds, and those that stay are fitted to every beam of the next scans.
const FITTED_BEAMS: usize = 180;

/// A candidate is confirmed after so many scans, and so long \[s\].
const CONFIRMED_AFTER: (u32, f64) = (3, 0.12);

/// Time over which a search lets go of the fit that it asks for \[s\].
const LEAST_FIT_FOR: f64 = 5.0;

/// Standard deviation of a candidate that motion has not confirmed \[m\], \[m\], [rad]: it may be another place.
const UNCONFIRMED: [f64; 3] = [1.0, 1.0, 0.5];

impl Default for Search {
    fn default() -> Self {
        Self {
            candidates: Vec::new(),
            driven: 0.0,
            since_check: f64::INFINITY,
            least_fit: 0.0,
            seconds: 0.0,
        }
    }
}

impl Search {
    /// A search that begins with candidates which were followed over so much driving \[m\], and that confirms none which fits
    /// worse than `least_fit` at first.
    pub(crate) fn with(
        candidates: Vec<Candidate>,
        driven: f64,
        least_fit: f64,
        settings: &SearchSettings,
    ) -> Self {
        let mut search = Self {
            candidates,
            driven,
            since_check: 0.0,
            least_fit,
            seconds: 0.0,
        };
        search.rank(settings.search.search_candidates);
        search
    }

    /// Takes in the next scan, and the motion since the one before. Returns the confirmed estimate.
    pub(crate) fn update(
        &mut self,
        map: &TrackMap,
        scan: &PreprocessedScan,
        motion: Pose,
        seconds: f64,
        settings: &SearchSettings,
    ) -> Option<Estimate> {
        self.driven += motion.x.hypot(motion.y);
        self.since_check += seconds;
        self.seconds += seconds;
        self.candidates
            .par_iter_mut()
            .for_each(|candidate| candidate.follow(map, scan, motion, seconds, settings));
        self.rank(settings.search.search_candidates);
        self.confirmed(&settings.search)
    }

    /// Whether it is time for a look at the whole map.
    pub(crate) fn wants_check(&self) -> bool {
        let explained = self.candidates.iter().any(|candidate| explains(candidate.score));
        self.candidates.is_empty() || self.since_check >= CHECK_EVERY[usize::from(explained)]
    }

    /// Looks at the whole map with the next scan.
    pub(crate) fn check_soon(&mut self) {
        self.since_check = f64::INFINITY;
    }

    /// Candidates of a global check join.
    pub(crate) fn add(&mut self, candidates: Vec<Candidate>, settings: &SearchSettings) {
        self.since_check = 0.0;
        self.candidates.extend(candidates);
        self.rank(settings.search.search_candidates);
    }

    /// Best first, without doubles and the hopeless. Of two that are one the older stays, with what it has explained.
    fn rank(&mut self, most: usize) {
        let by_score = |a: &Candidate, b: &Candidate| b.posterior_score().total_cmp(&a.posterior_score());
        self.candidates.sort_by(by_score);
        let best = self.candidates.first().map_or(0.0, Candidate::posterior_score);
        let mut kept: Vec<Candidate> = Vec::with_capacity(most);
        for candidate in &self.candidates {
            if candidate.posterior_score() < best - HOPELESS {
                break;
            }
            let pose = candidate.estimate.pose;
            let twin = kept.iter_mut().find(|other| same(other.estimate.pose, pose));
            if let Some(twin) = twin {
                if candidate.seconds > twin.seconds {
                    *twin = *candidate;
                }
            } else if kept.len() < most {
                kept.push(*candidate);
            } else {
                break;
            }
        }
        kept.sort_by(by_score);
        self.candidates = kept;
    }

    /// The best candidate, with a covariance as large as the doubt: how far the others are spread about it by their
    /// likelihood, and never less than [`UNCONFIRMED`].
    pub(crate) fn best_so_far(&self) -> Option<Estimate> {
        let best = self.candidates.first()?;
        let mut spread = Matrix3::zeros();
        let mut mass = 0.0;
        for candidate in &self.candidates {
            let weight = (candidate.posterior_score() - best.posterior_score()).exp();
            let off = offset(best.estimate.pose, candidate.estimate.pose);
            spread += (candidate.estimate.covariance + off * off.transpose()) * weight;
            mass += weight;
        }
        let floor = UNCONFIRMED.map(|sigma| sigma * sigma);
        Some(Estimate {
            pose: best.estimate.pose,
            covariance: spread / mass + Matrix3::from_diagonal(&Vector3::from(floor)),
        })
    }

    fn confirmed(&self, parameters: &SearchParameters) -> Option<Estimate> {
        let best = self.candidates.first()?;
        let margin = self.candidates.get(1).map_or(f64::INFINITY, |second| {
            best.posterior_score() - second.posterior_score()
        });
        // A car that stands still is believed when there is no doubt at all.
        let moved = self.driven >= parameters.search_distance;
        let needed = if moved {
            parameters.search_margin
        } else {
            3.0 * parameters.search_margin
        };
        // Not before the rest of the map was looked at.
        if self.since_check.is_infinite() {
            return None;
        }
        let (scans, seconds) = CONFIRMED_AFTER;
        let followed = best.scans >= scans && best.seconds >= seconds;
        let fits = best.fit() >= self.least_fit * (-self.seconds / LEAST_FIT_FOR).exp();
        (followed && fits && explains(best.score) && margin >= needed).then_some(best.estimate)
    }

    /// The odometry has jumped, and the car is at `stayed`, where it would be without, or at `moved`, where it was carried,
    /// or where it drove while messages were missing: no farther than `reach` \[m\].
    pub(crate) fn after_jump(
        map: &TrackMap,
        scan: &PreprocessedScan,
        [stayed, moved]: [Pose; 2],
        reach: f64,
        settings: &SearchSettings,
    ) -> AfterJump {
        let distance = stayed.distance(moved);
        // So little is the filter's to mend.
        if distance < NEARBY && same_way(stayed, moved) {
            return AfterJump::Stayed;
        }
        let candidate = |pose| Candidate::new(map, scan, fitted(map, scan, pose, settings));
        // Odometry errs by a few per cent of its way, and turns; of places that fit alike it knows best.
        let astray = (ASTRAY * stayed.distance(moved)).clamp(STEP, 10.0 * STEP);
        let steps = (astray / STEP) as i32;
        let starts: Vec<_> = (-steps..=steps)
            .flat_map(|on| (0..9).map(move |k| [on, k % 3 - 1, k / 3 - 1].map(f64::from)))
            .map(|[on, left, turn]| Pose::new(STEP * on, STEP * left, TURN * turn))
            .collect();
        let Some((_, mut moved)) = starts
            .into_par_iter()
            .map(|by| {
                let found = candidate(moved * by);
                (found.score - 0.5 * (by.x.hypot(by.y) / astray).powi(2), found)
            })
            .max_by(|(a, _), (b, _)| a.total_cmp(b))
        else {
            return AfterJump::Stayed;
        };
        let stayed = candidate(stayed);
        let margin = settings.search.search_margin;
        if explains(stayed.score) && stayed.score > moved.score + margin {
            return AfterJump::Stayed;
        }
        if explains(stayed.score) && distance > reach && moved.score < stayed.score + margin {
            return AfterJump::Rival(moved);
        }
        // Perhaps it is neither.
        let mut since_check = f64::INFINITY;
        if explains(moved.score) && moved.score >= stayed.score {
            since_check = 0.0;
            moved.prior = PRIOR_OF_JUMP * settings.search.search_margin;
            moved.estimate.covariance +=
                Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, 0.0)) * astray.powi(2);
        }
        AfterJump::Search(Self {
            candidates: vec![moved, stayed],
            driven: 0.0,
            since_check,
            least_fit: 0.0,
            seconds: 0.0,
        })
    }
}

/// What a jump of the odometry means.
#[derive(Debug, Clone)]
pub(crate) enum AfterJump {
    /// The car is where it would be without.
    Stayed,
    /// It probably is: no car comes so far in the time, but the scan could be from there, too.
    Rival(Candidate),
    /// It may be at either place, or at neither.
    Search(Search),
}

/// A jump of odometry by less than this is no other place \[m\].
const NEARBY: f64 = 0.6;

/// Odometry's share of error over a way of which nothing was seen...
const ASTRAY: f64 = 0.05;
/// ...and how far apart poses at its end are tried \[m\], \[rad\].
const STEP: f64 = 0.2;
const TURN: f64 = 0.06;

/// Odometry that begins anew puts the car just anywhere, hardly ever where the scan fits as well as before: where it does,
/// this many times the margin is the log of its prior odds.
const PRIOR_OF_JUMP: f64 = 1.5;

/// A look at the whole map for where one scan may have been taken. It takes some 30 ms on one core, and is made to run on
/// another thread than the filter's.
#[derive(Debug, Clone)]
pub struct GlobalCheck {
    pub(crate) map: Arc<TrackMap>,
    pub(crate) scan: PreprocessedScan,
    pub(crate) settings: SearchSettings,
    /// Which check it is.
    pub(crate) number: u64,
}

/// What a [`GlobalCheck`] has found.
#[derive(Debug, Clone)]
pub struct GlobalCheckOutcome {
    pub(crate) candidates: Vec<Candidate>,
    pub(crate) number: u64,
}

impl GlobalCheck {
    /// Looks. The same scan gives the same outcome, on whatever threads.
    pub fn run(self) -> GlobalCheckOutcome {
        GlobalCheckOutcome {
            candidates: global_check(&self.map, &self.scan, &self.settings),
            number: self.number,
        }
    }
}

/// Candidates from one scan alone.
pub(crate) fn global_check(
    map: &TrackMap,
    scan: &PreprocessedScan,
    settings: &SearchSettings,
) -> Vec<Candidate> {
    seed(map, &scan.points, &settings.search)
        .into_par_iter()
        .map(|pose| Candidate::new(map, scan, fitted(map, scan, pose, settings)))
        .collect()
}

/// Whether a score is that of a pose which explains a scan, at least in good part.
fn explains(score: f64) -> bool {
    score > INDEPENDENT * 0.35f64.ln()
}

/// The fit of part of a scan near a pose that is known only coarsely.
fn fitted(map: &TrackMap, scan: &PreprocessedScan, pose: Pose, settings: &SearchSettings) -> Estimate {
    let prior = Estimate {
        pose,
        covariance: Matrix3::from_diagonal(&Vector3::new(0.04, 0.04, 0.01)),
    };
    let parameters = RefinementParameters {
        refine_beams: settings.refinement.refine_beams.min(FITTED_BEAMS),
        ..settings.refinement.clone()
    };
    refine(
        map.field(),
        &scan.points,
        pose,
        &prior,
        WallCalibration::default(),
        &parameters,
    )
}

/// How far `there` lies from `here`, in the frame of both.
pub(crate) fn offset(here: Pose, there: Pose) -> Vector3<f64> {
    Vector3::new(
        there.x - here.x,
        there.y - here.y,
        wrap_angle(there.heading - here.heading),
    )
}

pub(crate) fn same(a: Pose, b: Pose) -> bool {
    are_near(a, b, SAME)
}

fn same_way(a: Pose, b: Pose) -> bool {
    wrap_angle(a.heading - b.heading).abs() < SAME[1]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::quality::tests::scan;
    use maps::{Cell, OccupancyGrid};
    use std::f64::consts::PI;

    fn candidate(x: f64, score: f64, scans: u32, seconds: f64) -> Candidate {
        let estimate = Estimate {
            pose: Pose::new(x, 0.0, 0.0),
            covariance: Matrix3::identity(),
        };
        Candidate::followed(estimate, score, scans, seconds)
    }

    #[test]
    fn of_two_equal_candidates_the_older_stays() {
        let (older, newer) = (candidate(0.0, -3.0, 20, 0.5), candidate(0.1, -1.0, 1, 0.0));
        let elsewhere = candidate(9.0, -2.0, 1, 0.0);
        let search = Search::with(
            vec![newer, older, elsewhere],
            1.0,
            0.0,
            &SearchSettings::default(),
        );
        assert_eq!(search.candidates, [elsewhere, older]);
    }

    /// Odometry that began anew put the car 53 m away, where a straight looks the same, and the right pose was given up.
    #[test]
    fn a_jump_that_no_car_makes_does_not_move_a_pose_that_fits() {
        let cell = |column: usize, row: usize| match (column, row) {
            (20..=22 | 217..=219, 20..=139) | (20..=219, 20..=22 | 137..=139) => Cell::Occupied,
            (20..=219, 20..=139) => Cell::Free,
            _ => Cell::Unknown,
        };
        // Turned by half a turn it is the same.
        let grid = OccupancyGrid::from_fn(240, 160, 0.05, Pose::IDENTITY, cell);
        let map = TrackMap::new(grid).expect("free space");
        let (here, alike) = (Pose::new(4.0, 3.0, 0.3), Pose::new(8.0, 5.0, 0.3 - PI));
        let scan = scan(&map, here);
        let after =
            |to, reach| Search::after_jump(&map, &scan, [here, to], reach, &SearchSettings::default());
        assert!(
            matches!(after(alike, 1.3), AfterJump::Rival(rival) if rival.estimate.pose.distance(alike) < 0.1)
        );
        assert!(
            matches!(after(alike, 10.0), AfterJump::Search(_)),
            "messages were missing"
        );
        assert!(matches!(after(Pose::new(9.0, 2.5, 1.0), 1.3), AfterJump::Stayed));
    }

    #[test]
    fn a_candidates_uncertainty_grows_alike_at_every_scan_rate() {
        let grown = |rate: u32| {
            let step = Pose::new(5.0 / f64::from(rate), 0.0, 1.0 / f64::from(rate));
            let mut candidate = candidate(0.0, 0.0, 1, 0.0);
            candidate.estimate.covariance = Matrix3::zeros();
            for _ in 0..rate {
                candidate.estimate = candidate.moved(step, 1.0 / f64::from(rate));
            }
            candidate.estimate.covariance
        };
        let slow = grown(10);
        for rate in [20, 40] {
            let fast = grown(rate);
            assert!(
                (fast - slow).norm() < 0.15 * slow.norm(),
                "{rate} Hz: {fast} at 10 Hz: {slow}"
            );
        }
        let averaged = |rate: u32| {
            let mut score = 0.0;
            for scan in 0..rate / 2 {
                score += averaging(1.0 / f64::from(rate), scan + 100) * (1.0 - score);
            }
            score
        };
        for rate in [10, 20, 40] {
            assert!((averaged(rate) - averaged(100)).abs() < 1e-9, "{rate} Hz");
        }
    }
}
