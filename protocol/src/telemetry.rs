//! Every message that a car sends about itself, as one type.

use crate::{
    Cloud, CodecError, Event, Header, Health, Load, Params, Pose, RecordedOdometry, RecordedScan, ScanView,
    Shadow, Topic, Truth, decode,
};

/// A message from a car. Its topic decides the variant.
#[derive(Debug, Clone, PartialEq)]
pub enum Telemetry {
    /// On [`Topic::Pose`] and [`Topic::RecordedPose`].
    Pose(Pose),
    /// On [`Topic::Cloud`].
    Cloud(Cloud),
    /// On [`Topic::Scan`].
    Scan(ScanView),
    /// On [`Topic::Health`] and [`Topic::RecordedHealth`].
    Health(Health),
    /// On [`Topic::Load`].
    Load(Load),
    /// On [`Topic::Params`].
    Params(Params),
    /// On [`Topic::Event`].
    Event(Event),
    /// On [`Topic::RecordedOdometry`].
    Odometry(RecordedOdometry),
    /// On [`Topic::RecordedScan`].
    RecordedScan(RecordedScan),
    /// On [`Topic::RecordedTruth`].
    Truth(Truth),
    /// On [`Topic::Shadow`].
    Shadow(Shadow),
}

impl Telemetry {
    /// True for topics that carry telemetry.
    pub fn carried_by(topic: Topic) -> bool {
        Self::decode(topic, &[]).is_some()
    }

    /// Decodes a message that arrived on `topic`. None for topics without telemetry.
    pub fn decode(topic: Topic, bytes: &[u8]) -> Option<Result<(Header, Self), CodecError>> {
        fn with<M: crate::Message>(
            bytes: &[u8],
            wrap: impl FnOnce(M) -> Telemetry,
        ) -> Result<(Header, Telemetry), CodecError> {
            decode(bytes).map(|(header, message)| (header, wrap(message)))
        }
        Some(match topic {
            Topic::Pose | Topic::RecordedPose => with(bytes, Self::Pose),
            Topic::Cloud => with(bytes, Self::Cloud),
            Topic::Scan => with(bytes, Self::Scan),
            Topic::Health | Topic::RecordedHealth => with(bytes, Self::Health),
            Topic::Load => with(bytes, Self::Load),
            Topic::Params => with(bytes, Self::Params),
            Topic::Event => with(bytes, Self::Event),
            Topic::RecordedOdometry => with(bytes, Self::Odometry),
            Topic::RecordedScan => with(bytes, Self::RecordedScan),
            Topic::RecordedTruth => with(bytes, Self::Truth),
            Topic::Shadow => with(bytes, Self::Shadow),
            Topic::Alive
            | Topic::Map
            | Topic::Info
            | Topic::Clock
            | Topic::CmdParams
            | Topic::CmdPose
            | Topic::CmdRelocalize
            | Topic::CmdRates
            | Topic::CmdAuto
            | Topic::Link
            | Topic::Missing
            | Topic::Files
            | Topic::CmdRecord => return None,
        })
    }
}
