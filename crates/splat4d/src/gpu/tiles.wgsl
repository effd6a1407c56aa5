// Which 16 x 16 tiles each splat touches. Twin of Footprint in render/project.rs and of Bins in render/bin.rs: splats
// come nearest first, so that a stable sort of the pairs by tile leaves each tile's list in the order (depth, number).
// render/project.wgsl is put in front of this file.
//
// Bindings, group 0: 0 view; 1 band; 2 counts ([1]: visible splats, [2]: pairs); 3 order (splats, nearest first); 4
// shapes; 5 tile_counts (written by count), 6 first_pairs (their exclusive sums, read by emit); written by emit, one a
// pair: 7 keys (tile within the band), 8 values (number of the pair), 9 owners (splat, and its quadrants of the tile).
// Eight storage buffers. count: a thread owns a splat. emit: a workgroup owns 256 splats, and its threads share out
// their pairs, so that a splat over the whole image delays no thread for long. The two are compiled apart, and rounding
// may make them disagree by a tile: a slot without a tile gets one past the last tile, which sorts it behind all lists.

const TILE: u32 = 16u;
// Added under the root of a chord, so that rounding never loses a pixel that a tangent touches (render/rasterize.rs).
const CHORD_MARGIN: f32 = 1e-5;
const EMIT_SPLATS: u32 = 256u;
// Pixels across and down a quadrant of a tile.
const QUADRANT: u32 = 8u;
// An owner's bits from here on say which quadrants its splat may touch (2 x row + column); below is the splat's number.
const OWNER_SHIFT: u32 = 28u;

