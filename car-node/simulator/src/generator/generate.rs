//! Makes a track of its description: walls along the centre line, a raceline between them, and a map.

use std::f64::consts::TAU;

use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};

use super::spline::{curve_and_knots, distance, normals};
use super::{LineError, TrackSpec, draw_map, minimum_curvature};
use crate::{Surface, Track, Wall, Walls, speed_profile};

/// Distance between the points of the centre line \[m\].
const SPACING: f64 = 0.05;

impl TrackSpec {
    /// Makes the track.
    pub fn generate(&self) -> Result<Track, LineError> {
        let mut rng = StdRng::seed_from_u64(self.seed);
        let (control, widths) = self.whole_lap();
        let (centre, knots) = curve_and_knots(&control, SPACING);
        let widths = along_lap(centre.len(), &knots, &widths);
        let walls = self.walls(&centre, &widths, &mut rng);
        let line = minimum_curvature(&centre, &walls, self.margin)?;
        let grid = draw_map(&centre, &walls, &self.mapping, self.seed);
        Ok(Track {
            name: self.name.clone(),
            grid,
            raceline: speed_profile(&line, &self.speed),
            walls,
        })
    }

    fn walls(&self, centre: &[[f64; 2]], widths: &[f64], rng: &mut StdRng) -> Walls {
        let n = centre.len();
        let period = if self.point_symmetric { 2.0 } else { 1.0 };
        let left = normals(centre);
        let mut walls = Vec::new();
        for side in [1.0, -1.0] {
            let waves: Vec<(f64, f64)> = (0..4)
                .map(|_| {
                    // Waves of 1 m to 4 m, a whole number of them in a lap (or half a lap).
                    let lap = n as f64 * SPACING / period;
                    let count = (lap / (1.0 + 3.0 * rng.random::<f64>())).round().max(1.0);
                    (count * period, rng.random::<f64>() * TAU)
                })
                .collect();
            let offset = |i: usize| {
                let lap = i as f64 / n as f64;
                let wave: f64 = waves
                    .iter()
                    .map(|(count, phase)| (TAU * count * lap + phase).sin())
                    .sum();
                side * (widths[i] + self.texture * wave / 2.0)
            };
            let face: Vec<[f64; 2]> = (0..=n)
                .map(|i| i % n)
                .map(|i| [0, 1].map(|axis| centre[i][axis] + offset(i) * left[i][axis]))
                .collect();
            walls.extend(self.painted(&face, side > 0.0));
            walls.extend(self.posts(&face, n, rng));
        }
        walls.extend(
            self.blocks
                .iter()
                .map(|block| rectangle(block.at, block.size, block.heading)),
        );
        Walls::new(walls)
    }

    /// A wall's face, split where its surface changes.
    fn painted(&self, face: &[[f64; 2]], left: bool) -> Vec<Wall> {
        let last = (face.len() - 1) as f64;
        let surface = |i: usize| {
            let lap = i as f64 / last;
            let black = self
                .black
                .iter()
                .any(|b| b.left == left && (b.from..b.to).contains(&lap));
            if black { Surface::Black } else { Surface::Plain }
        };
        let mut walls: Vec<Wall> = Vec::new();
        for i in 0..face.len() - 1 {
            match walls.last_mut() {
                Some(wall) if wall.surface == surface(i) => wall.points.push(face[i + 1]),
                _ => walls.push(Wall {
                    surface: surface(i),
                    points: vec![face[i], face[i + 1]],
                }),
            }
        }
        for wall in &mut walls {
            wall.points = simplified(&wall.points);
        }
        walls
    }

    /// Posts at random places along a wall; in a point-symmetric track, in pairs.
    fn posts(&self, face: &[[f64; 2]], n: usize, rng: &mut StdRng) -> Vec<Wall> {
        let half = if self.point_symmetric { n / 2 } else { n };
        let count = (self.posts * half as f64 * SPACING / 10.0).round() as usize;
        (0..count)
            .flat_map(|_| {
                let i = rng.random_range(0..half);
                let size = [0, 1].map(|_| 0.2 + 0.2 * rng.random::<f64>());
                let heading = rng.random::<f64>() * TAU;
                let post = rectangle(face[i], size, heading);
                let turned = self.point_symmetric.then(|| Wall {
                    surface: post.surface,
                    points: post.points.iter().map(|[x, y]| [-x, -y]).collect(),
                });
                [Some(post), turned].into_iter().flatten()
            })
            .collect()
    }
}

