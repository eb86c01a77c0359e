//! The whole pit wall: a link, a fleet and the page.

use std::sync::Arc;

use crate::hub::Hub;
use crate::link::{LinkError, Role};
use crate::web::{Page, PageOptions};

/// How a pit wall is set up.
#[derive(Debug, Clone)]
pub struct WallOptions {
    /// How to get at the cars.
    pub role: Role,
    /// How the page is served.
    pub page: PageOptions,
}

/// A running pit wall with its page.
pub struct PitWall {
    hub: Arc<Hub>,
    page: Page,
}

impl PitWall {
    /// Opens the link and serves the page. Needs a multi-thread tokio runtime.
    pub async fn start(options: WallOptions) -> Result<Self, WallError> {
        let address = options.page.address;
        let hub = Hub::open(&options.role).await?;
        match Page::serve(hub.clone(), options.page).await {
            Ok(page) => Ok(Self { hub, page }),
            Err(reason) => {
                hub.close().await;
                Err(WallError::Page { address, reason })
            }
        }
    }

    /// The fleet, the link and the recorder.
    pub fn hub(&self) -> &Arc<Hub> {
        &self.hub
    }

    /// What to type into a browser.
    pub fn url(&self) -> &str {
        self.page.url()
    }

    /// Stops serving, ends a recording that is going on, and closes the link.
    pub async fn stop(self) {
        self.page.stop().await;
        self.hub.close().await;
    }
}

/// Why a pit wall does not start.
#[derive(Debug, thiserror::Error)]
pub enum WallError {
    /// The network.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// The page.
    #[error("cannot serve the page at {address}: {reason}")]
    Page {
        /// Where.
        address: std::net::SocketAddr,
        /// What the system says.
        reason: std::io::Error,
    },
}
