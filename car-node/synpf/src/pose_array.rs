//! Poses as one array per component, for eight of them at a time.

use maps::Pose;
use wide::f32x8;

/// Poses in the grid's frame.
///
/// Every way to write a heading writes its cosine and sine too, so that they always belong to it.
#[derive(Debug, Clone, Default)]
pub(crate) struct PoseArray {
    x: Vec<f32>,
    y: Vec<f32>,
    heading: Vec<f32>,
    cos: Vec<f32>,
    sin: Vec<f32>,
}

impl PoseArray {
    /// An empty array with room for `capacity` poses.
    pub(crate) fn with_capacity(capacity: usize) -> Self {
        let array = || Vec::with_capacity(capacity);
        Self {
            x: array(),
            y: array(),
            heading: array(),
            cos: array(),
            sin: array(),
        }
    }

    /// Number of poses.
    pub(crate) fn len(&self) -> usize {
        self.x.len()
    }

    /// Cuts the array off at `count` poses, or fills it up with the pose at the origin.
    pub(crate) fn resize(&mut self, count: usize) {
        for array in [&mut self.x, &mut self.y, &mut self.heading, &mut self.sin] {
            array.resize(count, 0.0);
        }
        self.cos.resize(count, 1.0);
    }

    /// Pose `i`.
    pub(crate) fn get(&self, i: usize) -> Pose {
        Pose::new(self.x[i].into(), self.y[i].into(), self.heading[i].into())
    }

    /// Writes pose `i`.
    pub(crate) fn set(&mut self, i: usize, pose: Pose) {
        let heading = maps::wrap_angle(pose.heading);
        self.x[i] = pose.x as f32;
        self.y[i] = pose.y as f32;
        self.heading[i] = heading as f32;
        self.cos[i] = heading.cos() as f32;
        self.sin[i] = heading.sin() as f32;
    }

    /// Makes this array the poses of `from` at `indices`, in their order.
    pub(crate) fn gather(&mut self, from: &Self, indices: &[u32]) {
        for (to, from) in [
            (&mut self.x, &from.x),
            (&mut self.y, &from.y),
            (&mut self.heading, &from.heading),
            (&mut self.cos, &from.cos),
            (&mut self.sin, &from.sin),
        ] {
            to.clear();
            to.extend(indices.iter().map(|&i| from[i as usize]));
        }
    }

    /// Writes the first `lanes` of eight poses from index `i` on. Headings may be any angle of a few turns.
    #[inline]
    pub(crate) fn store(&mut self, i: usize, lanes: usize, [x, y, heading]: [f32x8; 3]) {
        let turn = f32x8::splat(std::f32::consts::TAU);
        let turns = (heading * f32x8::splat(1.0 / std::f32::consts::TAU)).fast_round_int();
        let wrapped = heading - turn * f32x8::from_i32x8(turns);
        let (sin, cos) = wrapped.sin_cos();
        store(x, &mut self.x[i..], lanes);
        store(y, &mut self.y[i..], lanes);
        store(wrapped, &mut self.heading[i..], lanes);
        store(cos, &mut self.cos[i..], lanes);
        store(sin, &mut self.sin[i..], lanes);
    }

    /// x \[m\].
    pub(crate) fn x(&self) -> &[f32] {
        &self.x
    }

    /// y \[m\].
    pub(crate) fn y(&self) -> &[f32] {
        &self.y
    }

    /// Headings in [-pi, pi) to the rounding of `f32` \[rad\].
    pub(crate) fn heading(&self) -> &[f32] {
        &self.heading
    }

    /// Cosines of the headings.
    pub(crate) fn cos(&self) -> &[f32] {
        &self.cos
    }

    /// Sines of the headings.
    pub(crate) fn sin(&self) -> &[f32] {
        &self.sin
    }
}

/// Eight lanes; the first `lanes` hold the values, the rest 0.
#[inline]
pub(crate) fn load(values: &[f32], lanes: usize) -> f32x8 {
    if lanes == 8 {
        f32x8::from(<[f32; 8]>::try_from(&values[..8]).expect("eight lanes"))
    } else {
        let mut some = [0.0; 8];
        some[..lanes].copy_from_slice(&values[..lanes]);
        f32x8::from(some)
    }
}

/// Writes the first `lanes` of eight lanes.
#[inline]
pub(crate) fn store(value: f32x8, to: &mut [f32], lanes: usize) {
    // A copy of known length compiles to a store, one of unknown length to a call.
    if lanes == 8 {
        to[..8].copy_from_slice(value.as_array());
    } else {
        to[..lanes].copy_from_slice(&value.as_array()[..lanes]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn assert_consistent(poses: &PoseArray) {
        for i in 0..poses.len() {
            let (sin, cos) = poses.heading[i].sin_cos();
            assert!(
                (poses.sin[i] - sin).abs() < 1e-6 && (poses.cos[i] - cos).abs() < 1e-6,
                "{i}: heading {}, cos {}, sin {}",
                poses.heading[i],
                poses.cos[i],
                poses.sin[i]
            );
        }
    }

    /// Cosines and sines used to be written by the motion alone. After a resampling each particle was weighed with those
    /// of the particle that had its index before, and with 0 after `initialize` on a car that stood.
    #[test]
    fn cosines_and_sines_belong_to_the_headings_after_every_write() {
        let mut poses = PoseArray::default();
        poses.resize(11);
        assert_consistent(&poses);
        for i in 0..11 {
            poses.set(i, Pose::new(i as f64, 0.0, 0.7 * i as f64));
        }
        assert_consistent(&poses);
        let mut gathered = PoseArray::default();
        gathered.gather(&poses, &[9, 9, 2, 5, 0]);
        assert_eq!(gathered.get(2), poses.get(2));
        assert_consistent(&gathered);
        gathered.resize(8);
        gathered.store(0, 5, [f32x8::splat(1.0), f32x8::splat(2.0), f32x8::splat(9.5)]);
        assert!(f64::from(gathered.heading[4]) - maps::wrap_angle(9.5) < 1e-6);
        assert_consistent(&gathered);
    }
}
