//! The search of the whole map: candidates from one scan, told apart by motion.
//!
//! A single scan is not safe: on a track the best and the second-best pose often tie. So the scan is matched
//! against the map everywhere ([`crate::seed`]), the best candidates are kept, and each follows odometry and the next scans on
//! its own until one of them explains all of it clearly better than the rest.

use maps::{Pose, wrap_angle};
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::calibration::WallCalibration;
use crate::estimate::Estimate;
use crate::preprocessed_scan::PreprocessedScan;
use crate::scan_matcher::{RefinementParameters, fit_by, refine};
use crate::seed::seed;
use crate::surprise::Fall;
use crate::track_map::TrackMap;
use crate::validation::Check;

/// Parameters of the search.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct SearchParameters {
    /// Distance between the positions that are tried [m].
    pub search_step: f64,
    /// Angle between the headings that are tried [rad].
    pub search_turn: f64,
    /// Candidates that are followed.
    pub search_candidates: usize,
    /// By how much the best must explain a scan better than the next, in units of log-likelihood.
    pub search_margin: f64,
    /// Distance that the car must have driven before one is confirmed [m].
    pub search_distance: f64,
}

impl Default for SearchParameters {
    fn default() -> Self {
        Self {
            search_step: 0.2,
            search_turn: 0.0524,
            search_candidates: 40,
            search_margin: 2.0,
            search_distance: 0.5,
        }
    }
}

impl SearchParameters {
    pub(crate) fn validate(&self, check: &mut Check) {
        check.range("search_step", self.search_step, 0.05, 2.0);
        check.range("search_turn", self.search_turn, 0.01, 0.6);
        check.range("search_candidates", self.search_candidates as f64, 2.0, 1000.0);
        check.range("search_margin", self.search_margin, 0.0, 1000.0);
        check.range("search_distance", self.search_distance, 0.0, 100.0);
    }
}

/// The parts of a parameter set that a search goes by.
#[derive(Debug, Clone, Default)]
pub(crate) struct SearchSettings {
    pub(crate) search: SearchParameters,
    pub(crate) refinement: RefinementParameters,
}

/// A pose that the car may be at.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Candidate {
    pub(crate) estimate: Estimate,
    /// Log-likelihood of a scan, averaged over the last ones.
    pub(crate) score: f64,
    /// What speaks for it beside the scans, in the same units.
    favour: f64,
    /// Scans that it has explained.
    scans: u32,
}

impl Candidate {
    /// A candidate from one scan alone.
    fn new(map: &TrackMap, scan: &PreprocessedScan, estimate: Estimate) -> Self {
        Self {
            estimate,
            score: score(map, scan, estimate.pose),
            favour: 0.0,
            scans: 1,
        }
    }

    /// All that speaks for it.
    fn merit(&self) -> f64 {
        self.score + self.favour
    }
}

/// A search under way.
#[derive(Debug, Clone, Default)]
pub(crate) struct Search {
    /// Best first.
    pub(crate) candidates: Vec<Candidate>,
    driven: f64,
    since_seeding: f64,
}

/// Standard deviation of a candidate that motion has not confirmed [m], [m], [rad]: it may be another place.
const UNCONFIRMED: [f64; 3] = [1.0, 1.0, 0.5];

/// How long one scan is remembered in a score [s].
const MEMORY: f64 = 0.5;

/// How often new candidates join while none is confirmed [s]: soon if none explains the scan, else seldom.
const RESEED: [f64; 2] = [0.3, 1.0];

/// A candidate worse than the best by this is dropped.
const HOPELESS: f64 = 12.0;

/// Candidates nearer than this are one [m], [rad].
const SAME: [f64; 2] = [0.3, 0.2];

/// Beams that the score looks at.
const BEAMS: usize = 60;

/// Beams that a seed is fitted with: there are many seeds, and those that stay are fitted to every beam of the next scans.
const FITTED_BEAMS: usize = 180;

/// Neighbouring beams err together: the score counts this many as independent.
pub(crate) const INDEPENDENT: f64 = 20.0;

