// Counts what rays did, ray by ray: where a processor draws, few rays are drawn at once, and to wait for the others of a
// workgroup costs more than counting.

fn add_to(counter: u32, count: u32) {
    if count > 0u {
        let before = atomicAdd(&report[counter], count);
        if counter == COUNT_SAMPLES && carry_of(before, count) > 0u {
            atomicAdd(&report[COUNT_SAMPLES_HIGH], 1u);
        }
    }
}

fn raise(counter: u32, value: u32) {
    // Few rays are above all before them; reading is cheaper than writing.
    if value > atomicLoad(&report[counter]) {
        atomicMax(&report[counter], value);
    }
}

fn hand_over(local: u32) {}
