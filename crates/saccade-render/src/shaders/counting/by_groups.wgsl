// Counts what rays did, the rays of a workgroup together: many rays at once would wait for the one counter.

var<workgroup> tallies: array<atomic<u32>, TALLIES>;

fn add_to(counter: u32, count: u32) {
    atomicAdd(&tallies[counter], count);
}

fn raise(counter: u32, value: u32) {
    atomicMax(&tallies[counter], value);
}

// Called by all rays of a group, when all are done.
fn hand_over(local: u32) {
    workgroupBarrier();
    if local == 0u {
        // What one group takes fits one word, what a large picture takes may not.
        let taken = atomicLoad(&tallies[COUNT_SAMPLES]);
        let before = atomicAdd(&report[COUNT_SAMPLES], taken);
        if carry_of(before, taken) > 0u {
            atomicAdd(&report[COUNT_SAMPLES_HIGH], 1u);
        }
        atomicAdd(&report[COUNT_LOOKUPS], atomicLoad(&tallies[COUNT_LOOKUPS]));
        atomicAdd(&report[COUNT_NODES], atomicLoad(&tallies[COUNT_NODES]));
        atomicAdd(&report[COUNT_SUBSTITUTED], atomicLoad(&tallies[COUNT_SUBSTITUTED]));
        atomicMax(&report[MOST_SUBSTITUTED_LEVELS], atomicLoad(&tallies[MOST_SUBSTITUTED_LEVELS]));
        atomicMax(&report[FINEST_LEVEL], atomicLoad(&tallies[FINEST_LEVEL]));
        atomicAdd(&report[COUNT_RAYS], atomicLoad(&tallies[COUNT_RAYS]));
        atomicMax(&report[MOST_LOOKUPS], atomicLoad(&tallies[MOST_LOOKUPS]));
        atomicMax(&report[FEWEST_LOOKUPS], atomicLoad(&tallies[FEWEST_LOOKUPS]));
    }
}
