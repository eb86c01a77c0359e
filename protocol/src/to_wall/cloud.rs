//! A sample of the particle cloud, small enough to send ten times a second.

use std::f64::consts::PI;

use serde::{Deserialize, Serialize};

use crate::{Invalid, Message, Pose2, Schema};

/// Summary of all particles, and a sample of them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Cloud {
    /// The filter update that it belongs to.
    pub update: u64,
    /// Particles in use.
    pub count: u32,
    /// Effective sample size over `count`, before resampling, in `[0, 1]`.
    pub ess_ratio: f32,
    /// Standard deviation along the car's heading \[m\].
    pub spread_along: f32,
    /// Standard deviation across the car's heading \[m\].
    pub spread_across: f32,
    /// Mass of the second cluster over that of the first, in `[0, 1]`.
    pub second_mode: f32,
    /// The point that particle positions are relative to \[m\].
    pub centre: [f64; 2],
    /// The sample: at most [`Cloud::MAX_PARTICLES`], drawn by weight or evenly.
    pub particles: Vec<CloudParticle>,
}

impl Cloud {
    /// Most particles in one message.
    pub const MAX_PARTICLES: usize = 256;

    /// The pose of a particle of this cloud.
    pub fn pose(&self, particle: CloudParticle) -> Pose2 {
        Pose2 {
            x: self.centre[0] + f64::from(particle.x) * CloudParticle::METRES,
            y: self.centre[1] + f64::from(particle.y) * CloudParticle::METRES,
            heading: f64::from(particle.heading) * CloudParticle::RADIANS,
        }
    }
}

/// One particle in 8 bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct CloudParticle {
    /// Offset from the centre, in [`CloudParticle::METRES`].
    pub x: i16,
    /// Offset from the centre, in [`CloudParticle::METRES`].
    pub y: i16,
    /// Heading, in [`CloudParticle::RADIANS`].
    pub heading: i16,
    /// Weight over the heaviest particle's, 65535 being 1.
    pub weight: u16,
}

impl CloudParticle {
    /// Step of a position \[m\]. It reaches 327 m to either side of the centre.
    pub const METRES: f64 = 0.01;
    /// Step of a heading \[rad\].
    pub const RADIANS: f64 = PI / 32768.0;

    /// Rounds a particle. `weight` is relative to the heaviest one, in `[0, 1]`. Positions out of range become the
    /// outermost ones.
    pub fn quantise(pose: Pose2, centre: [f64; 2], weight: f64) -> Self {
        // `as` saturates floats out of range and turns NaN into 0. A heading of pi would saturate to just below pi.
        // Through i32 it wraps to -pi, which is the same direction.
        Self {
            x: ((pose.x - centre[0]) / Self::METRES).round() as i16,
            y: ((pose.y - centre[1]) / Self::METRES).round() as i16,
            heading: (pose.heading / Self::RADIANS).round() as i32 as i16,
            weight: (weight * 65535.0).round() as u16,
        }
    }
}

impl Message for Cloud {
    const SCHEMA: Schema = Schema::Cloud;
    const MAX_LEN: usize = 4096;

    fn validate(&self) -> Result<(), Invalid> {
        Invalid::unless_at_most("particles", self.particles.len(), Self::MAX_PARTICLES)?;
        Invalid::unless_share("ess_ratio", self.ess_ratio)?;
        Invalid::unless_share("second_mode", self.second_mode)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn quantising_is_off_by_half_a_step(x in -300.0..300.0, y in -300.0..300.0, heading in -PI..PI) {
            let centre = [10.0, -5.0];
            let pose = Pose2 { x: x + centre[0], y: y + centre[1], heading };
            let cloud = Cloud {
                update: 1, count: 1, ess_ratio: 1.0, spread_along: 0.0, spread_across: 0.0, second_mode: 0.0,
                centre, particles: Vec::new(),
            };
            let back = cloud.pose(CloudParticle::quantise(pose, centre, 1.0));
            prop_assert!((back.x - pose.x).abs() <= 0.00501 && (back.y - pose.y).abs() <= 0.00501);
            let turn = (back.heading - heading).abs();
            prop_assert!(turn.min(2.0 * PI - turn) <= 0.51 * CloudParticle::RADIANS);
        }
    }

    #[test]
    fn far_particles_saturate() {
        let far = Pose2 {
            x: 1e9,
            y: -1e9,
            heading: 0.0,
        };
        let particle = CloudParticle::quantise(far, [0.0; 2], 2.0);
        assert_eq!(
            (particle.x, particle.y, particle.weight),
            (i16::MAX, i16::MIN, u16::MAX)
        );
    }
}
