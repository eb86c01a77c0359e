//! The certificate authority of a team: issues, renews and revokes.

use std::fmt;
use std::path::Path;

use protocol::CarName;
use rcgen::{
    BasicConstraints, CertificateParams, DistinguishedName, DnType, ExtendedKeyUsagePurpose, IsCa, Issuer,
    KeyPair, KeyUsagePurpose, PKCS_ECDSA_P256_SHA256, date_time_ymd,
};
use ring::rand::{SecureRandom, SystemRandom};
use serde::{Deserialize, Serialize};
use time::{Duration, OffsetDateTime};

use crate::bundle::Bundle;
use crate::error::KeyError;
use crate::identity::{Identity, Member, Role};
use crate::private_file::{read_text, write_private};
use crate::token::{OperatorToken, Token};

/// Longest file: a thousand certificates fit.
const LONGEST: u64 = 10_000_000;

/// Validity of the authority's own certificate.
const OWN_DAYS: i64 = 3650;

/// The authority: its key, and every certificate that it has issued.
#[derive(Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Authority {
    format: u32,
    certificate: String,
    key: String,
    /// Validity of the certificates that are issued \[days\].
    pub days: u32,
    issued: Vec<Issued>,
    #[serde(default)]
    operators: Vec<OperatorToken>,
}

/// A certificate that was issued.
#[derive(Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Issued {
    /// Who has it.
    #[serde(flatten)]
    pub member: Member,
    /// Names and addresses under which a browser reaches the page.
    pub hosts: Vec<String>,
    /// True when it is not in force any more.
    pub revoked: bool,
    certificate: String,
    key: String,
}

impl Authority {
    const FORMAT: u32 = 1;
    /// The authority's own file has this name.
    const RESERVED: &str = "authority";

    /// A new authority whose certificates are valid for `days`.
    pub fn create(days: u32) -> Result<Self, KeyError> {
        let fail = failure("the authority");
        let key = KeyPair::generate_for(&PKCS_ECDSA_P256_SHA256).map_err(&fail)?;
        let mut parameters = own_parameters();
        parameters.not_after = now() + Duration::days(OWN_DAYS);
        let certificate = parameters.self_signed(&key).map_err(&fail)?;
        Ok(Self {
            format: Self::FORMAT,
            certificate: certificate.pem(),
            key: key.serialize_pem(),
            days,
            issued: Vec::new(),
            operators: Vec::new(),
        })
    }

    /// Reads an authority's file.
    pub fn read(file: &Path) -> Result<Self, KeyError> {
        let text = read_text(file, LONGEST)?;
        let authority: Self = serde_json::from_str(&text).map_err(|error| {
            KeyError::format(file, format!("this is no authority of `pitwall keys`: {error}"))
        })?;
        if authority.format != Self::FORMAT {
            let fault = format!("format {}; this program reads {}", authority.format, Self::FORMAT);
            return Err(KeyError::format(file, fault));
        }
        Ok(authority)
    }

    /// Writes the file so that only its owner can read it.
    pub fn write(&self, file: &Path) -> Result<(), KeyError> {
        let text = serde_json::to_string_pretty(self).map_err(|error| KeyError::format(file, error))?;
        write_private(file, &(text + "\n"))
    }

    /// The authority's certificate (PEM), for browsers.
    pub fn certificate(&self) -> &str {
        &self.certificate
    }

    /// Every certificate that was issued, in order.
    pub fn issued(&self) -> &[Issued] {
        &self.issued
    }

    /// The operators with a token of their own.
    pub fn operators(&self) -> impl Iterator<Item = &CarName> {
        self.operators.iter().map(|operator| &operator.name)
    }

    /// Issues a certificate. `hosts` are names and addresses of the machine, for the page.
    pub fn issue(&mut self, role: Role, name: CarName, hosts: &[String]) -> Result<(), KeyError> {
        // Files are called by the name, whatever the role.
        if let Some(member) = self.members().find(|member| member.name == name) {
            return Err(KeyError::Exists(format!("{} {name}", member.role)));
        }
        if name.as_str() == Self::RESERVED {
            return Err(KeyError::Exists(format!("the {name}")));
        }
        self.issue_until(
            role,
            name,
            hosts.to_vec(),
            now() + Duration::days(self.days.into()),
        )
    }

