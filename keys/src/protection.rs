//! How a program is protected on the network, and the settings of its zenoh session.

use std::io::Write;
use std::path::Path;
use std::sync::Arc;

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use protocol::CarName;
use serde_json::json;

use crate::access::{self, Side};
use crate::bundle::Bundle;
use crate::error::KeyError;
use crate::identity::Role;
use crate::passphrase::Passphrase;
use crate::signature::{Signer, Verifier};

/// How a program is protected on the network.
#[derive(Debug, Clone, Default)]
pub enum Protection {
    /// Not at all: for loopback.
    #[default]
    None,
    /// Encrypted, each host with a certificate of its own.
    Keys(Arc<Bundle>),
    /// A shared secret to connect and to command. What is sent can be read by others.
    Passphrase(Arc<Passphrase>),
}

/// Settings of a zenoh session, as pairs of a key and JSON. Keep it until the session is open.
#[derive(Debug)]
pub struct Settings {
    /// The settings.
    pub entries: Vec<(&'static str, String)>,
    /// zenoh reads the passphrase of a listener from a file.
    _dictionary: Option<tempfile::NamedTempFile>,
}

impl Protection {
    /// Reads what the command line names: a file of keys for `role`, or a file with a passphrase.
    pub fn read(
        keys: Option<&Path>,
        passphrase: Option<&Path>,
        roles: &[Role],
        car: Option<&CarName>,
    ) -> Result<Self, KeyError> {
        Ok(match (keys, passphrase) {
            (Some(file), _) => {
                let bundle = Bundle::read(file)?;
                let role = roles
                    .iter()
                    .find(|role| **role == bundle.role)
                    .or(roles.first())
                    .copied()
                    .unwrap_or(bundle.role);
                Self::Keys(Arc::new(bundle.for_role(role, car)?))
            }
            (None, Some(file)) => Self::Passphrase(Arc::new(Passphrase::read(file)?)),
            (None, None) => Self::None,
        })
    }

    /// True when others on the network are kept out.
    pub fn protects(&self) -> bool {
        !matches!(self, Self::None)
    }

    /// What endpoints begin with.
    pub fn scheme(&self) -> &'static str {
        match self {
            Self::Keys(_) => "tls",
            Self::None | Self::Passphrase(_) => "tcp",
        }
    }

    /// One word for it: `none`, `keys` or `passphrase`.
    pub fn as_str(&self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Keys(_) => "keys",
            Self::Passphrase(_) => "passphrase",
        }
    }

    /// Refuses an endpoint that would not be protected.
    pub fn check_endpoint(&self, endpoint: &str) -> Result<(), String> {
        match self {
            Self::Keys(_) if !endpoint.starts_with("tls/") => Err(format!(
                "{endpoint} is not encrypted; with keys, use tls/{}",
                endpoint.split_once('/').map_or(endpoint, |(_, address)| address)
            )),
            Self::None | Self::Passphrase(_) if endpoint.starts_with("tls/") => {
                Err(format!("{endpoint} is encrypted and needs --keys FILE"))
            }
            _ => Ok(()),
        }
    }

    /// Signs the commands of a pit wall; None when it has no keys that may.
    pub fn signer(&self) -> Result<Option<Signer>, String> {
        Ok(match self {
            Self::None => None,
            Self::Keys(bundle) => Some(Signer::new(bundle)?),
            Self::Passphrase(passphrase) => Some(Signer::with_passphrase(passphrase)),
        })
    }

    /// Checks the commands to a car; None when everybody may command.
    pub fn verifier(&self) -> Result<Option<Verifier>, String> {
        Ok(match self {
            Self::None => None,
            Self::Keys(bundle) => Some(Verifier::new(bundle)?),
            Self::Passphrase(passphrase) => Some(Verifier::with_passphrase(passphrase)),
        })
    }

    /// The settings of a session.
    pub fn settings(&self, side: &Side) -> std::io::Result<Settings> {
        let mut dictionary = None;
        let entries = match self {
            Self::None => Vec::new(),
            Self::Keys(bundle) => {
                let text = |pem: &str| BASE64_STANDARD.encode(pem);
                let tls = json!({
                    "enable_mtls": true,
                    // A laptop has another address at every track. The access rules know it by its certificate's name.
                    "verify_name_on_connect": false,
                    "close_link_on_expiration": true,
                    "root_ca_certificate_base64": text(&bundle.authority),
                    "listen_certificate_base64": text(&bundle.certificate),
                    "listen_private_key_base64": text(&bundle.key),
                    "connect_certificate_base64": text(&bundle.certificate),
                    "connect_private_key_base64": text(&bundle.key),
                });
                vec![
                    ("transport/link/tls", tls.to_string()),
                    ("transport/link/protocols", json!(["tls"]).to_string()),
                    ("access_control", access::by_certificate(bundle, side).to_string()),
                ]
            }
            Self::Passphrase(passphrase) => {
                let mut login = json!({"user": Passphrase::USER, "password": passphrase.password()});
                let mut entries = Vec::new();
                if *side == Side::Listener {
                    let mut file = tempfile::NamedTempFile::new()?;
                    writeln!(file, "{}:{}", Passphrase::USER, passphrase.password())?;
                    login["dictionary_file"] = json!(file.path());
                    dictionary = Some(file);
                    entries.push(("access_control", access::by_passphrase().to_string()));
                }
                entries.push(("transport/auth/usrpwd", login.to_string()));
                entries
            }
        };
        Ok(Settings {
            entries,
            _dictionary: dictionary,
        })
    }
}
