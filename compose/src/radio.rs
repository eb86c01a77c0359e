//! The radio link of one car: a TCP relay that is cut in every round, as behind a grandstand.

use std::time::Duration;

use anyhow::Context;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio::time::{Instant, sleep_until};

use crate::cars::ROUND;

/// Start and end of the outage in each round.
pub(crate) const OUTAGE: [Duration; 2] = [Duration::from_secs(100), Duration::from_secs(106)];

/// Starts a relay to the pit wall that listens at `pitwall` (such as `tcp/127.0.0.1:7447`). Returns the endpoint for the
/// car to connect to. The relay runs on the current tokio runtime, and ends with it.
pub(crate) async fn start(pitwall: &str) -> anyhow::Result<String> {
    let address = pitwall
        .strip_prefix("tcp/")
        .and_then(|rest| rest.split(['?', '#']).next())
        .with_context(|| format!("--listen {pitwall}: the demo's radio needs tcp/ADDRESS:PORT"))?
        .to_owned();
    let listener = TcpListener::bind("127.0.0.1:0").await?;
    let endpoint = format!("tcp/{}", listener.local_addr()?);
    let (set_cut, cut) = watch::channel(false);
    tokio::spawn(schedule(set_cut));
    tokio::spawn(relay(listener, address, cut));
    Ok(endpoint)
}

/// Cuts and restores the link in every round.
async fn schedule(set_cut: watch::Sender<bool>) {
    let mut round = Instant::now();
    loop {
        for (after, cut) in [(OUTAGE[0], true), (OUTAGE[1], false)] {
            sleep_until(round + after).await;
            if set_cut.send(cut).is_err() {
                return;
            }
        }
        round += ROUND;
    }
}

/// Copies bytes in both directions. While the link is cut, it closes every connection.
async fn relay(listener: TcpListener, pitwall: String, cut: watch::Receiver<bool>) {
    while let Ok((mut car, _)) = listener.accept().await {
        let (pitwall, mut cut) = (pitwall.clone(), cut.clone());
        tokio::spawn(async move {
            if *cut.borrow() {
                return;
            }
            let Ok(mut server) = TcpStream::connect(pitwall).await else {
                return;
            };
            // Small messages must not wait for more bytes.
            if car.set_nodelay(true).and(server.set_nodelay(true)).is_err() {
                return;
            }
            tokio::select! {
                _ = tokio::io::copy_bidirectional(&mut car, &mut server) => {}
                _ = cut.wait_for(|cut| *cut) => {}
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::io::{AsyncReadExt, AsyncWriteExt};

    #[tokio::test]
    async fn an_outage_closes_connections_and_a_new_one_works_afterwards() {
        let pitwall = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let pitwall_address = pitwall.local_addr().expect("bound").to_string();
        let radio = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let radio_address = radio.local_addr().expect("bound");
        let (set_cut, cut) = watch::channel(false);
        tokio::spawn(relay(radio, pitwall_address, cut));
        let within = |work| tokio::time::timeout(Duration::from_secs(20), work);

        within(Box::pin(async {
            let mut car = TcpStream::connect(radio_address).await.expect("the radio");
            car.write_all(b"pose").await.expect("sent");
            let (mut server, _) = pitwall.accept().await.expect("the car");
            let mut received = [0; 4];
            server.read_exact(&mut received).await.expect("received");
            assert_eq!(&received, b"pose");
            set_cut.send(true).expect("a relay");
            // Both ends see their connection closed.
            assert_eq!(server.read(&mut received).await.unwrap_or(0), 0);
            assert_eq!(car.read(&mut received).await.unwrap_or(0), 0);
            set_cut.send(false).expect("a relay");
            let mut again = TcpStream::connect(radio_address).await.expect("the radio");
            again.write_all(b"pose").await.expect("sent");
            let (mut server, _) = pitwall.accept().await.expect("the car again");
            server.read_exact(&mut received).await.expect("received");
        }))
        .await
        .expect("within the deadline");
    }
}
