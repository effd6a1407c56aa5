// Where each tile's pairs begin and end in the sorted list. Twin of `starts` in render/bin.rs.
//
// Bindings, group 0: 0 counts ([2]: pairs); 1 keys, ascending; 2 ranges: three u32 per tile, first, one past the last
// and (written by rasterize.wgsl) one past the last of use, cleared to 0 before. Keys past the last tile have no list.
// Three storage buffers. A thread owns every 256th of a workgroup's 2,048 pairs.

const RANGES_THREADS: u32 = 256u;
const RANGES_ROUNDS: u32 = 8u;

@group(0) @binding(0) var<storage, read> counts: array<u32>;
@group(0) @binding(1) var<storage, read> keys: array<u32>;
@group(0) @binding(2) var<storage, read_write> ranges: array<u32>;

@compute @workgroup_size(256)
fn ranges_of(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let pairs = min(counts[2], arrayLength(&keys));
    for (var round = 0u; round < RANGES_ROUNDS; round++) {
        let i = (group.x * RANGES_ROUNDS + round) * RANGES_THREADS + thread;
        if (i >= pairs) {
            return;
        }
        let tile = keys[i];
        if (3u * tile + 2u >= arrayLength(&ranges)) {
            return;
        }
        if (i == 0u || keys[max(i, 1u) - 1u] != tile) {
            ranges[3u * tile] = i;
        }
        if (i + 1u == pairs || keys[min(i + 1u, pairs - 1u)] != tile) {
            ranges[3u * tile + 1u] = i + 1u;
        }
    }
}
