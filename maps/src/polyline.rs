//! The nearest point of a closed polyline, exactly and in logarithmic time.

/// A binary tree of bounding boxes over the consecutive segments of a closed polyline.
///
/// Neighbours in order are neighbours in space, so halving the *index range* makes tight boxes without sorting. The tree
/// is an implicit heap over blocks of [`BLOCK`] segments.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct PolylineTree {
    /// `[min_x, min_y, max_x, max_y]`; children of `i` are `2 i` and `2 i + 1`, root at 1, leaves from `leaves` on.
    boxes: Vec<[f64; 4]>,
    leaves: usize,
}

/// The nearest point of a polyline.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Nearest {
    /// Segment from vertex `segment` to the next one.
    pub(crate) segment: usize,
    /// Position on the segment, in \[0, 1\].
    pub(crate) fraction: f64,
    /// Squared distance \[m^2\].
    pub(crate) distance_squared: f64,
}

/// Segments per leaf: few enough to scan, enough to keep the tree small.
const BLOCK: usize = 8;
const EMPTY: [f64; 4] = [f64::INFINITY, f64::INFINITY, f64::NEG_INFINITY, f64::NEG_INFINITY];

impl PolylineTree {
    pub(crate) fn new(vertices: &[[f64; 2]]) -> Self {
        let leaves = vertices.len().div_ceil(BLOCK).next_power_of_two();
        let mut boxes = vec![EMPTY; 2 * leaves];
        for (i, &[x, y]) in vertices.iter().enumerate() {
            let [u, v] = vertices[(i + 1) % vertices.len()];
            let leaf = &mut boxes[leaves + i / BLOCK];
            *leaf = union(*leaf, [x.min(u), y.min(v), x.max(u), y.max(v)]);
        }
        for i in (1..leaves).rev() {
            boxes[i] = union(boxes[2 * i], boxes[2 * i + 1]);
        }
        Self { boxes, leaves }
    }

    /// The point of the polyline nearest to `point`. `vertices` are those of the polyline.
    pub(crate) fn nearest(&self, vertices: &[[f64; 2]], point: [f64; 2]) -> Nearest {
        let mut best = Nearest {
            segment: 0,
            fraction: 0.0,
            distance_squared: f64::INFINITY,
        };
        self.descend(1, vertices, point, &mut best);
        best
    }

    fn descend(&self, node: usize, vertices: &[[f64; 2]], point: [f64; 2], best: &mut Nearest) {
        if node >= self.leaves {
            let start = (node - self.leaves) * BLOCK;
            for segment in start..(start + BLOCK).min(vertices.len()) {
                let next = vertices[(segment + 1) % vertices.len()];
                let (fraction, distance_squared) = project(vertices[segment], next, point);
                if distance_squared < best.distance_squared {
                    *best = Nearest {
                        segment,
                        fraction,
                        distance_squared,
                    };
                }
            }
            return;
        }
        let children = [2 * node, 2 * node + 1];
        let distances = children.map(|child| distance_squared(self.boxes[child], point));
        let near = usize::from(distances[1] < distances[0]);
        for side in [near, 1 - near] {
            if distances[side] < best.distance_squared {
                self.descend(children[side], vertices, point, best);
            }
        }
    }
}

/// The point of the segment from `a` to `b` nearest to `point`, as a fraction in \[0, 1\], and its squared distance.
fn project(a: [f64; 2], b: [f64; 2], point: [f64; 2]) -> (f64, f64) {
    let [dx, dy] = [b[0] - a[0], b[1] - a[1]];
    let [px, py] = [point[0] - a[0], point[1] - a[1]];
    let length_squared = dx * dx + dy * dy;
    let fraction = if length_squared > 0.0 {
        ((px * dx + py * dy) / length_squared).clamp(0.0, 1.0)
    } else {
        0.0
    };
    let [ex, ey] = [px - fraction * dx, py - fraction * dy];
    (fraction, ex * ex + ey * ey)
}

fn union(a: [f64; 4], b: [f64; 4]) -> [f64; 4] {
    [a[0].min(b[0]), a[1].min(b[1]), a[2].max(b[2]), a[3].max(b[3])]
}

fn distance_squared([x0, y0, x1, y1]: [f64; 4], [x, y]: [f64; 2]) -> f64 {
    let dx = (x0 - x).max(x - x1).max(0.0);
    let dy = (y0 - y).max(y - y1).max(0.0);
    dx * dx + dy * dy
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn finds_what_a_scan_over_all_segments_finds(
            vertices in proptest::collection::vec((-9.0..9.0, -9.0..9.0).prop_map(|(x, y)| [x, y]), 1..60),
            point in (-20.0..20.0, -20.0..20.0).prop_map(|(x, y)| [x, y]),
        ) {
            let found = PolylineTree::new(&vertices).nearest(&vertices, point);
            let scanned = (0..vertices.len())
                .map(|i| project(vertices[i], vertices[(i + 1) % vertices.len()], point).1)
                .fold(f64::INFINITY, f64::min);
            prop_assert!((found.distance_squared - scanned).abs() < 1e-12);
        }
    }
}