impl Search {
    /// Takes in the next scan, and the motion and noise since the one before. Returns the confirmed estimate.
    pub(crate) fn update(
        &mut self,
        map: &TrackMap,
        scan: &PreprocessedScan,
        motion: Pose,
        seconds: f64,
        parameters: &SearchSettings,
    ) -> Option<Estimate> {
        self.driven += motion.x.hypot(motion.y);
        self.since_seeding += seconds;
        let forget = (seconds / MEMORY).clamp(0.01, 0.5);
        let noise = Matrix3::from_diagonal(&Vector3::new(
            (0.2 * motion.x).powi(2) + 1e-4,
            (0.1 * motion.x).powi(2) + 1e-4,
            (0.3 * motion.heading).powi(2) + 1e-4,
        ));
        self.candidates.par_iter_mut().for_each(|candidate| {
            let prior = candidate.estimate.moved(motion, &noise);
            candidate.estimate = refine(
                map.field(),
                &scan.points,
                prior.pose,
                &prior,
                WallCalibration::default(),
                &parameters.refinement,
            );
            let score = score(map, scan, candidate.estimate.pose);
            let share = forget.max(1.0 / f64::from(candidate.scans + 1));
            candidate.scans += 1;
            candidate.score += share * (score - candidate.score);
        });
        let explained = self.candidates.iter().any(|candidate| explains(candidate.score));
        if self.candidates.is_empty() || self.since_seeding >= RESEED[usize::from(explained)] {
            self.since_seeding = 0.0;
            self.candidates.extend(candidates(map, scan, parameters));
        }
        self.rank(parameters.search.search_candidates);
        self.confirmed(parameters)
    }

    /// Best first, without doubles and the hopeless.
    fn rank(&mut self, most: usize) {
        self.candidates.sort_by(|a, b| b.merit().total_cmp(&a.merit()));
        let best = self.candidates.first().map_or(0.0, Candidate::merit);
        let mut kept: Vec<Candidate> = Vec::with_capacity(most);
        for candidate in &self.candidates {
            if kept.len() == most || candidate.merit() < best - HOPELESS {
                break;
            }
            let pose = candidate.estimate.pose;
            // Of two that are one the older is kept: it has explained more.
            match kept.iter_mut().find(|other| same(other.estimate.pose, pose)) {
                Some(other) if candidate.scans > other.scans => {
                    other.scans = candidate.scans;
                }
                Some(_) => {}
                None => kept.push(*candidate),
            }
        }
        self.candidates = kept;
    }

    /// The best candidate, with a covariance as large as the doubt: how far the others are spread about it by their
    /// likelihood, and never less than [`UNCONFIRMED`].
    pub(crate) fn best_so_far(&self) -> Option<Estimate> {
        let best = self.candidates.first()?;
        let floor = UNCONFIRMED.map(|sigma| sigma * sigma);
        let mut spread = Matrix3::zeros();
        let mut mass = 0.0;
        for candidate in &self.candidates {
            let weight = (candidate.merit() - best.merit()).exp();
            let (here, there) = (best.estimate.pose, candidate.estimate.pose);
            let off = Vector3::new(
                there.x - here.x,
                there.y - here.y,
                wrap_angle(there.heading - here.heading),
            );
            spread += (candidate.estimate.covariance + off * off.transpose()) * weight;
            mass += weight;
        }
        Some(Estimate {
            pose: best.estimate.pose,
            covariance: spread / mass + Matrix3::from_diagonal(&Vector3::from(floor)),
        })
    }

    fn confirmed(&self, parameters: &SearchSettings) -> Option<Estimate> {
        let best = self.candidates.first()?;
        let margin = self
            .candidates
            .get(1)
            .map_or(f64::INFINITY, |second| best.merit() - second.merit());
        // A car that stands still is believed when there is no doubt at all.
        let moved = self.driven >= parameters.search.search_distance;
        let needed = if moved {
            parameters.search.search_margin
        } else {
            3.0 * parameters.search.search_margin
        };
        (best.scans >= 6 && explains(best.score) && margin >= needed).then_some(best.estimate)
    }