    /// Issues a certificate that expires at `expires`.
    pub fn issue_until(
        &mut self,
        role: Role,
        name: CarName,
        hosts: Vec<String>,
        expires: OffsetDateTime,
    ) -> Result<(), KeyError> {
        let subject = format!("{role} {name}");
        let fail = failure(&subject);
        let mut number = [0; 8];
        SystemRandom::new()
            .fill(&mut number)
            .map_err(|_| fail_with(&subject, "the system has no random numbers"))?;
        let identity = Identity {
            role,
            name: name.clone(),
            number: u64::from_be_bytes(number),
        };
        let authority = KeyPair::from_pem(&self.key).map_err(&fail)?;
        let key = KeyPair::generate_for(&PKCS_ECDSA_P256_SHA256).map_err(&fail)?;
        let mut parameters = CertificateParams::new(hosts.clone()).map_err(&fail)?;
        parameters.distinguished_name = DistinguishedName::new();
        parameters
            .distinguished_name
            .push(DnType::CommonName, identity.to_string());
        // A car without a clock of its own starts in the past.
        parameters.not_before = date_time_ymd(2000, 1, 1);
        parameters.not_after = expires;
        parameters.key_usages = vec![KeyUsagePurpose::DigitalSignature];
        parameters.extended_key_usages = vec![ExtendedKeyUsagePurpose::ClientAuth];
        if matches!(role, Role::Pit | Role::Router) {
            // Only a pit wall or a router may accept connections: nobody else can pretend to be one.
            parameters
                .extended_key_usages
                .push(ExtendedKeyUsagePurpose::ServerAuth);
        }
        let certificate = parameters
            .signed_by(&key, &Issuer::new(own_parameters(), authority))
            .map_err(&fail)?;
        self.issued.push(Issued {
            member: Member {
                role,
                name,
                common_name: identity.to_string(),
                expires: expires.unix_timestamp(),
            },
            hosts,
            revoked: false,
            certificate: certificate.pem(),
            key: key.serialize_pem(),
        });
        Ok(())
    }

    /// Puts the certificate of a host out of force.
    pub fn revoke(&mut self, role: Role, name: &CarName) -> Result<(), KeyError> {
        let unknown = || KeyError::Unknown(format!("{role} {name}"));
        self.in_force(role, name).ok_or_else(unknown)?.revoked = true;
        Ok(())
    }

    /// Replaces the certificate and the key of a host.
    pub fn renew(&mut self, role: Role, name: &CarName) -> Result<(), KeyError> {
        let unknown = || KeyError::Unknown(format!("{role} {name}"));
        let hosts = self.in_force(role, name).ok_or_else(unknown)?.hosts.clone();
        self.revoke(role, name)?;
        self.issue(role, name.clone(), &hosts)
    }

    /// Gives an operator a new token for the page; an earlier one is void.
    pub fn issue_token(&mut self, operator: CarName) -> Result<Token, KeyError> {
        let token =
            Token::new().ok_or_else(|| fail_with(operator.as_str(), "the system has no random numbers"))?;
        self.operators.retain(|known| known.name != operator);
        self.operators.push(OperatorToken::new(operator, token.reveal()));
        Ok(token)
    }

    /// Voids the token of an operator.
    pub fn revoke_token(&mut self, operator: &CarName) -> Result<(), KeyError> {
        let before = self.operators.len();
        self.operators.retain(|known| known.name != *operator);
        if self.operators.len() == before {
            return Err(KeyError::Unknown(format!("operator {operator}")));
        }
        Ok(())
    }

    /// The file of a host, with what is in force now.
    pub fn bundle(&self, role: Role, name: &CarName) -> Result<Bundle, KeyError> {
        let issued = self
            .issued
            .iter()
            .rfind(|issued| !issued.revoked && issued.member.role == role && issued.member.name == *name)
            .ok_or_else(|| KeyError::Unknown(format!("{role} {name}")))?;
        Ok(Bundle {
            format: Bundle::FORMAT,
            role,
            name: name.clone(),
            authority: self.certificate.clone(),
            certificate: issued.certificate.clone(),
            key: issued.key.clone(),
            members: self.members().cloned().collect(),
            operators: if role == Role::Pit {
                self.operators.clone()
            } else {
                Vec::new()
            },
        })
    }

