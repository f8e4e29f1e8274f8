//! The application on a page.

use std::cell::RefCell;
use std::sync::Arc;

use saccade_source::VolumeSource;
use saccade_source::remote::{RemoteSource, volumes};
use wasm_bindgen::prelude::{JsCast, JsValue, wasm_bindgen};
use web_sys::HtmlCanvasElement;

use crate::acquisition::from_server;
use crate::app::{App, Surroundings};
use crate::page::PageOptions;
use crate::setup::wgpu_options;

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
    run(&canvas_id)
        .await
        .map_err(|message| JsValue::from_str(&message))
}

/// What the picture shows right now, as JSON; empty before the first picture.
#[wasm_bindgen]
pub fn status() -> String {
    STATUS.with_borrow(String::clone)
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

    let name = match page.volume {
        Some(name) => name,
        None => {
            let names = volumes(&origin).await.map_err(|error| in_words(&error))?;
            names
                .into_iter()
                .next()
                .ok_or("The server offers no volumes yet.")?
        }
    };
    let source = RemoteSource::open(&origin, &name)
        .await
        .map_err(|error| in_words(&error))?;
    let acquisition = from_server(source.status_reader());
    // Shared within this thread only: browsers have no other.
    #[expect(
        clippy::arc_with_non_send_sync,
        reason = "sources are shared by Arc natively"
    )]
    let source: Arc<dyn VolumeSource> = Arc::new(source);

    let options = eframe::WebOptions {
        wgpu_options: wgpu_options(),
        dithering: false,
        ..Default::default()
    };
    let surroundings = Surroundings {
        publish: Box::new(|json| STATUS.set(json)),
        lost: Box::new(tell_lost),
        acquisition: Some(acquisition),
    };
    let view = page.view;
    let create = Box::new(move |context: &eframe::CreationContext<'_>| {
        let app = App::new(context, source, view, surroundings)?;
        Ok(Box::new(app) as Box<dyn eframe::App>)
    });
    let runner = eframe::WebRunner::new();
    let started = runner.start(canvas, options, create).await;
    started.map_err(|error| error.as_string().unwrap_or_else(|| format!("{error:?}")))?;
    // The application runs for as long as the page is open.
    std::mem::forget(runner);
    Ok(())
}

fn page_options(search: &str) -> Result<PageOptions, String> {
    let query = search.trim_start_matches('?');
    let parameters =
        web_sys::UrlSearchParams::new_with_str(query).map_err(|error| format!("{error:?}"))?;
    let names = [
        "volume",
        "camera",
        "channels",
        "transfer",
        "mode",
        "clip",
        "slice",
        "background",
        "ui",
    ];
    let pairs = names
        .iter()
        .filter_map(|name| Some(((*name).to_owned(), parameters.get(name)?)));
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
