//! A link that a test can cut: it passes on what comes at its endpoint, until it is cut.

use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio::task::JoinHandle;

/// A link to an endpoint. Dropping it cuts it for good.
pub struct Link {
    endpoint: String,
    whole: watch::Sender<bool>,
    task: JoinHandle<()>,
}

impl Link {
    /// A link to `to`, such as `tcp/127.0.0.1:7447`.
    pub async fn to(to: &str) -> Self {
        let to = to.strip_prefix("tcp/").expect("a TCP endpoint").to_owned();
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a free port");
        let address = listener.local_addr().expect("an address");
        let (whole, state) = watch::channel(true);
        let task = tokio::spawn(async move {
            while let Ok((near, _)) = listener.accept().await {
                // While it is cut, whoever dials is not heard.
                if *state.borrow() {
                    tokio::spawn(pass_on(near, to.clone(), state.clone()));
                }
            }
        });
        Self {
            endpoint: format!("tcp/{address}"),
            whole,
            task,
        }
    }

    /// The near end.
    pub fn endpoint(&self) -> &str {
        &self.endpoint
    }

    /// Cuts the link.
    pub fn cut(&self) {
        self.whole.send_replace(false);
    }

    /// Mends the link.
    pub fn restore(&self) {
        self.whole.send_replace(true);
    }
}

impl Drop for Link {
    fn drop(&mut self) {
        self.cut();
        self.task.abort();
    }
}

async fn pass_on(mut near: TcpStream, to: String, mut whole: watch::Receiver<bool>) {
    let Ok(mut far) = TcpStream::connect(&to).await else {
        return;
    };
    tokio::select! {
        // One end has closed, or has failed.
        _ = tokio::io::copy_bidirectional(&mut near, &mut far) => {}
        _ = whole.wait_for(|whole| !whole) => {}
    }
}
