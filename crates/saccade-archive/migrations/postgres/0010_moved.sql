-- Whether somebody other than the records has put a tile where it lies: 0 or 1, and nothing where that is not known.

ALTER TABLE tiles ADD COLUMN moved BIGINT;
