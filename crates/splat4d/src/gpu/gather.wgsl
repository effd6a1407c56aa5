// Adds up each splat's records: along every row of tiles from left to right, and the rows from top to bottom, one after the
// other, so that bands of rows add in the order of the whole. Twin of Raster::collect in render/rasterize.rs.
//
// Bindings, group 0: 0 band; 1 counts ([1]: visible splats), 2 order (splats, nearest first), 3 tile_counts and
// 4 first_pairs as tiles.wgsl wrote and read them; 5 records of rasterize_back.wgsl, three vec4 a pair; out: 6 sums, three
// vec4 a splat, by its number; 7 marks, which become 2 where a splat has pairs at all. Seven storage buffers.
// A workgroup owns 256 visible splats; a thread owns a vec4 of the records of a splat, three times over.

struct Band {
    first_row: u32,
    rows: u32,
    across: u32,
    further: u32, // 0: sums are overwritten, else added to
}

const GATHER_SPLATS: u32 = 256u;

@group(0) @binding(0) var<uniform> band: Band;
@group(0) @binding(1) var<storage, read> counts: array<u32>;
@group(0) @binding(2) var<storage, read> order: array<u32>;
@group(0) @binding(3) var<storage, read> tile_counts: array<u32>;
@group(0) @binding(4) var<storage, read> first_pairs: array<u32>;
@group(0) @binding(5) var<storage, read> records: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> sums: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read_write> marks: array<u32>;

@compute @workgroup_size(256)
fn gather(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    for (var round = 0u; round < 3u; round++) {
        let item = round * GATHER_SPLATS + thread;
        let k = group.x * GATHER_SPLATS + item / 3u;
        if (k >= counts[1]) {
            return;
        }
        let splat = order[k];
        let to = 3u * splat + item % 3u;
        let first = first_pairs[k];
        let end = first + tile_counts[k];
        if (end > first && item % 3u == 0u) {
            marks[splat] = 2u;
        }
        var sum = vec4<f32>(0.0);
        if (band.further != 0u) {
            sum = sums[to];
        }
        for (var pair = first; pair < end; pair++) {
            sum += records[3u * pair + item % 3u];
        }
        sums[to] = sum;
    }
}
