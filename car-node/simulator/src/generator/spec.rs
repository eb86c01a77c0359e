//! The description of a track, from which everything else is generated.

use maps::MapError;
use serde::{Deserialize, Serialize};

use super::MappingParams;
use super::spline::distance;
use crate::SpeedParams;

/// Least distance between control points \[m\].
const CLOSEST: f64 = 0.1;
/// Longest lap, measured along the control points \[m\]. Club tracks reach 540 m.
const LONGEST: f64 = 600.0;

/// The description of a track. The same description makes the same track.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrackSpec {
    /// The track's name.
    pub name: String,
    /// Decides everything that is random: wall texture, posts, map noise.
    pub seed: u64,
    /// Control points of the closed centre line, in order of travel \[m\].
    pub centre: Vec<[f64; 2]>,
    /// True when the second half of the lap is the first, turned by 180 degrees about the origin; `centre` then gives the
    /// first half only.
    #[serde(default)]
    pub point_symmetric: bool,
    /// From the centre line to either wall, at each control point \[m\]. One value counts for all.
    pub half_width: Vec<f64>,
    /// From the raceline to any wall \[m\]: half a car and the driver's error.
    pub margin: f64,
    /// Amplitude of the walls' waves \[m\]; 0 makes them featureless.
    #[serde(default)]
    pub texture: f64,
    /// Posts along the walls, boxes of 0.2 m to 0.4 m that stand half in the track: number per 10 m of wall.
    #[serde(default)]
    pub posts: f64,
    /// Stretches of black wall.
    #[serde(default)]
    pub black: Vec<BlackStretch>,
    /// Boxes on the track.
    #[serde(default)]
    pub blocks: Vec<Block>,
    /// Limits of the raceline's speeds.
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
    /// Where it begins, in \[0, 1\].
    pub from: f64,
    /// Where it ends, in \[0, 1\], after `from`.
    pub to: f64,
    /// On the left wall, else on the right one.
    pub left: bool,
}

/// A box on the track.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Block {
    /// Its middle \[m\].
    pub at: [f64; 2],
    /// Length of its sides \[m\].
    pub size: [f64; 2],
    /// Direction of the first side \[rad\].
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

    /// The first invalid value, by its key.
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

    /// The first invalid name, point, block or stretch.
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
            // Also false for NaN.
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

    /// The first number out of range.
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

    /// Control points and half widths of the whole lap.
    pub(super) fn whole_lap(&self) -> (Vec<[f64; 2]>, Vec<f64>) {
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
}

#[cfg(test)]
mod tests {
    use super::*;

    const YAML: &str = "name: oval\nseed: 7\ncentre: [[0, 0], [4, -2], [8, 0], [8, 3], [4, 5], [0, 3]]\n\
                        half_width: [0.8]\nmargin: 0.3\ntexture: 0.03\nposts: 1.0\n";

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
}
