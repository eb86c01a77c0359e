//! The search of the whole map: candidates from one scan, told apart by motion.
//!
//! A single scan is not safe: on a track the best and the second-best pose often tie. So the scan is matched
//! against the distance field everywhere (after Olson, ICRA 2009, with one coarse level and Gauss-Newton in place
//! of the fine ones), the best candidates are kept, and each follows odometry and the next scans on its own until
//! one of them explains all of it clearly better than the rest.

use std::cmp::Ordering;

use maps::{DistanceField, OccupancyGrid, Pose, wrap_angle};
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::TrackMap;
use crate::beams::ReadyScan;
use crate::parameters::{Check, Parameters};
use crate::refine::{Estimate, fit, refine};
use crate::surprise::Fall;

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
                0.0,
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
    /// search can begin. `fall` says that the scan fits worse than usual.
    pub(crate) fn second_opinion(
        map: &TrackMap,
        scan: &ReadyScan,
        pose: Pose,
        sudden: bool,
        fall: Option<Fall>,
        parameters: &Parameters,
    ) -> Option<Self> {
        let mut search = Self {
            candidates: seed(map, scan, parameters),
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
        search.candidates.push(Candidate {
            estimate: freely,
            score: score(map, scan, freely.pose),
            scans: 1,
        });
        Some(search)
    }
}

/// A pose may be wrong by this much along its heading without being another place [0.1 m].
const NEARBY: i32 = 6;

/// Whether a score is that of a pose which explains a scan, at least in good part.
fn explains(score: f64) -> bool {
    score > INDEPENDENT * 0.35f64.ln()
}

/// How well a scan's end points lie on walls at a pose, in [0, 1]: what scores are made of.
pub(crate) fn fit_of(map: &TrackMap, scan: &ReadyScan, pose: Pose) -> f64 {
    fit(map.field(), &scan.points, BEAMS, pose, 0.08)
}

/// The fit of a scan near a pose that is known only coarsely.
fn fitted(map: &TrackMap, scan: &ReadyScan, pose: Pose, parameters: &Parameters) -> Estimate {
    let prior = Estimate {
        pose,
        covariance: Matrix3::from_diagonal(&Vector3::new(0.04, 0.04, 0.01)),
    };
    refine(
        map.field(),
        &scan.points,
        pose,
        &prior,
        0.0,
        &parameters.refinement,
    )
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
    INDEPENDENT * fit_of(map, scan, pose).max(0.02).ln()
}

/// How near a wall is, coarsely and in few bytes, so that a whole map stays in a processor's cache while every
/// pose is tried on it.
#[derive(Debug)]
pub(crate) struct CoarseField {
    width: usize,
    /// 255 on a wall, a half at [`COARSE_REACH`], falling to 0.
    nearness: Vec<u8>,
    /// Edge of a coarse cell [m].
    resolution: f32,
}

/// Distance from a wall at which an end point counts half in the coarse match [m]: as far off as a coarse pose is.
const COARSE_REACH: f32 = 0.2;

/// Coarse cells are at least this large [m].
const COARSE_CELL: f64 = 0.1;

impl CoarseField {
    pub(crate) fn new(grid: &OccupancyGrid, field: &DistanceField) -> Self {
        let factor = (COARSE_CELL / grid.resolution).round().max(1.0) as usize;
        let (width, height) = (grid.width.div_ceil(factor), grid.height.div_ceil(factor));
        let nearest = |index: usize| {
            let (column, row) = (index % width * factor, index / width * factor);
            let columns = column..(column + factor).min(grid.width);
            let rows = row..(row + factor).min(grid.height);
            let cells = rows.flat_map(|row| columns.clone().map(move |column| row * grid.width + column));
            cells
                .map(|cell| field.values()[cell].abs())
                .fold(f32::INFINITY, f32::min)
        };
        let nearness = (0..width * height)
            .map(|index| {
                let ratio = nearest(index) / COARSE_REACH;
                (255.0 / (1.0 + ratio * ratio)) as u8
            })
            .collect();
        Self {
            width,
            nearness,
            resolution: (grid.resolution * factor as f64) as f32,
        }
    }

