-- What was read, so that other records in the same place are known.

ALTER TABLE cursors ADD COLUMN seen BIGINT;
