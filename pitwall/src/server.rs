//! The whole pit wall: connection, fleet and page.

use std::sync::Arc;

use keys::Protection;

use crate::fleet_service::FleetService;
use crate::network::{ConnectionError, Role};
use crate::web::{Page, PageOptions};

/// How a pit wall is set up.
#[derive(Debug, Clone)]
pub struct PitWallOptions {
    /// How to connect to the cars.
    pub role: Role,
    /// How the network is protected. With keys, a page beyond loopback is served over HTTPS.
    pub protection: Protection,
    /// How to serve the page.
    pub page: PageOptions,
}

/// A running pit wall with its page.
pub struct PitWallServer {
    service: Arc<FleetService>,
    page: Page,
}

impl PitWallServer {
    /// Opens the connection and serves the page. Needs a multi-thread tokio runtime.
    pub async fn start(options: PitWallOptions) -> Result<Self, PitWallError> {
        let address = options.page.address;
        let service = FleetService::open_protected(&options.role, &options.protection).await?;
        let keys = match &options.protection {
            Protection::Keys(keys) => Some(keys.clone()),
            Protection::None | Protection::Passphrase(_) => None,
        };
        match Page::serve_with_keys(service.clone(), options.page, keys).await {
            Ok(page) => Ok(Self { service, page }),
            Err(reason) => {
                service.close().await;
                Err(PitWallError::Page { address, reason })
            }
        }
    }

    /// The fleet, the connection and the recorder.
    pub fn service(&self) -> &Arc<FleetService> {
        &self.service
    }

    /// The page's address for a browser.
    pub fn url(&self) -> &str {
        self.page.url()
    }

    /// Stops serving, ends a running recording and closes the connection.
    pub async fn stop(self) {
        self.page.stop().await;
        self.service.close().await;
    }
}

/// Why a pit wall does not start.
#[derive(Debug, thiserror::Error)]
pub enum PitWallError {
    /// The network.
    #[error(transparent)]
    Connection(#[from] ConnectionError),
    /// The page.
    #[error("cannot serve the page at {address}: {reason}")]
    Page {
        /// The address.
        address: std::net::SocketAddr,
        /// The system's message.
        reason: std::io::Error,
    },
}
