//! `pitwall keep`: starts containers again that were killed. Docker itself does that after a crash, and not after `docker kill`.
//!
//! It talks to the Docker daemon only, over its socket, and starts nothing that ended by itself or by `docker stop`.

use std::io::{Read, Write};
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::process::ExitCode;
use std::time::Duration;

use anyhow::{Context, bail, ensure};
use serde::Deserialize;

use super::time_or_interrupt;
use crate::output;

/// Period of the checks.
const PERIOD: Duration = Duration::from_secs(2);
/// Exit code of a program that was killed by SIGKILL.
const KILLED: i64 = 137;
/// Longest answer of the daemon \[bytes\].
const LONGEST: u64 = 4_000_000;

pub(super) async fn run(socket: &Path, project: &str) -> anyhow::Result<ExitCode> {
    // A project's name goes into a URL.
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_".contains(c);
    ensure!(
        !project.is_empty() && project.chars().all(plain),
        super::BadUsage(format!("{project:?} is no name of a Compose project"))
    );
    let mut fault = String::new();
    loop {
        let (path, name) = (socket.to_owned(), project.to_owned());
        let outcome = tokio::task::spawn_blocking(move || start_killed(&path, &name)).await?;
        let now = match outcome {
            Ok(started) => {
                for container in started {
                    output::print(&format!("started {container} again"));
                }
                String::new()
            }
            Err(error) => format!("{error:#}"),
        };
        if now != fault && !now.is_empty() {
            output::print_error(&now);
        }
        fault = now;
        let ended = tokio::select! {
            () = time_or_interrupt(None) => true,
            () = tokio::time::sleep(PERIOD) => false,
        };
        if ended {
            return Ok(ExitCode::SUCCESS);
        }
    }
}

#[derive(Deserialize)]
#[serde(rename_all = "PascalCase")]
struct Container {
    id: String,
    names: Vec<String>,
}

#[derive(Deserialize)]
#[serde(rename_all = "PascalCase")]
struct Details {
    state: State,
}

#[derive(Deserialize)]
#[serde(rename_all = "PascalCase")]
struct State {
    exit_code: i64,
}

/// Starts the killed containers of a project; returns their names.
fn start_killed(socket: &Path, project: &str) -> anyhow::Result<Vec<String>> {
    let filters = format!(
        "%7B%22status%22%3A%5B%22exited%22%5D%2C%22label%22%3A%5B%22com.docker.compose.project%3D{project}%22%5D%7D"
    );
    let (_, body) = ask(
        socket,
        "GET",
        &format!("/containers/json?all=1&filters={filters}"),
    )?;
    let ended: Vec<Container> = serde_json::from_slice(&body).context("the list of containers")?;
    let mut started = Vec::new();
    for container in ended {
        let hexadecimal = container.id.chars().all(|c| c.is_ascii_hexdigit());
        ensure!(hexadecimal, "container id {:?}", container.id);
        let (_, body) = ask(socket, "GET", &format!("/containers/{}/json", container.id))?;
        let details: Details = serde_json::from_slice(&body).context("the state of a container")?;
        if details.state.exit_code != KILLED {
            continue;
        }
        ask(socket, "POST", &format!("/containers/{}/start", container.id))?;
        let name = container
            .names
            .first()
            .map_or(container.id.as_str(), String::as_str);
        started.push(name.trim_start_matches('/').to_owned());
    }
    Ok(started)
}

/// Sends a request to the daemon. HTTP 1.0: the answer ends with the connection.
fn ask(socket: &Path, method: &str, path: &str) -> anyhow::Result<(u16, Vec<u8>)> {
    let mut stream = UnixStream::connect(socket).with_context(|| socket.display().to_string())?;
    stream.set_read_timeout(Some(Duration::from_secs(30)))?;
    let request = format!("{method} {path} HTTP/1.0\r\nHost: docker\r\nContent-Length: 0\r\n\r\n");
    stream.write_all(request.as_bytes())?;
    let mut answer = Vec::new();
    stream.take(LONGEST).read_to_end(&mut answer)?;
    parse(&answer)
}

/// Status and body of an HTTP answer.
fn parse(answer: &[u8]) -> anyhow::Result<(u16, Vec<u8>)> {
    let end = answer
        .windows(4)
        .position(|window| window == b"\r\n\r\n")
        .context("the Docker daemon's answer has no end of the headers")?;
    let head = String::from_utf8_lossy(&answer[..end]);
    let status: u16 = head
        .split(' ')
        .nth(1)
        .and_then(|status| status.parse().ok())
        .context("the Docker daemon's answer has no status")?;
    let body = answer[end + 4..].to_vec();
    // 304: it runs already, because the other keeper was faster.
    if !(200..300).contains(&status) && status != 304 {
        bail!(
            "the Docker daemon says {status}: {}",
            String::from_utf8_lossy(&body).trim()
        );
    }
    Ok((status, body))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::net::UnixListener;

    #[test]
    fn only_what_was_killed_is_started_again() {
        let folder = tempfile::tempdir().expect("a folder");
        let socket = folder.path().join("docker.sock");
        let listener = UnixListener::bind(&socket).expect("a socket");
        let daemon = std::thread::spawn(move || {
            let mut started = Vec::new();
            // The list, the state of two containers, and one start.
            for stream in listener.incoming().take(4) {
                let mut stream = stream.expect("a connection");
                let mut request = Vec::new();
                while !request.ends_with(b"\r\n\r\n") {
                    let mut byte = [0];
                    stream.read_exact(&mut byte).expect("a request");
                    request.extend(byte);
                }
                let request = String::from_utf8_lossy(&request).into_owned();
                let body = if request.contains("/containers/json") {
                    assert!(request.contains("project%3Drace"), "{request}");
                    r#"[{"Id":"aa","Names":["/race_car-1"]},{"Id":"bb","Names":["/race_keys"]}]"#
                } else if request.contains("/aa/json") {
                    r#"{"State":{"ExitCode":137}}"#
                } else if request.contains("/bb/json") {
                    r#"{"State":{"ExitCode":0}}"#
                } else {
                    started.push(request.lines().next().unwrap_or_default().to_owned());
                    ""
                };
                write!(stream, "HTTP/1.0 200 OK\r\nX: y\r\n\r\n{body}").expect("sent");
            }
            started
        });
        assert_eq!(start_killed(&socket, "race").expect("answers"), ["race_car-1"]);
        assert_eq!(
            daemon.join().expect("no panic"),
            ["POST /containers/aa/start HTTP/1.0"]
        );
    }

    #[test]
    fn a_refusal_of_the_daemon_is_named() {
        let error = parse(b"HTTP/1.0 404 Not Found\r\n\r\nno such container\n").expect_err("refused");
        assert!(error.to_string().contains("404: no such container"), "{error}");
        assert!(parse(b"").is_err());
    }
}
