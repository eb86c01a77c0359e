//! Finds the sockets of this process in `/proc/self/fd`.

use std::collections::HashSet;
use std::fs;
use std::io;
use std::os::fd::{BorrowedFd, OwnedFd, RawFd};
use std::path::PathBuf;
use std::sync::Once;
use std::thread;
use std::time::Duration;

use socket2::{Domain, Socket, Type};

use crate::LEASE;

/// New sockets are searched for this often. A connection that is cut sooner after its start is found all the same, because its
/// socket stays open.
const PERIOD: Duration = Duration::from_millis(250);
/// Data that a connection takes beyond what it can send \[bytes\].
const UNSENT: u32 = 2048;

/// Starts the thread, once for the process.
pub fn watch() {
    static STARTED: Once = Once::new();
    STARTED.call_once(|| {
        let spawned = thread::Builder::new().name("sockets".into()).spawn(|| {
            let mut known = HashSet::new();
            loop {
                set_options(&mut known);
                thread::sleep(PERIOD);
            }
        });
        if let Err(error) = spawned {
            tracing::warn!(%error, "no thread for socket options: a cut link may be found late");
        }
    });
}

/// Sets the options of all sockets that are not in `known`, which holds the names of the sockets that are done.
fn set_options(known: &mut HashSet<PathBuf>) {
    let Ok(entries) = fs::read_dir("/proc/self/fd") else {
        return;
    };
    let mut open = HashSet::new();
    for entry in entries.flatten() {
        // `socket:[NUMBER]`; the number is not used again soon.
        let Ok(name) = fs::read_link(entry.path()) else {
            continue;
        };
        if !name.to_string_lossy().starts_with("socket:") {
            continue;
        }
        if !known.contains(&name)
            && let Some(fd) = entry.file_name().to_str().and_then(|fd| fd.parse().ok())
            && let Ok(socket) = duplicate(fd).map(Socket::from)
        {
            match over_a_radio(&socket) {
                Ok(true) => {
                    if let Err(error) = set_options_of(&socket) {
                        tracing::debug!(%error, fd, "a socket does not take an option");
                    }
                }
                Ok(false) => {}
                // It is not connected yet.
                Err(_) => continue,
            }
        }
        open.insert(name);
    }
    *known = open;
}

/// A descriptor of its own for the same socket.
fn duplicate(fd: RawFd) -> io::Result<OwnedFd> {
    #[expect(
        unsafe_code,
        reason = "a library's socket is known by its number only; no safe function takes a number"
    )]
    // SAFETY: The descriptor is borrowed for one system call, which copies it. If its owner closes it before, the call
    // fails, or copies another file of this process. The copy is then checked for being a TCP socket.
    let borrowed = unsafe { BorrowedFd::borrow_raw(fd) };
    borrowed.try_clone_to_owned()
}

/// True for TCP that leaves the machine, and for listeners, whose connections inherit the options.
fn over_a_radio(socket: &Socket) -> io::Result<bool> {
    let internet = matches!(socket.domain(), Ok(domain) if domain == Domain::IPV4 || domain == Domain::IPV6);
    if !internet || socket.r#type()? != Type::STREAM {
        return Ok(false);
    }
    let address = if socket.is_listener()? {
        socket.local_addr()?
    } else {
        socket.peer_addr()?
    };
    Ok(address
        .as_socket()
        .is_some_and(|address| !address.ip().is_loopback()))
}

fn set_options_of(socket: &Socket) -> io::Result<()> {
    socket.set_tcp_user_timeout(Some(LEASE))?;
    socket.set_tcp_notsent_lowat(UNSENT)?;
    socket.set_tcp_thin_linear_timeouts(true)
}

#[cfg(test)]
mod tests {
    use std::net::{TcpListener, TcpStream};

    use super::*;

    #[test]
    fn connections_that_leave_the_machine_get_the_options() {
        // Nobody connects to this listener; its connections would inherit the options.
        let outside = Socket::from(TcpListener::bind("0.0.0.0:0").expect("a free port"));
        let inside = TcpListener::bind("127.0.0.1:0").expect("a free port");
        let connected = TcpStream::connect(inside.local_addr().expect("an address")).expect("a connection");
        let connected = Socket::from(connected);
        let mut known = HashSet::new();
        set_options(&mut known);
        assert_eq!(outside.tcp_user_timeout().expect("an option"), Some(LEASE));
        assert_eq!(outside.tcp_notsent_lowat().expect("an option"), UNSENT);
        assert_eq!(connected.tcp_user_timeout().expect("an option"), None);
        assert!(known.len() >= 3, "{known:?}");
        // What is closed is forgotten.
        let before = known.len();
        drop((outside, inside, connected));
        set_options(&mut known);
        assert!(known.len() < before);
    }
}
