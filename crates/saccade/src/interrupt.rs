//! Ctrl-C, and what else ends programs politely.

use saccade_ingest::Cancel;

/// How a program ends that was to do something to its end, and was interrupted.
pub(crate) const INTERRUPTED: u8 = 130;

/// Returns when the user wants the program to end.
pub(crate) async fn interrupted() {
    tokio::select! {
        () = ctrl_c() => {}
        () = terminated() => {}
    }
}

/// A wish to end that the user's interrupt utters. A second interrupt ends the program at once.
pub(crate) fn cancel_when_interrupted() -> Cancel {
    let cancel = Cancel::new();
    let uttered = cancel.clone();
    tokio::spawn(async move {
        interrupted().await;
        uttered.cancel();
        interrupted().await;
        std::process::exit(INTERRUPTED.into());
    });
    cancel
}

async fn ctrl_c() {
    if let Err(error) = tokio::signal::ctrl_c().await {
        log::debug!("interrupts are not heard: {error}");
        std::future::pending::<()>().await;
    }
}

#[cfg(unix)]
async fn terminated() {
    use tokio::signal::unix::{SignalKind, signal};
    match signal(SignalKind::terminate()) {
        Ok(mut signal) => drop(signal.recv().await),
        Err(error) => {
            log::debug!("requests to end are not heard: {error}");
            std::future::pending::<()>().await;
        }
    }
}

#[cfg(not(unix))]
async fn terminated() {
    std::future::pending::<()>().await;
}
