//! Messages to bytes and back. The only file that names the serializer.
//!
//! Payloads are bincode 2 with fixed-size little-endian integers: a list's length is a `u64`, an enum's variant a
//! `u32`, and a number takes what its type takes. bincode has no maintainer any more; swapping it means this file
//! and new golden bytes.

use serde::de::DeserializeOwned;

use bincode::config::{Configuration, Fixint, Limit, LittleEndian};

use crate::{Header, HeaderError, Invalid, Message, Stamps, finite};

/// No message is longer than this [bytes].
const LIMIT: usize = 16 * 1024 * 1024;

const CONFIG: Configuration<LittleEndian, Fixint, Limit<LIMIT>> = bincode::config::standard()
    .with_little_endian()
    .with_fixed_int_encoding()
    .with_limit::<LIMIT>();

/// Checks a message and writes it behind its header.
pub fn encode<M: Message>(message: &M, stamps: Stamps) -> Result<Vec<u8>, CodecError> {
    check(message)?;
    let mut bytes = Header::new(M::SCHEMA, M::VERSION, stamps).to_bytes().to_vec();
    bincode::serde::encode_into_std_write(message, &mut bytes, CONFIG)
        .map_err(|e| CodecError::Payload(e.to_string()))?;
    fits::<M>(bytes.len() - Header::LEN)?;
    Ok(bytes)
}

/// Reads a message: the whole of `bytes`, every value checked. One of an older version comes as the present one; the header
/// says which it was.
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

/// What follows a header.
#[derive(Debug, Clone, Copy)]
pub struct Payload<'a>(&'a [u8]);

impl Payload<'_> {
    /// The whole of it as a `T`.
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

    /// The number of the variant, of a payload that begins with an enum.
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
    /// The header is missing or not ours.
    #[error(transparent)]
    Header(#[from] HeaderError),
    /// Another message than the key promises.
    #[error("the message is a {got:?}, not a {expected:?}")]
    Schema {
        /// What it says it is.
        got: crate::Schema,
        /// What was asked for.
        expected: crate::Schema,
    },
    /// A layout of another version.
    #[error("{schema:?} has version {got}, this program reads version {known}: update the older side")]
    Version {
        /// The message.
        schema: crate::Schema,
        /// Its version.
        got: u16,
        /// Ours.
        known: u16,
    },
    /// Longer than this message may be.
    #[error("a payload of {len} bytes exceeds {max}")]
    TooLong {
        /// Length [bytes].
        len: usize,
        /// Limit [bytes].
        max: usize,
    },
    /// The payload is cut off, or no value of its type.
    #[error("malformed payload: {0}")]
    Payload(String),
    /// Bytes are left over.
    #[error("the payload ends after {consumed} of {len} bytes")]
    Trailing {
        /// Bytes that the message took.
        consumed: usize,
        /// Bytes there are.
        len: usize,
    },
    /// A value that may not be.
    #[error("invalid value: {0}")]
    Invalid(#[from] Invalid),
}
