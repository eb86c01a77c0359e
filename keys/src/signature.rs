//! Signatures of commands. They travel beside the command, as the query's attachment.
//!
//! ```text
//! certificates: 1, length of the certificate (u16, little-endian), certificate (DER), ECDSA P-256 signature (ASN.1)
//! passphrase:   2, HMAC-SHA256
//! ```
//!
//! Signed are the key, the car's run and the command: a command to another car, to another topic, or from before the car's
//! restart does not pass.

use std::fmt;
use std::sync::Arc;
use std::time::SystemTime;

use ring::rand::SystemRandom;
use ring::signature::{ECDSA_P256_SHA256_ASN1_SIGNING, EcdsaKeyPair};
use rustls_pki_types::{CertificateDer, UnixTime};
use webpki::{EndEntityCert, KeyUsage, anchor_from_trusted_cert, ring as algorithms};

use crate::bundle::{Bundle, common_name};
use crate::identity::Role;
use crate::passphrase::Passphrase;

const CERTIFICATE: u8 = 1;
const PASSPHRASE: u8 = 2;

/// Why a command is not accepted.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Refusal {
    /// It has no signature.
    #[error("the command is not signed; this car takes signed commands only")]
    Unsigned,
    /// The signature cannot be read.
    #[error("the signature of the command cannot be read")]
    Malformed,
    /// The certificate is not of this authority, or has expired.
    #[error("the signer's certificate is refused: {0}")]
    Certificate(String),
    /// The certificate does not allow commands.
    #[error("{role} {name} may not command; only a pit wall may")]
    Role {
        /// Its role.
        role: Role,
        /// Its name.
        name: String,
    },
    /// The certificate is not in force any more.
    #[error("the certificate of {0} is revoked, or newer than this car's keys")]
    Revoked(String),
    /// The signature belongs to another command, car or run.
    #[error("the signature does not belong to this command, car and run")]
    Wrong,
}

/// Signs commands.
#[derive(Clone)]
pub struct Signer(Arc<SignerKind>);

enum SignerKind {
    Certificate {
        certificate: CertificateDer<'static>,
        key: EcdsaKeyPair,
        random: SystemRandom,
    },
    Passphrase(Passphrase),
}

impl Signer {
    /// Signs with the key of a host.
    pub fn new(bundle: &Bundle) -> Result<Self, String> {
        let random = SystemRandom::new();
        let key = bundle.private_key()?;
        let key = EcdsaKeyPair::from_pkcs8(&ECDSA_P256_SHA256_ASN1_SIGNING, key.secret_pkcs8_der(), &random)
            .map_err(|error| format!("the private key cannot sign: {error}"))?;
        Ok(Self(Arc::new(SignerKind::Certificate {
            certificate: bundle.certificate_der()?,
            key,
            random,
        })))
    }

    /// Signs with the passphrase.
    pub fn with_passphrase(passphrase: &Passphrase) -> Self {
        Self(Arc::new(SignerKind::Passphrase(passphrase.clone())))
    }

    /// The attachment of a command that is sent under `key` to the car's run `run_id`.
    pub fn sign(&self, key: &str, run_id: u64, command: &[u8]) -> Result<Vec<u8>, String> {
        let message = message(key, run_id, command);
        match &*self.0 {
            SignerKind::Certificate {
                certificate,
                key,
                random,
            } => {
                let signature = key
                    .sign(random, &message)
                    .map_err(|_| "the system has no random numbers")?;
                let length = u16::try_from(certificate.len()).map_err(|_| "the certificate is too long")?;
                let mut bytes = vec![CERTIFICATE];
                bytes.extend(length.to_le_bytes());
                bytes.extend_from_slice(certificate);
                bytes.extend_from_slice(signature.as_ref());
                Ok(bytes)
            }
            SignerKind::Passphrase(passphrase) => {
                let mut bytes = vec![PASSPHRASE];
                bytes.extend(passphrase.tag(&message));
                Ok(bytes)
            }
        }
    }
}

impl fmt::Debug for Signer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Signer(..)")
    }
}

/// Checks who commands.
#[derive(Debug, Clone)]
pub struct Verifier(Arc<VerifierKind>);

