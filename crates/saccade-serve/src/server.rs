//! Listening and stopping.

mod accept;
mod access;
mod connection;
mod connections;
mod heads;
mod limits;
mod paced;
mod streams;

use std::future::Future;
use std::io;
use std::net::SocketAddr;
use std::time::Duration;

use tokio::net::TcpListener;
use tokio::sync::watch;

pub(crate) use access::Gate;
pub use access::{Access, Origins};
pub use limits::Limits;
pub(crate) use streams::{StreamPlace, Streams};
#[cfg(any(test, fuzzing))]
pub(crate) use {access::fuzz as fuzz_access, heads::fuzz as fuzz_heads};

use crate::routes::{App, router};
use crate::volumes::Volumes;

/// Settings of a server.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Options {
    /// Longest time that building a chunk may take before its client is told to ask again.
    pub patience: Duration,
    /// Whom to send compressed answers, of those who accept them.
    pub compress: Compress,
    /// How much clients may take.
    pub limits: Limits,
    /// Who may ask.
    pub access: Access,
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
        limits: Limits::DEFAULT,
        access: Access::DEFAULT,
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
    /// The system gives no thread or no timer to accept connections by; see the source.
    #[error("connections cannot be accepted")]
    Accept {
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
    /// [`ServeError::Accept`] before anything is answered. What happens to one connection ends no others.
    pub async fn run(
        self,
        volumes: Volumes,
        options: Options,
        stop: impl Future<Output = ()> + Send + 'static,
    ) -> Result<(), ServeError> {
        let (close, closing) = watch::channel(false);
        let limits = options.limits;
        let app = App::new(volumes, options, closing.clone());
        let stopping = async {
            stop.await;
            close.send_replace(true);
            // Kept to the end: a sender that is gone would read as one that stops.
            std::future::pending::<()>().await;
        };
        tokio::select! {
            ended = accept::accept(self.listener, router(app), limits, closing) => {
                ended.map_err(|source| ServeError::Accept { source })
            }
            () = stopping => Ok(()),
        }
    }
}
