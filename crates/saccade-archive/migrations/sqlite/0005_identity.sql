-- What tells the archive from every other: the catalog and the storage have the same.

CREATE TABLE archive (
    part     INTEGER PRIMARY KEY CHECK (part = 1), -- one row
    identity TEXT NOT NULL
) STRICT;