#[derive(Debug)]
enum VerifierKind {
    Certificate {
        authority: CertificateDer<'static>,
        /// Common names of the pit walls in force.
        pits: Vec<String>,
    },
    Passphrase(Passphrase),
}

impl Verifier {
    /// Accepts the pit walls that these keys name.
    pub fn new(bundle: &Bundle) -> Result<Self, String> {
        Ok(Self(Arc::new(VerifierKind::Certificate {
            authority: bundle.authority_der()?,
            pits: bundle.common_names(Role::Pit).map(str::to_owned).collect(),
        })))
    }

    /// Accepts whoever knows the passphrase.
    pub fn with_passphrase(passphrase: &Passphrase) -> Self {
        Self(Arc::new(VerifierKind::Passphrase(passphrase.clone())))
    }

    /// Checks the attachment of a command, and returns the name of its signer.
    pub fn check(
        &self,
        attachment: Option<&[u8]>,
        key: &str,
        run_id: u64,
        command: &[u8],
    ) -> Result<String, Refusal> {
        let (kind, rest) = attachment
            .and_then(<[u8]>::split_first)
            .ok_or(Refusal::Unsigned)?;
        let message = message(key, run_id, command);
        match (&*self.0, *kind) {
            (VerifierKind::Certificate { authority, pits }, CERTIFICATE) => {
                check_certificate(authority, pits, rest, &message)
            }
            (VerifierKind::Passphrase(passphrase), PASSPHRASE) => {
                if passphrase.verifies(&message, rest) {
                    Ok(Passphrase::USER.to_owned())
                } else {
                    Err(Refusal::Wrong)
                }
            }
            _ => Err(Refusal::Malformed),
        }
    }
}

fn check_certificate(
    authority: &CertificateDer<'_>,
    pits: &[String],
    attachment: &[u8],
    message: &[u8],
) -> Result<String, Refusal> {
    let refused = |error: webpki::Error| Refusal::Certificate(error.to_string());
    let (length, rest) = attachment.split_first_chunk::<2>().ok_or(Refusal::Malformed)?;
    let (certificate, signature) = rest
        .split_at_checked(usize::from(u16::from_le_bytes(*length)))
        .ok_or(Refusal::Malformed)?;
    let der = CertificateDer::from(certificate);
    let end_entity = EndEntityCert::try_from(&der).map_err(refused)?;
    let anchor = anchor_from_trusted_cert(authority).map_err(refused)?;
    let now = SystemTime::now()
        .duration_since(SystemTime::UNIX_EPOCH)
        .unwrap_or_default();
    end_entity
        .verify_for_usage(
            webpki::ALL_VERIFICATION_ALGS,
            &[anchor],
            &[],
            UnixTime::since_unix_epoch(now),
            KeyUsage::client_auth(),
            None,
            None,
        )
        .map_err(refused)?;
    let identity = common_name(certificate).map_err(Refusal::Certificate)?;
    end_entity
        .verify_signature(algorithms::ECDSA_P256_SHA256, message, signature)
        .map_err(|_| Refusal::Wrong)?;
    if identity.role != Role::Pit {
        return Err(Refusal::Role {
            role: identity.role,
            name: identity.name.to_string(),
        });
    }
    if !pits.contains(&identity.to_string()) {
        return Err(Refusal::Revoked(identity.name.to_string()));
    }
    Ok(identity.name.to_string())
}

