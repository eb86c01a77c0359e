//! Closed curves through points.

use super::ring::LEAST;
#[cfg(doc)]
use super::ring::Ring;

/// Points between two control points before resampling.
const STEPS: usize = 100;

/// A closed Catmull-Rom curve through control points, resampled to points about `spacing` \[m\] apart. The centripetal form
/// has no cusps and no loops (Yuksel et al., 2011).
pub(crate) fn closed_curve(control: &[[f64; 2]], spacing: f64) -> Vec<[f64; 2]> {
    curve_and_knots(control, spacing).0
}

/// A closed curve, and for each control point the index of its point on the curve.
pub(crate) fn curve_and_knots(control: &[[f64; 2]], spacing: f64) -> (Vec<[f64; 2]>, Vec<usize>) {
    let n = control.len();
    let mut fine = Vec::new();
    for i in 0..n {
        let p = [0, 1, 2, 3].map(|k| control[(i + n + k - 1) % n]);
        for step in 0..STEPS {
            fine.push(centripetal(p, step as f64 / STEPS as f64));
        }
    }
    let curve = resample(&fine, spacing);
    let mut passed = vec![0.0];
    for i in 0..fine.len() {
        passed.push(passed[i] + distance(fine[i], fine[(i + 1) % fine.len()]));
    }
    let per_metre = curve.len() as f64 / passed[fine.len()];
    let knots = (0..n)
        .map(|k| (passed[k * STEPS] * per_metre).round() as usize)
        .collect();
    (curve, knots)
}

/// A closed polyline resampled at equal distances of about `spacing` \[m\], with at least as many points as a [`Ring`]
/// needs.
pub(crate) fn resample(points: &[[f64; 2]], spacing: f64) -> Vec<[f64; 2]> {
    let n = points.len();
    let lengths: Vec<f64> = (0..n).map(|i| distance(points[i], points[(i + 1) % n])).collect();
    let total: f64 = lengths.iter().sum();
    let count = ((total / spacing).round() as usize).max(LEAST);
    let mut resampled = Vec::with_capacity(count);
    let (mut segment, mut passed) = (0, 0.0);
    for k in 0..count {
        let s = total * k as f64 / count as f64;
        while segment + 1 < n && passed + lengths[segment] < s {
            passed += lengths[segment];
            segment += 1;
        }
        let t = if lengths[segment] > 0.0 {
            (s - passed) / lengths[segment]
        } else {
            0.0
        };
        let (a, b) = (points[segment], points[(segment + 1) % n]);
        resampled.push([a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])]);
    }
    resampled
}

/// Unit vectors to the left of a closed polyline at its points.
pub(crate) fn normals(points: &[[f64; 2]]) -> Vec<[f64; 2]> {
    let n = points.len();
    (0..n)
        .map(|i| {
            let (a, b) = (points[(i + n - 1) % n], points[(i + 1) % n]);
            let length = distance(a, b).max(1e-12);
            [(a[1] - b[1]) / length, (b[0] - a[0]) / length]
        })
        .collect()
}

pub(crate) fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// Barry and Goldman's pyramid for the segment from `p[1]` to `p[2]`.
fn centripetal(p: [[f64; 2]; 4], t: f64) -> [f64; 2] {
    let knot = |a, b| distance(a, b).sqrt().max(1e-9);
    let t0 = 0.0;
    let t1 = t0 + knot(p[0], p[1]);
    let t2 = t1 + knot(p[1], p[2]);
    let t3 = t2 + knot(p[2], p[3]);
    let t = t1 + t * (t2 - t1);
    let mix = |a: [f64; 2], b: [f64; 2], from: f64, to: f64| {
        let w = (t - from) / (to - from);
        [a[0] + w * (b[0] - a[0]), a[1] + w * (b[1] - a[1])]
    };
    let a = [
        mix(p[0], p[1], t0, t1),
        mix(p[1], p[2], t1, t2),
        mix(p[2], p[3], t2, t3),
    ];
    let b = [mix(a[0], a[1], t0, t2), mix(a[1], a[2], t1, t3)];
    mix(b[0], b[1], t1, t2)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::TAU;

    #[test]
    fn points_of_a_circle_make_a_circle() {
        let control: Vec<_> = (0..12)
            .map(|i| TAU * f64::from(i) / 12.0)
            .map(|a| [3.0 * a.cos(), 3.0 * a.sin()])
            .collect();
        let curve = closed_curve(&control, 0.1);
        assert_eq!(curve.len(), (3.0 * TAU / 0.1).round() as usize);
        for (point, normal) in curve.iter().zip(normals(&curve)) {
            assert!((distance(*point, [0.0; 2]) - 3.0).abs() < 0.03);
            // Left of a counter-clockwise circle is inside.
            assert!(point[0] * normal[0] + point[1] * normal[1] < -2.9);
        }
    }

    #[test]
    fn resampled_points_are_evenly_spaced() {
        let square = [[0.0, 0.0], [4.0, 0.0], [4.0, 1.0], [0.0, 1.0]];
        let points = resample(&square, 0.5);
        assert_eq!(points.len(), 20);
        for pair in points.windows(2) {
            assert!((distance(pair[0], pair[1]) - 0.5).abs() < 1e-12);
        }
    }
}
