//! Decoding in web workers: each an instance of this very module, without shared memory. Where no worker can be had, the
//! page itself decodes, in turns with everything else.

use std::cell::{Cell, RefCell};
use std::time::Duration;

use bytes::Bytes;
use js_sys::{Array, Function, Object, Reflect, Uint8Array};
use tokio::sync::oneshot;
use wasm_bindgen::prelude::{Closure, JsCast, JsValue, wasm_bindgen};

use super::Decoding;
use super::pool::{Job, Pool};
use crate::codecs::Damage;
use crate::maybe_send::{sleep, spawn};

/// More workers than this only take memory.
const MOST_WORKERS: usize = 8;
/// Between two looks at whether workers come along.
const LOOK: Duration = Duration::from_secs(15);
/// A worker that finished nothing during so many looks in a row has broken down.
const LOOKS: u32 = 4;

#[wasm_bindgen]
extern "C" {
    type Worker;
    #[wasm_bindgen(constructor, catch)]
    fn new(script: &str, options: &Object) -> Result<Worker, JsValue>;
    #[wasm_bindgen(method, catch, js_name = postMessage)]
    fn post(this: &Worker, message: &JsValue, transfer: &Array) -> Result<(), JsValue>;
    #[wasm_bindgen(method)]
    fn terminate(this: &Worker);
    #[wasm_bindgen(method, setter, js_name = onmessage)]
    fn set_onmessage(this: &Worker, listener: Option<&Function>);
    #[wasm_bindgen(method, setter, js_name = onerror)]
    fn set_onerror(this: &Worker, listener: Option<&Function>);
}

/// What was decoded where.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct Counts {
    /// Workers there are now.
    pub workers: usize,
    /// Chunks that workers decoded, or found damaged.
    pub by_workers: u64,
    /// Chunks that the page itself decoded, as no worker could.
    pub by_the_page: u64,
    /// Chunks that nobody wanted any more before a worker began with them.
    pub dropped: u64,
    /// Workers that broke down, and were replaced.
    pub replaced: u64,
}

thread_local! {
    /// Script of the workers, once they may be started.
    static SCRIPT: RefCell<Option<String>> = const { RefCell::new(None) };
    static CREW: RefCell<Option<Crew>> = const { RefCell::new(None) };
    /// What is counted of crews that are gone, and of what was done without one.
    static COUNTS: Cell<Counts> = const { Cell::new(Counts { workers: 0, by_workers: 0, by_the_page: 0, dropped: 0, replaced: 0 }) };
}

/// Decodes from now on in workers that run the module script `script`, an address. They are started when there is
/// something to decode.
///
/// The script answers the message `[module]`, with the compiled module of this program, by `[]` once it has instantiated it;
/// and each `[number, task, bytes]` by `[number, bytes]` or `[number, words]`, as [`work`] has it, or by `[number]` if it
/// broke down.
pub fn use_workers(script: &str) {
    SCRIPT.set(Some(script.to_owned()));
}

/// What was decoded where so far.
pub fn counts() -> Counts {
    let mut counts = COUNTS.get();
    CREW.with_borrow(|crew| {
        if let Some(crew) = crew {
            counts.workers = crew.hands.len();
            counts.dropped += crew.pool.dropped();
        }
    });
    counts
}

/// A worker's part: decodes a chunk as the task says.
///
/// # Errors
///
/// In words, what is wrong with the chunk.
pub fn work(task: &str, bytes: Vec<u8>) -> Result<Vec<u8>, String> {
    Decoding::from_text(task)?.run(bytes.into()).map(Vec::from)
}