/// What is signed.
fn message(key: &str, run_id: u64, command: &[u8]) -> Vec<u8> {
    let mut message = b"synpf command 1\0".to_vec();
    message.extend_from_slice(key.as_bytes());
    message.push(0);
    message.extend(run_id.to_le_bytes());
    message.extend_from_slice(command);
    message
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Authority;
    use protocol::CarName;

    const KEY: &str = "synpf/v1/car-1/cmd/pose";

    fn name(text: &str) -> CarName {
        text.parse().expect("a name")
    }

    fn team() -> Authority {
        let mut authority = Authority::create(30).expect("an authority");
        for (role, who) in [
            (Role::Pit, "laptop"),
            (Role::Pit, "old"),
            (Role::Car, "car-1"),
            (Role::Car, "car-2"),
            (Role::Viewer, "ana"),
        ] {
            authority.issue(role, name(who), &[]).expect("issued");
        }
        authority
    }

    fn signer(authority: &Authority, role: Role, who: &str) -> Signer {
        Signer::new(&authority.bundle(role, &name(who)).expect("in force")).expect("a key")
    }

    fn verifier(authority: &Authority) -> Verifier {
        Verifier::new(&authority.bundle(Role::Car, &name("car-1")).expect("in force")).expect("keys")
    }

    #[test]
    fn only_a_pit_wall_in_force_commands() {
        let mut authority = team();
        let old = signer(&authority, Role::Pit, "old");
        authority.revoke(Role::Pit, &name("old")).expect("revoked");
        let verifier = verifier(&authority);
        let check = |signer: &Signer| {
            let signature = signer.sign(KEY, 7, b"command").expect("signed");
            verifier.check(Some(&signature), KEY, 7, b"command")
        };
        assert_eq!(
            check(&signer(&authority, Role::Pit, "laptop")),
            Ok("laptop".into())
        );
        assert_eq!(check(&old), Err(Refusal::Revoked("old".into())));
        for (role, who) in [(Role::Viewer, "ana"), (Role::Car, "car-2")] {
            let refusal = check(&signer(&authority, role, who)).expect_err("no pit wall");
            assert!(matches!(refusal, Refusal::Role { .. }), "{refusal}");
        }
        let stranger = signer(&team(), Role::Pit, "laptop");
        assert!(matches!(check(&stranger), Err(Refusal::Certificate(_))));
        assert_eq!(verifier.check(None, KEY, 7, b"command"), Err(Refusal::Unsigned));
    }

    #[test]
    fn an_expired_certificate_is_refused() {
        let mut authority = team();
        let yesterday = time::OffsetDateTime::now_utc() - time::Duration::days(1);
        authority
            .issue_until(Role::Pit, name("late"), Vec::new(), yesterday)
            .expect("issued");
        let signature = signer(&authority, Role::Pit, "late")
            .sign(KEY, 7, b"command")
            .expect("signed");
        let refusal = verifier(&authority)
            .check(Some(&signature), KEY, 7, b"command")
            .expect_err("expired");
        assert!(refusal.to_string().contains("xpired"), "{refusal}");
    }

    #[test]
    fn a_signature_is_for_one_command_car_and_run() {
        let authority = team();
        let verifier = verifier(&authority);
        let passphrase = Passphrase::new("correct horse battery").expect("long enough");
        let by_passphrase = Verifier::with_passphrase(&passphrase);
        for (signer, verifier) in [
            (signer(&authority, Role::Pit, "laptop"), &verifier),
            (Signer::with_passphrase(&passphrase), &by_passphrase),
        ] {
            let signature = signer.sign(KEY, 7, b"command").expect("signed");
            assert!(verifier.check(Some(&signature), KEY, 7, b"command").is_ok());
            for (key, run, command) in [
                ("synpf/v1/car-2/cmd/pose", 7, &b"command"[..]),
                (KEY, 8, b"command"),
                (KEY, 7, b"commanD"),
            ] {
                let refusal = verifier.check(Some(&signature), key, run, command);
                assert_eq!(refusal, Err(Refusal::Wrong));
            }
        }
        let other = Passphrase::new("another passphrase").expect("long enough");
        let forged = Signer::with_passphrase(&other)
            .sign(KEY, 7, b"command")
            .expect("signed");
        assert_eq!(
            by_passphrase.check(Some(&forged), KEY, 7, b"command"),
            Err(Refusal::Wrong)
        );
        assert!(Passphrase::new("short").is_err());
    }

    #[test]
    fn no_bytes_pass_and_none_panic() {
        let authority = team();
        let verifier = verifier(&authority);
        let good = signer(&authority, Role::Pit, "laptop")
            .sign(KEY, 7, b"command")
            .expect("signed");
        for length in 0..good.len() {
            assert!(verifier.check(Some(&good[..length]), KEY, 7, b"command").is_err());
            let mut broken = good.clone();
            broken[length] ^= 0x55;
            assert!(
                verifier.check(Some(&broken), KEY, 7, b"command").is_err(),
                "byte {length}"
            );
        }
    }
}