    /// The odometry has jumped, and the car is at `stayed`, where it would be without, or at `moved`, where it was carried,
    /// or where it drove while messages were missing. None when it stayed; else a search has begun with both.
    pub(crate) fn after_jump(
        map: &TrackMap,
        scan: &PreprocessedScan,
        [stayed, moved]: [Pose; 2],
        parameters: &SearchSettings,
    ) -> Option<Self> {
        // So little is the filter's to mend.
        if stayed.distance(moved) < 0.1 * f64::from(NEARBY) && same_way(stayed, moved) {
            return None;
        }
        let candidate = |pose| Candidate::new(map, scan, fitted(map, scan, pose, parameters));
        // Odometry errs by a few per cent of its way, and turns; of places that fit alike it knows best.
        let astray = (ASTRAY * stayed.distance(moved)).clamp(STEP, 10.0 * STEP);
        let steps = (astray / STEP) as i32;
        let starts: Vec<_> = (-steps..=steps)
            .flat_map(|on| (0..9).map(move |k| [on, k % 3 - 1, k / 3 - 1].map(f64::from)))
            .map(|[on, left, turn]| Pose::new(STEP * on, STEP * left, TURN * turn))
            .collect();
        let (_, mut moved) = starts
            .into_par_iter()
            .map(|by| {
                let found = candidate(moved * by);
                (found.score - 0.5 * (by.x.hypot(by.y) / astray).powi(2), found)
            })
            .max_by(|(a, _), (b, _)| a.total_cmp(b))
            .expect("at least one");
        let stayed = candidate(stayed);
        if explains(stayed.score) && stayed.score > moved.score + parameters.search.search_margin {
            return None;
        }
        let mut search = Self::default();
        if explains(moved.score) && moved.score >= stayed.score {
            moved.favour = FAVOUR * parameters.search.search_margin;
            moved.estimate.covariance +=
                Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, 0.0)) * astray.powi(2);
        } else {
            // Perhaps it is neither.
            search.since_seeding = f64::INFINITY;
        }
        search.candidates = vec![moved, stayed];
        Some(search)
    }

    /// Looks for a pose elsewhere that explains a scan clearly better than `pose` does; with what was found, a
    /// search can begin. `fall` says that the scan fits worse than usual.
    pub(crate) fn second_opinion(
        map: &TrackMap,
        scan: &PreprocessedScan,
        pose: Pose,
        sudden: bool,
        fall: Option<Fall>,
        parameters: &SearchSettings,
    ) -> Option<Self> {
        let mut search = Self {
            candidates: candidates(map, scan, parameters),
            ..Self::default()
        };
        search.rank(parameters.search.search_candidates);
        let best = search.candidates.first()?;
        // At the end of a straight a pose is often a little too far on or back. That is the filter's to mend.
        // And it has as much of a chance to follow this scan as the candidates have.
        let freely = fitted(map, scan, pose, parameters);
        let own = (-NEARBY..=NEARBY)
            .flat_map(|step| {
                [pose, freely.pose].map(|pose| pose * Pose::new(0.1 * f64::from(step), 0.0, 0.0))
            })
            .map(|pose| score(map, scan, pose))
            .fold(f64::MIN, f64::max);
        // One scan often fits several places of a large map, and where something stands in view or the map is out of
        // date, another one better: a pose that explains the scan in good part is not given up for that, unless the fit
        // has fallen from one scan to the next, or is worse than usual while the other place explains as much as usual.
        let usual = fall.map(|fall| INDEPENDENT * fall.least.max(0.02).ln());
        let as_usual = usual.is_some_and(|usual| best.score >= usual);
        if explains(own) && !sudden && !as_usual {
            return None;
        }
        // On a map that is out of date something fits by chance, hardly ever well.
        if best.score < INDEPENDENT * CONVINCING.ln() {
            return None;
        }
        let elsewhere = !same(best.estimate.pose, pose);
        let most = parameters.search.search_margin;
        // Along a straight a wrong place fits nearly as well as the right one; that the pose jumped is evidence as well.
        let margin = match usual {
            Some(usual) if as_usual && fall.is_some_and(|fall| fall.jumped) => {
                (0.5 * (usual - own)).clamp(0.15 * most, most)
            }
            _ => most,
        };
        if !elsewhere || best.score < own + margin {
            return None;
        }
        // It may be right after all.
        search.candidates.push(Candidate::new(map, scan, freely));
        Some(search)
    }
}

