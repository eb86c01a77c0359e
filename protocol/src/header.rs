//! The header: 40 bytes in front of every payload, readable without knowing the payload.
//!
//! ```text
//! offset  0        4         6          8          16          24             32                40
//!         | "SYPF" | schema  | version  | run id   | sequence  | sensor time  | publish time    |
//!         | 4      | u16     | u16      | u64      | u64       | i64 unix ns  | i64 unix ns     |
//! ```
//! All numbers are little-endian.

use serde::{Deserialize, Serialize};

use crate::Schema;

/// What a sender adds to the content of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Stamps {
    /// Identifies a run: the life of one sending process. Sequence numbers start again at 1 with each run. A car chooses the
    /// unix time of its start \[ns\], or one more than its last run's where its clock is behind. Receivers compare it for
    /// equality only: a higher number is no proof of a later run.
    pub run_id: u64,
    /// Number of the message within the run and its key, from 1. It is 0 for queries and commands, which are not counted.
    pub sequence: u64,
    /// The time that the content describes: the sensor's stamp \[unix ns\].
    pub sensor: i64,
    /// When the message was handed to the network \[unix ns\].
    pub published: i64,
}

/// A message's header.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Header {
    /// What the payload is.
    pub schema: Schema,
    /// Version of the payload's layout.
    pub version: u16,
    /// See [`Stamps::run_id`]. JSON of older recordings calls it `session`.
    #[serde(alias = "session")]
    pub run_id: u64,
    /// See [`Stamps::sequence`].
    pub sequence: u64,
    /// See [`Stamps::sensor`].
    pub sensor: i64,
    /// See [`Stamps::published`].
    pub published: i64,
}

impl Header {
    /// Bytes that a header takes.
    pub const LEN: usize = 40;
    /// The first bytes of every message.
    pub const MAGIC: [u8; 4] = *b"SYPF";
    /// Largest sequence number: a message every microsecond for a hundred thousand years.
    pub const MAX_SEQUENCE: u64 = 1 << 62;

    /// A header for a message of `schema`.
    pub fn new(schema: Schema, version: u16, stamps: Stamps) -> Self {
        let Stamps {
            run_id,
            sequence,
            sensor,
            published,
        } = stamps;
        Self {
            schema,
            version,
            run_id,
            sequence,
            sensor,
            published,
        }
    }

    /// The header's bytes.
    pub fn to_bytes(self) -> [u8; Self::LEN] {
        let mut bytes = [0; Self::LEN];
        bytes[0..4].copy_from_slice(&Self::MAGIC);
        bytes[4..6].copy_from_slice(&(self.schema as u16).to_le_bytes());
        bytes[6..8].copy_from_slice(&self.version.to_le_bytes());
        bytes[8..16].copy_from_slice(&self.run_id.to_le_bytes());
        bytes[16..24].copy_from_slice(&self.sequence.to_le_bytes());
        bytes[24..32].copy_from_slice(&self.sensor.to_le_bytes());
        bytes[32..40].copy_from_slice(&self.published.to_le_bytes());
        bytes
    }

    /// Reads the header at the front of `message`.
    pub fn read(message: &[u8]) -> Result<Self, HeaderError> {
        let bytes: &[u8; Self::LEN] = message
            .first_chunk()
            .ok_or(HeaderError::Truncated { got: message.len() })?;
        let field = |at: usize| -> [u8; 8] { bytes[at..at + 8].try_into().expect("eight bytes") };
        if bytes[0..4] != Self::MAGIC {
            return Err(HeaderError::Magic);
        }
        let schema = u16::from_le_bytes([bytes[4], bytes[5]]);
        Ok(Self {
            schema: Schema::from_id(schema).ok_or(HeaderError::Schema(schema))?,
            version: u16::from_le_bytes([bytes[6], bytes[7]]),
            run_id: u64::from_le_bytes(field(8)),
            sequence: u64::from_le_bytes(field(16)),
            sensor: i64::from_le_bytes(field(24)),
            published: i64::from_le_bytes(field(32)),
        })
    }
}

/// Bytes that do not start with a header of this protocol.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum HeaderError {
    /// Too short to hold a header.
    #[error("{got} bytes are too few for a header of {}", Header::LEN)]
    Truncated {
        /// Bytes at hand.
        got: usize,
    },
    /// Not a message of this protocol.
    #[error("the message does not start with SYPF")]
    Magic,
    /// A message that this version does not know.
    #[error("unknown schema {0}")]
    Schema(u16),
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn read_undoes_to_bytes(
            schema in proptest::sample::select(Schema::ALL.to_vec()),
            version: u16, run_id: u64, sequence: u64, sensor: i64, published: i64,
        ) {
            let header = Header { schema, version, run_id, sequence, sensor, published };
            prop_assert_eq!(Header::read(&header.to_bytes()), Ok(header));
        }

        #[test]
        fn no_bytes_panic(bytes: Vec<u8>) {
            prop_assert!(Header::read(&bytes).is_err() || bytes.starts_with(&Header::MAGIC));
        }
    }
}
