//! Full-rate streams for the recorder. They hold all that is needed to run the filter again.

use serde::{Deserialize, Serialize};

use crate::{Invalid, Message, Pose2, Schema, Twist2};

/// One message of wheel odometry as the filter received it, at the header's sensor time.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct RecordedOdometry {
    /// `odom_from_base_link`.
    pub pose: Pose2,
    /// Velocity.
    pub twist: Twist2,
}

impl Message for RecordedOdometry {
    const SCHEMA: Schema = Schema::RecordedOdometry;
    const MAX_LEN: usize = 256;
}

/// One scan as the filter received it. Its first beam was measured at the header's sensor time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RecordedScan {
    /// Direction of the first beam in the laser's frame \[rad\].
    pub angle_min: f64,
    /// Angle from one beam to the next, signed \[rad\].
    pub angle_increment: f64,
    /// Time from one beam to the next; 0 when the whole scan has one time \[s\].
    pub time_increment: f64,
    /// Shortest valid reading \[m\].
    pub range_min: f64,
    /// Readings from here on mean that nothing is in range \[m\].
    pub range_max: f64,
    /// One reading per beam \[mm\], [`RecordedScan::NO_RETURN`] where there was none; at most
    /// [`RecordedScan::MAX_BEAMS`].
    pub ranges: Vec<u16>,
}

impl RecordedScan {
    /// Most beams in one message.
    pub const MAX_BEAMS: usize = 16_384;
    /// Marks a reading that is NaN, infinite, negative or beyond 65.534 m.
    pub const NO_RETURN: u16 = u16::MAX;

    /// A reading \[m\] in millimetres.
    pub fn quantise(range: f32) -> u16 {
        let millimetres = (range * 1000.0).round();
        if (0.0..f32::from(Self::NO_RETURN)).contains(&millimetres) {
            millimetres as u16
        } else {
            Self::NO_RETURN
        }
    }

    /// A reading in metres; infinite where there was no return.
    pub fn metres(range: u16) -> f32 {
        if range == Self::NO_RETURN {
            f32::INFINITY
        } else {
            f32::from(range) / 1000.0
        }
    }
}

impl Message for RecordedScan {
    const SCHEMA: Schema = Schema::RecordedScan;

    fn validate(&self) -> Result<(), Invalid> {
        Invalid::unless_at_most("ranges", self.ranges.len(), Self::MAX_BEAMS)
    }
}

/// The true pose from a simulator or a motion-capture system, at the header's sensor time.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Truth {
    /// `map_from_base_link`.
    pub pose: Pose2,
    /// Velocity.
    pub twist: Twist2,
}

impl Message for Truth {
    const SCHEMA: Schema = Schema::Truth;
    const MAX_LEN: usize = 256;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn invalid_readings_become_infinite() {
        for range in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -0.1, 65.535, 1e9] {
            assert_eq!(RecordedScan::quantise(range), RecordedScan::NO_RETURN, "{range}");
        }
        assert!(RecordedScan::metres(RecordedScan::NO_RETURN).is_infinite());
        assert!((RecordedScan::metres(RecordedScan::quantise(10.0)) - 10.0).abs() < 1e-6);
        assert_eq!(RecordedScan::quantise(65.534), 65_534);
    }
}