    /// Nearness at a point in coarse cells, 0 outside.
    #[inline]
    fn at(&self, u: f32, v: f32) -> u32 {
        // Negative coordinates become 0 and lie outside or in the rim; a column beyond the width is caught.
        let (column, row) = (u as usize, v as usize);
        if column >= self.width || u < 0.0 || v < 0.0 {
            return 0;
        }
        self.nearness
            .get(row * self.width + column)
            .map_or(0, |&nearness| u32::from(nearness))
    }
}

/// Least mean nearness of a coarse pose that is looked at again.
const LEAST_NEARNESS: f32 = 0.3;

/// Candidates from one scan alone: every position and heading tried coarsely, the best refined.
fn seed(map: &TrackMap, scan: &ReadyScan, parameters: &Parameters) -> Vec<Candidate> {
    let field = map.field();
    let coarse_field = map.coarse_field();
    let resolution = map.grid().resolution;
    let width = map.grid().width;
    let step = (parameters.search.search_step / resolution).round().max(1.0) as usize;
    let clearance = 0.12f32;
    let per_cell = resolution as f32 / coarse_field.resolution;
    let positions: Vec<[f32; 2]> = map
        .plausible_regions()
        .into_iter()
        .flat_map(|region| map.regions()[region].cells.iter())
        .map(|&cell| (cell as usize % width, cell as usize / width, cell as usize))
        .filter(|&(column, row, cell)| {
            column % step == 0 && row % step == 0 && field.values()[cell] > clearance
        })
        .map(|(column, row, _)| [(column as f32 + 0.5) * per_cell, (row as f32 + 0.5) * per_cell])
        .collect();
    let headings = (std::f64::consts::TAU / parameters.search.search_turn).ceil() as usize;
    let stride = scan.points.len().div_ceil(COARSE_BEAMS).max(1);
    // Spread over the field of view in both halves, so that a look at the first half tells.
    let looked_at = || scan.points.iter().step_by(stride);
    let ordered: Vec<[f32; 2]> = looked_at()
        .step_by(2)
        .chain(looked_at().skip(1).step_by(2))
        .copied()
        .collect();
    let cells = 1.0 / coarse_field.resolution;
    let half = ordered.len() / 2;
    let least = |points: usize| (LEAST_NEARNESS * 255.0 * points as f32) as u32;
    let mut coarse: Vec<(u32, Pose)> = (0..headings)
        .into_par_iter()
        .flat_map_iter(|k| {
            let heading = k as f64 / headings as f64 * std::f64::consts::TAU;
            let (sin, cos) = (heading.sin() as f32 * cells, heading.cos() as f32 * cells);
            let turned: Vec<[f32; 2]> = ordered
                .iter()
                .map(|p| [cos * p[0] - sin * p[1], sin * p[0] + cos * p[1]])
                .collect();
            let sum = |at: &[f32; 2], points: &[[f32; 2]]| -> u32 {
                points
                    .iter()
                    .map(|point| coarse_field.at(at[0] + point[0], at[1] + point[1]))
                    .sum()
            };
            let mut good = Vec::new();
            for at in &positions {
                let first = sum(at, &turned[..half]);
                // Most poses are hopeless after half of the beams.
                if first * 3 < least(half) * 2 {
                    continue;
                }
                let whole = first + sum(at, &turned[half..]);
                if whole >= least(turned.len()) {
                    let [x, y] = at.map(|v| f64::from(v * coarse_field.resolution));
                    good.push((whole, Pose::new(x, y, heading)));
                }
            }
            good
        })
        .collect();
    if coarse.len() > COARSE {
        coarse.select_nth_unstable_by(COARSE, |a, b| b.0.cmp(&a.0));
        coarse.truncate(COARSE);
    }
    // Ties in the order of the poses, which does not depend on the number of threads.
    let key = |pose: &Pose| [pose.x, pose.y, pose.heading];
    coarse.sort_by(|a, b| {
        b.0.cmp(&a.0)
            .then_with(|| key(&a.1).partial_cmp(&key(&b.1)).unwrap_or(Ordering::Equal))
    });
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
    picked
        .into_par_iter()
        .map(|pose| {
            let estimate = fitted(map, scan, pose, parameters);
            Candidate {
                estimate,
                score: score(map, scan, estimate.pose),
                scans: 1,
            }
        })
        .collect()
}
