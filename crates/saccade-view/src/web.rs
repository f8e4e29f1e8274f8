//! The application on a page.

use std::cell::RefCell;
use std::sync::Arc;

use futures::StreamExt as _;
use futures::channel::mpsc;
use saccade_source::objects::Location;
use saccade_source::remote::{RemoteSource, volumes};
use saccade_source::{VolumeSource, images, workers};
use wasm_bindgen::prelude::{JsCast, JsValue, wasm_bindgen};
use web_sys::HtmlCanvasElement;

use crate::acquisition::{AcquisitionReader, from_server};
use crate::app::Surroundings;
use crate::handover::Handover;
use crate::options::AskedWith;
use crate::page::PageOptions;
use crate::setup::wgpu_options;

/// Script of workers that decode, beside the page.
const DECODER: &str = "decoder.js";

thread_local! {
    static STATUS: RefCell<String> = const { RefCell::new(String::new()) };
}

/// Starts the application on a canvas, as the page's address asks.
///
/// # Errors
///
/// Text for people: no such canvas or volume, an address that makes no sense, no WebGPU.
#[wasm_bindgen]
pub async fn start(canvas_id: String) -> Result<(), JsValue> {
    console_error_panic_hook::set_once();
    eframe::WebLogger::init(log::LevelFilter::Warn).ok();
    workers::use_workers(DECODER);
    run(&canvas_id)
        .await
        .map_err(|message| JsValue::from_str(&message))
}

/// What the picture shows right now, as JSON; empty before the first picture.
#[wasm_bindgen]
pub fn status() -> String {
    STATUS.with_borrow(String::clone)
}

/// What was decoded where, as JSON: see [`workers::Counts`].
#[wasm_bindgen]
pub fn decoders() -> String {
    serde_json::to_string(&workers::counts()).unwrap_or_default()
}

/// Makes this instance a worker's: what goes wrong is said on the console.
#[wasm_bindgen]
pub fn prepare_decoder() {
    console_error_panic_hook::set_once();
    eframe::WebLogger::init(log::LevelFilter::Warn).ok();
}

/// A worker's part: decodes a chunk.
///
/// # Errors
///
/// A string: what is wrong with the chunk.
#[wasm_bindgen]
pub fn decode(task: &str, bytes: Vec<u8>) -> Result<Vec<u8>, JsValue> {
    workers::work(task, bytes).map_err(|damage| JsValue::from_str(&damage))
}

async fn run(canvas_id: &str) -> Result<(), String> {
    let window = web_sys::window().ok_or("this is no page")?;
    let location = window.location();
    let text = |value: Result<String, JsValue>| value.map_err(|error| format!("{error:?}"));
    let origin = text(location.origin())?;
    let page = page_options(&text(location.search())?)?;
    let canvas = window
        .document()
        .and_then(|document| document.get_element_by_id(canvas_id))
        .and_then(|element| element.dyn_into::<HtmlCanvasElement>().ok())
        .ok_or_else(|| format!("the page has no canvas {canvas_id:?}"))?;

    let opened = match page.image(&origin).map_err(|error| in_words(&error))? {
        Some(image) => open_image(&image).await?,
        None => open_volume(&origin, page.volume).await?,
    };
    let there = page.view.check(opened.source.volume());
    there.map_err(|error| format!("The page's address asks for what is not there: {error}."))?;
    let mut notes = opened.notes;
    notes.extend(
        page.view
            .without_effect(opened.source.volume(), AskedWith::Address),
    );

    let (tell, losses) = mpsc::unbounded();
    let surroundings = Surroundings {
        publish: Box::new(|json| STATUS.set(json)),
        lost: Box::new(move |_, may_revive| {
            // Somebody listens for as long as the page is open.
            let _ = tell.unbounded_send(may_revive);
        }),
        acquisition: opened.acquisition,
        notes,
        open: Some(Box::new(go_to_image)),
    };
    let drawn = Drawn {
        canvas,
        runner: eframe::WebRunner::new(),
        handover: Handover::new(opened.source, page.view, surroundings),
    };
    drawn.start().await?;
    // The application runs for as long as the page is open.
    wasm_bindgen_futures::spawn_local(drawn.revive(losses));
    Ok(())
}

/// The application on its canvas.
struct Drawn {
    canvas: HtmlCanvasElement,
    runner: eframe::WebRunner,
    handover: Handover,
}

