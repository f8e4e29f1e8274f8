-- Several workers share the records of a volume.

CREATE TABLE workers (
    id    INTEGER PRIMARY KEY AUTOINCREMENT, -- never another's
    name  TEXT NOT NULL,
    lease INTEGER NOT NULL                 -- until when its claims hold without a sign of life
) STRICT;

-- `waiting` is the queue: what is to be worked on, and with `parked` what waits for its file.
ALTER TABLE waiting ADD COLUMN worker INTEGER;                      -- who has claimed it
ALTER TABLE waiting ADD COLUMN attempts INTEGER NOT NULL DEFAULT 0; -- claims since it did no harm
ALTER TABLE waiting ADD COLUMN parked INTEGER NOT NULL DEFAULT 1;
