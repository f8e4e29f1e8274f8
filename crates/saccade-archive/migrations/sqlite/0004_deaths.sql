-- A death counts for the records that were in hand, and workers that are gone for good are known at once.

ALTER TABLE waiting ADD COLUMN begun INTEGER NOT NULL DEFAULT 0; -- whether its worker works on it now
ALTER TABLE workers ADD COLUMN process TEXT NOT NULL DEFAULT ''; -- tells a process from all others, or nothing
