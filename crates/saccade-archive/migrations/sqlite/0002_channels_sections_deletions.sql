-- Channels, sections counted, tiles deleted.

ALTER TABLE tiles ADD COLUMN channel INTEGER NOT NULL DEFAULT 0;

-- A deleted tile stays as a row, so that its id is never another's: `position` is then that of the
-- record that deleted it, and what lies before it brings nothing back.
ALTER TABLE tiles ADD COLUMN deleted INTEGER NOT NULL DEFAULT 0;

-- Sections that have a tile. Found in the tiles' index, twenty thousand of them cost as many reads.
CREATE TABLE sections (
    volume  INTEGER NOT NULL REFERENCES volumes (id),
    section INTEGER NOT NULL,
    tiles   INTEGER NOT NULL,
    PRIMARY KEY (volume, section)
) STRICT, WITHOUT ROWID;

INSERT INTO sections (volume, section, tiles)
    SELECT volume, section, count(*) FROM tiles GROUP BY volume, section;

-- One more reason; a check can only be changed with its table.
CREATE TABLE new_changes (
    volume   INTEGER NOT NULL REFERENCES volumes (id),
    revision INTEGER NOT NULL,
    tile     INTEGER NOT NULL,
    section  INTEGER NOT NULL,
    x0 INTEGER NOT NULL, y0 INTEGER NOT NULL, x1 INTEGER NOT NULL, y1 INTEGER NOT NULL,
    reason   TEXT NOT NULL CHECK (reason IN ('tile', 'transform', 'deleted')),
    PRIMARY KEY (volume, revision)
) STRICT, WITHOUT ROWID;

INSERT INTO new_changes (volume, revision, tile, section, x0, y0, x1, y1, reason)
    SELECT volume, revision, tile, section, x0, y0, x1, y1, reason FROM changes;
DROP TABLE changes;
ALTER TABLE new_changes RENAME TO changes;
