-- Where a record is that was set aside since its image did not come: should it come, it is taken in.

ALTER TABLE quarantine ADD COLUMN awaited BIGINT;
