//! The search of the whole map: candidates from one scan, told apart by motion.
//!
//! A single scan is not safe: on a track the best and the second-best pose often tie. So the scan is matched
//! against the distance field everywhere (after Olson, ICRA 2009, with one coarse level and Gauss-Newton in place
//! of the fine ones), the best candidates are kept, and each follows odometry and the next scans on its own until
//! one of them explains all of it clearly better than the rest.

use maps::{Pose, wrap_angle};
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::TrackMap;
use crate::beams::ReadyScan;
use crate::parameters::{Check, Parameters};
use crate::refine::{Estimate, fit, refine};

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
            search_turn: 0.0873,
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

/// A pose that the car may be at.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Candidate {
    pub(crate) estimate: Estimate,
    /// Log-likelihood of a scan, averaged over the last ones.
    pub(crate) score: f64,
    /// Scans that it has explained.
    scans: u32,
}

/// A search under way.
#[derive(Debug, Clone, Default)]
pub(crate) struct Search {
    /// Best first.
    pub(crate) candidates: Vec<Candidate>,
    driven: f64,
    seconds: f64,
    since_seeding: f64,
}

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

/// Beams that the coarse match looks at.
const COARSE_BEAMS: usize = 36;

/// Coarse poses that are looked through for the best of each neighbourhood.
const COARSE: usize = 6000;

/// Neighbouring beams err together: the score counts this many as independent.
const INDEPENDENT: f64 = 20.0;

