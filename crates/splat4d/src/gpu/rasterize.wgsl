// Blends each tile's splats front to back to colour, alpha and depth. Twin of render/rasterize.rs (forward), where the
// equations and their sources are documented. render/project.wgsl is put in front of this file.
//
// Bindings, group 0: 0 view; 1 blend; 2 ranges (three u32 per tile; the third is written: one past the last pair that
// some pixel used), 3 values (pairs, sorted by tile, then nearest first), 4 owners (of a pair: splat and quadrants); 5
// shapes, 6 colors; out: 7 planes: red, green, blue over the background, alpha, depth (sum of z alpha T), each [rows of
// the planes][width], and behind them the states (below). Six storage buffers, 12 KiB of workgroup memory. A workgroup owns a tile of 16 x 16 pixels, 64
// neighbouring threads a quadrant of it, a thread per pixel; splats are read in batches by all threads together.

const TILE: u32 = 16u;
const THREADS: u32 = 256u;
// Splats that are read at a time, at most one per thread (gpu/tuning.rs).
const BATCH: u32 = 256u;
// Pixels across and down a quadrant, and the split of an owner (tiles.wgsl).
const QUADRANT: u32 = 8u;
const OWNER_SHIFT: u32 = 28u;
const OWNER_SPLAT: u32 = 0x0fffffffu;
const LOG2_E: f32 = 1.4426950408889634;
// Before every so many splats of a tile, the state of its pixels is written behind the planes, where
// rasterize_back_lanes.wgsl begins: red, green, blue, depth and transmittance, each [256 pixels]; where a pixel has
// stopped, the transmittance 0 alone. 0: never (gpu/kernels.rs).
const BUCKET: u32 = 0u;
const STATE: u32 = 5u;

struct Blend {
    background: vec3<f32>,
    alpha_max: f32,
    transmittance_min: f32,
    first_row: u32, // first row of tiles of the band
    pixel_rows: u32, // rows of pixels of the band
    flags: u32,      // of rasterize_back.wgsl, as what follows
    sums_at: u32,
    skipped: u32,    // rows of pixels of the planes above the band, and all of theirs
    plane_rows: u32,
    states_at: u32,  // number of the first state behind the planes
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> blend: Blend;
@group(0) @binding(2) var<storage, read_write> ranges: array<u32>;
@group(0) @binding(3) var<storage, read> values: array<u32>;
@group(0) @binding(4) var<storage, read> owners: array<u32>;
@group(0) @binding(5) var<storage, read> shapes: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read> colors: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read_write> planes: array<f32>;

var<workgroup> batch_center: array<vec2<f32>, BATCH>;
// The exponent's factors in powers of 2, and log2 of the opacity.
var<workgroup> batch_power: array<vec4<f32>, BATCH>;
var<workgroup> batch_color: array<vec4<f32>, BATCH>;
var<workgroup> batch_quadrants: array<u32, BATCH>;
var<workgroup> stopped: atomic<u32>;
var<workgroup> all_stopped: u32;
var<workgroup> last_used: atomic<u32>;
var<workgroup> list: vec2<u32>;

// The place of the state before splat `item` of a tile's list that begins at `first`.
fn state_at(tile: u32, first: u32, item: u32) -> u32 {
    let bucket = first / max(BUCKET, 1u) + tile + item / max(BUCKET, 1u);
    return blend.states_at + bucket * STATE * THREADS;
}

@compute @workgroup_size(256)
fn rasterize(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let quadrant = thread / (QUADRANT * QUADRANT);
    let x = group.x * TILE + (quadrant % 2u) * QUADRANT + thread % QUADRANT;
    let y = group.y * TILE + (quadrant / 2u) * QUADRANT + thread / QUADRANT % QUADRANT;
    let width = u32(view.size.x);
    let pixel = vec2<f32>(f32(x), f32(blend.first_row * TILE + y)) + 0.5;
    let inside = x < width && y < blend.pixel_rows;
    let tile = group.y * groups.x + group.x;
    let log_min = log2(view.alpha_min);
    var sum = vec4<f32>(0.0); // red, green, blue, depth
    var t = 1.0;
    var open = inside;
    // Set here, because native drivers do not clear a workgroup's memory.
    if (thread == 0u) {
        atomicStore(&stopped, 0u);
        atomicStore(&last_used, 0u);
        list = vec2<u32>(ranges[3u * tile], ranges[3u * tile + 1u]);
    }
    let both = workgroupUniformLoad(&list);
    let first = both.x;
    let end = both.y;
    var used = first;
    if (!inside) {
        atomicAdd(&stopped, 1u);
    }
    for (var start = first; start < end; start += BATCH) {
        // All threads have read the last batch and reported whether their pixel has stopped.
        workgroupBarrier();
        if (thread == 0u) {
            all_stopped = atomicLoad(&stopped);
        }
        if (workgroupUniformLoad(&all_stopped) == THREADS) {
            break;
        }
        let own = start + thread;
        if (thread < BATCH && own < end) {
            let owner = owners[values[own]];
            let splat = owner & OWNER_SPLAT;
            batch_quadrants[thread] = owner >> OWNER_SHIFT;
            let conic = shapes[2u * splat + 1u];
            batch_center[thread] = shapes[2u * splat].xy;
            batch_power[thread] = vec4<f32>(-LOG2_E * vec3<f32>(0.5, 1.0, 0.5) * conic.xyz, log2(conic.w));
            batch_color[thread] = colors[splat];
        }
        workgroupBarrier();
        let count = min(end - start, BATCH);
        var closed = 0u;
        for (var i = 0u; open && i < count; i++) {
            if (BUCKET != 0u) {
                closed = i + 1u;
                if ((start + i - first) % max(BUCKET, 1u) == 0u) {
                    let at = state_at(tile, first, start + i - first) + thread;
                    planes[at] = sum.x;
                    planes[at + THREADS] = sum.y;
                    planes[at + 2u * THREADS] = sum.z;
                    planes[at + 3u * THREADS] = sum.w;
                    planes[at + 4u * THREADS] = t;
                }
            }
            if (((batch_quadrants[i] >> quadrant) & 1u) == 0u) {
                continue;
            }
            let d = batch_center[i] - pixel;
            let p = batch_power[i];
            // Rounding may take a needle's exponent above its top.
            let power = min((p.z * d.y + p.y * d.x) * d.y + p.x * d.x * d.x + p.w, p.w);
            if (power < log_min) {
                continue;
            }
            let alpha = min(blend.alpha_max, exp2(power));
            let next = t * (1.0 - alpha);
            if (next < blend.transmittance_min) {
                open = false;
                atomicAdd(&stopped, 1u);
                break;
            }
            sum += (alpha * t) * batch_color[i];
            t = next;
            used = start + i + 1u;
        }
        if (BUCKET != 0u && !open) {
            for (var i = closed; i < count; i++) {
                if ((start + i - first) % max(BUCKET, 1u) == 0u) {
                    planes[state_at(tile, first, start + i - first) + 4u * THREADS + thread] = 0.0;
                }
            }
        }
    }
    atomicMax(&last_used, used);
    workgroupBarrier();
    if (thread == 0u) {
        ranges[3u * tile + 2u] = atomicLoad(&last_used);
    }
    if (inside) {
        let plane = width * blend.plane_rows;
        let at = (blend.skipped + y) * width + x;
        let color = sum.xyz + t * blend.background;
        planes[at] = color.x;
        planes[plane + at] = color.y;
        planes[2u * plane + at] = color.z;
        planes[3u * plane + at] = 1.0 - t;
        planes[4u * plane + at] = sum.w;
    }
}
