//! A compressed directional distance transform, CDDT (Walsh and Karaman, ICRA 2018).
//!
//! For each direction, parallel lanes are laid over the map. Each lane keeps the sorted places where its middle line
//! crosses a wall's face, and a range is a search in one lane. Opposite directions share their lanes. The paper keeps
//! occupied cells. We keep crossings with the faces (the contour of the distance field) and the face's slope there, so
//! that a range is right to a fraction of a cell; `ranges.rs` states to which. The range table is filled from the same
//! lanes, some ten times faster than by casting its rays one by one.

use maps::DistanceField;
use rayon::prelude::*;
use wide::f32x4;

/// Directions over a full turn; a power of two, so that headings wrap with a mask.
pub(crate) const DIRECTIONS: usize = 256;

/// Directions over half a turn.
pub(crate) const HALF_TURN: usize = DIRECTIONS / 2;

/// Lanes per cell.
const FINE: f32 = 2.0;

/// A [`CddtSlice`] for each direction over half a turn.
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

    /// Range from a point along an angle \[cells\], at most `longest`.
    pub(crate) fn range(&self, from: [f32; 2], angle: f32, longest: f32) -> f32 {
        let step = (angle * (HALF_TURN as f32 / std::f32::consts::PI)).round() as i64;
        let k = step.rem_euclid(DIRECTIONS as i64) as usize;
        let [ahead, behind] = self.directions[k % HALF_TURN].ranges(from);
        if k < HALF_TURN { ahead } else { behind }.min(longest)
    }

    /// An upper bound of the memory that a CDDT of a field takes \[bytes\], known before it is built.
    pub(crate) fn bytes_at_most(field: &DistanceField) -> usize {
        let faces = field.contour();
        // A face of length l crosses the middles of at most l lanes, and one more.
        let crossings = |[a, b]: &[[f32; 2]; 2]| ((a[0] - b[0]).hypot(a[1] - b[1]) * FINE) as usize + 1;
        let crossings: usize = faces.iter().map(crossings).sum();
        let mut reach = [f32::INFINITY, f32::INFINITY, f32::NEG_INFINITY, f32::NEG_INFINITY];
        for [x, y] in faces.into_iter().flatten() {
            reach = [reach[0].min(x), reach[1].min(y), reach[2].max(x), reach[3].max(y)];
        }
        let diagonal = (reach[2] - reach[0]).hypot(reach[3] - reach[1]);
        let lanes = if diagonal.is_finite() {
            (diagonal * FINE) as usize + 4
        } else {
            4
        };
        // Two slots at the infinities, and up to three more to fill a block.
        let blocks = crossings.div_ceil(4) + 2 * lanes;
        HALF_TURN * (blocks * size_of::<CrossingBlock>() + (lanes + 1) * size_of::<u32>())
    }

    /// Memory that it takes \[bytes\].
    pub(crate) fn bytes(&self) -> usize {
        let bytes = |slice: &CddtSlice| size_of_val(&*slice.starts) + size_of_val(&*slice.blocks);
        self.directions.iter().map(bytes).sum()
    }
}

/// The crossings with faces along one direction.
#[derive(Debug)]
pub(crate) struct CddtSlice {
    /// Unit vector along the lanes.
    along: [f32; 2],
    /// Offset of lane 0 across the lanes [lanes].
    first: f32,
    /// Where each lane begins in `blocks`; one more at the end.
    starts: Vec<u32>,
    /// Crossings of the lanes' middles with faces, sorted along each lane. Each lane starts with a crossing at minus
    /// infinity and is filled up to whole blocks with crossings at plus infinity.
    blocks: Vec<CrossingBlock>,
}

/// A crossing of a lane's middle with a face.
#[derive(Debug, Clone, Copy)]
struct Crossing {
    lane: u32,
    /// Place along the lane's middle \[cells\].
    at: f32,
    /// How the place moves across the lane [cells per lane].
    slope: f32,
}

/// Four crossings, compared at once.
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
                    // Bounds how far a face that is nearly parallel to the lane shifts within it.
                    slope: slope.clamp(-4.0, 4.0),
                });
            }
        }
        // Slots for every lane, including its crossings at the two infinities.
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
            // A handful, most of them in order already.
            sorted[4 * *start as usize..*end as usize].sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
        }
        let block = |slots: &[(f32, f32)]| CrossingBlock {
            at: std::array::from_fn(|i| slots[i].0),
            slope: std::array::from_fn(|i| slots[i].1),
        };
        Self {
            along,
            first,
            starts,
            blocks: sorted.chunks_exact(4).map(block).collect(),
        }
    }

    /// Ranges from a point ahead along the lanes and behind \[cells\]; infinite where no wall is met.
    #[inline]
    pub(crate) fn ranges(&self, from: [f32; 2]) -> [f32; 2] {
        let lane = (from[1] * self.along[0] - from[0] * self.along[1]) * FINE - self.first;
        let index = lane as usize;
        if !(lane >= 0.0 && index + 1 < self.starts.len()) {
            return [f32::INFINITY; 2];
        }
        let blocks = &self.blocks[self.starts[index] as usize..self.starts[index + 1] as usize];
        let off = lane - index as f32 - 0.5;
        let at = from[0] * self.along[0] + from[1] * self.along[1];
        // A lane crosses a handful of faces.
        let (offs, ats) = (f32x4::splat(off), f32x4::splat(at));
        let mut ahead = 0;
        for block in blocks {
            let behind = (f32x4::from(block.at) + f32x4::from(block.slope) * offs).simd_le(ats);
            let count = behind.to_bitmask().trailing_ones() as usize;
            ahead += count;
            if count < 4 {
                break;
            }
        }
        let here = |i: usize| blocks[i / 4].at[i % 4] + blocks[i / 4].slope[i % 4] * off;
        // The crossings at the infinities bound the indices on both sides.
        [here(ahead) - at, at - here(ahead - 1)]
    }
}

/// Rounds a number that is not negative up; faster than `ceil` without SSE 4.1.
fn upward(v: f32) -> u32 {
    let whole = v as u32;
    whole + u32::from((whole as f32) < v)
}