struct Band {
    first_row: u32, // of tiles
    rows: u32,      // of tiles
    across: u32,    // tiles across
    further: u32,   // of gather.wgsl
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> band: Band;
@group(0) @binding(2) var<storage, read> counts: array<u32>;
@group(0) @binding(3) var<storage, read> order: array<u32>;
@group(0) @binding(4) var<storage, read> shapes: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> tile_counts: array<u32>;
@group(0) @binding(6) var<storage, read> first_pairs: array<u32>;
@group(0) @binding(7) var<storage, read_write> keys: array<u32>;
@group(0) @binding(8) var<storage, read_write> values: array<u32>;
@group(0) @binding(9) var<storage, read_write> owners: array<u32>;

// The rows of tiles of the band, first and one past the last, that hold a pixel centre inside the ellipse's box.
fn tile_rows(shape: vec4<f32>) -> vec2<u32> {
    let low = max(ceil(shape.y - shape.w - 0.5), 0.0);
    let high = min(floor(shape.y + shape.w - 0.5), view.size.y - 1.0);
    if (!(low <= high)) {
        return vec2<u32>(0u);
    }
    let first = max(u32(low) / TILE, band.first_row);
    return vec2<u32>(first, max(min(u32(high) / TILE + 1u, band.first_row + band.rows), first));
}

// The columns of pixels, first and one past the last, of which a centre in the rows first to first + rows - 1 lies
// inside the ellipse of level tau.
fn pixel_span(shape: vec4<f32>, conic: vec3<f32>, tau: f32, first: u32, rows: u32) -> vec2<u32> {
    // Offsets of the rows' pixel centres from the splat's centre, cut to the ellipse's box.
    let top = max(f32(first) + 0.5 - shape.y, -shape.w);
    let bottom = min(min(f32(first + rows), view.size.y) - 0.5 - shape.y, shape.w);
    if (!(top <= bottom)) {
        return vec2<u32>(0u);
    }
    // The ellipse is x = slope dy +- reach sqrt(1 - (dy / half height)^2); its left and right ends lie at dy = -+
    // summit. Both branches are farthest out as near to their ends as the row comes.
    let slope = -conic.y / conic.x;
    let reach = sqrt(tau / conic.x);
    let summit = -conic.y / conic.z * shape.z;
    let right_dy = max(min(summit, bottom), top);
    let left_dy = max(min(-summit, bottom), top);
    let u = right_dy / shape.w;
    let v = left_dy / shape.w;
    let right = shape.x + slope * right_dy + reach * sqrt(max(1.0 + CHORD_MARGIN - u * u, 0.0));
    let left = shape.x + slope * left_dy - reach * sqrt(max(1.0 + CHORD_MARGIN - v * v, 0.0));
    let low = max(ceil(left - 0.5), 0.0);
    let high = min(floor(right - 0.5), view.size.x - 1.0);
    if (!(low <= high)) {
        return vec2<u32>(0u);
    }
    return vec2<u32>(u32(low), u32(high) + 1u);
}

// The tiles of one row, first and one past the last, that hold a pixel centre inside the ellipse of level tau.
fn tile_span(shape: vec4<f32>, conic: vec3<f32>, tau: f32, row: u32) -> vec2<u32> {
    let span = pixel_span(shape, conic, tau, row * TILE, TILE);
    return vec2<u32>(span.x / TILE, (span.y + TILE - 1u) / TILE);
}

// The quadrants of a tile (bit 2 x row + column) that hold a pixel centre inside the ellipse of level tau.
fn quadrants(shape: vec4<f32>, conic: vec3<f32>, tau: f32, row: u32, column: u32) -> u32 {
    var mask = 0u;
    let left = column * TILE;
    for (var strip = 0u; strip < 2u; strip++) {
        let span = pixel_span(shape, conic, tau, row * TILE + strip * QUADRANT, QUADRANT);
        let first = select(0u, 1u, span.x < left + QUADRANT && span.y > left);
        let second = select(0u, 2u, span.x < left + TILE && span.y > left + QUADRANT);
        mask |= (first | second) << (2u * strip);
    }
    return mask;
}

@compute @workgroup_size(256)
fn count(@builtin(global_invocation_id) at: vec3<u32>) {
    if (at.x >= counts[1]) {
        return;
    }
    let splat = order[at.x];
    let shape = shapes[2u * splat];
    let conic = shapes[2u * splat + 1u];
    let tau = cutoff(view, conic.w);
    let rows = tile_rows(shape);
    var sum = 0u;
    for (var row = rows.x; row < rows.y; row++) {
        let span = tile_span(shape, conic.xyz, tau, row);
        sum += span.y - span.x;
    }
    tile_counts[at.x] = sum;
}

var<workgroup> emit_first: array<u32, 257>;

@compute @workgroup_size(256)
fn emit(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let visible = counts[1];
    let k = group.x * EMIT_SPLATS + thread;
    // Splats past the last have no pairs: their first pair is one past the last pair.
    emit_first[thread] = counts[2];
    if (k < visible) {
        emit_first[thread] = first_pairs[k];
    }
    if (thread == EMIT_SPLATS - 1u) {
        emit_first[EMIT_SPLATS] = counts[2];
        if (k + 1u < visible) {
            emit_first[EMIT_SPLATS] = first_pairs[k + 1u];
        }
    }
    workgroupBarrier();
    let end = min(emit_first[EMIT_SPLATS], arrayLength(&keys));
    for (var pair = emit_first[0] + thread; pair < end; pair += EMIT_SPLATS) {
        // The last splat whose first pair is not above this one: those without pairs are passed over.
        var low = 0u;
        var high = EMIT_SPLATS;
        while (high - low > 1u) {
            let middle = (low + high) / 2u;
            if (emit_first[middle] <= pair) {
                low = middle;
            } else {
                high = middle;
            }
        }
        let splat = order[group.x * EMIT_SPLATS + low];
        let shape = shapes[2u * splat];
        let conic = shapes[2u * splat + 1u];
        let tau = cutoff(view, conic.w);
        let rows = tile_rows(shape);
        var rank = pair - emit_first[low];
        var key = band.rows * band.across;
        var owner = 0u;
        for (var row = rows.x; row < rows.y; row++) {
            let span = tile_span(shape, conic.xyz, tau, row);
            let tiles = span.y - span.x;
            if (rank < tiles) {
                let column = span.x + rank;
                key = (row - band.first_row) * band.across + column;
                owner = splat | (quadrants(shape, conic.xyz, tau, row, column) << OWNER_SHIFT);
                break;
            }
            rank -= tiles;
        }
        keys[pair] = key;
        values[pair] = pair;
        owners[pair] = owner;
    }
}
