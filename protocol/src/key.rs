//! Keys: `synpf/v1/<car>/<topic>`.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// The name of a car: 1 to 32 characters of `[a-z0-9-]`.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct CarName(String);

impl CarName {
    /// Most characters of a name.
    pub const MAX_LEN: usize = 32;

    /// Checks a name.
    pub fn new(name: impl Into<String>) -> Result<Self, KeyError> {
        let name = name.into();
        let allowed = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-';
        if (1..=Self::MAX_LEN).contains(&name.len()) && name.chars().all(allowed) {
            Ok(Self(name))
        } else {
            Err(KeyError::CarName(name))
        }
    }

    /// The name.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for CarName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(&self.0)
    }
}

impl FromStr for CarName {
    type Err = KeyError;

    fn from_str(name: &str) -> Result<Self, KeyError> {
        Self::new(name)
    }
}

impl TryFrom<String> for CarName {
    type Error = KeyError;

    fn try_from(name: String) -> Result<Self, KeyError> {
        Self::new(name)
    }
}

impl From<CarName> for String {
    fn from(name: CarName) -> Self {
        name.0
    }
}

/// The last part of a key: what its messages hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Topic {
    /// Liveliness token: the car's node runs.
    Alive,
    /// [`Pose`](crate::Pose), newest wins.
    Pose,
    /// [`Cloud`](crate::Cloud), newest wins.
    Cloud,
    /// [`ScanView`](crate::ScanView), newest wins.
    Scan,
    /// [`Health`](crate::Health), with history and recovery.
    Health,
    /// [`Load`](crate::Load), with history.
    Load,
    /// [`Params`](crate::Params), with history.
    Params,
    /// [`Event`](crate::Event), with history and recovery.
    Event,
    /// [`Pose`](crate::Pose) at full rate, recovered.
    RecordedPose,
    /// [`Health`](crate::Health) of every update, recovered.
    RecordedHealth,
    /// [`RecordedOdometry`](crate::RecordedOdometry), recovered.
    RecordedOdometry,
    /// [`RecordedScan`](crate::RecordedScan), recovered.
    RecordedScan,
    /// [`Truth`](crate::Truth), from simulators and bags that have it, recovered.
    RecordedTruth,
    /// Query, answered with a [`MapReply`](crate::MapReply).
    Map,
    /// Query, answered with a [`CarInfo`](crate::CarInfo).
    Info,
    /// Query with a [`ClockRequest`](crate::ClockRequest), answered with a [`ClockReply`](crate::ClockReply).
    Clock,
    /// [`Command`](crate::Command) about parameter sets.
    CmdParams,
    /// [`Command`](crate::Command) that gives an initial pose.
    CmdPose,
    /// [`Command`](crate::Command) about global relocalization.
    CmdRelocalize,
    /// [`Command`](crate::Command) about telemetry rates.
    CmdRates,
    /// [`Command`](crate::Command) that turns automatic switching on or off.
    CmdAuto,
    /// [`Shadow`](crate::Shadow), newest wins.
    Shadow,
    /// [`LinkReport`](crate::LinkReport), put by the pit wall.
    Link,
    /// Query with a [`MissingRequest`](crate::MissingRequest), answered with a [`MissingReply`](crate::MissingReply).
    Missing,
    /// Query with a [`FilesRequest`](crate::FilesRequest), answered with a [`FilesReply`](crate::FilesReply).
    Files,
    /// [`Command`](crate::Command) about the recording on the car.
    CmdRecord,
}

impl Topic {
    /// The key table.
    const TABLE: [(Self, &'static str); 26] = [
        (Self::Alive, "alive"),
        (Self::Pose, "pose"),
        (Self::Cloud, "cloud"),
        (Self::Scan, "scan"),
        (Self::Health, "health"),
        (Self::Load, "load"),
        (Self::Params, "params"),
        (Self::Event, "event"),
        (Self::RecordedPose, "recorded/pose"),
        (Self::RecordedHealth, "recorded/health"),
        (Self::RecordedOdometry, "recorded/odometry"),
        (Self::RecordedScan, "recorded/scan"),
        (Self::RecordedTruth, "recorded/truth"),
        (Self::Map, "map"),
        (Self::Info, "info"),
        (Self::Clock, "clock"),
        (Self::CmdParams, "cmd/params"),
        (Self::CmdPose, "cmd/pose"),
        (Self::CmdRelocalize, "cmd/relocalize"),
        (Self::CmdRates, "cmd/rates"),
        (Self::CmdAuto, "cmd/auto"),
        (Self::Shadow, "shadow"),
        (Self::Link, "link"),
        (Self::Missing, "missing"),
        (Self::Files, "files"),
        (Self::CmdRecord, "cmd/record"),
    ];

    /// Every topic.
    pub fn all() -> impl Iterator<Item = Self> {
        Self::TABLE.into_iter().map(|(topic, _)| topic)
    }

    /// The last part of the key.
    pub fn as_str(self) -> &'static str {
        Self::TABLE
            .into_iter()
            .find_map(|(topic, name)| (topic == self).then_some(name))
            .expect("every topic is in the table")
    }

