//! Reads what microscopes write; keeps tile pyramids and the catalog.
