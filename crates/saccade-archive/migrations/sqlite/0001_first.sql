-- Volumes, tiles and what ingest remembers. Positions are byte offsets of records in the
-- acquisition archive's list: a larger one is newer. Times are milliseconds since 1970.

PRAGMA application_id = 0x53616363; -- "Sacc"

CREATE TABLE volumes (
    id          INTEGER PRIMARY KEY,
    name        TEXT NOT NULL UNIQUE,
    description TEXT NOT NULL,              -- JSON, as saccade-core writes it
    revision    INTEGER NOT NULL DEFAULT 0, -- of the newest change
    tiles       INTEGER NOT NULL DEFAULT 0  -- counting millions of rows would take seconds
) STRICT;

CREATE TABLE tiles (
    id                 INTEGER PRIMARY KEY,
    volume             INTEGER NOT NULL REFERENCES volumes (id),
    name               TEXT NOT NULL,
    section            INTEGER NOT NULL,
    width              INTEGER NOT NULL,
    height             INTEGER NOT NULL,
    a REAL NOT NULL, b REAL NOT NULL, c REAL NOT NULL, d REAL NOT NULL,
    tx REAL NOT NULL, ty REAL NOT NULL,     -- to level-0 voxels from pixels
    pyramid            TEXT NOT NULL,
    revision           INTEGER NOT NULL,    -- of the volume, when the tile last changed
    position           INTEGER NOT NULL,    -- of the record that brought the image
    transform_position INTEGER NOT NULL     -- of the record that brought the transform
) STRICT;

CREATE UNIQUE INDEX tiles_by_name ON tiles (volume, name);
CREATE INDEX tiles_by_section ON tiles (volume, section);

CREATE TABLE changes (
    volume   INTEGER NOT NULL REFERENCES volumes (id),
    revision INTEGER NOT NULL,
    tile     INTEGER NOT NULL,
    section  INTEGER NOT NULL,
    x0 INTEGER NOT NULL, y0 INTEGER NOT NULL, x1 INTEGER NOT NULL, y1 INTEGER NOT NULL,
    reason   TEXT NOT NULL CHECK (reason IN ('tile', 'transform')),
    PRIMARY KEY (volume, revision)
) STRICT, WITHOUT ROWID;

-- Transforms whose tile has not come yet.
CREATE TABLE early_transforms (
    volume   INTEGER NOT NULL REFERENCES volumes (id),
    tile     TEXT NOT NULL,
    a REAL NOT NULL, b REAL NOT NULL, c REAL NOT NULL, d REAL NOT NULL,
    tx REAL NOT NULL, ty REAL NOT NULL,
    position INTEGER NOT NULL,
    PRIMARY KEY (volume, tile)
) STRICT, WITHOUT ROWID;

CREATE TABLE quarantine (
    id     INTEGER PRIMARY KEY,
    volume INTEGER NOT NULL REFERENCES volumes (id),
    file   TEXT NOT NULL,
    tile   TEXT,
    reason TEXT NOT NULL,
    bytes  INTEGER,
    at     INTEGER NOT NULL
) STRICT;

CREATE INDEX quarantine_by_tile ON quarantine (volume, tile);

-- How far the records were read: every record before is in a tile, in quarantine or in `waiting`.
CREATE TABLE cursors (
    volume INTEGER PRIMARY KEY REFERENCES volumes (id),
    byte   INTEGER NOT NULL,
    line   INTEGER NOT NULL
) STRICT;

-- Records whose file is not whole yet.
CREATE TABLE waiting (
    volume   INTEGER NOT NULL REFERENCES volumes (id),
    position INTEGER NOT NULL,
    tile     TEXT NOT NULL,
    record   TEXT NOT NULL,                 -- JSON, as the acquisition archive has it
    reason   TEXT NOT NULL,
    PRIMARY KEY (volume, position)
) STRICT, WITHOUT ROWID;

CREATE INDEX waiting_by_tile ON waiting (volume, tile);

-- Pyramids that no tile names any more; deleted once nobody can still be reading them.
CREATE TABLE retired (
    pyramid TEXT PRIMARY KEY,
    volume  INTEGER NOT NULL REFERENCES volumes (id),
    at      INTEGER NOT NULL
) STRICT, WITHOUT ROWID;