    /// The key expression of this topic for all cars.
    pub fn of_all_cars(self) -> String {
        format!("{}/*/{}", Key::PREFIX, self.as_str())
    }

    /// True for the full-rate streams that a recorder takes without gaps.
    pub fn recorded(self) -> bool {
        matches!(
            self,
            Self::RecordedPose
                | Self::RecordedHealth
                | Self::RecordedOdometry
                | Self::RecordedScan
                | Self::RecordedTruth
        )
    }

    /// True for topics whose lost messages the receiver requests again. The sender keeps them for a while.
    pub fn recovered(self) -> bool {
        self.recorded() || matches!(self, Self::Health | Self::Event)
    }
}

impl fmt::Display for Topic {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.as_str())
    }
}

impl FromStr for Topic {
    type Err = KeyError;

    fn from_str(name: &str) -> Result<Self, KeyError> {
        Self::TABLE
            .into_iter()
            .find_map(|(topic, known)| (known == name).then_some(topic))
            .ok_or_else(|| KeyError::Topic(name.to_owned()))
    }
}

/// A car and a topic.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Key {
    /// The car.
    pub car: CarName,
    /// The topic.
    pub topic: Topic,
}

impl Key {
    /// The message encoding of an MCAP channel whose topic is a key and whose messages are as on the wire.
    pub const RECORDED_ENCODING: &str = "synpf-v1";
    /// The first two parts of every key.
    pub const PREFIX: &'static str = "synpf/v1";

    /// The key of a car's topic.
    pub fn new(car: CarName, topic: Topic) -> Self {
        Self { car, topic }
    }

    /// The liveliness token of one run of a car, beside [`Topic::Alive`]. Two of them at once are two senders of one name.
    pub fn run_token(car: &CarName, run_id: u64) -> String {
        format!("{}/{car}/{}/{run_id}", Self::PREFIX, Topic::Alive)
    }

    /// The key expression of the run tokens of all cars.
    pub fn run_tokens_of_all_cars() -> String {
        format!("{}/*", Topic::Alive.of_all_cars())
    }

    /// The car and the run of a run token; None for another key.
    pub fn parse_run_token(key: &str) -> Option<(CarName, u64)> {
        let (alive, run_id) = key.rsplit_once('/')?;
        let key: Self = alive.parse().ok()?;
        (key.topic == Topic::Alive).then_some((key.car, run_id.parse().ok()?))
    }
}

impl fmt::Display for Key {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}/{}", Self::PREFIX, self.car, self.topic)
    }
}

impl FromStr for Key {
    type Err = KeyError;

    fn from_str(key: &str) -> Result<Self, KeyError> {
        let (car, topic) = key
            .strip_prefix(Self::PREFIX)
            .and_then(|rest| rest.strip_prefix('/'))
            .and_then(|rest| rest.split_once('/'))
            .ok_or_else(|| KeyError::Key(key.to_owned()))?;
        Ok(Self::new(car.parse()?, topic.parse()?))
    }
}

/// A key that does not belong to this protocol.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum KeyError {
    /// Not of the form `synpf/v1/<car>/<topic>`.
    #[error("key {0:?} is not {prefix}/<car>/<topic>", prefix = Key::PREFIX)]
    Key(String),
    /// A car's name with other characters than `[a-z0-9-]`, empty or too long.
    #[error("car name {0:?} is not 1 to {max} characters of a-z, 0-9 and -", max = CarName::MAX_LEN)]
    CarName(String),
    /// A topic that is not in the table.
    #[error("unknown topic {0:?}")]
    Topic(String),
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn the_table_has_every_topic_once() {
        let mut names: Vec<_> = Topic::all().map(Topic::as_str).collect();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), Topic::TABLE.len());
    }

    #[test]
    fn names_that_would_break_a_key_are_refused() {
        for name in ["", "Car", "car_1", "a/b", "*", "käfer", "a b", &"x".repeat(33)] {
            assert_eq!(CarName::new(name), Err(KeyError::CarName(name.to_owned())));
        }
    }

    proptest! {
        #[test]
        fn parse_undoes_format(name in "[a-z0-9-]{1,32}", topic in proptest::sample::select(Topic::all().collect::<Vec<_>>())) {
            let key = Key::new(CarName::new(name).expect("a good name"), topic);
            prop_assert_eq!(key.to_string().parse::<Key>(), Ok(key));
        }

        #[test]
        fn a_run_token_has_its_car_and_run(name in "[a-z0-9-]{1,32}", run_id: u64) {
            let car = CarName::new(name).expect("a good name");
            let token = Key::run_token(&car, run_id);
            prop_assert_eq!(Key::parse_run_token(&token), Some((car.clone(), run_id)));
            prop_assert_eq!(Key::parse_run_token(&Key::new(car, Topic::Alive).to_string()), None);
        }

        #[test]
        fn no_text_panics(text in ".*") {
            prop_assert_eq!(Key::parse_run_token(&text), None);
            if let Ok(key) = text.parse::<Key>() {
                prop_assert_eq!(key.to_string(), text);
            }
        }
    }
}
