//! Volumes over HTTP: chunks, metadata, change events and the browser application.
