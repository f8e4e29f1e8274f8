//! Who encrypts connections.

use std::sync::Once;

/// Makes ring this process's provider of cryptography, unless it has one: whoever opens connections
/// calls this first, since clients without a provider panic.
pub fn provide() {
    static PROVIDE: Once = Once::new();
    PROVIDE.call_once(|| {
        // Fails only if there is one already, which serves as well.
        let _ = rustls::crypto::ring::default_provider().install_default();
    });
}
