//! Makes the browser bundle.
fn main() {}
