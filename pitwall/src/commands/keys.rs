//! `pitwall keys`: makes, lists, renews and revokes the keys of a team.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::Context;
use keys::{Authority, Bundle, Issued, Member, Role};
use protocol::CarName;
use serde_json::json;

use super::this_machine;
use crate::cli::{KeysVerb, Owners};
use crate::{output, qr_code};

/// The authority's own file in the folder of the keys.
const AUTHORITY: &str = "authority.keys";
/// The authority's certificate, for browsers.
const CERTIFICATE: &str = "authority.pem";

pub(super) fn run(folder: Option<PathBuf>, verb: &KeysVerb, json: bool) -> anyhow::Result<ExitCode> {
    let folder = match folder {
        Some(folder) => folder,
        None => default_folder().context("this user has no home folder: give --folder")?,
    };
    match verb {
        KeysVerb::New {
            owners,
            hosts,
            missing,
            copies,
            qr,
            days,
        } => {
            let outcome = new(&folder, owners, hosts, *missing, *days, qr.as_deref(), json)?;
            deliver(&folder, copies)?;
            Ok(outcome)
        }
        KeysVerb::Revoke { owners } => revoke(&folder, owners, json),
        KeysVerb::Renew { owners } => renew(&folder, owners, json),
        KeysVerb::List => list(&folder, json),
    }
}

/// `$XDG_CONFIG_HOME/synpf/keys`, by default in `~/.config`.
fn default_folder() -> Option<PathBuf> {
    let variable = |name| std::env::var_os(name).filter(|value| !value.is_empty());
    let base = variable("XDG_CONFIG_HOME")
        .map(PathBuf::from)
        .or_else(|| Some(PathBuf::from(variable("HOME")?).join(".config")))?;
    Some(base.join("synpf/keys"))
}

fn new(
    folder: &Path,
    owners: &Owners,
    hosts: &[String],
    missing: bool,
    days: u32,
    qr: Option<&str>,
    json: bool,
) -> anyhow::Result<ExitCode> {
    make_folder(folder)?;
    let file = folder.join(AUTHORITY);
    let mut authority = if file.exists() {
        Authority::read(&file)?
    } else {
        Authority::create(days)?
    };
    authority.days = days;
    let fresh = authority.issued().is_empty();
    let mut owners = owners.clone();
    // The first call without names makes what everybody needs.
    if owners.is_empty() {
        anyhow::ensure!(
            fresh,
            super::BadUsage("name whose keys to make: --car, --pit, --viewer, --router or --token".into())
        );
        owners.pit = vec!["pit".parse()?];
        owners.car = (1..=3)
            .map(|number| format!("car-{number}").parse())
            .collect::<Result<_, _>>()?;
        owners.viewer = vec!["viewer".parse()?];
    }
    let hosts = if hosts.is_empty() {
        this_machine::names()
    } else {
        hosts.to_vec()
    };
    let mut changed = Vec::new();
    for (role, name) in owners.hosts() {
        let exists = |member: &Member| member.role == role && member.name == name;
        if missing && authority.members().any(exists) {
            continue;
        }
        let hosts = if role == Role::Pit { &hosts[..] } else { &[] };
        authority.issue(role, name.clone(), hosts)?;
        changed.push((role, name));
    }
    let mut tokens = Vec::new();
    for operator in &owners.tokens {
        tokens.push((operator, authority.issue_token(operator.clone())?));
    }
    save(folder, &authority)?;
    let copies = copies(folder, &authority, &changed, owners.tokens.is_empty());
    if json {
        let tokens: Vec<_> = tokens
            .iter()
            .map(|(operator, token)| json!({"operator": operator, "token": token.reveal()}))
            .collect();
        output::print_json(&json!({"folder": folder, "copy": copies, "tokens": tokens}))?;
        return Ok(ExitCode::SUCCESS);
    }
    output::print(&format!("keys in {}, valid for {days} days", folder.display()));
    print_copies(&copies);
    for (operator, token) in tokens {
        output::print(&format!(
            "token of {operator} for the page, shown once: {}",
            token.reveal()
        ));
        if let Some(page) = qr {
            let address = format!("https://{page}/?token={}", token.reveal());
            output::print(&format!("{}\n{}", qr_code::draw(&address)?, qr_warning(operator)));
        }
    }
    if fresh {
        output::print(&format!(
            "Keep {} to yourself: whoever has it can make keys.\nA browser trusts the page after you import {}.",
            file.display(),
            folder.join(CERTIFICATE).display()
        ));
    }
    Ok(ExitCode::SUCCESS)
}

fn revoke(folder: &Path, owners: &Owners, json: bool) -> anyhow::Result<ExitCode> {
    let mut authority = open(folder, owners)?;
    for (role, name) in owners.hosts() {
        authority.revoke(role, &name)?;
    }
    for operator in &owners.tokens {
        authority.revoke_token(operator)?;
    }
    save(folder, &authority)?;
    for (_, name) in owners.hosts() {
        remove(&host_file(folder, &name))?;
    }
    let pits_changed = !owners.pit.is_empty();
    finish(folder, &authority, &[], !pits_changed, "revoked", json)
}

fn renew(folder: &Path, owners: &Owners, json: bool) -> anyhow::Result<ExitCode> {
    anyhow::ensure!(
        owners.tokens.is_empty(),
        super::BadUsage("an operator gets another token with `pitwall keys new --token NAME`".into())
    );
    let mut authority = open(folder, owners)?;
    for (role, name) in owners.hosts() {
        authority.renew(role, &name)?;
    }
    save(folder, &authority)?;
    let changed: Vec<_> = owners.hosts().collect();
    finish(
        folder,
        &authority,
        &changed,
        owners.pit.is_empty(),
        "renewed",
        json,
    )
}

