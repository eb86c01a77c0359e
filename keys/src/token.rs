//! Tokens for the page: random, kept as hashes, compared in constant time.

use std::fmt;

use protocol::CarName;
use ring::digest::{SHA256, digest};
use ring::rand::{SecureRandom, SystemRandom};
use serde::{Deserialize, Serialize};

/// A random token of 128 bits.
#[derive(Clone, PartialEq, Eq)]
pub struct Token(String);

impl Token {
    /// A new token. None when the system has no random numbers.
    pub fn new() -> Option<Self> {
        let mut bytes = [0; 16];
        SystemRandom::new().fill(&mut bytes).ok()?;
        Some(Self(hexadecimal(&bytes)))
    }

    /// The text to show to its owner, once.
    pub fn reveal(&self) -> &str {
        &self.0
    }
}

/// It is never printed by accident.
impl fmt::Debug for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Token(..)")
    }
}

/// An operator and the hash of their token.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OperatorToken {
    /// The operator.
    pub name: CarName,
    /// SHA-256 of the token, in hexadecimal.
    sha256: String,
}

impl OperatorToken {
    /// An operator with a token.
    pub fn new(name: CarName, token: &str) -> Self {
        Self {
            name,
            sha256: hash(token),
        }
    }

    /// True when it is this operator's token.
    pub fn matches(&self, token: &str) -> bool {
        equal_in_constant_time(&hash(token), &self.sha256)
    }
}

/// Compares two texts in a time that does not depend on where they differ.
pub fn equal_in_constant_time(a: &str, b: &str) -> bool {
    // Hashes have one length, and whoever guesses cannot choose them.
    let (a, b) = (digest(&SHA256, a.as_bytes()), digest(&SHA256, b.as_bytes()));
    let difference = a
        .as_ref()
        .iter()
        .zip(b.as_ref())
        .fold(0, |all, (a, b)| all | (a ^ b));
    std::hint::black_box(difference) == 0
}

fn hash(token: &str) -> String {
    hexadecimal(digest(&SHA256, token.as_bytes()).as_ref())
}

pub(crate) fn hexadecimal(bytes: &[u8]) -> String {
    use std::fmt::Write;
    bytes.iter().fold(String::new(), |mut text, byte| {
        write!(text, "{byte:02x}").expect("a string takes everything");
        text
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tokens_differ_and_match_only_themselves() {
        let (one, other) = (Token::new().expect("random"), Token::new().expect("random"));
        assert_ne!(one, other);
        let operator = OperatorToken::new("ana".parse().expect("a name"), one.reveal());
        assert!(operator.matches(one.reveal()));
        assert!(!operator.matches(other.reveal()));
        assert!(!operator.matches(""));
        assert!(!format!("{one:?}{operator:?}").contains(one.reveal()));
    }
}
