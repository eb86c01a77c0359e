//! Answers to questions about the car itself: what it is, and what its clock says.

use serde::{Deserialize, Serialize};

use crate::{Message, Pose2, Schema};

/// What runs on the car.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CarInfo {
    /// Version of the node.
    pub version: String,
    /// Start of the node, in ns since 1970. It is the [`run_id`](crate::Header::run_id) of its messages.
    pub started: u64,
    /// Where the sensor data comes from, in words.
    pub source: String,
    /// Name of the map.
    pub map: String,
    /// Length of a lap of the raceline [m]; None without a raceline.
    pub lap_length: Option<f64>,
    /// Where the laser is mounted.
    pub base_link_from_laser: Pose2,
    /// Name of the machine.
    pub host: String,
}

impl Message for CarInfo {
    const SCHEMA: Schema = Schema::CarInfo;
    const MAX_LEN: usize = 4096;
}

/// "What time is it?"
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ClockRequest {
    /// When the question was sent [ns, the asker's clock].
    pub sent: i64,
}

impl Message for ClockRequest {
    const SCHEMA: Schema = Schema::ClockRequest;
    const MAX_LEN: usize = 64;
}

/// The three times that make a clock offset and a round-trip time, with the fourth taken on arrival.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ClockReply {
    /// [`ClockRequest::sent`], given back.
    pub sent: i64,
    /// When the question arrived [unix ns, the car's clock].
    pub received: i64,
    /// When this answer was made [unix ns, the car's clock].
    pub answered: i64,
}

impl ClockReply {
    /// What must be added to the asker's clock to get the car's, and the round-trip time [ns, ns]. The offset is
    /// right to within half the round-trip time. `arrived` is on the asker's clock.
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
    fn a_clock_ahead_by_a_second_is_seen_as_such() {
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
    fn absurd_times_do_not_overflow() {
        let reply = ClockReply {
            sent: i64::MIN,
            received: i64::MAX,
            answered: i64::MIN,
        };
        assert_eq!(reply.offset_and_round_trip(i64::MAX).1, i64::MAX);
    }
}
