// Exclusive sums of u32, and what follows from their total: how many workgroups later dispatches need. Twin of the
// running sums in render/bin.rs. Sums stop at 2^32 - 1 instead of wrapping: a reader of the total sees that it is too
// many.
//
// Three dispatches: block_sums (a workgroup a block of 2,048), total (one workgroup), offsets (as block_sums).
// Bindings, group 0: 0 scan_pass; 1 counts: numbers of things, [count_index] is read and [total_index] written; of
// steps on tables that stay, [3] stops them all (frame.rs, `count`): 1 + the view that had more things than there is
// room for, [4]; 2 scan_in, 3 scan_out: one a thing; 4 scan_sums: one per block; 5 arguments of indirect dispatches:
// two triples are written from arguments_at on, one thread a thing and 2,048 things a workgroup. Five storage buffers.
// A thread owns eight neighbouring numbers; in `total`, a run of neighbouring blocks.

const SCAN_THREADS: u32 = 256u;
const SCAN_RUN: u32 = 8u;
const SCAN_BLOCK: u32 = 2048u; // SCAN_THREADS x SCAN_RUN
const STOP: u32 = 3u;
const WANTED: u32 = 4u;

struct ScanPass {
    count_index: u32,
    total_index: u32,
    arguments_at: u32,
    capacity: u32, // more things than this are not dispatched at all: the total states that they were too many
    view: u32,     // 1 + the view of a step that stops then, as all that follow it; 0: of no step
    unused_0: u32,
    unused_1: u32,
    unused_2: u32,
}

@group(0) @binding(0) var<uniform> scan_pass: ScanPass;
@group(0) @binding(1) var<storage, read_write> counts: array<u32>;
@group(0) @binding(2) var<storage, read> scan_in: array<u32>;
@group(0) @binding(3) var<storage, read_write> scan_out: array<u32>;
@group(0) @binding(4) var<storage, read_write> scan_sums: array<u32>;
@group(0) @binding(5) var<storage, read_write> arguments: array<u32>;

var<workgroup> scan_shared: array<u32, 256>;

// a + b, at most 2^32 - 1.
fn plus(a: u32, b: u32) -> u32 {
    let sum = a + b;
    return select(sum, 0xffffffffu, sum < a);
}

// The sum of the values of all threads below this one; leaves the sums with their own in scan_shared.
fn scan_exclusive(thread: u32, value: u32) -> u32 {
    scan_shared[thread] = value;
    workgroupBarrier();
    for (var step = 1u; step < SCAN_THREADS; step *= 2u) {
        var below = 0u;
        if (thread >= step) {
            below = scan_shared[thread - step];
        }
        workgroupBarrier();
        scan_shared[thread] = plus(scan_shared[thread], below);
        workgroupBarrier();
    }
    if (thread == 0u) {
        return 0u;
    }
    return scan_shared[thread - 1u];
}

fn run_sum(first: u32, count: u32) -> u32 {
    var sum = 0u;
    for (var i = first; i < min(first + SCAN_RUN, count); i++) {
        sum = plus(sum, scan_in[i]);
    }
    return sum;
}

@compute @workgroup_size(256)
fn block_sums(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let count = counts[scan_pass.count_index];
    let first = group.x * SCAN_BLOCK + thread * SCAN_RUN;
    let before = scan_exclusive(thread, run_sum(first, count));
    if (thread == SCAN_THREADS - 1u && group.x * SCAN_BLOCK < count) {
        scan_sums[group.x] = scan_shared[thread];
    }
}

@compute @workgroup_size(256)
fn total(@builtin(local_invocation_index) thread: u32) {
    let count = counts[scan_pass.count_index];
    let blocks = (count + SCAN_BLOCK - 1u) / SCAN_BLOCK;
    let run = (blocks + SCAN_THREADS - 1u) / SCAN_THREADS;
    let first = min(thread * run, blocks);
    let end = min(first + run, blocks);
    var sum = 0u;
    for (var b = first; b < end; b++) {
        sum = plus(sum, scan_sums[b]);
    }
    var before = scan_exclusive(thread, sum);
    for (var b = first; b < end; b++) {
        let own = scan_sums[b];
        scan_sums[b] = before;
        before = plus(before, own);
    }
    if (thread == SCAN_THREADS - 1u) {
        counts[scan_pass.total_index] = before;
        let over = before > scan_pass.capacity;
        if (over && scan_pass.view > 0u && counts[STOP] == 0u) {
            counts[STOP] = scan_pass.view;
            counts[WANTED] = before;
        }
        let things = select(before, 0u, over || (scan_pass.view > 0u && counts[STOP] > 0u));
        let at = scan_pass.arguments_at;
        arguments[at] = (things + SCAN_THREADS - 1u) / SCAN_THREADS;
        arguments[at + 1u] = 1u;
        arguments[at + 2u] = 1u;
        arguments[at + 3u] = (things + SCAN_BLOCK - 1u) / SCAN_BLOCK;
        arguments[at + 4u] = 1u;
        arguments[at + 5u] = 1u;
    }
}

@compute @workgroup_size(256)
fn offsets(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let count = counts[scan_pass.count_index];
    let first = group.x * SCAN_BLOCK + thread * SCAN_RUN;
    var before = scan_exclusive(thread, run_sum(first, count));
    before = plus(before, scan_sums[group.x]);
    for (var i = first; i < min(first + SCAN_RUN, count); i++) {
        scan_out[i] = before;
        before = plus(before, scan_in[i]);
    }
}
