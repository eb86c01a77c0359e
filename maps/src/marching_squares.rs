//! Marching squares (Lorensen and Cline, SIGGRAPH 1987, in the plane): where a sampled function passes zero.

/// A square's corners as steps from its lower left one, counter-clockwise: the order of [`zero_lines`].
pub const CORNERS: [[usize; 2]; 4] = [[0, 0], [1, 0], [1, 1], [0, 1]];

/// Where a zero line crosses an edge of a square.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Crossing {
    /// Place in the square, from its lower left corner, in edges.
    pub at: [f32; 2],
    /// The corner at the edge's positive end.
    pub positive: usize,
}

/// The straight pieces of a function's zero line in a square of four samples: two at most.
pub fn zero_lines(corners: [f32; 4]) -> impl Iterator<Item = [Crossing; 2]> {
    let positive = corners.map(|value| value > 0.0);
    let crossing = |edge: usize| {
        let next = (edge + 1) % 4;
        (positive[edge] != positive[next]).then(|| {
            let share = corners[edge] / (corners[edge] - corners[next]);
            let along = |axis: usize| {
                let [from, to] = [edge, next].map(|corner| CORNERS[corner][axis] as f32);
                from + (to - from) * share
            };
            Crossing {
                at: [along(0), along(1)],
                positive: if positive[edge] { edge } else { next },
            }
        })
    };
    let [a, b, c, d] = [0, 1, 2, 3].map(crossing);
    let pieces = if let (Some(a), Some(b), Some(c), Some(d)) = (a, b, c, d) {
        // A saddle: where its middle is like corners 0 and 2, the line goes around 1 and 3, else around 0 and 2.
        let middle: f32 = corners.iter().sum();
        if positive[0] == (middle > 0.0) {
            [Some([a, b]), Some([c, d])]
        } else {
            [Some([d, a]), Some([b, c])]
        }
    } else {
        let mut met = [a, b, c, d].into_iter().flatten();
        [met.next().zip(met.next()).map(|(from, to)| [from, to]), None]
    };
    pieces.into_iter().flatten()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn places(corners: [f32; 4]) -> Vec<[[f32; 2]; 2]> {
        zero_lines(corners)
            .map(|ends| ends.map(|crossing| crossing.at))
            .collect()
    }

    #[test]
    fn a_line_passes_where_the_samples_say() {
        assert_eq!(places([-1.0, 3.0, 3.0, -1.0]), [[[0.25, 0.0], [0.25, 1.0]]]);
        assert_eq!(places([1.0, 2.0, 3.0, 4.0]), [[[0.0; 2]; 2]; 0]);
        let [[from, to]] = zero_lines([3.0, -1.0, -1.0, -3.0]).collect::<Vec<_>>()[..] else {
            panic!("one line cuts one corner off");
        };
        assert_eq!((from.positive, to.positive), (0, 0));
        assert_eq!((from.at, to.at), ([0.75, 0.0], [0.0, 0.5]));
    }

    #[test]
    fn a_saddle_is_cut_as_its_middle_says() {
        let around_the_negative = places([3.0, -1.0, 3.0, -1.0]);
        assert_eq!(
            around_the_negative,
            [[[0.75, 0.0], [1.0, 0.25]], [[0.25, 1.0], [0.0, 0.75]]]
        );
        let around_the_positive = places([1.0, -3.0, 1.0, -3.0]);
        assert_eq!(
            around_the_positive,
            [[[0.0, 0.25], [0.25, 0.0]], [[1.0, 0.75], [0.75, 1.0]]]
        );
    }
}
