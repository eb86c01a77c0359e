//! One secret that all of a team know: for a club day without certificates.

use std::fmt;
use std::num::NonZeroU32;
use std::path::Path;

use ring::{hmac, pbkdf2};

use crate::error::KeyError;
use crate::private_file::read_text;
use crate::token::hexadecimal;

/// Rounds of the derivation: a few hundredths of a second, once at start.
const ROUNDS: NonZeroU32 = NonZeroU32::new(50_000).expect("not zero");

/// A shared secret. Only what is derived from it is kept.
#[derive(Clone)]
pub struct Passphrase {
    password: String,
    signing: hmac::Key,
}

impl Passphrase {
    /// Least length \[characters\].
    pub const SHORTEST: usize = 12;
    /// The user under whose name everybody connects.
    pub(crate) const USER: &str = "team";

    /// Derives what is needed from the words.
    pub fn new(words: &str) -> Result<Self, KeyError> {
        let words = words.trim();
        let got = words.chars().count();
        if got < Self::SHORTEST {
            return Err(KeyError::ShortPassphrase {
                got,
                least: Self::SHORTEST,
            });
        }
        let derive = |purpose: &[u8]| {
            let mut bytes = [0; 32];
            pbkdf2::derive(
                pbkdf2::PBKDF2_HMAC_SHA256,
                ROUNDS,
                purpose,
                words.as_bytes(),
                &mut bytes,
            );
            bytes
        };
        Ok(Self {
            password: hexadecimal(&derive(b"pit wall: connect")),
            signing: hmac::Key::new(hmac::HMAC_SHA256, &derive(b"pit wall: command")),
        })
    }

    /// Reads the first line of a file.
    pub fn read(file: &Path) -> Result<Self, KeyError> {
        let text = read_text(file, 10_000)?;
        Self::new(text.lines().next().unwrap_or_default())
    }

    /// What zenoh takes as password.
    pub(crate) fn password(&self) -> &str {
        &self.password
    }

    pub(crate) fn tag(&self, message: &[u8]) -> Vec<u8> {
        hmac::sign(&self.signing, message).as_ref().to_vec()
    }

    pub(crate) fn verifies(&self, message: &[u8], tag: &[u8]) -> bool {
        hmac::verify(&self.signing, message, tag).is_ok()
    }
}

/// It is never printed.
impl fmt::Debug for Passphrase {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Passphrase(..)")
    }
}
