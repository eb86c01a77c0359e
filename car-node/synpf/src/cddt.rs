//! Ranges by lanes: a compressed directional distance transform, made exact.
//!
//! After Walsh and Karaman (ICRA 2018): for each direction the walls are projected onto parallel lanes, and each
//! lane keeps the sorted places where it meets a wall; a range is one search. Directions half a turn apart share
//! their lanes. Where the paper keeps cells, we keep crossings with the walls' faces (the contour of the distance
//! field) and the face's slope there, so that a range is right to a fraction of a cell. The range table is filled
//! from the same lanes, which is some ten times faster than casting its rays one by one.

use maps::DistanceField;
use rayon::prelude::*;

use crate::range_table::DIRECTIONS;

/// Directions over half a turn.
pub(crate) const HALF_TURN: usize = DIRECTIONS / 2;

/// Lanes per cell.
const FINE: f32 = 2.0;

/// Lanes for every direction over half a turn.
#[derive(Debug)]
pub(crate) struct Cddt {
    directions: Vec<Lanes>,
}

impl Cddt {
    pub(crate) fn new(field: &DistanceField) -> Self {
        let faces = field.contour();
        let direction = |k| Lanes::new(&faces, std::f64::consts::PI * k as f64 / HALF_TURN as f64);
        Self {
            directions: (0..HALF_TURN).into_par_iter().map(direction).collect(),
        }
    }

    /// Range from a point along an angle [cells], at most `longest`.
    pub(crate) fn range(&self, from: [f32; 2], angle: f32, longest: f32) -> f32 {
        let step = (angle * (HALF_TURN as f32 / std::f32::consts::PI)).round() as i64;
        let k = step.rem_euclid(DIRECTIONS as i64) as usize;
        let [ahead, behind] = self.directions[k % HALF_TURN].ranges(from);
        if k < HALF_TURN { ahead } else { behind }.min(longest)
    }

    /// Memory that it takes [bytes].
    pub(crate) fn bytes(&self) -> usize {
        let bytes = |lanes: &Lanes| size_of_val(&*lanes.starts) + size_of_val(&*lanes.crossings);
        self.directions.iter().map(bytes).sum()
    }
}

/// The walls as seen along one direction.
#[derive(Debug)]
pub(crate) struct Lanes {
    /// Unit vector along the lanes.
    along: [f32; 2],
    /// Offset across the lanes of lane 0 [lanes].
    first: f32,
    /// Where each lane begins in `crossings`; one more at the end.
    starts: Vec<u32>,
    /// Crossings of the lanes' middles with faces, sorted along each lane.
    crossings: Vec<Crossing>,
}

#[derive(Debug, Clone, Copy)]
struct Crossing {
    /// Place along the lane's middle [cells].
    at: f32,
    /// How the place moves across the lane [cells per lane].
    slope: f32,
}

impl Lanes {
    pub(crate) fn new(faces: &[[[f32; 2]; 2]], angle: f64) -> Self {
        let along = [angle.cos() as f32, angle.sin() as f32];
        let across = |p: &[f32; 2]| (p[1] * along[0] - p[0] * along[1]) * FINE;
        let place = |p: &[f32; 2]| p[0] * along[0] + p[1] * along[1];
        let mut low = f32::INFINITY;
        let mut high = f32::NEG_INFINITY;
        for offset in faces.iter().flatten().map(across) {
            low = low.min(offset);
            high = high.max(offset);
        }
        if faces.is_empty() {
            return Self {
                along,
                first: 0.0,
                starts: vec![0],
                crossings: Vec::new(),
            };
        }
        let first = low.floor() - 1.0;
        let count = (high - first) as usize + 2;
        // The lanes whose middles a face crosses, and where.
        let crossed = |face: &[[f32; 2]; 2]| {
            let (a, b) = (across(&face[0]) - first, across(&face[1]) - first);
            let lanes = (a.min(b) - 0.5).ceil() as u32..(a.max(b) - 0.5).ceil() as u32;
            let width = b - a;
            // A face along the lanes crosses the middle of none.
            let slope = if width.abs() < 1e-6 {
                0.0
            } else {
                (place(&face[1]) - place(&face[0])) / width
            };
            (lanes, place(&face[0]) - slope * a, slope)
        };
        let mut starts = vec![0u32; count + 1];
        for face in faces {
            for lane in crossed(face).0 {
                starts[lane as usize + 1] += 1;
            }
        }
        for lane in 0..count {
            starts[lane + 1] += starts[lane];
        }
        let mut crossings = vec![Crossing { at: 0.0, slope: 0.0 }; starts[count] as usize];
        let mut next = starts.clone();
        for face in faces {
            let (lanes, origin, slope) = crossed(face);
            for lane in lanes {
                let slot = &mut next[lane as usize];
                // A face along the lane must not reach beyond its own half cell.
                let at = origin + slope * (lane as f32 + 0.5);
                crossings[*slot as usize] = Crossing {
                    at,
                    slope: slope.clamp(-4.0, 4.0),
                };
                *slot += 1;
            }
        }
        for pair in starts.windows(2) {
            crossings[pair[0] as usize..pair[1] as usize].sort_unstable_by(|a, b| a.at.total_cmp(&b.at));
        }
        Self {
            along,
            first,
            starts,
            crossings,
        }
    }

    /// Ranges from a point ahead along the lanes and behind [cells]; infinite where no wall is met.
    #[inline]
    pub(crate) fn ranges(&self, from: [f32; 2]) -> [f32; 2] {
        let lane = (from[1] * self.along[0] - from[0] * self.along[1]) * FINE - self.first;
        let index = lane as usize;
        if !(lane >= 0.0 && index + 1 < self.starts.len()) {
            return [f32::INFINITY; 2];
        }
        let crossings = &self.crossings[self.starts[index] as usize..self.starts[index + 1] as usize];
        let off = lane - index as f32 - 0.5;
        let at = from[0] * self.along[0] + from[1] * self.along[1];
        let here = |crossing: &Crossing| crossing.at + crossing.slope * off;
        // A lane meets a handful of walls: counting those behind beats a search with its branches.
        let mut behind = 0;
        for crossing in crossings {
            behind += usize::from(here(crossing) <= at);
        }
        [
            crossings
                .get(behind)
                .map_or(f32::INFINITY, |crossing| here(crossing) - at),
            behind
                .checked_sub(1)
                .map_or(f32::INFINITY, |last| at - here(&crossings[last])),
        ]
    }
}
