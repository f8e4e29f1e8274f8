-- What was read, so that other records in the same place are known.

ALTER TABLE cursors ADD COLUMN seen INTEGER; -- as saccade-archive counts it; none: read by an older program
