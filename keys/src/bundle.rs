//! The keys of one host, in one file.

use std::fmt;
use std::path::Path;

use protocol::CarName;
use rustls_pki_types::pem::PemObject;
use rustls_pki_types::{CertificateDer, PrivatePkcs8KeyDer};
use serde::{Deserialize, Serialize};

use crate::error::KeyError;
use crate::identity::{Identity, Member, Role};
use crate::private_file::{read_text, write_private};
use crate::token::OperatorToken;

/// Longest file: a thousand members fit.
const LONGEST: u64 = 1_000_000;

/// What a host needs to take part: its certificate and key, the authority's certificate, and who else is in force.
#[derive(Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Bundle {
    /// Version of this format.
    pub(crate) format: u32,
    /// What the host may do.
    pub role: Role,
    /// Its name.
    pub name: CarName,
    /// The authority's certificate (PEM).
    pub authority: String,
    /// The host's certificate (PEM).
    pub certificate: String,
    /// The host's private key (PEM, PKCS 8).
    pub(crate) key: String,
    /// The certificates in force.
    pub members: Vec<Member>,
    /// Operators who log in to the page with a token of their own; only for a pit wall.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub operators: Vec<OperatorToken>,
}

impl Bundle {
    /// The format that is written.
    pub(crate) const FORMAT: u32 = 1;

    /// Reads and checks a file.
    pub fn read(file: &Path) -> Result<Self, KeyError> {
        let text = read_text(file, LONGEST)?;
        let bundle: Self = serde_json::from_str(&text).map_err(|error| {
            KeyError::format(file, format!("these are no keys of `pitwall keys`: {error}"))
        })?;
        if bundle.format != Self::FORMAT {
            let fault = format!("format {}; this program reads {}", bundle.format, Self::FORMAT);
            return Err(KeyError::format(file, fault));
        }
        bundle.identity().map_err(|fault| KeyError::format(file, fault))?;
        for (pem, name) in [
            (&bundle.authority, "authority"),
            (&bundle.certificate, "certificate"),
        ] {
            CertificateDer::from_pem_slice(pem.as_bytes())
                .map_err(|error| KeyError::format(file, format!("{name}: {error}")))?;
        }
        bundle
            .private_key()
            .map_err(|fault| KeyError::format(file, fault))?;
        Ok(bundle)
    }

    /// Writes the file so that only its owner can read it.
    pub fn write(&self, file: &Path) -> Result<(), KeyError> {
        let text = serde_json::to_string_pretty(self).map_err(|error| KeyError::format(file, error))?;
        write_private(file, &(text + "\n"))
    }

    /// Why a host with a certificate of this common name is not heard: it was revoked or replaced. None when it is in force.
    pub fn revoked(&self, common_name: &str) -> Option<String> {
        if self
            .members
            .iter()
            .any(|member| member.common_name == common_name)
        {
            return None;
        }
        let Ok(Identity { role, name, .. }) = common_name.parse() else {
            return Some("a host is connected with a certificate that names no role: it is not heard".into());
        };
        Some(format!(
            "{role} {name} is connected with keys that were revoked or replaced: it is not heard"
        ))
    }

    /// Refuses the keys of another role, or of another car.
    pub fn for_role(self, role: Role, car: Option<&CarName>) -> Result<Self, KeyError> {
        let fits = self.role == role && car.is_none_or(|car| *car == self.name);
        if fits {
            return Ok(self);
        }
        Err(KeyError::WrongRole {
            got: format!("{} {}", self.role, self.name),
            wanted: match car {
                Some(car) => format!("{role} {car}"),
                None => format!("a {role}"),
            },
        })
    }

    /// Who the certificate belongs to.
    pub fn identity(&self) -> Result<Identity, String> {
        common_name(&self.certificate_der()?)
    }

    /// Days until the certificate expires; negative when it has. None when the host itself is not in force any more.
    pub fn days_left(&self, now: i64) -> Option<i64> {
        let own = self.identity().ok()?.to_string();
        let member = self.members.iter().find(|member| member.common_name == own)?;
        Some((member.expires - now).div_euclid(86_400))
    }

    /// The certificates of a role that are in force.
    pub fn common_names(&self, role: Role) -> impl Iterator<Item = &str> {
        self.members
            .iter()
            .filter(move |member| member.role == role)
            .map(|member| member.common_name.as_str())
    }

    /// The host's certificate.
    pub fn certificate_der(&self) -> Result<CertificateDer<'static>, String> {
        CertificateDer::from_pem_slice(self.certificate.as_bytes())
            .map_err(|error| format!("certificate: {error}"))
    }

    /// The authority's certificate.
    pub fn authority_der(&self) -> Result<CertificateDer<'static>, String> {
        CertificateDer::from_pem_slice(self.authority.as_bytes())
            .map_err(|error| format!("authority: {error}"))
    }

    /// The private key.
    pub fn private_key(&self) -> Result<PrivatePkcs8KeyDer<'static>, String> {
        PrivatePkcs8KeyDer::from_pem_slice(self.key.as_bytes()).map_err(|error| format!("key: {error}"))
    }
}

/// The private key is never printed.
impl fmt::Debug for Bundle {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Bundle")
            .field("role", &self.role)
            .field("name", &self.name)
            .field("members", &self.members.len())
            .finish_non_exhaustive()
    }
}

/// Reads the common name of a certificate.
pub(crate) fn common_name(certificate: &[u8]) -> Result<Identity, String> {
    let (_, certificate) =
        x509_parser::parse_x509_certificate(certificate).map_err(|error| format!("certificate: {error}"))?;
    let name = certificate
        .subject()
        .iter_common_name()
        .next()
        .and_then(|name| name.as_str().ok())
        .ok_or("the certificate has no common name")?;
    name.parse()
        .map_err(|()| format!("the certificate's name {name:?} is not role/name/number"))
}