impl Search {
    /// Takes in the next scan, and the motion and noise since the one before. Returns the confirmed estimate.
    pub(crate) fn update(
        &mut self,
        map: &TrackMap,
        scan: &ReadyScan,
        motion: Pose,
        seconds: f64,
        parameters: &Parameters,
    ) -> Option<Estimate> {
        self.driven += motion.x.hypot(motion.y);
        self.seconds += seconds;
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
            self.candidates.extend(seed(map, scan, parameters));
        }
        self.rank(parameters.search.search_candidates);
        self.confirmed(parameters)
    }

    /// Best first, without doubles and the hopeless.
    fn rank(&mut self, most: usize) {
        self.candidates.sort_by(|a, b| b.score.total_cmp(&a.score));
        let best = self.candidates.first().map_or(0.0, |candidate| candidate.score);
        let mut kept: Vec<Candidate> = Vec::with_capacity(most);
        for candidate in &self.candidates {
            if kept.len() == most || candidate.score < best - HOPELESS {
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

    fn confirmed(&self, parameters: &Parameters) -> Option<Estimate> {
        let best = self.candidates.first()?;
        let margin = self
            .candidates
            .get(1)
            .map_or(f64::INFINITY, |second| best.score - second.score);
        // A car that stands still is believed when there is no doubt at all.
        let moved = self.driven >= parameters.search.search_distance;
        let needed = if moved {
            parameters.search.search_margin
        } else {
            3.0 * parameters.search.search_margin
        };
        (best.scans >= 6 && explains(best.score) && margin >= needed).then_some(best.estimate)
    }

    /// Looks for a pose elsewhere that explains a scan clearly better than `pose` does; with what was found, a
    /// search can begin.
    pub(crate) fn second_opinion(
        map: &TrackMap,
        scan: &ReadyScan,
        pose: Pose,
        parameters: &Parameters,
    ) -> Option<Self> {
        let mut search = Self {
            candidates: seed(map, scan, parameters),
            ..Self::default()
        };
        search.rank(parameters.search.search_candidates);
        let best = search.candidates.first()?;
        let own = score(map, scan, pose);
        let elsewhere = !same(best.estimate.pose, pose);
        (elsewhere && best.score >= own + parameters.search.search_margin).then_some(search)
    }
}

/// Whether a score is that of a pose which explains a scan, at least in good part.
fn explains(score: f64) -> bool {
    score > INDEPENDENT * 0.35f64.ln()
}

fn same(a: Pose, b: Pose) -> bool {
    a.distance(b) < SAME[0] && wrap_angle(a.heading - b.heading).abs() < SAME[1]
}

/// Log-likelihood of a scan at a pose: the robust fit of its end points.
fn score(map: &TrackMap, scan: &ReadyScan, pose: Pose) -> f64 {
    let on_track = map.field().nearest(
        (pose.x / map.grid().resolution) as f32,
        (pose.y / map.grid().resolution) as f32,
    );
    if on_track.is_none_or(|distance| distance <= 0.0) {
        return INDEPENDENT * 0.02f64.ln();
    }
    INDEPENDENT * fit(map.field(), &scan.points, BEAMS, pose, 0.08).max(0.02).ln()
}

/// Candidates from one scan alone: every position and heading tried coarsely, the best refined.
fn seed(map: &TrackMap, scan: &ReadyScan, parameters: &Parameters) -> Vec<Candidate> {
    let field = map.field();
    let resolution = map.grid().resolution;
    let width = map.grid().width;
    let step = (parameters.search.search_step / resolution).round().max(1.0) as usize;
    let clearance = 0.12f32;
    let positions: Vec<[f32; 2]> = map
        .plausible_regions()
        .into_iter()
        .flat_map(|region| map.regions()[region].cells.iter())
        .map(|&cell| (cell as usize % width, cell as usize / width, cell as usize))
        .filter(|&(column, row, cell)| {
            column % step == 0 && row % step == 0 && field.values()[cell] > clearance
        })
        .map(|(column, row, _)| [column as f32 + 0.5, row as f32 + 0.5])
        .collect();
    let headings = (std::f64::consts::TAU / parameters.search.search_turn).ceil() as usize;
    let stride = scan.points.len().div_ceil(COARSE_BEAMS).max(1);
    let cells = 1.0 / resolution as f32;
    // How far off a coarse pose is [m], over which an end point still counts.
    let reach = parameters.search.search_step as f32;
    let mut coarse: Vec<(f32, Pose)> = (0..headings)
        .into_par_iter()
        .flat_map_iter(|k| {
            let heading = k as f64 / headings as f64 * std::f64::consts::TAU;
            let (sin, cos) = (heading.sin() as f32 * cells, heading.cos() as f32 * cells);
            let turned: Vec<[f32; 2]> = scan
                .points
                .iter()
                .step_by(stride)
                .map(|p| [cos * p[0] - sin * p[1], sin * p[0] + cos * p[1]])
                .collect();
            let per_point = 1.0 / turned.len() as f32;
            positions
                .iter()
                .map(|at| {
                    let mut sum = 0.0;
                    for point in &turned {
                        if let Some(distance) = field.nearest(at[0] + point[0], at[1] + point[1]) {
                            let ratio = distance / reach;
                            sum += 1.0 / (1.0 + ratio * ratio);
                        }
                    }
                    let [x, y] = at.map(|v| f64::from(v) * resolution);
                    (sum * per_point, Pose::new(x, y, heading))
                })
                .filter(|&(fit, _)| fit > 0.3)
                .collect::<Vec<_>>()
        })
        .collect();
    if coarse.len() > COARSE {
        coarse.select_nth_unstable_by(COARSE, |a, b| b.0.total_cmp(&a.0));
        coarse.truncate(COARSE);
    }
    coarse.sort_by(|a, b| b.0.total_cmp(&a.0));
    // The best of each neighbourhood.
    let most = 3 * parameters.search.search_candidates;
    let mut picked: Vec<Pose> = Vec::with_capacity(most);
    for (_, pose) in coarse {
        let near = |other: &Pose| {
            other.distance(pose) < 0.45 && wrap_angle(other.heading - pose.heading).abs() < 0.3
        };
        if !picked.iter().any(near) {
            picked.push(pose);
            if picked.len() == most {
                break;
            }
        }
    }
    let spread = Matrix3::from_diagonal(&Vector3::new(0.04, 0.04, 0.01));
    picked
        .into_par_iter()
        .map(|pose| {
            let prior = Estimate {
                pose,
                covariance: spread,
            };
            let estimate = refine(field, &scan.points, pose, &prior, &parameters.refinement);
            Candidate {
                estimate,
                score: score(map, scan, estimate.pose),
                scans: 1,
            }
        })
        .collect()
}
