//! The part of a web address after the question mark.

use saccade_core::camera::{Camera, ParseCameraError};
use saccade_source::objects::{Location, LocationError};

use crate::detail::details_from_text;
use crate::options::{
    BackgroundError, ViewOptions, background_from_text, gpu_memory_from_text, host_memory_from_text,
};
use crate::plane::{plane_from_text, slice_from_text};
use crate::shown::{
    MOST_CUTS, ShownError, box_from_text, channels_from_text, false_colors_from_text,
    heat_from_text, isos_from_text, mode_from_text, thickness_from_text,
};
use crate::transfer_text::{TransferError, channel_of_text, transfer_from_text};

/// What a page's address asks for.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PageOptions {
    /// Volume to open; the server's first otherwise.
    pub volume: Option<String>,
    /// Address of an image that somebody else wrote, to open instead.
    pub source: Option<String>,
    /// What the application opens with.
    pub view: ViewOptions,
}

/// An address that cannot be followed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PageError {
    /// `camera=`.
    #[error(transparent)]
    Camera(#[from] ParseCameraError),
    /// `background=`.
    #[error(transparent)]
    Background(#[from] BackgroundError),
    /// `channels=`, `detail=`, `mode=`, `iso=`, `clip=`, `slice=`, `slab=`, `cut=`, `heat=`,
    /// `false-colors=`, `gpu-memory=` or `host-memory=`.
    #[error(transparent)]
    Shown(#[from] ShownError),
    /// `source=`.
    #[error(transparent)]
    Source(#[from] LocationError),
    /// `source=` and `volume=`.
    #[error("source= names an image and volume= one of the server's volumes; give one of them")]
    Both,
    /// `transfer=`.
    #[error("nothing can be shown with transfer=")]
    Transfer {
        /// What is wrong with it.
        #[from]
        source: TransferError,
    },
    /// `cut=` too often.
    #[error("{most} planes can cut, and the address has more (cut=)")]
    TooManyCuts {
        /// How many can.
        most: usize,
    },
    /// `ui=`.
    #[error("ui={value} is neither on nor off")]
    Ui {
        /// As given.
        value: String,
    },
}

impl PageOptions {
    /// From names and values, decoded. Names it does not know are left alone.
    ///
    /// # Errors
    ///
    /// [`PageError`] names the part that is wrong.
    pub fn from_pairs(
        pairs: impl IntoIterator<Item = (String, String)>,
    ) -> Result<Self, PageError> {
        let mut page = Self::default();
        for (name, value) in pairs {
            match name.as_str() {
                "volume" => page.volume = Some(value),
                "source" => page.source = Some(value),
                "camera" => page.view.camera = Some(value.parse::<Camera>()?),
                "transfer" => {
                    let (channel, text) = channel_of_text(&value);
                    let transfer = match text {
                        "auto" => None,
                        json => Some(transfer_from_text(json)?),
                    };
                    page.view.transfers.push((channel, transfer));
                }
                "channels" => page.view.channels = Some(channels_from_text(&value)?),
                "mode" => page.view.shown.mode = mode_from_text(&value)?,
                "iso" => page.view.isos = isos_from_text(&value)?,
                "clip" => page.view.shown.within = Some(box_from_text(&value)?),
                "detail" => page.view.details = details_from_text(&value)?,
                "slice" => page.view.shown.slice = Some(slice_from_text(&value)?),
                "slab" => page.view.shown.slab_nm = thickness_from_text(&value)?,
                "cut" => {
                    let fits = page.view.shown.cut(plane_from_text(&value)?);
                    let most = MOST_CUTS;
                    fits.then_some(()).ok_or(PageError::TooManyCuts { most })?;
                }
                "heat" => page.view.shown.heat = Some(heat_from_text(&value)?),
                "false-colors" => page.view.false_colors = false_colors_from_text(&value)?,
                "background" => page.view.background = background_from_text(&value)?,
                "gpu-memory" => page.view.gpu_bytes = gpu_memory_from_text(&value)?,
                "host-memory" => page.view.limits.host_bytes = host_memory_from_text(&value)?,
                "ui" => page.view.ui = on_or_off(value)?,
                _ => {}
            }
        }
        if page.source.is_some() && page.volume.is_some() {
            return Err(PageError::Both);
        }
        Ok(page)
    }

    /// Where the image is that is asked for, if one is. An address that begins with `/` is of the host that the page
    /// is of, whose `origin` is such as `http://localhost:8080`.
    ///
    /// # Errors
    ///
    /// [`PageError::Source`] if that is no address.
    pub fn image(&self, origin: &str) -> Result<Option<Location>, PageError> {
        let Some(source) = &self.source else {
            return Ok(None);
        };
        let source = source.trim();
        let address = match source.strip_prefix('/') {
            Some(path) => format!("{origin}/{path}"),
            None => source.to_owned(),
        };
        Ok(Some(address.parse()?))
    }
}

fn on_or_off(value: String) -> Result<bool, PageError> {
    match value.as_str() {
        "on" => Ok(true),
        "off" => Ok(false),
        _ => Err(PageError::Ui { value }),
    }
}

#[cfg(test)]
mod tests {
    use saccade_core::transfer::Histogram;

    use super::*;
    use crate::plane::Plane;

    fn page(pairs: &[(&str, &str)]) -> Result<PageOptions, PageError> {
        PageOptions::from_pairs(pairs.iter().map(|&(n, v)| (n.to_owned(), v.to_owned())))
    }

    #[test]
    fn an_address_without_wishes_gives_the_defaults() {
        assert_eq!(page(&[]).unwrap(), PageOptions::default());
        assert_eq!(
            page(&[("utm_source", "x")]).unwrap(),
            PageOptions::default()
        );
    }

    #[test]
    fn every_wish_is_heard() {
        let size = glam::DVec3::splat(1000.0);
        let transfer = Histogram::default().transfer_function(size);
        let json = serde_json::to_string(&transfer).unwrap();
        let page = page(&[
            ("volume", "my brain"),
            ("camera", "30,25,1000,1,2,3"),
            ("transfer", &json),
            ("transfer", &format!("2:{json}")),
            ("transfer", "0:auto"),
            ("iso", "0.5,2:0.25"),
            ("false-colors", "level"),
            ("gpu-memory", "64"),
            ("host-memory", "128"),
            ("background", "#ffffff"),
            ("channels", "2,0"),
            ("mode", "surface"),
            ("clip", "0,0,0,9,8,7"),
            ("slice", "x=3"),
            ("slab", "80"),
            ("cut", "0,1,1@4,5,6"),
            ("cut", "z=2"),
            ("heat", "lookups=8"),
            ("detail", "content,2:1-4+1"),
            ("ui", "off"),
        ]);
        let PageOptions { volume, view, .. } = page.unwrap();
        assert_eq!(volume.as_deref(), Some("my brain"));
        assert_eq!(view.camera.unwrap().distance_nm, 1000.0);
        let transfers = [
            (None, Some(transfer.clone())),
            (Some(2), Some(transfer)),
            (Some(0), None),
        ];
        assert_eq!(view.transfers, transfers);
        assert_eq!(view.false_colors, saccade_render::FalseColors::Level);
        assert_eq!(view.isos, [(None, 0.5), (Some(2), 0.25)]);
        assert_eq!(
            (view.gpu_bytes, view.limits.host_bytes),
            (64 << 20, 128 << 20)
        );
        assert_eq!(view.background, [1.0; 3]);
        assert_eq!(view.channels, Some(vec![2, 0]));
        let clip = [glam::DVec3::ZERO, glam::DVec3::new(9.0, 8.0, 7.0)];
        let oblique = Plane {
            normal: glam::DVec3::new(0.0, 1.0, 1.0),
            point: glam::DVec3::new(4.0, 5.0, 6.0),
        };
        assert_eq!(
            view.shown,
            crate::shown::Shown {
                mode: saccade_render::Mode::IsoSurface,
                within: Some(clip),
                slice: Some(Plane::across(0, 3.5)),
                slab_nm: 80.0,
                cuts: [Some(oblique), Some(Plane::across(2, 2.0)), None, None],
                heat: Some(saccade_render::Heat {
                    of: saccade_render::Work::Lookups,
                    full: 8.0,
                }),
            }
        );
        assert_eq!(view.details[0], (None, saccade_stream::Detail::ByContent));
        let bounded = saccade_stream::Detail::Chosen {
            levels: 1..=4,
            coarser: 1,
        };
        assert_eq!(view.details[1..], [(Some(2), bounded)]);
        assert!(!view.ui);
    }

    #[test]
    fn images_are_named_by_addresses() {
        let image = |source: &str| {
            let page = page(&[("source", source)]).unwrap();
            page.image("http://localhost:8080")
        };
        for (source, place) in [
            ("https://host/a/b.zarr", "https://host/a/b.zarr"),
            ("/v/em/zarr", "http://localhost:8080/v/em/zarr"),
            (
                "precomputed://gs://bucket/em",
                "https://storage.googleapis.com/bucket/em",
            ),
        ] {
            let got = image(source).unwrap().unwrap();
            assert_eq!(got.to_string(), place);
        }
        assert!(matches!(
            image("ftp://host/b.zarr"),
            Err(PageError::Source(_))
        ));
        assert_eq!(page(&[]).unwrap().image("http://h").unwrap(), None);
        let both = page(&[("source", "/a"), ("volume", "b")]);
        assert!(matches!(both, Err(PageError::Both)));
    }

    #[test]
    fn nonsense_is_named() {
        for (name, value) in [
            ("camera", "1,2"),
            ("transfer", "{}"),
            ("transfer", "1:file.json"),
            ("iso", "0:2"),
            ("false-colors", "many"),
            ("gpu-memory", "much"),
            ("host-memory", "2"),
            ("background", "sky"),
            ("channels", "red"),
            ("mode", "dreamy"),
            ("clip", "1,2"),
            ("slice", "40"),
            ("slab", "thick"),
            ("cut", "w=4"),
            ("heat", "fire"),
            ("detail", "nice"),
            ("detail", "0:4-1"),
            ("ui", "maybe"),
        ] {
            let error = page(&[(name, value)]).unwrap_err().to_string();
            let named = match name {
                "slice" | "cut" => "plane",
                "slab" => "thickness",
                "iso" => "surface",
                "false-colors" => "false colours",
                "gpu-memory" => "GPU memory",
                "host-memory" => "main memory",
                "heat" => "work of rays",
                name => name,
            };
            assert!(error.contains(named), "{error}");
        }
        let cuts = [("cut", "x=1"); 5];
        let error = page(&cuts).unwrap_err().to_string();
        assert!(error.contains("4 planes"), "{error}");
    }
}
