//! Messages to bytes and back. No other file names the serializer.
//!
//! Payloads are bincode 2 with fixed-size little-endian integers: a list's length is a `u64`, an enum's variant a
//! `u32`, and a number takes what its type takes. bincode is no longer maintained; replacing it
//! changes this file and the golden bytes.

use serde::de::DeserializeOwned;

use bincode::config::{Configuration, Fixint, Limit, LittleEndian};

use crate::{Header, HeaderError, Invalid, Message, Stamps, finite};

/// No message is longer than this \[bytes\].
const LIMIT: usize = 16 * 1024 * 1024;

const CONFIG: Configuration<LittleEndian, Fixint, Limit<LIMIT>> = bincode::config::standard()
    .with_little_endian()
    .with_fixed_int_encoding()
    .with_limit::<LIMIT>();

/// Checks a message and writes its header and payload.
pub fn encode<M: Message>(message: &M, stamps: Stamps) -> Result<Vec<u8>, CodecError> {
    check(message)?;
    let mut bytes = Header::new(M::SCHEMA, M::VERSION, stamps).to_bytes().to_vec();
    bincode::serde::encode_into_std_write(message, &mut bytes, CONFIG)
        .map_err(|e| CodecError::Payload(e.to_string()))?;
    fits::<M>(bytes.len() - Header::LEN)?;
    Ok(bytes)
}

/// Reads a message and checks every value. All of `bytes` must belong to it. A message of an older version is converted
/// to the present one; the header keeps the older version's number.
pub fn decode<M: Message>(bytes: &[u8]) -> Result<(Header, M), CodecError> {
    let header = Header::read(bytes)?;
    if header.schema != M::SCHEMA {
        return Err(CodecError::Schema {
            got: header.schema,
            expected: M::SCHEMA,
        });
    }
    let payload = Payload(&bytes[Header::LEN..]);
    fits::<M>(payload.0.len())?;
    let message = if header.version == M::VERSION {
        payload.read::<M>()?
    } else {
        M::older(header.version, &payload).ok_or(CodecError::Version {
            schema: M::SCHEMA,
            got: header.version,
            known: M::VERSION,
        })??
    };
    check(&message)?;
    Ok((header, message))
}

/// The bytes behind a header.
#[derive(Debug, Clone, Copy)]
pub struct Payload<'a>(&'a [u8]);

impl Payload<'_> {
    /// Reads all of it as a `T`.
    pub fn read<T: DeserializeOwned>(&self) -> Result<T, CodecError> {
        let (value, consumed) = bincode::serde::decode_from_slice::<T, _>(self.0, CONFIG)
            .map_err(|e| CodecError::Payload(e.to_string()))?;
        if consumed == self.0.len() {
            Ok(value)
        } else {
            Err(CodecError::Trailing {
                consumed,
                len: self.0.len(),
            })
        }
    }

    /// The variant's number in a payload that begins with an enum.
    pub fn variant(&self) -> Option<u32> {
        self.0.first_chunk().map(|tag| u32::from_le_bytes(*tag))
    }
}

fn fits<M: Message>(len: usize) -> Result<(), CodecError> {
    let max = M::MAX_LEN.min(LIMIT);
    if len <= max {
        Ok(())
    } else {
        Err(CodecError::TooLong { len, max })
    }
}

fn check<M: Message>(message: &M) -> Result<(), CodecError> {
    finite::check(message)?;
    message.validate()?;
    Ok(())
}

/// Why bytes are not a message, or a message cannot be sent.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CodecError {
    /// The header is missing or belongs to another protocol.
    #[error(transparent)]
    Header(#[from] HeaderError),
    /// A message of another type than expected.
    #[error("the message is a {got:?}, not a {expected:?}")]
    Schema {
        /// The type in its header.
        got: crate::Schema,
        /// The type expected.
        expected: crate::Schema,
    },
    /// A version that this program does not know.
    #[error("{schema:?} has version {got}, this program reads version {known}: update the older side")]
    Version {
        /// The message.
        schema: crate::Schema,
        /// Its version.
        got: u16,
        /// The version that this program knows.
        known: u16,
    },
    /// Longer than this message may be.
    #[error("a payload of {len} bytes exceeds {max}")]
    TooLong {
        /// Length \[bytes\].
        len: usize,
        /// Limit \[bytes\].
        max: usize,
    },
    /// The payload is cut off or malformed.
    #[error("malformed payload: {0}")]
    Payload(String),
    /// Bytes are left over.
    #[error("the payload ends after {consumed} of {len} bytes")]
    Trailing {
        /// Bytes that the message took.
        consumed: usize,
        /// Bytes of the payload.
        len: usize,
    },
    /// A value outside its rules.
    #[error("invalid value: {0}")]
    Invalid(#[from] Invalid),
}
