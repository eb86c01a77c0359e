//! What a track is made from.

use std::f64::consts::TAU;

use maps::MapError;
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use serde::{Deserialize, Serialize};

use super::spline::{curve_and_knots, distance, normals};
use super::{LineError, MappingParams, SpeedParams, draw_map, minimum_curvature, speed_profile};
use crate::{Surface, Track, Wall, Walls};

/// The tracks that ship, by name.
pub const BUNDLED: [&str; 4] = ["club", "hall", "park", "mirror"];

/// Distance between the points of the centre line [m].
const SPACING: f64 = 0.05;
/// Control points are at least so far apart [m].
const CLOSEST: f64 = 0.1;
/// Longest lap from control point to control point [m]: club tracks reach 540 m.
const LONGEST: f64 = 600.0;

/// A track, described: everything else is generated from it, the same every time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrackSpec {
    /// What to call it.
    pub name: String,
    /// Decides everything that is random: wall texture, posts, map noise.
    pub seed: u64,
    /// Control points of the closed centre line, in order of travel [m].
    pub centre: Vec<[f64; 2]>,
    /// True when the second half of the lap is the first, turned by 180 degrees about the origin; `centre` then gives the
    /// first half only.
    #[serde(default)]
    pub point_symmetric: bool,
    /// From the centre line to either wall, at each control point [m]; one value stands for all.
    pub half_width: Vec<f64>,
    /// From the raceline to any wall: half a car and what the driver needs [m].
    pub margin: f64,
    /// Amplitude of the walls' waves [m]; 0 makes them featureless.
    #[serde(default)]
    pub texture: f64,
    /// Posts along the walls, boxes of 0.2 m to 0.4 m that stand half in the track: number per 10 m of wall.
    #[serde(default)]
    pub posts: f64,
    /// Stretches of black wall.
    #[serde(default)]
    pub black: Vec<BlackStretch>,
    /// Things that stand on the track.
    #[serde(default)]
    pub blocks: Vec<Block>,
    /// How fast to drive.
    #[serde(default)]
    pub speed: SpeedParams,
    /// How the map is made.
    #[serde(default)]
    pub mapping: MappingParams,
}

/// A stretch of wall made of black tubes, in shares of the lap.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BlackStretch {
    /// Where it begins, in [0, 1].
    pub from: f64,
    /// Where it ends, in [0, 1], after `from`.
    pub to: f64,
    /// On the left wall, else on the right one.
    pub left: bool,
}

/// A box on the track.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Block {
    /// Its middle [m].
    pub at: [f64; 2],
    /// Length of its sides [m].
    pub size: [f64; 2],
    /// Direction of the first side [rad].
    #[serde(default)]
    pub heading: f64,
}

impl TrackSpec {
    /// Reads a description in YAML; `file` names it in errors.
    pub fn parse(file: &str, yaml: &str) -> Result<Self, MapError> {
        let spec: Self = serde_saphyr::from_str(yaml).map_err(|e| MapError::Format {
            file: file.to_owned(),
            fault: e.without_snippet().to_string(),
        })?;
        match spec.fault() {
            None => Ok(spec),
            Some((key, fault)) => Err(MapError::Key {
                file: file.to_owned(),
                key: key.to_owned(),
                fault,
            }),
        }
    }

    /// The first value that makes no track.
    fn fault(&self) -> Option<(&'static str, String)> {
        let finite = self
            .centre
            .iter()
            .flatten()
            .all(|v| v.is_finite() && v.abs() < 1e3);
        if self.centre.len() < 3 || self.centre.len() > 1000 || !finite {
            let fault = format!("{} points; 3 to 1000 within 1 km are needed", self.centre.len());
            return Some(("centre", fault));
        }
        if self.half_width.len() != 1 && self.half_width.len() != self.centre.len() {
            let fault = format!(
                "{} values; one, or one for each of the {} points of centre, are needed",
                self.half_width.len(),
                self.centre.len()
            );
            return Some(("half_width", fault));
        }
        self.misplaced().or_else(|| self.out_of_range())
    }

    /// What lies where nothing can: points in one place, lines and walls longer than can be worked on.
    fn misplaced(&self) -> Option<(&'static str, String)> {
        if self.name.is_empty() || self.name.len() > 64 || self.name.chars().any(char::is_control) {
            let fault = format!("{:?} should be 1 to 64 printable characters", self.name);
            return Some(("name", fault));
        }
        let (centre, _) = self.whole_lap();
        let next = |i: usize| centre[(i + 1) % centre.len()];
        if let Some(i) = (0..centre.len()).find(|&i| distance(centre[i], next(i)) < CLOSEST) {
            let other = (i + 1) % centre.len();
            let fault = format!(
                "points {} and {} are less than {CLOSEST} m apart",
                i + 1,
                other + 1
            );
            return Some(("centre", fault));
        }
        let length: f64 = (0..centre.len()).map(|i| distance(centre[i], next(i))).sum();
        if length > LONGEST {
            let fault = format!("a lap of {length:.0} m; up to {LONGEST} m can be worked on");
            return Some(("centre", fault));
        }
        for (i, block) in self.blocks.iter().enumerate() {
            let sides = block.size.iter().all(|side| (0.01..=100.0).contains(side));
            let near = centre.iter().any(|&point| distance(point, block.at) < 100.0);
            // NaN is neither near nor of any size.
            if !(sides && near && block.heading.is_finite()) {
                let fault = format!(
                    "block {} at {:?} of size {:?}, heading {}: sides of 0.01 m to 100 m, within 100 m of the centre line, are \
                     needed",
                    i + 1,
                    block.at,
                    block.size,
                    block.heading
                );
                return Some(("blocks", fault));
            }
        }
        let faulty = |b: &&BlackStretch| !(b.from >= 0.0 && b.from < b.to && b.to <= 1.0);
        self.black.iter().find(faulty).map(|b| {
            let fault = format!("from {} to {} should rise within [0, 1]", b.from, b.to);
            ("black", fault)
        })
    }

