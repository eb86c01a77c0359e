//! The scale of the wheels' distance, by the distance of the scans.

use localizer::{SensorFinding, SensorFindings};

use super::Stretch;

/// Compares distances. Slip of up to a tenth is left to the slip model, which knows its causes.
#[derive(Debug, Clone)]
pub(super) struct WheelScale {
    scale: f64,
    /// Wheel distance, weighed by how well the scans tell the distance \[m\].
    weight: f64,
    /// The same, not weighed \[m\].
    driven: f64,
    /// Sums of the ratio, scans over wheels, and of its squares.
    ratio: f64,
    squares: f64,
}

impl Default for WheelScale {
    fn default() -> Self {
        Self {
            scale: 1.0,
            weight: 0.0,
            driven: 0.0,
            ratio: 0.0,
            squares: 0.0,
        }
    }
}

/// How far back distances count \[m\].
const MEMORY: f64 = 20.0;

/// Least distance to judge the scale by, weighed and not \[m\].
const LEAST: [f64; 2] = [0.7, 2.0];

/// Tyres within their limit slip by less: a longitudinal slip of 0.1 is where their force peaks (Pacejka, *Tire and
/// Vehicle Dynamics*, section 1.2).
const SLIP: f64 = 0.12;

/// A scale is none if its ratio scatters by more than this share of what it is off by.
const STEADY: f64 = 0.7;

/// Slower than this, a share of the distance says little [m/s].
const WALKING: f64 = 0.5;

/// More is no scale but another fault.
const MOST: f64 = 2.5;

impl WheelScale {
    /// Takes in a stretch that was driven while the wheels counted `applied` times. Returns true when the scale has changed.
    pub(super) fn learn(&mut self, stretch: &Stretch, applied: f64) -> bool {
        let wheels = stretch.driven.distance * applied;
        // Where the scans do not tell the distance, it is the wheels' own.
        if wheels.abs() < WALKING * stretch.seconds || stretch.information < 0.02 {
            return false;
        }
        let ratio = stretch.distance / wheels;
        if !(1.0 / MOST..MOST).contains(&ratio) {
            return false;
        }
        let keep = (-wheels.abs() / MEMORY).exp();
        let weight = wheels.abs() * stretch.information;
        self.weight = self.weight * keep + weight;
        self.driven = self.driven * keep + wheels.abs();
        self.ratio = self.ratio * keep + weight * ratio;
        self.squares = self.squares * keep + weight * ratio * ratio;
        if self.weight < LEAST[0] || self.driven < LEAST[1] {
            return false;
        }
        let mean = self.ratio / self.weight;
        let deviation = (self.squares / self.weight - mean * mean).max(0.0).sqrt();
        let off = (1.0 / mean - 1.0).abs();
        if off < SLIP || deviation > STEADY * off {
            return false;
        }
        // What comes next is compared with the new scale.
        *self = Self {
            scale: (self.scale * mean).clamp(1.0 / MOST, MOST),
            ..Self::default()
        };
        true
    }

    /// Distance driven over the wheels' distance.
    pub(super) fn scale(&self) -> f64 {
        self.scale
    }

    pub(super) fn report(&self, findings: &mut SensorFindings) {
        if (self.scale - 1.0).abs() > 1e-9 {
            findings.insert(SensorFinding::WheelScale, 1.0 / self.scale);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensor_check::DrivenSums;

    /// 20 m, the wheels counting `multiple(step)` times as far as the car goes.
    fn drive(information: f64, multiple: impl Fn(u32) -> f64) -> WheelScale {
        let mut scale = WheelScale::default();
        for step in 0..50 {
            let wheels = 0.4 * multiple(step);
            let applied = scale.scale();
            scale.learn(
                &Stretch {
                    seconds: 0.1,
                    distance: 0.4,
                    turn: 0.0,
                    information,
                    driven: DrivenSums {
                        distance: wheels,
                        ..DrivenSums::default()
                    },
                },
                applied,
            );
        }
        scale
    }

    #[test]
    fn a_scale_that_is_off_by_two_fifths_is_found() {
        for multiple in [0.6, 0.8, 1.2, 1.4] {
            let found = 1.0 / drive(0.5, |_| multiple).scale();
            assert!((found - multiple).abs() < 0.01, "{multiple}: {found}");
        }
    }

    #[test]
    fn slip_is_no_scale() {
        // Within the tyres' limit, and wheels that spin in every bend.
        assert!((drive(0.5, |_| 1.08).scale() - 1.0).abs() < 1e-12);
        let spinning = drive(0.5, |step| if step % 4 == 0 { 1.5 } else { 1.02 });
        assert!((spinning.scale() - 1.0).abs() < 1e-12);
    }

    #[test]
    fn along_a_featureless_straight_nothing_is_learned() {
        assert!((drive(0.001, |_| 1.4).scale() - 1.0).abs() < 1e-12);
    }
}
