// Blends each tile's splats front to back to colour, alpha and depth. Twin of render/rasterize.rs (forward), where the
// equations and their sources stand. render/project.wgsl is put in front of this file.
//
// Bindings, group 0: 0 view; 1 blend; 2 ranges (two u32 a tile), 3 values (splats, sorted by tile, then nearest first);
// 4 shapes, 5 colors; out: 6 planes: red, green, blue over the background, alpha, depth (sum of z alpha T), each
// [rows of the band][width]. Five storage buffers, 11 KiB of workgroup memory.
// A workgroup owns a tile of 16 x 16 pixels, a thread a pixel; 256 splats at a time are read by all threads together.

const TILE: u32 = 16u;
const BATCH: u32 = 256u;
const LOG2_E: f32 = 1.4426950408889634;

struct Blend {
    background: vec3<f32>,
    alpha_max: f32,
    transmittance_min: f32,
    first_row: u32, // first row of tiles of the band
    pixel_rows: u32, // rows of pixels of the band
    spare: u32,
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> blend: Blend;
@group(0) @binding(2) var<storage, read> ranges: array<u32>;
@group(0) @binding(3) var<storage, read> values: array<u32>;
@group(0) @binding(4) var<storage, read> shapes: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read> colors: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> planes: array<f32>;

var<workgroup> batch_center: array<vec2<f32>, 256>;
// The exponent's factors in powers of 2, and log2 of the opacity.
var<workgroup> batch_power: array<vec4<f32>, 256>;
var<workgroup> batch_color: array<vec4<f32>, 256>;
var<workgroup> stopped: atomic<u32>;
var<workgroup> all_stopped: u32;

@compute @workgroup_size(256)
fn rasterize(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let x = group.x * TILE + thread % TILE;
    let y = group.y * TILE + thread / TILE;
    let width = u32(view.size.x);
    let pixel = vec2<f32>(f32(x), f32(blend.first_row * TILE + y)) + 0.5;
    let inside = x < width && y < blend.pixel_rows;
    let tile = group.y * groups.x + group.x;
    let first = ranges[2u * tile];
    let end = ranges[2u * tile + 1u];
    let log_min = log2(view.alpha_min);
    var sum = vec4<f32>(0.0); // red, green, blue, depth
    var t = 1.0;
    var open = inside;
    // Set here, because natively nobody clears a workgroup's memory.
    if (thread == 0u) {
        atomicStore(&stopped, 0u);
    }
    workgroupBarrier();
    if (!inside) {
        atomicAdd(&stopped, 1u);
    }
    for (var start = first; start < end; start += BATCH) {
        // Everybody has read the last batch, and has said whether their pixel has stopped.
        workgroupBarrier();
        if (thread == 0u) {
            all_stopped = atomicLoad(&stopped);
        }
        if (workgroupUniformLoad(&all_stopped) == BATCH) {
            break;
        }
        let own = start + thread;
        if (own < end) {
            let splat = values[own];
            let conic = shapes[2u * splat + 1u];
            batch_center[thread] = shapes[2u * splat].xy;
            batch_power[thread] = vec4<f32>(-LOG2_E * vec3<f32>(0.5, 1.0, 0.5) * conic.xyz, log2(conic.w));
            batch_color[thread] = colors[splat];
        }
        workgroupBarrier();
        let count = min(end - start, BATCH);
        for (var i = 0u; open && i < count; i++) {
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
        }
    }
    if (inside) {
        let plane = width * blend.pixel_rows;
        let at = y * width + x;
        let color = sum.xyz + t * blend.background;
        planes[at] = color.x;
        planes[plane + at] = color.y;
        planes[2u * plane + at] = color.z;
        planes[3u * plane + at] = 1.0 - t;
        planes[4u * plane + at] = sum.w;
    }
}
