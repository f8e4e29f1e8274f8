-- What tells the archive from every other: the catalog and the storage have the same.

CREATE TABLE archive (
    part     BIGINT PRIMARY KEY CHECK (part = 1),
    identity TEXT NOT NULL
);
