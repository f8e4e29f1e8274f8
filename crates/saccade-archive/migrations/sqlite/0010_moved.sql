-- Who has put a tile where it lies: 0 where its records have; else a number of the transform that somebody else gave it; nothing where
-- that is not known.

ALTER TABLE tiles ADD COLUMN moved INTEGER;