/// Fit of a place for which another one is given up.
const CONVINCING: f64 = 0.7;

/// Weight of a beam that says nothing.
const NEUTRAL: f32 = 0.5;

/// A pose may be wrong by this much along its heading without being another place [0.1 m].
const NEARBY: i32 = 6;

/// Odometry's share of error over a way of which nothing was seen...
const ASTRAY: f64 = 0.05;
/// ...and how far apart poses at its end are tried [m], [rad].
const STEP: f64 = 0.2;
const TURN: f64 = 0.06;

/// Odometry that begins anew puts the car just anywhere, hardly ever where the scan fits as well as before: where it does,
/// this many times the margin speaks for it.
const FAVOUR: f64 = 1.5;

/// Whether a score is that of a pose which explains a scan, at least in good part.
fn explains(score: f64) -> bool {
    score > INDEPENDENT * 0.35f64.ln()
}

/// How well a scan's end points lie on walls at a pose, in [0, 1]: what scores are made of. A beam that ends where nothing
/// was mapped speaks neither for the pose nor against it.
pub(crate) fn fit_of(map: &TrackMap, scan: &PreprocessedScan, pose: Pose) -> f64 {
    let laser = pose * scan.base_link_from_laser;
    let laser = [laser.x as f32, laser.y as f32];
    fit_by(map.field(), &scan.points, BEAMS, pose, 0.08, |weight, end| {
        if weight < NEUTRAL && map.unmapped(laser, end) {
            NEUTRAL
        } else {
            weight
        }
    })
}

/// Candidates from one scan alone.
fn candidates(map: &TrackMap, scan: &PreprocessedScan, parameters: &SearchSettings) -> Vec<Candidate> {
    seed(map, &scan.points, &parameters.search)
        .into_par_iter()
        .map(|pose| Candidate::new(map, scan, fitted(map, scan, pose, parameters)))
        .collect()
}

/// The fit of part of a scan near a pose that is known only coarsely.
fn fitted(map: &TrackMap, scan: &PreprocessedScan, pose: Pose, parameters: &SearchSettings) -> Estimate {
    let prior = Estimate {
        pose,
        covariance: Matrix3::from_diagonal(&Vector3::new(0.04, 0.04, 0.01)),
    };
    let parameters = RefinementParameters {
        refine_beams: parameters.refinement.refine_beams.min(FITTED_BEAMS),
        ..parameters.refinement.clone()
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

fn same(a: Pose, b: Pose) -> bool {
    a.distance(b) < SAME[0] && same_way(a, b)
}

fn same_way(a: Pose, b: Pose) -> bool {
    wrap_angle(a.heading - b.heading).abs() < SAME[1]
}

/// Log-likelihood of a scan at a pose: the robust fit of its end points.
fn score(map: &TrackMap, scan: &PreprocessedScan, pose: Pose) -> f64 {
    let on_track = map.field().nearest(
        (pose.x / map.grid().resolution) as f32,
        (pose.y / map.grid().resolution) as f32,
    );
    if on_track.is_none_or(|distance| distance <= 0.0) {
        return INDEPENDENT * 0.02f64.ln();
    }
    INDEPENDENT * fit_of(map, scan, pose).max(0.02).ln()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::quality::tests::{room, scan};

    #[test]
    fn another_place_is_convincing_or_none_is_better() {
        let map = room();
        let (truth, wrong) = (Pose::new(9.0, 4.0, 0.3), Pose::new(3.0, 5.5, 1.4));
        // With so many of ten beams on something that is not on the map.
        let opinion = |strange: usize| {
            let mut scan = scan(&map, truth);
            for (_, point) in scan
                .points
                .iter_mut()
                .enumerate()
                .filter(|(i, _)| i / 9 % 10 < strange)
            {
                *point = point.map(|v| 0.6 * v);
            }
            Search::second_opinion(&map, &scan, wrong, true, None, &SearchSettings::default())
        };
        let search = opinion(0).expect("a better place");
        assert!(same(search.candidates[0].estimate.pose, truth), "{search:?}");
        assert_eq!(opinion(5).map(|search| search.candidates.len()), None);
    }
}
