//! The trait of all messages: a schema, a version, a size limit and rules for the values.

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::codec::{CodecError, Payload};

/// A payload that can travel behind a [`Header`](crate::Header).
pub trait Message: Serialize + DeserializeOwned {
    /// The type of the payload.
    const SCHEMA: Schema;
    /// Version of its layout.
    const VERSION: u16 = 1;
    /// Longest payload \[bytes\].
    const MAX_LEN: usize = 64 * 1024;

    /// Converts a payload of an older version to the present one. None for a version that never existed.
    fn older(version: u16, payload: &Payload<'_>) -> Option<Result<Self, CodecError>> {
        let _ = (version, payload);
        None
    }

    /// Checks lengths and ranges. [`encode`](crate::encode) and [`decode`](crate::decode) check that all floats are finite.
    fn validate(&self) -> Result<(), Invalid> {
        Ok(())
    }
}

/// What is wrong with a message's values.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{field}: {fault}")]
pub struct Invalid {
    /// The field.
    pub field: &'static str,
    /// What is wrong with it.
    pub fault: String,
}

impl Invalid {
    pub(crate) fn new(field: &'static str, fault: impl Into<String>) -> Self {
        let fault = fault.into();
        Self { field, fault }
    }

    /// Refuses a list longer than `max`.
    pub(crate) fn unless_at_most(field: &'static str, len: usize, max: usize) -> Result<(), Self> {
        if len <= max {
            Ok(())
        } else {
            Err(Self::new(field, format!("length {len} exceeds {max}")))
        }
    }

    /// Refuses a share outside `[0, 1]`.
    pub(crate) fn unless_share(field: &'static str, share: f32) -> Result<(), Self> {
        if (0.0..=1.0).contains(&share) {
            Ok(())
        } else {
            Err(Self::new(field, format!("{share} is not between 0 and 1")))
        }
    }
}

macro_rules! schemas {
    ($($(#[$doc:meta])* $name:ident = $id:literal,)*) => {
        /// The type of a payload. The numbers are on the wire, so a number is never reused.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
        #[repr(u16)]
        pub enum Schema { $($(#[$doc])* $name = $id,)* }

        impl Schema {
            /// Every schema.
            pub const ALL: &[Self] = &[$(Self::$name,)*];

            /// The schema with this number.
            pub fn from_id(id: u16) -> Option<Self> {
                match id {
                    $($id => Some(Self::$name),)*
                    _ => None,
                }
            }
        }
    };
}

schemas! {
    /// [`Pose`](crate::Pose)
    Pose = 1,
    /// [`Cloud`](crate::Cloud)
    Cloud = 2,
    /// [`ScanView`](crate::ScanView)
    ScanView = 3,
    /// [`Health`](crate::Health)
    Health = 4,
    /// [`Load`](crate::Load)
    Load = 5,
    /// [`Params`](crate::Params)
    Params = 6,
    /// [`Event`](crate::Event)
    Event = 7,
    /// [`RecordedOdometry`](crate::RecordedOdometry)
    RecordedOdometry = 8,
    /// [`RecordedScan`](crate::RecordedScan)
    RecordedScan = 9,
    /// [`Truth`](crate::Truth)
    Truth = 10,
    /// [`MapReply`](crate::MapReply)
    MapReply = 11,
    /// [`CarInfo`](crate::CarInfo)
    CarInfo = 12,
    /// [`ClockRequest`](crate::ClockRequest)
    ClockRequest = 13,
    /// [`ClockReply`](crate::ClockReply)
    ClockReply = 14,
    /// [`Command`](crate::Command)
    Command = 15,
    /// [`Answer`](crate::Answer)
    Answer = 16,
    /// [`Shadow`](crate::Shadow)
    Shadow = 17,
    /// [`LinkReport`](crate::LinkReport)
    LinkReport = 18,
    /// [`MissingRequest`](crate::MissingRequest)
    MissingRequest = 19,
    /// [`MissingReply`](crate::MissingReply)
    MissingReply = 20,
    /// [`FilesRequest`](crate::FilesRequest)
    FilesRequest = 21,
    /// [`FilesReply`](crate::FilesReply)
    FilesReply = 22,
}
