-- A death counts for the records that were in hand, and workers that are gone for good are known at once.

ALTER TABLE waiting ADD COLUMN begun BIGINT NOT NULL DEFAULT 0;
ALTER TABLE workers ADD COLUMN process TEXT NOT NULL DEFAULT '';