    /// The certificates in force.
    pub fn members(&self) -> impl Iterator<Item = &Member> {
        self.issued
            .iter()
            .filter(|issued| !issued.revoked)
            .map(|issued| &issued.member)
    }

    fn in_force(&mut self, role: Role, name: &CarName) -> Option<&mut Issued> {
        self.issued
            .iter_mut()
            .find(|issued| !issued.revoked && issued.member.role == role && issued.member.name == *name)
    }
}

/// Private keys are never printed.
impl fmt::Debug for Authority {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Authority")
            .field("issued", &self.issued)
            .finish_non_exhaustive()
    }
}

impl fmt::Debug for Issued {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Issued")
            .field("member", &self.member)
            .field("revoked", &self.revoked)
            .finish_non_exhaustive()
    }
}

/// The authority's own certificate, whose name is the issuer of all others.
fn own_parameters() -> CertificateParams {
    let mut parameters = CertificateParams::default();
    parameters.distinguished_name = DistinguishedName::new();
    parameters
        .distinguished_name
        .push(DnType::CommonName, "pit wall authority");
    parameters.not_before = date_time_ymd(2000, 1, 1);
    parameters.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
    parameters.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
    parameters
}

fn now() -> OffsetDateTime {
    OffsetDateTime::now_utc()
}

fn failure(subject: &str) -> impl Fn(rcgen::Error) -> KeyError {
    let subject = subject.to_owned();
    move |error| fail_with(&subject, &error.to_string())
}

fn fail_with(subject: &str, reason: &str) -> KeyError {
    KeyError::Certificate {
        subject: subject.to_owned(),
        reason: reason.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn name(text: &str) -> CarName {
        text.parse().expect("a name")
    }

    #[test]
    fn a_renewed_certificate_is_another_and_the_old_one_is_out_of_force() {
        let mut authority = Authority::create(30).expect("an authority");
        authority.issue(Role::Car, name("car-1"), &[]).expect("issued");
        assert!(matches!(
            authority.issue(Role::Car, name("car-1"), &[]),
            Err(KeyError::Exists(_))
        ));
        let old = authority.bundle(Role::Car, &name("car-1")).expect("in force");
        authority.renew(Role::Car, &name("car-1")).expect("renewed");
        let new = authority.bundle(Role::Car, &name("car-1")).expect("in force");
        let (old, new_name) = (old.identity().expect("named"), new.identity().expect("named"));
        assert_ne!(old, new_name);
        assert_eq!(new.members.len(), 1);
        assert_eq!(new.members[0].common_name, new_name.to_string());
        authority.revoke(Role::Car, &name("car-1")).expect("revoked");
        assert!(authority.bundle(Role::Car, &name("car-1")).is_err());
        assert!(authority.revoke(Role::Car, &name("car-1")).is_err());
    }

    #[test]
    fn files_are_private_and_read_back() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut authority = Authority::create(30).expect("an authority");
        authority
            .issue(
                Role::Pit,
                name("laptop"),
                &["192.168.1.10".into(), "pit.local".into()],
            )
            .expect("issued");
        let token = authority.issue_token(name("ana")).expect("a token");
        let file = folder.path().join("authority.keys");
        authority.write(&file).expect("written");
        assert!(!crate::open_to_others(&file));
        let read = Authority::read(&file).expect("read");
        let bundle = read.bundle(Role::Pit, &name("laptop")).expect("in force");
        let file = folder.path().join("laptop.keys");
        bundle.write(&file).expect("written");
        assert!(!crate::open_to_others(&file));
        let bundle = Bundle::read(&file).expect("read");
        assert!(bundle.operators[0].matches(token.reveal()));
        assert_eq!(bundle.days_left(now().unix_timestamp() + 60), Some(29));
        let shown = format!("{authority:?}{bundle:?}");
        assert!(
            !shown.contains("PRIVATE") && !shown.contains(token.reveal()),
            "{shown}"
        );
    }

    #[test]
    fn a_file_of_another_kind_is_named() {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("x.keys");
        std::fs::write(&file, "{}").expect("written");
        let error = Bundle::read(&file).expect_err("no keys").to_string();
        assert!(error.contains("x.keys") && error.contains("no keys"), "{error}");
        assert!(Authority::read(&file).is_err());
    }
}
