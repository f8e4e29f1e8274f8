-- Which channels a section has is told by the index alone, without a look at any of its tiles.

DROP INDEX tiles_by_section;
CREATE INDEX tiles_by_section ON tiles (volume, section, channel, deleted);
