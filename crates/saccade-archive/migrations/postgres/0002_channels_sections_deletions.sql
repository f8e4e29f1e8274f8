-- Channels, sections counted, tiles deleted.

ALTER TABLE tiles ADD COLUMN channel BIGINT NOT NULL DEFAULT 0;
ALTER TABLE tiles ADD COLUMN deleted BIGINT NOT NULL DEFAULT 0;

CREATE TABLE sections (
    volume  BIGINT NOT NULL REFERENCES volumes (id),
    section BIGINT NOT NULL,
    tiles   BIGINT NOT NULL,
    PRIMARY KEY (volume, section)
);

INSERT INTO sections (volume, section, tiles)
    SELECT volume, section, count(*) FROM tiles GROUP BY volume, section;

ALTER TABLE changes DROP CONSTRAINT changes_reason_check;
ALTER TABLE changes ADD CONSTRAINT changes_reason_check
    CHECK (reason IN ('tile', 'transform', 'deleted'));
