use std::sync::Arc;

use tokio::sync::watch;

/// Asks long-running work to end soon. Clones share the wish.
///
/// Work that is told to end leaves everything in a state from which it can go on later.
#[derive(Clone, Debug, Default)]
pub struct Cancel(Arc<watch::Sender<bool>>);

impl Cancel {
    /// A wish not yet uttered.
    pub fn new() -> Self {
        Self::default()
    }

    /// Utters it.
    pub fn cancel(&self) {
        self.0.send_replace(true);
    }

    /// Whether it was uttered.
    pub fn is_cancelled(&self) -> bool {
        *self.0.borrow()
    }

    /// Waits until it is uttered.
    pub async fn cancelled(&self) {
        let heard = self
            .0
            .subscribe()
            .wait_for(|cancelled| *cancelled)
            .await
            .is_ok();
        debug_assert!(heard, "the sender lives in `self`");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn every_clone_hears_it() {
        let cancel = Cancel::new();
        let clone = cancel.clone();
        assert!(!clone.is_cancelled());
        let waiting = tokio::spawn(async move { clone.cancelled().await });
        cancel.cancel();
        waiting.await.unwrap();
        assert!(cancel.is_cancelled());
        cancel.cancelled().await;
    }
}
