// The last dispatch of a pass of sort.wgsl on devices with subgroups of 8 to 64 threads, a power of two: the same pairs
// go to the same positions. sort.wgsl, whose bindings these are, is put in front of this file. 11 KiB of workgroup
// memory.
//
// Threads of a subgroup vote on the bits of their digits, so that each gets its peers of the same digit; those below it
// are its rank. How many peers each subgroup has is kept a byte a digit, and a thread a digit adds up the subgroups in
// their order.

// Of 8 threads each; a byte each for 256 digits.
const SORT_SUBGROUPS: u32 = 32u;
const SORT_VOTE_WORDS: u32 = 2048u; // SORT_SUBGROUPS x 64

// By subgroup and digit: pairs of the round, then those of the subgroups below.
var<workgroup> sort_votes: array<atomic<u32>, SORT_VOTE_WORDS>;

// The threads of the subgroup whose digit is this one's; those without a pair have no peers.
fn sort_peers(digit: u32, there: bool) -> vec4<u32> {
    var peers = subgroupBallot(there);
    for (var bit = 0u; bit < 8u; bit++) {
        let one = ((digit >> bit) & 1u) != 0u;
        let votes = subgroupBallot(one);
        peers &= select(~votes, votes, one);
    }
    return peers;
}

@compute @workgroup_size(256)
fn scatter_subgroup(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) index: u32,
    @builtin(subgroup_id) subgroup: u32,
    @builtin(subgroup_size) size: u32,
    @builtin(subgroup_invocation_id) lane: u32,
) {
    let pairs = sort_pairs();
    let blocks = sort_blocks();
    let block = group.x;
    // The order of pairs within a round is that of subgroups and of their threads, whatever the device calls them.
    let thread = subgroup * size + lane;
    let subgroups = SORT_THREADS / size;
    let total = select(0u, sort_counts[SORT_THREADS * blocks + index], block < blocks);
    var next = sort_exclusive(index, total);
    if (block < blocks) {
        next += sort_counts[index * blocks + block];
    }
    // Threads below this one, of 64 at most.
    let below = vec2<u32>((1u << min(lane, 31u)) - 1u, (1u << (max(lane, 32u) - 32u)) - 1u);
    let under = vec2<u32>(select(below.x, 0xffffffffu, lane >= 32u), below.y);
    for (var round = 0u; round < SORT_ROUNDS; round++) {
        workgroupBarrier();
        sort_sums[index] = next;
        for (var s = 0u; s < subgroups; s += 4u) {
            // 64 words a subgroup: four subgroups at a time.
            if (s + index / 64u < subgroups) {
                atomicStore(&sort_votes[(s + index / 64u) * 64u + index % 64u], 0u);
            }
        }
        let i = block * SORT_BLOCK + round * SORT_THREADS + thread;
        let there = i < pairs;
        var key = 0u;
        if (there) {
            key = keys_in[i];
        }
        let digit = sort_digit(key);
        let peers = sort_peers(digit, there);
        let ranks = countOneBits(peers.xy & under);
        let rank = ranks.x + ranks.y;
        workgroupBarrier();
        // The first of the peers writes their number: at most 64, so that bytes hold it.
        if (there && rank == 0u) {
            let all = countOneBits(peers.xy);
            atomicOr(&sort_votes[subgroup * 64u + digit / 4u], (all.x + all.y) << (8u * (digit % 4u)));
        }
        workgroupBarrier();
        // A thread a word: four digits, added up over the subgroups below, of which fewer than 256 pairs are, and in
        // all.
        if (index < 64u) {
            var sum = 0u;
            for (var s = 0u; s < subgroups; s++) {
                let own = atomicLoad(&sort_votes[s * 64u + index]);
                atomicStore(&sort_votes[s * 64u + index], sum);
                if (s + 1u == subgroups) {
                    for (var k = 0u; k < 4u; k++) {
                        let all = ((sum >> (8u * k)) & 0xffu) + ((own >> (8u * k)) & 0xffu);
                        atomicStore(&sort_digits[4u * index + k], all);
                    }
                }
                sum += own;
            }
        }
        workgroupBarrier();
        if (there) {
            let before = (atomicLoad(&sort_votes[subgroup * 64u + digit / 4u]) >> (8u * (digit % 4u))) & 0xffu;
            let to = sort_sums[digit] + before + rank;
            keys_out[to] = key;
            values_out[to] = values_in[i];
        }
        next += atomicLoad(&sort_digits[index]);
    }
}
