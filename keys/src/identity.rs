//! Who a certificate belongs to.

use std::fmt;
use std::str::FromStr;

use protocol::CarName;
use serde::{Deserialize, Serialize};

/// What the owner of a certificate may do.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Role {
    /// Publishes under its own name and executes commands.
    Car,
    /// Listens for cars, reads everything and commands.
    Pit,
    /// Reads everything.
    Viewer,
    /// Listens for everybody and passes messages on. It cannot command.
    Router,
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Car => "car",
            Self::Pit => "pit",
            Self::Viewer => "viewer",
            Self::Router => "router",
        })
    }
}

impl FromStr for Role {
    type Err = ();

    fn from_str(text: &str) -> Result<Self, ()> {
        [Self::Car, Self::Pit, Self::Viewer, Self::Router]
            .into_iter()
            .find(|role| role.to_string() == text)
            .ok_or(())
    }
}

/// Role, name and number of a certificate. Its common name is `role/name/number`.
///
/// Each certificate has a number of its own, so that a revoked one and its successor differ.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Identity {
    /// What the owner may do.
    pub role: Role,
    /// The owner's name.
    pub name: CarName,
    /// 64 random bits.
    pub number: u64,
}

impl fmt::Display for Identity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}/{:016x}", self.role, self.name, self.number)
    }
}

impl FromStr for Identity {
    type Err = ();

    fn from_str(common_name: &str) -> Result<Self, ()> {
        let mut parts = common_name.split('/');
        let (Some(role), Some(name), Some(number), None) =
            (parts.next(), parts.next(), parts.next(), parts.next())
        else {
            return Err(());
        };
        if number.len() != 16 {
            return Err(());
        }
        Ok(Self {
            role: role.parse()?,
            name: name.parse().map_err(|_| ())?,
            number: u64::from_str_radix(number, 16).map_err(|_| ())?,
        })
    }
}

/// A certificate in force, as every host knows it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Member {
    /// What the owner may do.
    pub role: Role,
    /// The owner's name.
    pub name: CarName,
    /// Common name of the certificate.
    pub common_name: String,
    /// When the certificate expires \[unix s\].
    pub expires: i64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_common_name_is_read_as_it_is_written() {
        let identity = Identity {
            role: Role::Car,
            name: "car-1".parse().expect("a name"),
            number: 0x1f,
        };
        assert_eq!(identity.to_string(), "car/car-1/000000000000001f");
        assert_eq!(identity.to_string().parse(), Ok(identity));
        for text in [
            "",
            "car/car-1",
            "car/car-1/1f",
            "king/car-1/000000000000001f",
            "car/../000000000000001f",
        ] {
            assert_eq!(text.parse::<Identity>(), Err(()), "{text}");
        }
    }

    #[test]
    fn the_longest_common_name_fits_into_a_certificate() {
        let identity = Identity {
            role: Role::Viewer,
            name: CarName::new("x".repeat(CarName::MAX_LEN)).expect("a name"),
            number: u64::MAX,
        };
        // RFC 5280, ub-common-name.
        assert!(identity.to_string().len() <= 64);
    }
}
