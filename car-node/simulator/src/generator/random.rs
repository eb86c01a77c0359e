//! Random tracks.

use std::f64::consts::TAU;

use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};

use super::spline::{closed_curve, distance};
use super::{MappingParams, TrackSpec};
use crate::SpeedParams;

/// Most tries to find a random line with room for a track.
const TRIES: u64 = 1000;
/// Distance between the points at which a line is checked \[m\].
const SPACING: f64 = 0.25;

impl TrackSpec {
    /// A random track: about `length` \[m\] a lap, `width` \[m\] wide.
    ///
    /// The centre line winds around a ring. Lines that bend too sharply for their width or come too close to themselves are
    /// rejected. Long and narrow tracks wind more.
    pub fn random(seed: u64, length: f64, width: f64) -> Self {
        let half_width = width / 2.0;
        // More room allows more winding; after many failures the line winds less.
        let mut centre = Vec::new();
        for attempt in 0..TRIES {
            let wildness = 0.55 * (1.0 - attempt as f64 / TRIES as f64);
            centre = ring(seed.wrapping_mul(TRIES).wrapping_add(attempt), length, wildness);
            if fits(&closed_curve(&centre, SPACING), half_width) {
                break;
            }
        }
        // Rounded to three decimals, as the file is written, so that the file makes the same track.
        let centre = centre
            .into_iter()
            .map(|p| p.map(|v| (v * 1000.0).round() / 1000.0))
            .collect();
        Self {
            name: format!("random-{seed}"),
            seed,
            centre,
            point_symmetric: false,
            half_width: vec![half_width],
            margin: (0.4 * half_width).clamp(0.22, 0.5),
            texture: 0.03,
            posts: 1.0,
            black: Vec::new(),
            blocks: Vec::new(),
            speed: SpeedParams::default(),
            mapping: MappingParams::default(),
        }
    }
}

/// Control points around a ring whose radius varies by the share `wildness`, scaled to the length.
fn ring(seed: u64, length: f64, wildness: f64) -> Vec<[f64; 2]> {
    let mut rng = StdRng::seed_from_u64(seed);
    let count = (length / 4.0).clamp(8.0, 40.0).round() as usize;
    let stretch = 1.0 + 0.8 * rng.random::<f64>();
    let control: Vec<[f64; 2]> = (0..count)
        .map(|i| {
            let angle = TAU * (i as f64 + 0.4 * (rng.random::<f64>() - 0.5)) / count as f64;
            let radius = 1.0 + wildness * (2.0 * rng.random::<f64>() - 1.0);
            [stretch * radius * angle.cos(), radius * angle.sin()]
        })
        .collect();
    let curve = closed_curve(&control, 0.02);
    let unscaled: f64 = (0..curve.len())
        .map(|i| distance(curve[i], curve[(i + 1) % curve.len()]))
        .sum();
    control
        .into_iter()
        .map(|p| p.map(|v| v * length / unscaled))
        .collect()
}

/// True if walls fit beside the line: it bends gently enough and keeps away from itself.
fn fits(curve: &[[f64; 2]], half_width: f64) -> bool {
    let n = curve.len();
    let wall = 2.0 * half_width + 0.3;
    // Along a bend, points this far apart may be nearer than a track's width.
    let near = (2.0 * wall / SPACING).ceil() as usize;
    let bends = |i: usize| {
        let (a, b, c) = (curve[i], curve[(i + 2) % n], curve[(i + 4) % n]);
        let area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
        2.0 * area.abs() / (distance(a, b) * distance(b, c) * distance(a, c)).max(1e-12)
    };
    (0..n).all(|i| bends(i) < 1.0 / (half_width + 0.25))
        && (0..n).all(|i| {
            (i + near..n)
                .filter(|j| i + n - j >= near)
                .all(|j| distance(curve[i], curve[j]) > wall)
        })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn random_tracks_can_be_made() {
        for (seed, length, width) in [(0, 50.0, 2.0), (1, 50.0, 2.0), (2, 30.0, 1.5), (3, 120.0, 3.0)] {
            let spec = TrackSpec::random(seed, length, width);
            let track = spec.generate().expect("room enough");
            let ratio = track.raceline.length() / length;
            assert!((0.75..1.1).contains(&ratio), "seed {seed}: {ratio}");
        }
    }

    #[test]
    fn another_seed_is_another_track() {
        let [a, b, again] = [4, 5, 4].map(|seed| TrackSpec::random(seed, 60.0, 2.0));
        assert_ne!(a.centre, b.centre);
        assert_eq!(a, again);
    }
}
