//! Who may do what on the network: keys of cars, pit walls and viewers.
//!
//! ```text
//! Authority --issues--> Bundle (one file per host) --> Settings of the zenoh session: mutual TLS, access rules
//!                                                 '--> Signer (pit wall) and Verifier (car) of commands
//! Passphrase ----------------------------------------> the same with one shared secret, without encryption
//! ```
//!
//! A car writes under its own name only, a pit wall commands, a viewer reads. The pit wall's router enforces that by the common
//! names of the certificates. A car checks the signature of every command as well, so that a router between the two cannot
//! command it.
//!
//! The crate knows no socket. It hands the settings on as text; the programs give them to zenoh.
//!
//! # Example
//!
//! ```
//! use keys::{Authority, Role, Signer, Verifier};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let mut authority = Authority::create(365)?;
//! authority.issue(Role::Pit, "laptop".parse()?, &[])?;
//! authority.issue(Role::Car, "car-1".parse()?, &[])?;
//! let laptop = authority.bundle(Role::Pit, &"laptop".parse()?)?;
//! let car = authority.bundle(Role::Car, &"car-1".parse()?)?;
//!
//! let signature = Signer::new(&laptop)?.sign("synpf/v1/car-1/cmd/auto", 7, b"a command")?;
//! let who = Verifier::new(&car)?.check(Some(&signature), "synpf/v1/car-1/cmd/auto", 7, b"a command")?;
//! assert_eq!(who, "laptop");
//! # Ok(())
//! # }
//! ```

mod access;
mod authority;
mod bundle;
mod error;
mod forgeries;
mod identity;
mod passphrase;
mod private_file;
mod protection;
pub mod refusals;
mod signature;
mod token;

pub use access::Side;
pub use authority::{Authority, Issued};
pub use bundle::Bundle;
pub use error::KeyError;
pub use identity::{Identity, Member, Role};
pub use passphrase::Passphrase;
pub use private_file::{open_to_others, write_private};
pub use protection::{Protection, Settings};
pub use signature::{Refusal, Signer, Verifier};
pub use token::{OperatorToken, Token, equal_in_constant_time};
