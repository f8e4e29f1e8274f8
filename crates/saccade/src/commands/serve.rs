//! `saccade serve`: an archive over HTTP.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::time::Duration;

use anyhow::{Context as _, Result};
use clap::Args;
use saccade_archive::VisualizationArchive;
use saccade_serve::{Access, Options, Origins, Server, Volumes, follow_archive, offer_archive};

use crate::arguments::CatalogArgument;
use crate::interrupt::interrupted;
use crate::open::{NOT_STITCHED, Place, neither, waited_for};
use crate::report::{say, tell};
use crate::stitching::Stitching;

/// Offer the volumes of an archive, or an image that somebody else wrote, over HTTP, with the browser
/// application. Nothing is fetched for clients but from the places given here.
#[derive(Args)]
pub(crate) struct Serve {
    /// A visualization archive: its folder, or s3://bucket/prefix with --catalog; or an OME-Zarr or precomputed
    /// image: its folder, http(s)://, s3:// or gs:// address
    #[arg(value_name = "ARCHIVE|IMAGE")]
    place: Place,

    #[command(flatten)]
    catalog: CatalogArgument,

    #[command(flatten)]
    at: At,

    #[command(flatten)]
    stitching: Stitching,
}

/// Where to listen.
#[derive(Args)]
pub(crate) struct At {
    /// Address to listen on; 0.0.0.0 lets other computers in
    #[arg(long, value_name = "ADDRESS", default_value_t = IpAddr::V4(Ipv4Addr::LOCALHOST))]
    host: IpAddr,

    /// Port to listen on; 0 for any free one
    #[arg(long, default_value_t = 8080)]
    port: u16,

    /// Another name by which clients call this server, beside localhost, addresses in numbers and
    /// this computer's own name; may be given several times [default: none]
    #[arg(long, value_name = "NAME")]
    allow_host: Vec<String>,

    /// Let only the server's own pages read, and those of this origin, such as
    /// https://viewer.example; may be given several times [default: all pages may]
    #[arg(long, value_name = "ORIGIN")]
    allow_origin: Vec<String>,
}

impl At {
    pub(crate) fn address(&self) -> SocketAddr {
        SocketAddr::new(self.host, self.port)
    }

    pub(crate) fn options(&self) -> Options {
        let origins = match &*self.allow_origin {
            [] => Origins::Any,
            only => Origins::Only(only.to_vec()),
        };
        Options {
            access: Access {
                hosts: self.allow_host.clone(),
                origins,
            },
            ..Options::DEFAULT
        }
    }
}

/// Between looks for new volumes.
const POLL: Duration = Duration::from_secs(2);

impl Serve {
    pub(crate) async fn run(self) -> Result<()> {
        if let Some(image) = self.place.open_to_serve(&self.catalog).await? {
            self.stitching.refuse(NOT_STITCHED)?;
            let volumes = Volumes::new();
            volumes.publish(image, None);
            let server = Server::bind(self.at.address()).await?;
            tell(&server.url());
            server
                .run(volumes, self.at.options(), interrupted())
                .await?;
            return Ok(());
        }
        let storage = self.place.storage().context("there is no archive")?;
        let location = Place::archive(storage, &self.catalog)?;
        // One ear from the beginning: who is not listening when a signal comes never hears of it.
        let mut interrupted = Box::pin(interrupted());
        let volumes = Volumes::new();
        let prepare = async {
            let archive = waited_for(|| VisualizationArchive::open(&location)).await;
            let archive = archive.map_err(|error| neither(error, &self.catalog))?;
            let server = Server::bind(self.at.address()).await?;
            let options = self.stitching.options(&location).await?;
            let offer = offer_archive(&volumes, &archive, options.clone()).await?;
            if let ([], Some((_, error))) = (&*offer.new, offer.failing.first()) {
                // There is nothing to look at, and somebody who can mend it.
                return Err(error.clone().into());
            }
            if offer.new.is_empty() {
                say("the archive holds no volumes yet; they are offered as they appear");
            }
            anyhow::Ok((archive, server, options))
        };
        let (archive, server, options) = tokio::select! {
            prepared = prepare => prepared?,
            () = &mut interrupted => return Ok(()),
        };
        let disk_cache = options.disk_cache.clone();
        tell(&server.url());
        let follow = follow_archive(&volumes, &archive, options, POLL);
        tokio::select! {
            served = server.run(volumes.clone(), self.at.options(), interrupted) => served?,
            () = follow => {}
        }
        if let Some(cache) = disk_cache {
            cache.close().await;
        }
        Ok(())
    }
}