/// Writes the keys of hosts into folders of their own.
fn deliver(folder: &Path, copies: &[(CarName, PathBuf)]) -> anyhow::Result<()> {
    for (name, to) in copies {
        let bundle = Bundle::read(&host_file(folder, name))?;
        bundle.write(&to.join(format!("{name}.keys")))?;
    }
    Ok(())
}

/// Prints what must be copied now. Cars know the pit walls by name, so a change of those concerns every host.
fn finish(
    folder: &Path,
    authority: &Authority,
    changed: &[(Role, CarName)],
    pits_only: bool,
    what: &str,
    json: bool,
) -> anyhow::Result<ExitCode> {
    let hosts: Vec<_> = authority
        .members()
        .map(|member| (member.role, member.name.clone()))
        .filter(|host| !pits_only || host.0 == Role::Pit || changed.contains(host))
        .collect();
    let copies = copies(folder, authority, &hosts, true);
    if json {
        output::print_json(&json!({"folder": folder, "copy": copies}))?;
    } else {
        output::print(&format!(
            "{what}; it takes effect where the new file is, after a restart of the program"
        ));
        print_copies(&copies);
    }
    Ok(ExitCode::SUCCESS)
}

fn list(folder: &Path, json: bool) -> anyhow::Result<ExitCode> {
    let authority = Authority::read(&folder.join(AUTHORITY))?;
    let now = pitwall::unix_now() / 1_000_000_000;
    let days = |issued: &Issued| (issued.member.expires - now).div_euclid(86_400);
    if json {
        let hosts: Vec<_> = authority
            .issued()
            .iter()
            .map(|issued| {
                json!({
                    "role": issued.member.role, "name": issued.member.name, "revoked": issued.revoked,
                    "certificate": issued.member.common_name, "days_left": days(issued), "hosts": issued.hosts,
                })
            })
            .collect();
        let operators: Vec<_> = authority.operators().collect();
        output::print_json(&json!({"hosts": hosts, "operators": operators}))?;
        return Ok(ExitCode::SUCCESS);
    }
    for issued in authority.issued() {
        let state = match (issued.revoked, days(issued)) {
            (true, _) => "revoked".to_owned(),
            (false, left) if left < 0 => "expired".to_owned(),
            (false, left) => format!("{left} days left"),
        };
        let (role, name) = (issued.member.role, &issued.member.name);
        output::print(&format!(
            "{role:6} {name:16} {state:14} {}",
            issued.hosts.join(" ")
        ));
    }
    for operator in authority.operators() {
        output::print(&format!("token  {operator}"));
    }
    Ok(ExitCode::SUCCESS)
}

fn open(folder: &Path, owners: &Owners) -> anyhow::Result<Authority> {
    anyhow::ensure!(
        !owners.is_empty(),
        super::BadUsage("name whose keys: --car, --pit, --viewer, --router or --token".into())
    );
    Ok(Authority::read(&folder.join(AUTHORITY))?)
}

/// Writes the authority and the file of every host: each knows who is in force.
fn save(folder: &Path, authority: &Authority) -> anyhow::Result<()> {
    authority.write(&folder.join(AUTHORITY))?;
    let certificate = folder.join(CERTIFICATE);
    std::fs::write(&certificate, authority.certificate())
        .with_context(|| certificate.display().to_string())?;
    for member in authority.members() {
        let bundle = authority.bundle(member.role, &member.name)?;
        bundle.write(&host_file(folder, &member.name))?;
    }
    Ok(())
}

fn host_file(folder: &Path, name: &CarName) -> PathBuf {
    folder.join(format!("{name}.keys"))
}

/// Files that must be copied to their hosts.
fn copies(folder: &Path, authority: &Authority, changed: &[(Role, CarName)], pits_too: bool) -> Vec<PathBuf> {
    authority
        .members()
        .filter(|member| {
            changed.contains(&(member.role, member.name.clone())) || (pits_too && member.role == Role::Pit)
        })
        .map(|member| host_file(folder, &member.name))
        .collect()
}

/// What a code with a token gives away.
fn qr_warning(operator: &CarName) -> String {
    format!(
        "The code opens the page as {operator}. Whoever photographs it can do that, too: clear the screen when {operator} has \
         scanned it. The phone trusts the page after it has imported {CERTIFICATE}."
    )
}

fn print_copies(copies: &[PathBuf]) {
    if copies.is_empty() {
        return;
    }
    output::print("copy each file to its host, for example:");
    for file in copies {
        let host = file.file_stem().unwrap_or_default().to_string_lossy();
        output::print(&format!("  scp {} USER@{host}:", file.display()));
    }
}

fn remove(file: &Path) -> anyhow::Result<()> {
    match std::fs::remove_file(file) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
            Err(error).with_context(|| file.display().to_string())
        }
        _ => Ok(()),
    }
}

/// Makes a folder that only its owner can read.
fn make_folder(folder: &Path) -> anyhow::Result<()> {
    let mut builder = std::fs::DirBuilder::new();
    builder.recursive(true);
    #[cfg(unix)]
    std::os::unix::fs::DirBuilderExt::mode(&mut builder, 0o700);
    builder
        .create(folder)
        .with_context(|| folder.display().to_string())
}
