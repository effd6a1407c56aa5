// A stable sort of (key, value) pairs by eight bits of the key: one pass of a least-significant-digit radix sort.
// Twin of the sort in render/bin.rs, whose order is (depth bits, id): pairs that start in the order of ids and are
// sorted by depth bits in four passes end in just that order.
//
// One pass is three dispatches, in this order, pairs going from keys_in/values_in to keys_out/values_out:
//   histogram   as many workgroups as there are blocks (or more: the rest do nothing)
//   scan        256 workgroups; 1 is enough for up to SORT_FEW blocks
//   scatter     as histogram
// A block is SORT_BLOCK pairs; blocks = ceil(pairs / SORT_BLOCK), at most 65,535. The number of pairs is read from
// sort_count, so that an earlier dispatch decides it; dispatch indirectly, or for the most pairs there can be. Pairs
// beyond the end of keys_in do not exist, whatever sort_count states.
//
// Bindings, group 0; every entry point uses the ones in brackets:
//   0 uniform sort_pass: shift = 0, 8, 16 or 24; count_index = where in sort_count the number of pairs is  [all]
//   1 sort_count                                                                                           [all]
//   2 keys_in, 3 values_in, 4 keys_out, 5 values_out: a u32 a pair            [histogram: 2; scan: 2; scatter: all]
//   6 sort_counts: 256 x (blocks + 1) u32: pairs by digit and block, then by digit; needs no clearing      [all]
// Six storage buffers at most, 3 KiB of workgroup memory, no subgroups.

// Threads of a workgroup, and digits: scan and scatter give each thread a digit, so the two must be equal.
const SORT_THREADS: u32 = 256u;
// Rounds of a workgroup, 256 pairs each: more rounds make fewer counts to scan, and fewer workgroups to run at once.
const SORT_ROUNDS: u32 = 8u;
const SORT_BLOCK: u32 = 2048u; // SORT_THREADS x SORT_ROUNDS
// Side of the square in which a workgroup adds up its 256 numbers.
const SORT_ROW: u32 = 16u;
// Up to this many blocks one thread walks along a digit's counts: fewer steps than a workgroup's sums take.
const SORT_FEW: u32 = 32u;
// 32-bit words that hold a byte for each thread. Bits by digit and thread would need fewer steps, but 8 KiB of
// workgroup memory, which software devices take a second to compile.
const SORT_WORDS: u32 = 64u;

struct SortPass {
    shift: u32,
    count_index: u32,
}

@group(0) @binding(0) var<uniform> sort_pass: SortPass;
@group(0) @binding(1) var<storage, read> sort_count: array<u32>;
@group(0) @binding(2) var<storage, read> keys_in: array<u32>;
@group(0) @binding(3) var<storage, read> values_in: array<u32>;
@group(0) @binding(4) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(5) var<storage, read_write> values_out: array<u32>;
@group(0) @binding(6) var<storage, read_write> sort_counts: array<u32>;

var<workgroup> sort_digits: array<atomic<u32>, 256>;
var<workgroup> sort_sums: array<u32, 256>;
var<workgroup> sort_rows: array<u32, 16>;
var<workgroup> sort_bytes: array<atomic<u32>, 64>; // the threads' digits, SORT_WORDS

fn sort_pairs() -> u32 {
    return min(sort_count[sort_pass.count_index], arrayLength(&keys_in));
}

fn sort_blocks() -> u32 {
    return (sort_pairs() + SORT_BLOCK - 1u) / SORT_BLOCK;
}

fn sort_digit(key: u32) -> u32 {
    return (key >> sort_pass.shift) & 0xffu;
}

// Counts the digits of a block. A workgroup owns a block, a thread every 256th pair of it, then one digit's count.
// Integer counts do not depend on the order of the additions, so the atomics leave the result repeatable.
@compute @workgroup_size(256)
fn histogram(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let pairs = sort_pairs();
    let blocks = sort_blocks();
    let block = group.x;
    atomicStore(&sort_digits[thread], 0u);
    workgroupBarrier();
    for (var round = 0u; round < SORT_ROUNDS; round++) {
        let i = block * SORT_BLOCK + round * SORT_THREADS + thread;
        if (i < pairs) {
            atomicAdd(&sort_digits[sort_digit(keys_in[i])], 1u);
        }
    }
    workgroupBarrier();
    if (block < blocks) {
        sort_counts[thread * blocks + block] = atomicLoad(&sort_digits[thread]);
    }
}