    /// The first number beyond what makes sense.
    fn out_of_range(&self) -> Option<(&'static str, String)> {
        let m = &self.mapping;
        let s = &self.speed;
        let ranges = [
            (
                "half_width",
                self.half_width.iter().copied().fold(f64::INFINITY, f64::min),
                0.2,
                20.0,
            ),
            (
                "half_width",
                self.half_width.iter().copied().fold(0.0, f64::max),
                0.2,
                20.0,
            ),
            ("margin", self.margin, 0.0, 10.0),
            ("texture", self.texture, 0.0, 1.0),
            ("posts", self.posts, 0.0, 100.0),
            ("speed.lateral", s.lateral, 0.1, 100.0),
            ("speed.drive", s.drive, 0.1, 100.0),
            ("speed.brake", s.brake, 0.1, 100.0),
            ("speed.top", s.top, 0.1, 100.0),
            ("mapping.resolution", m.resolution, 0.01, 1.0),
            ("mapping.drift", m.drift, 0.0, 1.0),
            ("mapping.heading_drift", m.heading_drift, 0.0, 0.5),
            ("mapping.occupied_share", m.occupied_share, 0.01, 0.99),
            ("mapping.step", m.step, 0.02, 5.0),
        ];
        ranges
            .into_iter()
            .find(|(_, value, least, most)| !(*least..=*most).contains(value))
            .map(|(key, value, least, most)| (key, format!("{value} should lie in [{least}, {most}]")))
    }

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

    /// Control points and half widths of the whole lap.
    fn whole_lap(&self) -> (Vec<[f64; 2]>, Vec<f64>) {
        let mut centre = self.centre.clone();
        let mut widths: Vec<f64> = (0..centre.len())
            .map(|i| self.half_width[i % self.half_width.len()])
            .collect();
        if self.point_symmetric {
            let turned: Vec<_> = centre.iter().map(|[x, y]| [-x, -y]).collect();
            centre.extend(turned);
            widths.extend_from_within(..);
        }
        (centre, widths)
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

    /// A wall's face, cut where its surface changes.
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
    fn faults_name_the_key() {
        for (from, to, expected) in [
            ("margin: 0.3", "margin: .nan", "t.yaml: margin: NaN"),
            (
                "half_width: [0.8]",
                "half_width: []",
                "t.yaml: half_width: 0 values",
            ),
            (
                "half_width: [0.8]",
                "half_width: [0.1]",
                "t.yaml: half_width: 0.1",
            ),
            ("[0, 3]]", "[0, .inf]]", "t.yaml: centre: "),
            ("seed: 7", "seed: x", "t.yaml: "),
            ("posts: 1.0", "poles: 1.0", "t.yaml: "),
            ("name: oval", "name: ''", "t.yaml: name: "),
            (
                "[[0, 0], [4, -2]",
                "[[0, 0], [0, 0], [4, -2]",
                "t.yaml: centre: points 1 and 2 are",
            ),
            ("[8, 3]", "[800, 3]", "t.yaml: centre: a lap of 16"),
            (
                "posts: 1.0",
                "black: [{ from: 0.9, to: 0.1, left: true }]",
                "t.yaml: black: from 0.9 to 0.1",
            ),
            (
                "posts: 1.0",
                "black: [{ from: .nan, to: 1, left: true }]",
                "t.yaml: black: from NaN",
            ),
            (
                "posts: 1.0",
                "blocks: [{ at: [4, 1], size: [-1, 1] }]",
                "t.yaml: blocks: block 1 at [4.0, 1.0]",
            ),
            (
                "posts: 1.0",
                "blocks: [{ at: [4, 1], size: [1e9, 1] }]",
                "t.yaml: blocks: block 1",
            ),
            (
                "posts: 1.0",
                "blocks: [{ at: [.nan, 1], size: [1, 1] }]",
                "t.yaml: blocks: block 1",
            ),
        ] {
            let error = TrackSpec::parse("t.yaml", &YAML.replace(from, to)).expect_err("a fault");
            assert!(
                error.to_string().starts_with(expected),
                "{error} should start with {expected}"
            );
        }
    }

    #[test]
    fn a_block_on_the_line_is_where_it_is_too_narrow() {
        let yaml = format!("{YAML}blocks: [{{ at: [4, -2], size: [1.2, 1.2] }}]\n");
        let spec = TrackSpec::parse("oval", &yaml).expect("a valid description");
        assert!(matches!(spec.generate(), Err(LineError::TooNarrow { .. })));
    }
}
