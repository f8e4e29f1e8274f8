//! Listening and stopping.

use std::future::Future;
use std::io;
use std::net::SocketAddr;
use std::time::Duration;

use axum::serve::ListenerExt;
use tokio::net::TcpListener;
use tokio::sync::watch;

use crate::routes::{App, router};
use crate::volumes::Volumes;

/// How long answers under way may take once the server is to stop.
const LAST_ANSWERS: Duration = Duration::from_secs(2);

/// Settings of a server.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Options {
    /// Longest time that building a chunk may take before its client is told to ask again.
    pub patience: Duration,
    /// Whom to send compressed answers, of those who accept them.
    pub compress: Compress,
}

/// Whom to send large answers compressed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Compress {
    /// Clients on other computers.
    FarClients,
    /// All clients.
    Always,
}

impl Options {
    /// The usual ones.
    pub const DEFAULT: Self = Self {
        patience: Duration::from_secs(20),
        compress: Compress::FarClients,
    };
}

impl Default for Options {
    fn default() -> Self {
        Self::DEFAULT
    }
}

/// Marks answers that may be compressed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Compressible {
    /// Descriptions: always worth it.
    Small,
    /// Voxels and programs: worth it over a network.
    Large,
}

/// Why a server cannot run.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ServeError {
    /// Another program listens there.
    #[error(
        "port {} is in use; choose another with --port, or --port 0 for any free one",
        address.port()
    )]
    PortInUse {
        /// As asked for.
        address: SocketAddr,
    },
    /// Listening there is impossible; see the source.
    #[error("cannot listen on {address}")]
    Listen {
        /// What the system says.
        source: io::Error,
        /// As asked for.
        address: SocketAddr,
    },
    /// Serving ended; see the source.
    #[error("the server stopped")]
    Stopped {
        /// What the system says.
        source: io::Error,
    },
}

/// Listens already; answers while it runs.
#[derive(Debug)]
pub struct Server {
    listener: TcpListener,
    address: SocketAddr,
}

impl Server {
    /// Listens on an address; port 0 takes a free one.
    ///
    /// # Errors
    ///
    /// [`ServeError::PortInUse`] and [`ServeError::Listen`].
    pub async fn bind(address: SocketAddr) -> Result<Self, ServeError> {
        let refused = |source: io::Error| match source.kind() {
            io::ErrorKind::AddrInUse => ServeError::PortInUse { address },
            _ => ServeError::Listen { source, address },
        };
        let listener = TcpListener::bind(address).await.map_err(refused)?;
        let address = listener.local_addr().map_err(refused)?;
        Ok(Self { listener, address })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// The address for a browser on this computer.
    pub fn url(&self) -> String {
        let mut address = self.address;
        if address.ip().is_unspecified() {
            address.set_ip(std::net::Ipv4Addr::LOCALHOST.into());
        }
        format!("http://{address}/")
    }

    /// Answers requests until `stop` is done. Answers under way are finished, event streams ended.
    ///
    /// # Errors
    ///
    /// [`ServeError::Stopped`] when the system ends it.
    pub async fn run(
        self,
        volumes: Volumes,
        options: Options,
        stop: impl Future<Output = ()> + Send + 'static,
    ) -> Result<(), ServeError> {
        let (close, closing) = watch::channel(false);
        let app = App {
            volumes,
            options,
            closing: closing.clone(),
        };
        let service = router(app).into_make_service_with_connect_info::<SocketAddr>();
        // Chunks are many and small: waiting to fill packets would only delay them.
        let listener = self.listener.tap_io(|stream| {
            if let Err(error) = stream.set_nodelay(true) {
                log::debug!("cannot turn off packet delay: {error}");
            }
        });
        let stopped = async move {
            stop.await;
            close.send_replace(true);
        };
        let serving = axum::serve(listener, service).with_graceful_shutdown(stopped);
        let mut closing = closing;
        let cut = async move {
            if closing.wait_for(|closing| *closing).await.is_err() {
                std::future::pending::<()>().await;
            }
            tokio::time::sleep(LAST_ANSWERS).await;
        };
        tokio::select! {
            served = serving.into_future() => served.map_err(|source| ServeError::Stopped { source }),
            () = cut => Ok(()),
        }
    }
}