/// Values given at control points, at all `n` points of the curve: linear in between.
fn along_lap(n: usize, knots: &[usize], values: &[f64]) -> Vec<f64> {
    let mut result = vec![0.0; n];
    for (k, &start) in knots.iter().enumerate() {
        let (from, to) = (values[k], values[(k + 1) % values.len()]);
        let end = knots.get(k + 1).copied().unwrap_or(n);
        for (i, value) in result[start..end].iter_mut().enumerate() {
            *value = from + (to - from) * i as f64 / (end - start) as f64;
        }
    }
    result
}

/// A closed box.
fn rectangle(at: [f64; 2], size: [f64; 2], heading: f64) -> Wall {
    let frame = maps::Pose::new(at[0], at[1], heading);
    let [a, b] = size.map(|v| v / 2.0);
    Wall {
        surface: Surface::Plain,
        points: [[-a, -b], [a, -b], [a, b], [-a, b], [-a, -b]]
            .map(|corner| frame.transform(corner))
            .to_vec(),
    }
}

/// The polyline with the points left out that lie within a millimetre of the rest (Douglas and Peucker, 1973).
fn simplified(points: &[[f64; 2]]) -> Vec<[f64; 2]> {
    const TOLERANCE: f64 = 0.001;
    let (Some(&first), Some(&last)) = (points.first(), points.last()) else {
        return Vec::new();
    };
    let base = distance(first, last);
    let off = |p: &[f64; 2]| {
        if base < 1e-9 {
            return distance(*p, first);
        }
        ((last[0] - first[0]) * (p[1] - first[1]) - (last[1] - first[1]) * (p[0] - first[0])).abs() / base
    };
    let furthest = (1..points.len() - 1).max_by(|&a, &b| off(&points[a]).total_cmp(&off(&points[b])));
    match furthest {
        Some(i) if off(&points[i]) > TOLERANCE => {
            let mut left = simplified(&points[..=i]);
            left.pop();
            left.extend(simplified(&points[i..]));
            left
        }
        _ => vec![first, last],
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use maps::MapError;

    const YAML: &str = "name: oval\nseed: 7\ncentre: [[0, 0], [4, -2], [8, 0], [8, 3], [4, 5], [0, 3]]\n\
                        half_width: [0.8]\nmargin: 0.3\ntexture: 0.03\nposts: 1.0\n";

    #[test]
    fn the_same_description_makes_the_same_track() {
        let spec = TrackSpec::parse("oval", YAML).expect("a valid description");
        let [a, b] = [(); 2].map(|()| spec.generate().expect("room enough"));
        assert_eq!(a.grid, b.grid);
        assert_eq!(a.walls, b.walls);
        assert_eq!(a.raceline, b.raceline);
        let other = TrackSpec { seed: 8, ..spec }.generate().expect("room enough");
        assert_ne!(a.walls, other.walls);
    }

    #[test]
    fn a_point_symmetric_track_is_its_own_turned_image() {
        let yaml = "name: s\nseed: 7\npoint_symmetric: true\ncentre: [[4, -2], [6, 0], [4, 2], [0, 1.5], [-2, 2]]\n\
                    half_width: [0.7, 0.7, 0.7, 0.7, 0.9]\nmargin: 0.3\ntexture: 0.03\nposts: 2.0\n";
        let track = TrackSpec::parse("s", yaml).and_then(|spec| {
            spec.generate().map_err(|e| MapError::Format {
                file: "s".into(),
                fault: e.to_string(),
            })
        });
        let track = track.expect("a valid description");
        let line = &track.raceline;
        for i in 0..200 {
            let angle = f64::from(i) * 0.031;
            let p = line.at(f64::from(i) * 0.1);
            let there = track.walls.cast([p.x, p.y], [angle.cos(), angle.sin()], 30.0);
            let turned = track.walls.cast([-p.x, -p.y], [-angle.cos(), -angle.sin()], 30.0);
            let [a, b] = [there, turned].map(|hit| hit.map_or(30.0, |hit| hit.range));
            // Sampling the curve and leaving out points within a millimetre differ a little between the halves.
            assert!((a - b).abs() < 0.05, "at {i}: {a} and {b}");
        }
    }

    #[test]
    fn a_block_on_the_line_is_where_it_is_too_narrow() {
        let yaml = format!("{YAML}blocks: [{{ at: [4, -2], size: [1.2, 1.2] }}]\n");
        let spec = TrackSpec::parse("oval", &yaml).expect("a valid description");
        assert!(matches!(spec.generate(), Err(LineError::TooNarrow { .. })));
    }
}
