//! Several defects of the sensors at once.

use maps::Pose;

use super::catalogue::Defect;
use super::sensor_damage::{ArrivalQueue, DamagedArrival, SensorDamage, TruePose};
use crate::sensors::bag::Arrival;

/// Damages the messages of one car by several defects, one after the other.
#[derive(Debug)]
pub struct DamageChain(Vec<SensorDamage>);

impl DamageChain {
    /// Defects of the map do not count. `has_gyro` is true for a car with a gyroscope of its own.
    pub fn new(defects: &[Defect], base_link_from_laser: Pose, has_gyro: bool, seed: u64) -> Self {
        let of = |defect: &Defect| SensorDamage::new(*defect, base_link_from_laser, has_gyro, seed);
        Self(defects.iter().filter_map(of).collect())
    }

    /// Puts what becomes of a message into the queue.
    pub fn damage(&mut self, arrival: Arrival, truth: TruePose<'_>, queue: &mut ArrivalQueue) {
        let measured = arrival.event.stamp();
        let mut messages = vec![DamagedArrival { arrival, measured }];
        for damage in &mut self.0 {
            let mut damaged = Vec::with_capacity(messages.len());
            for DamagedArrival { arrival, measured } in messages {
                let (stamp, begin) = (arrival.event.stamp(), damaged.len());
                damage.damage(arrival, truth, &mut damaged);
                for message in &mut damaged[begin..] {
                    // What an earlier defect did to the stamp is kept.
                    if message.measured == stamp {
                        message.measured = measured;
                    }
                }
            }
            messages = damaged;
        }
        for message in messages {
            queue.push(message);
        }
    }
}
