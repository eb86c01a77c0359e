//! Accepts the browsers' connections, with TLS when there are keys.
//!
//! A connection that has not sent an admitted request yet is cheap to open and may be hostile. There is a limit to those, and
//! the oldest makes room for the newest. Headers must arrive within a few seconds. Whoever opens sockets and sends nothing
//! therefore shuts nobody out, and neither does a lack of file handles.

use std::collections::VecDeque;
use std::net::IpAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use axum::Router;
use axum::extract::Request;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use keys::Bundle;
use rustls_pki_types::PrivateKeyDer;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio::task::{AbortHandle, JoinSet};
use tokio_rustls::TlsAcceptor;
use tower::ServiceExt;

/// Time for the TLS handshake, and for the headers of a request.
const PATIENCE: Duration = Duration::from_secs(10);
/// Most connections without an admitted request.
const MOST_STRANGERS: usize = 64;
/// Most connections.
const MOST: usize = 256;
/// Buffer of a connection \[bytes\]; longer headers are refused.
const BUFFER: usize = 64 * 1024;
/// Wait after a failed accept, such as without file handles.
const RETRY: Duration = Duration::from_millis(50);
/// Time for open requests when the page stops.
const CLOSING: Duration = Duration::from_secs(1);

/// Set when the guard has admitted a request of the connection.
#[derive(Debug, Clone, Default)]
pub(super) struct Admitted(Arc<AtomicBool>);

impl Admitted {
    /// The connection belongs to somebody who may use the page.
    pub(super) fn set(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    fn get(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}

/// Makes the acceptor of TLS connections from the keys of a pit wall.
pub(super) fn acceptor(keys: &Bundle) -> Result<TlsAcceptor, String> {
    let chain = vec![keys.certificate_der()?, keys.authority_der()?];
    let key = PrivateKeyDer::Pkcs8(keys.private_key()?);
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let config = rustls::ServerConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .and_then(|builder| builder.with_no_client_auth().with_single_cert(chain, key))
        .map_err(|error| error.to_string())?;
    Ok(TlsAcceptor::from(Arc::new(config)))
}

/// Serves until `stopping`.
pub(super) async fn serve(
    listener: TcpListener,
    tls: Option<TlsAcceptor>,
    router: Router,
    mut stopping: watch::Receiver<bool>,
) {
    let mut tasks = JoinSet::new();
    let mut open = OpenConnections::default();
    let mut failures = 0_u64;
    loop {
        let (stream, from) = tokio::select! {
            accepted = listener.accept() => match accepted {
                Ok((stream, from)) => (stream, from.ip()),
                Err(error) => {
                    failures += 1;
                    if failures.is_power_of_two() {
                        tracing::warn!(%error, failures, "the page cannot accept a connection");
                    }
                    open.close_oldest_stranger();
                    tokio::time::sleep(RETRY).await;
                    continue;
                }
            },
            _ = tasks.join_next(), if !tasks.is_empty() => continue,
            () = stopped(&mut stopping) => break,
        };
        let admitted = Admitted::default();
        if !open.make_room() {
            continue;
        }
        let connection = handle(
            stream,
            tls.clone(),
            router.clone(),
            admitted.clone(),
            stopping.clone(),
        );
        open.add(tasks.spawn(connection), admitted, from);
    }
    let ended = async { while tasks.join_next().await.is_some() {} };
    if tokio::time::timeout(CLOSING, ended).await.is_err() {
        tracing::debug!("some connections of the page did not end in time");
    }
}

/// Waits until the page is stopped.
async fn stopped(stopping: &mut watch::Receiver<bool>) {
    drop(stopping.wait_for(|stop| *stop).await);
}

/// The connections, the oldest first.
#[derive(Default)]
struct OpenConnections(VecDeque<(AbortHandle, Admitted, IpAddr)>);

impl OpenConnections {
    /// Closes what must make room for another connection. False when all are in use.
    fn make_room(&mut self) -> bool {
        self.0.retain(|(task, ..)| !task.is_finished());
        let strangers = self.0.iter().filter(|(_, admitted, _)| !admitted.get()).count();
        if strangers >= MOST_STRANGERS || self.0.len() >= MOST {
            return self.close_oldest_stranger();
        }
        true
    }

    fn close_oldest_stranger(&mut self) -> bool {
        let oldest = self.0.iter().position(|(_, admitted, _)| !admitted.get());
        let Some((task, _, from)) = oldest.and_then(|oldest| self.0.remove(oldest)) else {
            return false;
        };
        task.abort();
        keys::refusals::add(
            "page",
            format!(
                "more than {MOST_STRANGERS} connections to the page said nothing: the oldest, from {from}, were closed"
            ),
        );
        true
    }

    fn add(&mut self, task: AbortHandle, admitted: Admitted, from: IpAddr) {
        self.0.push_back((task, admitted, from));
    }
}

async fn handle(
    stream: TcpStream,
    tls: Option<TlsAcceptor>,
    router: Router,
    admitted: Admitted,
    stopping: watch::Receiver<bool>,
) {
    // Snapshots are small and frequent.
    stream.set_nodelay(true).ok();
    match tls {
        None => respond(stream, router, admitted, stopping).await,
        Some(tls) => match tokio::time::timeout(PATIENCE, tls.accept(stream)).await {
            Ok(Ok(stream)) => respond(stream, router, admitted, stopping).await,
            Ok(Err(error)) => tracing::debug!(%error, "a TLS handshake of the page failed"),
            Err(_) => tracing::debug!("a TLS handshake of the page took too long"),
        },
    }
}

async fn respond<S: AsyncRead + AsyncWrite + Unpin + Send + 'static>(
    stream: S,
    router: Router,
    admitted: Admitted,
    mut stopping: watch::Receiver<bool>,
) {
    let service = router.map_request(move |mut request: hyper::Request<hyper::body::Incoming>| {
        request.extensions_mut().insert(admitted.clone());
        let request: Request = request.map(axum::body::Body::new);
        request
    });
    let connection = hyper::server::conn::http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(PATIENCE)
        .max_buf_size(BUFFER)
        .serve_connection(TokioIo::new(stream), TowerToHyperService::new(service))
        .with_upgrades();
    let mut connection = std::pin::pin!(connection);
    let outcome = tokio::select! {
        outcome = &mut connection => outcome,
        () = stopped(&mut stopping) => {
            connection.as_mut().graceful_shutdown();
            connection.await
        }
    };
    if let Err(error) = outcome {
        tracing::debug!(%error, "a connection of the page ended");
    }
}
