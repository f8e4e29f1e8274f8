//! The pull itself: misses become prioritised requests, chunks become bricks, deliveries stay within a budget.