impl Drawn {
    /// Draws with a new device, instead of the last one if there was one.
    async fn start(&self) -> Result<(), String> {
        let options = eframe::WebOptions {
            wgpu_options: wgpu_options(),
            dithering: false,
            ..Default::default()
        };
        let handover = self.handover.clone();
        let create = Box::new(move |context: &eframe::CreationContext<'_>| {
            Ok(Box::new(handover.window(context)?) as Box<dyn eframe::App>)
        });
        let started = self.runner.start(self.canvas.clone(), options, create);
        let started = started.await;
        started.map_err(|error| error.as_string().unwrap_or_else(|| format!("{error:?}")))
    }

    /// Replaces devices that are lost, and says where that does not help.
    async fn revive(self, mut losses: mpsc::UnboundedReceiver<bool>) {
        while let Some(may_revive) = losses.next().await {
            if !may_revive {
                return tell_lost();
            }
            log::info!("the GPU was lost; going on with a new device");
            if let Err(error) = self.start().await {
                log::error!("no other device: {error}");
                return tell_lost();
            }
        }
    }
}

/// What the page shows.
struct Opened {
    source: Arc<dyn VolumeSource>,
    acquisition: Option<AcquisitionReader>,
    /// What the user should know of it.
    notes: Vec<String>,
}

/// An image that somebody else wrote, read by this page itself.
async fn open_image(location: &Location) -> Result<Opened, String> {
    let image = images::open(location).await;
    let image =
        image.map_err(|error| format!("The image cannot be opened: {}", in_words(&error)))?;
    Ok(Opened {
        source: image.source,
        acquisition: None,
        notes: image.notes,
    })
}

/// A volume of the server that the page is of; its first if none is named.
async fn open_volume(origin: &str, name: Option<String>) -> Result<Opened, String> {
    let name = match name {
        Some(name) => name,
        None => {
            let names = volumes(origin).await.map_err(|error| in_words(&error))?;
            let first = names.into_iter().next();
            first.ok_or("The server offers no volumes yet.")?
        }
    };
    let source = RemoteSource::open(origin, &name).await;
    let source = source.map_err(|error| in_words(&error))?;
    let acquisition = from_server(source.status_reader());
    // Shared within this thread only: browsers have no other.
    #[expect(
        clippy::arc_with_non_send_sync,
        reason = "sources are shared by Arc natively"
    )]
    let source: Arc<dyn VolumeSource> = Arc::new(source);
    Ok(Opened {
        source,
        acquisition: Some(acquisition),
        notes: Vec::new(),
    })
}

/// Opens the page anew, on an image.
fn go_to_image(address: &str) {
    let source = js_sys::encode_uri_component(address.trim());
    let moved =
        web_sys::window().map(|window| window.location().set_search(&format!("source={source}")));
    if !matches!(moved, Some(Ok(()))) {
        log::error!("the page cannot be sent to {address}");
    }
}

fn page_options(search: &str) -> Result<PageOptions, String> {
    let query = search.trim_start_matches('?');
    let parameters =
        web_sys::UrlSearchParams::new_with_str(query).map_err(|error| format!("{error:?}"))?;
    // Each is an array of a name and a value; some names come several times.
    let pairs = js_sys::try_iter(&parameters).ok().flatten();
    let pairs = { pairs.into_iter().flatten() }.filter_map(|pair| {
        let pair = js_sys::Array::from(&pair.ok()?);
        Some((pair.get(0).as_string()?, pair.get(1).as_string()?))
    });
    PageOptions::from_pairs(pairs).map_err(|error| in_words(&error))
}

/// The page shows the message; see `index.html`.
fn tell_lost() {
    let function = js_sys::Reflect::get(&js_sys::global(), &"saccadeLost".into());
    let function = function.and_then(|f| f.dyn_into::<js_sys::Function>());
    if function.and_then(|f| f.call0(&JsValue::NULL)).is_err() {
        log::error!("the GPU was lost");
    }
}

/// An error with its sources, on one line.
fn in_words(error: &dyn std::error::Error) -> String {
    let mut words = error.to_string();
    let mut source = error.source();
    while let Some(cause) = source {
        words.push_str(": ");
        words.push_str(&cause.to_string());
        source = cause.source();
    }
    words
}
