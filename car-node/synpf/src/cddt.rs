//! Ranges by lanes: a compressed directional distance transform, made exact.
//!
//! After Walsh and Karaman (ICRA 2018): for each direction the walls are projected onto parallel lanes, and each
//! lane keeps the sorted places where it meets a wall; a range is one search. Directions half a turn apart share
//! their lanes. Where the paper keeps cells, we keep crossings with the walls' faces (the contour of the distance
//! field) and the face's slope there, so that a range is right to a fraction of a cell. The range table is filled
//! from the same lanes, which is some ten times faster than casting its rays one by one.

use maps::DistanceField;
use rayon::prelude::*;
use wide::f32x4;

use crate::range_table::DIRECTIONS;

/// Directions over half a turn.
pub(crate) const HALF_TURN: usize = DIRECTIONS / 2;

/// CddtSlice per cell.
const FINE: f32 = 2.0;

/// CddtSlice for every direction over half a turn.
#[derive(Debug)]
pub(crate) struct Cddt {
    directions: Vec<CddtSlice>,
}

impl Cddt {
    pub(crate) fn new(field: &DistanceField) -> Self {
        let faces = field.contour();
        let direction = |k| CddtSlice::new(&faces, std::f64::consts::PI * k as f64 / HALF_TURN as f64);
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
        let bytes = |lanes: &CddtSlice| size_of_val(&*lanes.starts) + size_of_val(&*lanes.fours);
        self.directions.iter().map(bytes).sum()
    }
}

/// The walls as seen along one direction.
#[derive(Debug)]
pub(crate) struct CddtSlice {
    /// Unit vector along the lanes.
    along: [f32; 2],
    /// Offset across the lanes of lane 0 [lanes].
    first: f32,
    /// Where each lane begins in `fours`; one more at the end.
    starts: Vec<u32>,
    /// Crossings of the lanes' middles with faces, sorted along each lane, with one at minus infinity before them
    /// and plus infinity up to the end of the last four.
    fours: Vec<CrossingBlock>,
}

/// A crossing of a lane's middle with a face.
#[derive(Debug, Clone, Copy)]
struct Crossing {
    lane: u32,
    /// Place along the lane's middle [cells].
    at: f32,
    /// How the place moves across the lane [cells per lane].
    slope: f32,
}

/// CrossingBlock crossings, compared at once.
#[derive(Debug, Clone, Copy)]
struct CrossingBlock {
    at: [f32; 4],
    slope: [f32; 4],
}

impl CddtSlice {
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
            (low, high) = (0.0, 0.0);
        }
        let first = low.floor() - 1.0;
        let count = (high - first) as usize + 2;
        let mut crossings = Vec::with_capacity(2 * faces.len());
        for face in faces {
            let (a, b) = (across(&face[0]) - first, across(&face[1]) - first);
            let (from, to) = (place(&face[0]), place(&face[1]));
            let width = b - a;
            // A face along the lanes crosses the middle of none.
            let slope = if width.abs() < 1e-6 {
                0.0
            } else {
                (to - from) / width
            };
            for lane in upward(a.min(b) - 0.5)..upward(a.max(b) - 0.5) {
                crossings.push(Crossing {
                    lane,
                    at: from + slope * (lane as f32 + 0.5 - a),
                    // A face along the lane must not reach beyond its own half cell.
                    slope: slope.clamp(-4.0, 4.0),
                });
            }
        }
        // Slots for every lane, with the two infinities.
        let mut starts = vec![0u32; count + 1];
        for crossing in &crossings {
            starts[crossing.lane as usize + 1] += 1;
        }
        for lane in 0..count {
            starts[lane + 1] = starts[lane] + (starts[lane + 1] + 2).div_ceil(4);
        }
        let slots = 4 * starts[count] as usize;
        let mut sorted = vec![(f32::INFINITY, 0.0f32); slots];
        let mut next: Vec<u32> = starts[..count].iter().map(|start| 4 * start).collect();
        for slot in &mut next {
            sorted[*slot as usize].0 = f32::NEG_INFINITY;
            *slot += 1;
        }
        for crossing in &crossings {
            let slot = &mut next[crossing.lane as usize];
            sorted[*slot as usize] = (crossing.at, crossing.slope);
            *slot += 1;
        }
        for (start, end) in starts.iter().zip(&next) {
            // A handful, most of them in order.
            sorted[4 * *start as usize..*end as usize].sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
        }
        let four = |four: &[(f32, f32)]| CrossingBlock {
            at: std::array::from_fn(|i| four[i].0),
            slope: std::array::from_fn(|i| four[i].1),
        };
        Self {
            along,
            first,
            starts,
            fours: sorted.chunks_exact(4).map(four).collect(),
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
        let fours = &self.fours[self.starts[index] as usize..self.starts[index + 1] as usize];
        let off = lane - index as f32 - 0.5;
        let at = from[0] * self.along[0] + from[1] * self.along[1];
        // A lane meets a handful of walls, four of them compared at once.
        let (offs, ats) = (f32x4::splat(off), f32x4::splat(at));
        let mut ahead = 0;
        for four in fours {
            let behind = (f32x4::from(four.at) + f32x4::from(four.slope) * offs).simd_le(ats);
            let count = behind.to_bitmask().trailing_ones() as usize;
            ahead += count;
            if count < 4 {
                break;
            }
        }
        let here = |i: usize| fours[i / 4].at[i % 4] + fours[i / 4].slope[i % 4] * off;
        // The infinities bound the count from both sides.
        [here(ahead) - at, at - here(ahead - 1)]
    }
}

/// The least whole number not below a number that is not negative; quicker than `ceil` without SSE 4.1.
fn upward(v: f32) -> u32 {
    let whole = v as u32;
    whole + u32::from((whole as f32) < v)
}
