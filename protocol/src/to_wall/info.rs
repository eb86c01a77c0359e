//! Replies to queries about the car: what runs on it, and the time of its clock.

use serde::{Deserialize, Serialize};

use crate::{Message, Pose2, Schema};

/// What runs on the car.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CarInfo {
    /// Version of the node.
    pub version: String,
    /// Start of the node, in ns since 1970, by the car's clock.
    pub started: u64,
    /// Description of the source of the sensor data.
    pub source: String,
    /// Name of the map.
    pub map: String,
    /// Length of a lap of the raceline \[m\]; None without a raceline.
    pub lap_length: Option<f64>,
    /// Pose of the laser on the car.
    pub base_link_from_laser: Pose2,
    /// Name of the machine.
    pub host: String,
}

impl Message for CarInfo {
    const SCHEMA: Schema = Schema::CarInfo;
    const MAX_LEN: usize = 4096;
}

/// Asks for the time of the car's clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ClockRequest {
    /// When the query was sent \[ns, the sender's clock\].
    pub sent: i64,
}

impl Message for ClockRequest {
    const SCHEMA: Schema = Schema::ClockRequest;
    const MAX_LEN: usize = 64;
}

/// Three of the four times that give a clock offset and a round-trip time. The sender of the query takes the fourth on
/// arrival.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ClockReply {
    /// [`ClockRequest::sent`], returned.
    pub sent: i64,
    /// When the query arrived \[unix ns, the car's clock\].
    pub received: i64,
    /// When this reply was made \[unix ns, the car's clock\].
    pub answered: i64,
}

impl ClockReply {
    /// The offset of the car's clock from that of the query's sender, and the round-trip time \[ns, ns\]. The error of the
    /// offset is at most half the round-trip time. `arrived` is when the reply arrived, by the sender's clock.
    pub fn offset_and_round_trip(&self, arrived: i64) -> (i64, i64) {
        let there = i128::from(self.received) - i128::from(self.sent);
        let back = i128::from(self.answered) - i128::from(arrived);
        let round_trip = there - back;
        let clamp = |v: i128| v.clamp(i64::MIN.into(), i64::MAX.into()) as i64;
        (clamp(i128::midpoint(there, back)), clamp(round_trip))
    }
}

impl Message for ClockReply {
    const SCHEMA: Schema = Schema::ClockReply;
    const MAX_LEN: usize = 64;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_offset_of_a_clock_ahead_by_a_second() {
        // 10 ms there, 2 ms on the car, 10 ms back.
        let reply = ClockReply {
            sent: 0,
            received: 1_010_000_000,
            answered: 1_012_000_000,
        };
        assert_eq!(
            reply.offset_and_round_trip(22_000_000),
            (1_000_000_000, 20_000_000)
        );
    }

    #[test]
    fn extreme_times_do_not_overflow() {
        let reply = ClockReply {
            sent: i64::MIN,
            received: i64::MAX,
            answered: i64::MIN,
        };
        assert_eq!(reply.offset_and_round_trip(i64::MAX).1, i64::MAX);
    }
}