/// Decodes in a worker, or here.
pub(crate) async fn decode(decoding: Decoding, bytes: Bytes) -> Result<Bytes, Damage> {
    if has_crew() {
        let (reply, answer) = oneshot::channel();
        let task = Order {
            task: decoding.to_text()?,
            bytes: bytes.clone(),
            reply,
        };
        with_crew(|crew| crew.pool.submit(task));
        go_on();
        match answer.await {
            Ok(Answer::Done(done)) => return done,
            Ok(Answer::Broke) => {
                return Err("decoding it broke down, twice".to_owned());
            }
            // There are no workers any more.
            Err(_) => {}
        }
    }
    // Other tasks have their turn before.
    sleep(Duration::ZERO).await;
    count(|counts| counts.by_the_page += 1);
    decoding.run(bytes)
}

/// A chunk to be decoded by a worker.
struct Order {
    task: String,
    bytes: Bytes,
    reply: oneshot::Sender<Answer>,
}

enum Answer {
    Done(Result<Bytes, Damage>),
    Broke,
}

impl Job for Order {
    fn is_wanted(&self) -> bool {
        !self.reply.is_closed()
    }
}

/// A worker, and who listens to it.
struct Hand {
    worker: Worker,
    _listeners: [Closure<dyn FnMut(JsValue)>; 2],
    /// Looks since it last finished something.
    idle_looks: u32,
}

impl Drop for Hand {
    fn drop(&mut self) {
        self.worker.set_onmessage(None);
        self.worker.set_onerror(None);
        self.worker.terminate();
    }
}

struct Crew {
    script: String,
    pool: Pool<Order>,
    hands: Vec<Hand>,
    /// Whether somebody looks at how it comes along.
    watched: bool,
}

fn count(change: impl FnOnce(&mut Counts)) {
    let mut counts = COUNTS.get();
    change(&mut counts);
    COUNTS.set(counts);
}

fn with_crew<T>(act: impl FnOnce(&mut Crew) -> T) -> Option<T> {
    CREW.with_borrow_mut(|crew| crew.as_mut().map(act))
}

/// Whether there are workers; starts them with the first call.
fn has_crew() -> bool {
    if CREW.with_borrow(Option::is_some) {
        return true;
    }
    // Taken: if they cannot be started now, they are not tried again with each chunk.
    let Some(script) = SCRIPT.take() else {
        return false;
    };
    let count = processors().saturating_sub(1).clamp(1, MOST_WORKERS);
    let hands: Result<Vec<Hand>, JsValue> = (0..count).map(|n| hand(&script, n)).collect();
    match hands {
        Ok(hands) => {
            CREW.set(Some(Crew {
                script,
                pool: Pool::new(count),
                hands,
                watched: false,
            }));
            true
        }
        Err(error) => {
            log::warn!("no worker can be started, so that the page itself decodes: {error:?}");
            false
        }
    }
}

/// Processors that the browser tells of.
fn processors() -> usize {
    let navigator = Reflect::get(&js_sys::global(), &"navigator".into());
    let count = navigator.and_then(|n| Reflect::get(&n, &"hardwareConcurrency".into()));
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a small whole number"
    )]
    count
        .ok()
        .and_then(|count| count.as_f64())
        .map_or(2, |count| count as usize)
}

/// Starts the worker at a place.
fn hand(script: &str, place: usize) -> Result<Hand, JsValue> {
    let options = Object::new();
    Reflect::set(&options, &"type".into(), &"module".into())?;
    let worker = Worker::new(script, &options)?;
    let heard: Closure<dyn FnMut(JsValue)> = Closure::new(move |event: JsValue| {
        if let Ok(data) = Reflect::get(&event, &"data".into()) {
            take_answer(place, &Array::from(&data));
        }
    });
    let broke: Closure<dyn FnMut(JsValue)> = Closure::new(move |event: JsValue| {
        let words = Reflect::get(&event, &"message".into()).ok();
        let words = words.and_then(|words| words.as_string());
        replace(
            place,
            &words.unwrap_or_else(|| "its script cannot be loaded".to_owned()),
        );
    });
    worker.set_onmessage(Some(heard.as_ref().unchecked_ref()));
    worker.set_onerror(Some(broke.as_ref().unchecked_ref()));
    worker.post(&Array::of1(&wasm_bindgen::module()), &Array::new())?;
    Ok(Hand {
        worker,
        _listeners: [heard, broke],
        idle_looks: 0,
    })
}

