-- Why a worker does not go on, as long as it does not.

CREATE TABLE held_up (
    volume BIGINT NOT NULL REFERENCES volumes (id),
    worker BIGINT NOT NULL,
    number BIGINT NOT NULL,
    why    TEXT NOT NULL,
    since  BIGINT NOT NULL,
    PRIMARY KEY (volume, worker, number)
);
