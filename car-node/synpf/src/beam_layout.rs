//! The choice of the beams that the sensor model weighs.

use serde::{Deserialize, Serialize};

use crate::validation::Check;

/// How the beams for the sensor model are chosen.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum BeamLayout {
    /// At equal spacing along the outline of a corridor (Stahl et al., IV 2019). More beams look along the track, where the
    /// information on the position along it is.
    Boxed,
    /// At equal angles.
    Uniform,
}

/// Which beams the sensor model weighs, and whether the scan is deskewed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct BeamParameters {
    /// How the beams are chosen.
    pub beam_layout: BeamLayout,
    /// Number of beams that are weighed; more than 128 count as 128 (`des_lidar_beams` in the reference's file).
    pub beams: usize,
    /// Length over width of the corridor of the boxed layout (`lidar_aspect_ratio` in the reference's file).
    pub lidar_aspect_ratio: f64,
    /// Transform each beam to the scan's stamp by the odometry since; else all count as measured at the stamp.
    pub deskew: bool,
}

impl Default for BeamParameters {
    fn default() -> Self {
        Self {
            beam_layout: BeamLayout::Boxed,
            beams: 21,
            lidar_aspect_ratio: 3.5,
            deskew: true,
        }
    }
}

impl BeamParameters {
    pub(crate) fn validate(&self, check: &mut Check) {
        check.range("beams", self.beams as f64, 3.0, 1000.0);
        check.range("lidar_aspect_ratio", self.lidar_aspect_ratio, 0.1, 100.0);
    }
}

/// Most beams that are weighed, so that their directions and rows of the beam model fit on the stack.
pub(crate) const MOST_BEAMS: usize = 128;

/// The choice of beams for a scan's geometry: `count` beams from `angle_min` on, `increment` apart \[rad\].
pub(crate) fn chosen_beams(
    count: usize,
    angle_min: f64,
    increment: f64,
    parameters: &BeamParameters,
) -> Vec<u32> {
    match parameters.beam_layout {
        BeamLayout::Uniform => uniform(count, parameters.beams),
        BeamLayout::Boxed => boxed(count, angle_min, increment, parameters),
    }
}

/// `wanted` beams at equal angles, the first and last included.
fn uniform(count: usize, wanted: usize) -> Vec<u32> {
    let wanted = wanted.min(count);
    let last = (count - 1) as f64;
    let mut chosen: Vec<u32> = (0..wanted)
        .map(|k| (k as f64 * last / (wanted.max(2) - 1) as f64).round() as u32)
        .collect();
    chosen.dedup();
    chosen
}

/// The beams that meet the outline of a corridor at equally spaced points. The car is in its middle and looks along it.
fn boxed(count: usize, angle_min: f64, increment: f64, parameters: &BeamParameters) -> Vec<u32> {
    let (half_length, half_width) = (parameters.lidar_aspect_ratio, 1.0);
    let outline = |i: usize| {
        let (sin, cos) = (angle_min + increment * i as f64).sin_cos();
        let reach = (half_length / cos.abs().max(1e-9)).min(half_width / sin.abs().max(1e-9));
        [reach * cos, reach * sin]
    };
    let mut path = Vec::with_capacity(count);
    let (mut length, mut before) = (0.0, outline(0));
    for i in 0..count {
        let here = outline(i);
        length += f64::hypot(here[0] - before[0], here[1] - before[1]);
        path.push(length);
        before = here;
    }
    let wanted = parameters.beams.min(count);
    let mut chosen: Vec<u32> = (0..wanted)
        .map(|k| {
            let target = length * k as f64 / (wanted.max(2) - 1) as f64;
            path.partition_point(|&at| at < target).min(count - 1) as u32
        })
        .collect();
    chosen.dedup();
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::PI;

    const COUNT: usize = 1081;

    #[test]
    fn boxed_beams_look_ahead_and_back() {
        let parameters = BeamParameters::default();
        let chosen = boxed(COUNT, -0.75 * PI, 1.5 * PI / (COUNT - 1) as f64, &parameters);
        assert!((19..=21).contains(&chosen.len()));
        let ahead = |limit: f64| {
            let angle = |i: u32| -0.75 * PI + 1.5 * PI / (COUNT - 1) as f64 * f64::from(i);
            chosen.iter().filter(|&&i| angle(i).abs() < limit).count()
        };
        let evenly = 21.0 * 2.0 * 0.6 / (1.5 * PI);
        assert!(
            ahead(0.6) as f64 > 1.5 * evenly,
            "{} beams within 0.6 rad",
            ahead(0.6)
        );
    }
}