// Exclusive sums over the workgroup's 256 numbers, one per thread; uses sort_sums and sort_rows. Rows of 16 keep it at
// two barriers: software devices pay for each, and on others the few more additions cost nothing.
fn sort_exclusive(thread: u32, value: u32) -> u32 {
    sort_sums[thread] = value;
    workgroupBarrier();
    if (thread < SORT_ROW) {
        var sum = 0u;
        for (var i = 0u; i < SORT_ROW; i++) {
            sum += sort_sums[thread * SORT_ROW + i];
        }
        sort_rows[thread] = sum;
    }
    workgroupBarrier();
    let row = thread / SORT_ROW;
    var before = 0u;
    for (var r = 0u; r < row; r++) {
        before += sort_rows[r];
    }
    for (var i = row * SORT_ROW; i < thread; i++) {
        before += sort_sums[i];
    }
    return before;
}

// Turns a digit's counts by block into exclusive sums, and writes their total. A workgroup owns a digit; where there
// are few blocks, the first workgroup does all of it, a thread a digit.
@compute @workgroup_size(256)
fn scan(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let blocks = sort_blocks();
    if (blocks <= SORT_FEW) {
        if (group.x == 0u) {
            sort_counts[SORT_THREADS * blocks + thread] = sort_run(thread * blocks, thread * blocks + blocks, 0u);
        }
        return;
    }
    let digit = group.x;
    // A thread sums a run of neighbouring blocks, so that one pass over the workgroup is enough for any number.
    let run = (blocks + SORT_THREADS - 1u) / SORT_THREADS;
    let first = min(thread * run, blocks);
    let end = min(first + run, blocks);
    var sum = 0u;
    for (var b = first; b < end; b++) {
        sum += sort_counts[digit * blocks + b];
    }
    let before = sort_exclusive(thread, sum);
    if (thread == SORT_THREADS - 1u) {
        sort_counts[SORT_THREADS * blocks + digit] = before + sum;
    }
    _ = sort_run(digit * blocks + first, digit * blocks + end, before);
}

// Turns counts first to end - 1 into exclusive sums that begin at `start`; answers the sum behind them.
fn sort_run(first: u32, end: u32, start: u32) -> u32 {
    var before = start;
    for (var i = first; i < end; i++) {
        let count = sort_counts[i];
        sort_counts[i] = before;
        before += count;
    }
    return before;
}

// Moves the pairs of a block to their sorted positions. A workgroup owns a block; in each round a thread owns one pair.
@compute @workgroup_size(256)
fn scatter(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let pairs = sort_pairs();
    let blocks = sort_blocks();
    let block = group.x;
    // Index of the next pair of each digit: the digits below, this digit's blocks below, then the rounds below.
    let total = select(0u, sort_counts[SORT_THREADS * blocks + thread], block < blocks);
    var next = sort_exclusive(thread, total);
    if (block < blocks) {
        next += sort_counts[thread * blocks + block];
    }
    workgroupBarrier();
    let word = thread / 4u;
    let byte = 8u * (thread % 4u);
    for (var round = 0u; round < SORT_ROUNDS; round++) {
        let i = block * SORT_BLOCK + round * SORT_THREADS + thread;
        let there = i < pairs;
        var key = 0u;
        var digit = 0u;
        sort_sums[thread] = next;
        atomicStore(&sort_digits[thread], 0u);
        if (thread < SORT_WORDS) {
            atomicStore(&sort_bytes[thread], 0u);
        }
        workgroupBarrier();
        if (there) {
            key = keys_in[i];
            digit = sort_digit(key);
            atomicOr(&sort_bytes[word], digit << byte);
            atomicAdd(&sort_digits[digit], 1u);
        }
        workgroupBarrier();
        if (there) {
            // Pairs of the same digit with a lower thread come first: that keeps the sort stable. All threads below one
            // that is there are there too.
            var rank = countOneBits(sort_equal(atomicLoad(&sort_bytes[word]), digit) & ((1u << byte) - 1u));
            for (var w = 0u; w < word; w++) {
                rank += countOneBits(sort_equal(atomicLoad(&sort_bytes[w]), digit));
            }
            let to = sort_sums[digit] + rank;
            keys_out[to] = key;
            values_out[to] = values_in[i];
        }
        workgroupBarrier();
        next += atomicLoad(&sort_digits[thread]);
    }
}

// The top bit of every byte of `bytes` that equals `digit`.
fn sort_equal(bytes: u32, digit: u32) -> u32 {
    let other = bytes ^ (digit * 0x01010101u);
    return ~(((other & 0x7f7f7f7fu) + 0x7f7f7f7fu) | other | 0x7f7f7f7fu);
}
