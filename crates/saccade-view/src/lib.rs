//! The application: a window on a live volume, native and in the browser.
