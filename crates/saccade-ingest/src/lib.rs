//! Watches an acquisition archive and turns raw tiles into pyramids; simulates a microscope.
