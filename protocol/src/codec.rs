//! Messages to bytes and back. The only file that names the serializer.
//!
//! Payloads are bincode 2 with fixed-size little-endian integers: a list's length is a `u64`, an enum's variant a
//! `u32`, and a number takes what its type takes. bincode has no maintainer any more; swapping it means this file
//! and new golden bytes.

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

/// Reads a message: the whole of `bytes`, every value checked.
pub fn decode<M: Message>(bytes: &[u8]) -> Result<(Header, M), CodecError> {
    let header = Header::read(bytes)?;
    if header.schema != M::SCHEMA {
        return Err(CodecError::Schema {
            got: header.schema,
            expected: M::SCHEMA,
        });
    }
    if header.version != M::VERSION {
        return Err(CodecError::Version {
            schema: M::SCHEMA,
            got: header.version,
            known: M::VERSION,
        });
    }
    let payload = &bytes[Header::LEN..];
    fits::<M>(payload.len())?;
    let (message, consumed) = bincode::serde::decode_from_slice::<M, _>(payload, CONFIG)
        .map_err(|e| CodecError::Payload(e.to_string()))?;
    if consumed != payload.len() {
        return Err(CodecError::Trailing {
            consumed,
            len: payload.len(),
        });
    }
    check(&message)?;
    Ok((header, message))
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
