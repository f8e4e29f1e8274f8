-- Why a worker does not go on, as long as it does not.

CREATE TABLE held_up (
    volume INTEGER NOT NULL REFERENCES volumes (id),
    worker INTEGER NOT NULL,
    number INTEGER NOT NULL,
    why    TEXT NOT NULL,
    since  INTEGER NOT NULL,
    PRIMARY KEY (volume, worker, number)
) STRICT, WITHOUT ROWID;
