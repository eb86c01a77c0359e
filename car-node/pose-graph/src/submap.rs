//! Submaps: grids of the last scans, which the next scans are matched with.

use maps::Pose;

use crate::parameters::PoseGraphParameters;
use crate::probability_grid::{Observation, ProbabilityGrid};
use crate::scan_points::transform_all;

/// Number of a submap since the start.
pub(crate) type SubmapId = u64;

/// A grid in the local frame.
#[derive(Debug, Clone)]
pub(crate) struct Submap {
    pub(crate) id: SubmapId,
    /// Where the car was when it began; its heading is that of the local frame.
    pub(crate) local_pose: Pose,
    pub(crate) grid: ProbabilityGrid,
    scans: usize,
}

/// The two submaps that scans are inserted in. The older one has more scans, and is the one to match with.
#[derive(Debug, Clone)]
pub(crate) struct ActiveSubmaps {
    submaps: Vec<Submap>,
    next_id: SubmapId,
    hit: Observation,
    miss: Observation,
    probabilities: [f64; 2],
}

/// End points of a scan, and points up to where beams without an end point have seen free space, in the frame of `base_link`.
#[derive(Debug, Clone, Copy)]
pub(crate) struct RangeData<'a> {
    /// The laser's pose.
    pub(crate) base_link_from_laser: Pose,
    pub(crate) returns: &'a [[f32; 2]],
    pub(crate) misses: &'a [[f32; 2]],
}

impl ActiveSubmaps {
    /// No submaps yet; the first one gets the number `next_id`.
    pub(crate) fn new(next_id: SubmapId, parameters: &PoseGraphParameters) -> Self {
        let probabilities = [parameters.hit_probability, parameters.miss_probability];
        Self {
            submaps: Vec::new(),
            next_id,
            hit: Observation::new(probabilities[0]),
            miss: Observation::new(probabilities[1]),
            probabilities,
        }
    }

    /// Number of the next submap that begins.
    pub(crate) fn next_id(&self) -> SubmapId {
        self.next_id
    }

    /// The submap to match with.
    pub(crate) fn matching(&self) -> Option<&Submap> {
        self.submaps.first()
    }

    /// Inserts a scan taken at `pose`. Returns the submaps that it was inserted in, as number and local pose.
    pub(crate) fn insert(
        &mut self,
        range_data: RangeData<'_>,
        pose: Pose,
        parameters: &PoseGraphParameters,
    ) -> Vec<(SubmapId, Pose)> {
        let probabilities = [parameters.hit_probability, parameters.miss_probability];
        if probabilities.map(f64::to_bits) != self.probabilities.map(f64::to_bits) {
            *self = Self {
                submaps: std::mem::take(&mut self.submaps),
                ..Self::new(self.next_id, parameters)
            };
        }
        let full = |submap: &Submap| submap.scans >= parameters.submaps_num_range_data;
        if self.submaps.last().is_none_or(full) {
            if self.submaps.len() == 2 {
                self.submaps.remove(0);
            }
            self.submaps.push(Submap {
                id: self.next_id,
                local_pose: Pose::new(pose.x, pose.y, 0.0),
                grid: ProbabilityGrid::new(parameters.submaps_resolution),
                scans: 0,
            });
            self.next_id += 1;
        }
        let laser = pose * range_data.base_link_from_laser;
        let returns = transform_all(range_data.returns, pose);
        let misses = transform_all(range_data.misses, pose);
        let free_space = parameters.insert_free_space;
        for submap in &mut self.submaps {
            let tables = [&self.hit, &self.miss];
            submap
                .grid
                .insert([laser.x, laser.y], &returns, &misses, tables, free_space);
            submap.scans += 1;
        }
        let inserted = self
            .submaps
            .iter()
            .map(|submap| (submap.id, submap.local_pose))
            .collect();
        // A finished submap is no longer matched with once the younger one has enough scans.
        if self.submaps[0].scans >= 2 * parameters.submaps_num_range_data && self.submaps.len() == 2 {
            self.submaps.remove(0);
        }
        inserted
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_scan_is_in_two_submaps_once_the_first_is_half_full() {
        let parameters = PoseGraphParameters {
            submaps_num_range_data: 3,
            ..PoseGraphParameters::default()
        };
        let mut submaps = ActiveSubmaps::new(5, &parameters);
        let range_data = RangeData {
            base_link_from_laser: Pose::IDENTITY,
            returns: &[[1.0, 0.0]],
            misses: &[],
        };
        let inserted: Vec<Vec<SubmapId>> = (0..9)
            .map(|_| {
                let inserted = submaps.insert(range_data, Pose::IDENTITY, &parameters);
                inserted.into_iter().map(|(id, _)| id).collect()
            })
            .collect();
        let expected: [&[SubmapId]; 9] = [
            &[5],
            &[5],
            &[5],
            &[5, 6],
            &[5, 6],
            &[5, 6],
            &[6, 7],
            &[6, 7],
            &[6, 7],
        ];
        assert_eq!(inserted, expected);
        assert_eq!(submaps.matching().map(|submap| submap.id), Some(7));
    }
}
