//! Work that takes a processor's time, on threads for that: as many as there are processors.

use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};

use tokio::sync::oneshot;

/// Does it there, unless nobody waits for it any more when its turn comes. A panic is a bug; it goes to whoever
/// waits, instead of ending the process.
pub(crate) async fn on_a_processor<T: Send + 'static>(
    work: impl FnOnce() -> T + Send + 'static,
) -> T {
    let (send, receive) = oneshot::channel();
    rayon::spawn(move || {
        if !send.is_closed() {
            let done = catch_unwind(AssertUnwindSafe(work));
            let _ = send.send(done);
        }
    });
    match receive
        .await
        .expect("the sender sends while the receiver is there")
    {
        Ok(done) => done,
        Err(panic) => resume_unwind(panic),
    }
}