/// Gives workers that have less than they can have in hand something to do.
fn go_on() {
    let broken = with_crew(|crew| {
        let mut broken = Vec::new();
        while let Some((place, number, order)) = crew.pool.next() {
            let bytes = Uint8Array::from(&*order.bytes);
            let message = Array::of3(&number.into(), &order.task.as_str().into(), &bytes);
            let posted = crew.hands[place]
                .worker
                .post(&message, &Array::of1(&bytes.buffer()));
            if posted.is_err() && !broken.contains(&place) {
                broken.push(place);
            }
        }
        broken
    });
    for place in broken.into_iter().flatten() {
        replace(place, "it takes no messages");
    }
    watch();
}

/// What a worker says.
fn take_answer(place: usize, answer: &Array) {
    let number = answer.get(0).as_f64();
    let Some(number) = number else {
        with_crew(|crew| crew.pool.works(place));
        return;
    };
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a number that was sent"
    )]
    let number = number as u32;
    let what = answer.get(1);
    let done = match what.dyn_ref::<Uint8Array>() {
        Some(bytes) => Ok(Bytes::from(bytes.to_vec())),
        None => match what.as_string() {
            Some(damage) => Err(damage),
            None => return replace(place, "it broke down at a chunk"),
        },
    };
    let order = with_crew(|crew| {
        crew.hands[place].idle_looks = 0;
        crew.pool.works(place);
        crew.pool.done(place, number)
    });
    if let Some(order) = order.flatten() {
        count(|counts| counts.by_workers += 1);
        // Nobody may wait for it any more.
        let _ = order.reply.send(Answer::Done(done));
    }
    go_on();
}

/// Puts another worker into the place of one that broke down.
fn replace(place: usize, why: &str) {
    log::warn!("a decoding worker is replaced: {why}");
    count(|counts| counts.replaced += 1);
    let gone = CREW.with_borrow_mut(|slot| {
        let crew = slot.as_mut()?;
        if let Some(culprit) = crew.pool.broke(place) {
            let _ = culprit.reply.send(Answer::Broke);
        }
        match hand(&crew.script, place) {
            Ok(new) if !crew.pool.is_hopeless() => {
                let old = std::mem::replace(&mut crew.hands[place], new);
                // Not here: one of its listeners may be what runs.
                spawn(async move { drop(old) });
                None
            }
            _ => slot.take(),
        }
    });
    match gone {
        None => go_on(),
        Some(mut crew) => {
            log::warn!("workers break down before they are ready, so that the page itself decodes");
            count(|counts| counts.dropped += crew.pool.dropped());
            // Whoever waits sees that nobody will answer.
            drop(crew.pool.take_all());
            spawn(async move { drop(crew) });
        }
    }
}

/// Looks now and then, while workers have something in hand, whether they finish anything.
fn watch() {
    let begin = with_crew(|crew| !std::mem::replace(&mut crew.watched, true));
    if begin != Some(true) {
        return;
    }
    spawn(async {
        loop {
            sleep(LOOK).await;
            let stuck = with_crew(|crew| {
                let mut busy = false;
                let mut stuck = Vec::new();
                for (place, hand) in crew.hands.iter_mut().enumerate() {
                    if crew.pool.is_busy(place) {
                        busy = true;
                        hand.idle_looks += 1;
                    }
                    if hand.idle_looks > LOOKS {
                        stuck.push(place);
                    }
                }
                crew.watched = busy;
                busy.then_some(stuck)
            });
            let Some(Some(stuck)) = stuck else { return };
            for place in stuck {
                replace(place, "it finishes nothing");
            }
        }
    });
}
