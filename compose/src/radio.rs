//! The radio of one car: a relay on this machine that falls silent now and then, as one does behind a grandstand.

use std::time::Duration;

use anyhow::Context;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio::time::{Instant, sleep_until};

use crate::cars::ROUND;

/// When in each round the radio falls silent, and for how long.
pub(crate) const SILENT: [Duration; 2] = [Duration::from_secs(100), Duration::from_secs(6)];

/// Starts a relay to the wall that listens at `wall` (such as `tcp/127.0.0.1:7447`). Returns the endpoint for the car to
/// dial. Must be called on the runtime, and ends with it.
pub(crate) async fn start(wall: &str) -> anyhow::Result<String> {
    let address = wall
        .strip_prefix("tcp/")
        .and_then(|rest| rest.split(['?', '#']).next())
        .with_context(|| format!("--listen {wall}: the demo's radio needs tcp/ADDRESS:PORT"))?
        .to_owned();
    let listener = TcpListener::bind("127.0.0.1:0").await?;
    let endpoint = format!("tcp/{}", listener.local_addr()?);
    let (switch, silent) = watch::channel(false);
    tokio::spawn(schedule(switch));
    tokio::spawn(relay(listener, address, silent));
    Ok(endpoint)
}

/// Silences the radio in every round.
async fn schedule(switch: watch::Sender<bool>) {
    let mut round = Instant::now();
    loop {
        for (after, silent) in [(SILENT[0], true), (SILENT[0] + SILENT[1], false)] {
            sleep_until(round + after).await;
            if switch.send(silent).is_err() {
                return;
            }
        }
        round += ROUND;
    }
}

/// Passes bytes on in both directions while the radio is on; silence cuts every connection.
async fn relay(listener: TcpListener, wall: String, silent: watch::Receiver<bool>) {
    while let Ok((mut car, _)) = listener.accept().await {
        let (wall, mut silent) = (wall.clone(), silent.clone());
        tokio::spawn(async move {
            if *silent.borrow() {
                return;
            }
            let Ok(mut there) = TcpStream::connect(wall).await else {
                return;
            };
            // Small messages must not wait for company.
            if car.set_nodelay(true).and(there.set_nodelay(true)).is_err() {
                return;
            }
            tokio::select! {
                _ = tokio::io::copy_bidirectional(&mut car, &mut there) => {}
                _ = silent.wait_for(|silent| *silent) => {}
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::io::{AsyncReadExt, AsyncWriteExt};

    #[tokio::test]
    async fn silence_cuts_the_link_and_the_next_try_gets_through() {
        let wall = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let wall_address = wall.local_addr().expect("bound").to_string();
        let radio = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let radio_address = radio.local_addr().expect("bound");
        let (switch, silent) = watch::channel(false);
        tokio::spawn(relay(radio, wall_address, silent));
        let within = |work| tokio::time::timeout(Duration::from_secs(20), work);

        within(Box::pin(async {
            let mut car = TcpStream::connect(radio_address).await.expect("the radio");
            car.write_all(b"pose").await.expect("sent");
            let (mut there, _) = wall.accept().await.expect("the car");
            let mut heard = [0; 4];
            there.read_exact(&mut heard).await.expect("heard");
            assert_eq!(&heard, b"pose");
            switch.send(true).expect("a relay");
            // Both ends learn of it.
            assert_eq!(there.read(&mut heard).await.unwrap_or(0), 0);
            assert_eq!(car.read(&mut heard).await.unwrap_or(0), 0);
            switch.send(false).expect("a relay");
            let mut again = TcpStream::connect(radio_address).await.expect("the radio");
            again.write_all(b"pose").await.expect("sent");
            let (mut there, _) = wall.accept().await.expect("the car again");
            there.read_exact(&mut heard).await.expect("heard");
        }))
        .await
        .expect("in time");
    }
}
