//! A recorded drive with a defect.

use std::collections::BTreeMap;
use std::sync::Arc;

use maps::{OccupancyGrid, Pose};
use rand::SeedableRng;
use rand::rngs::SmallRng;
use synpf::{Stamp, TrackMap};

use super::catalogue::{Defect, DefectKind, Part};
use super::damage_chain::DamageChain;
use super::map_damage::{self, Warp};
use super::sensor_damage::ArrivalQueue;
use crate::evaluate::{Fault, FaultKind, Truth};
use crate::sensors::bag::{Arrival, SensorEvent, SensorLog};

/// The log and the map of a drive, and where the car was.
#[derive(Debug, Clone)]
pub struct Drive {
    /// What the sensors delivered.
    pub log: SensorLog,
    /// Pose of the laser on the car.
    pub base_link_from_laser: Pose,
    /// Where the car was, `map_from_base_link` by stamp.
    pub truth: Vec<(Stamp, Pose)>,
    /// The longest time between two poses of `truth` that is interpolated \[s\].
    pub longest_gap: f64,
}

/// A drive with a defect.
#[derive(Debug)]
pub struct DamagedDrive {
    /// What arrives, in order.
    pub arrivals: Vec<Arrival>,
    /// Where the car was, by the stamps of the damaged scans.
    pub truth: Truth,
    /// The map; None where it is not damaged.
    pub map: Option<Arc<TrackMap>>,
    /// When the car was carried away.
    pub carried_at: Option<Stamp>,
}

impl DamagedDrive {
    /// The true pose at the first scan, or the first one that is known.
    pub fn start(&self) -> Option<Pose> {
        let first = self.arrivals.iter().find_map(|arrival| match &arrival.event {
            SensorEvent::Scan(scan) => Some(scan.stamp),
            _ => None,
        })?;
        self.truth.at(first).or_else(|| self.truth.first())
    }
}

/// Why a defect does not apply to a drive.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NotApplicable {
    /// The log has no gyroscope that could be missing.
    #[error("the log has no gyroscope")]
    NoGyro,
    /// The log is too short for the defect.
    #[error("the log is too short: it needs {needed} s")]
    TooShort {
        /// The shortest log that would do \[s\].
        needed: u32,
    },
    /// No wall beside the path, or no cell, is changed by it.
    #[error("it changes nothing on this map")]
    MapUnchanged,
    /// The damaged map cannot be used.
    #[error("{0}")]
    Map(String),
}

/// A car that was carried needs this long before and after \[s\].
const AROUND_KIDNAP: f64 = 8.0;

impl Drive {
    /// The drive with a defect. The same seed gives the same damage.
    pub fn damaged(
        &self,
        grid: &OccupancyGrid,
        defect: Defect,
        seed: u64,
    ) -> Result<DamagedDrive, NotApplicable> {
        let truth = Truth::with_gaps(self.truth.clone(), self.longest_gap);
        match defect.kind.part() {
            Part::Map => self.on_map(grid, defect, seed),
            Part::Car => self.carried(defect),
            _ => self.with_sensors(&truth, defect, seed),
        }
    }

    /// The drive as it was recorded.
    pub fn undamaged(&self) -> DamagedDrive {
        DamagedDrive {
            arrivals: self.log.arrivals.clone(),
            truth: Truth::with_gaps(self.truth.clone(), self.longest_gap),
            map: None,
            carried_at: None,
        }
    }

    fn on_map(&self, grid: &OccupancyGrid, defect: Defect, seed: u64) -> Result<DamagedDrive, NotApplicable> {
        let mut random = SmallRng::seed_from_u64(seed);
        let path: Vec<Pose> = self.truth.iter().map(|(_, pose)| *pose).collect();
        let (damaged, warp) = map_damage::damage(grid, defect, &path, &mut random)
            .filter(|(damaged, _)| damaged != grid)
            .ok_or(NotApplicable::MapUnchanged)?;
        let map = TrackMap::new(damaged).map_err(|error| NotApplicable::Map(error.to_string()))?;
        let moved =
            |(stamp, pose): &(Stamp, Pose)| (*stamp, warp.map_or(*pose, |warp: Warp| warp.pose(*pose)));
        Ok(DamagedDrive {
            truth: Truth::with_gaps(self.truth.iter().map(moved).collect(), self.longest_gap),
            map: Some(Arc::new(map)),
            ..self.undamaged()
        })
    }

    fn carried(&self, defect: Defect) -> Result<DamagedDrive, NotApplicable> {
        let needed = 2.0 * AROUND_KIDNAP + defect.size();
        let [first, last] = self.log.span().unwrap_or([Stamp(0); 2]);
        let lasts = last.since(first);
        if lasts < needed {
            let needed = needed.ceil() as u32;
            return Err(NotApplicable::TooShort { needed });
        }
        let at = (lasts - defect.size()) / 2.0;
        let fault = Fault {
            kind: FaultKind::Kidnap,
            at,
            duration: defect.size(),
        };
        let mut log = SensorLog {
            truth: self.truth.clone(),
            ..self.log.clone()
        };
        fault.apply(&mut log);
        Ok(DamagedDrive {
            arrivals: log.arrivals,
            truth: Truth::with_gaps(log.truth, self.longest_gap),
            map: None,
            carried_at: Some(first.plus(at)),
        })
    }

    fn with_sensors(&self, truth: &Truth, defect: Defect, seed: u64) -> Result<DamagedDrive, NotApplicable> {
        let is_gyro = |arrival: &Arrival| matches!(arrival.event, SensorEvent::YawRate(_));
        let has_gyro = self.log.arrivals.iter().any(is_gyro);
        if defect.kind == DefectKind::GyroNone && !has_gyro {
            return Err(NotApplicable::NoGyro);
        }
        let mut chain = DamageChain::new(&[defect], self.base_link_from_laser, has_gyro, seed);
        let true_pose = |stamp| truth.at(stamp);
        let mut queue = ArrivalQueue::default();
        let (mut arrivals, mut measured) = (Vec::with_capacity(self.log.arrivals.len()), BTreeMap::new());
        for arrival in &self.log.arrivals {
            chain.damage(arrival.clone(), &true_pose, &mut queue);
            while let Some(damaged) = queue.pop(arrival.log_time) {
                keep(damaged, &mut arrivals, &mut measured);
            }
        }
        while let Some(damaged) = queue.pop(Stamp(i64::MAX)) {
            keep(damaged, &mut arrivals, &mut measured);
        }
        Ok(DamagedDrive {
            arrivals,
            truth: Truth::with_gaps(self.truth.clone(), self.longest_gap).with_measured(measured),
            map: None,
            carried_at: None,
        })
    }
}

/// Keeps a message, and when it was measured if its stamp differs.
fn keep(
    damaged: super::sensor_damage::DamagedArrival,
    arrivals: &mut Vec<Arrival>,
    measured: &mut BTreeMap<Stamp, Stamp>,
) {
    if let SensorEvent::Scan(scan) = &damaged.arrival.event
        && scan.stamp != damaged.measured
    {
        measured.insert(scan.stamp, damaged.measured);
    }
    arrivals.push(damaged.arrival);
}
