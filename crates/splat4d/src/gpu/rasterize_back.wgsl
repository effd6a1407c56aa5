// The way back through a tile: of each pair of tile and splat one record of twelve sums, at a place that is known
// beforehand, so that nothing is added atomically. Twin of Returning in render/blend.rs, where the equations stand.
// render/project.wgsl is put in front of this file.
//
// Bindings, group 0: 0 view; 1 blend; 2 ranges (three u32 a tile), 3 values, 4 owners, 5 shapes, 6 colors and 7 planes as
// rasterize.wgsl read and wrote them; 8 d_planes: gradient to the planes, laid out as they are; out: 9 records, twelve
// numbers a pair, cleared to 0 before, and behind them (at blend.sums_at) three a tile, the gradient to the background.
// Eight storage buffers, 16 KiB of workgroup memory.
// A workgroup owns a tile and goes front to back in rounds of up to four splats: a thread owns a pixel and writes v = dL/d ln
// alpha and the weight w = alpha T of each splat; then a thread owns a splat, a column of the tile and a quarter of the
// sums; then a thread owns one sum of one splat, and adds the columns in order.
//
// Of a record: 0 v, 1 v dx, 2 v dx^2, 3 v dy, 4 v dx dy, 5 v dy^2, 6 to 9 gradient to red, green, blue and depth, 10 and
// 11 absolute gradients to the centre, where they are wanted.

const TILE: u32 = 16u;
// Pixels across and down a quadrant, and the split of an owner (tiles.wgsl).
const QUADRANT: u32 = 8u;
const OWNER_SHIFT: u32 = 28u;
const OWNER_SPLAT: u32 = 0x0fffffffu;
const LOG2_E: f32 = 1.4426950408889634;
// Splats in a round, at most one for 64 threads: more need more than 16 KiB (gpu/tuning.rs).
const ROUND: u32 = 4u;
// Numbers between two rows of pixels in workgroup memory, and in a splat's plane of them: one more than pixels, so that
// columns lie in different banks.
const ROW: u32 = 17u;
const PLANE: u32 = 272u;
const NUMBERS: u32 = 12u;
// Bits of blend.flags: there is a gradient to alpha, to depth; absolute gradients are wanted.
const BACK_ALPHA: u32 = 1u;
const BACK_DEPTH: u32 = 2u;
const BACK_ABS: u32 = 4u;

struct Blend {
    background: vec3<f32>,
    alpha_max: f32,
    transmittance_min: f32,
    first_row: u32,
    pixel_rows: u32,
    flags: u32,
    sums_at: u32, // number of the first sum behind the records
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> blend: Blend;
@group(0) @binding(2) var<storage, read> ranges: array<u32>;
@group(0) @binding(3) var<storage, read> values: array<u32>;
@group(0) @binding(4) var<storage, read> owners: array<u32>;
@group(0) @binding(5) var<storage, read> shapes: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read> colors: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read> planes: array<f32>;
@group(0) @binding(8) var<storage, read> d_planes: array<f32>;
@group(0) @binding(9) var<storage, read_write> records: array<f32>;

var<workgroup> round_v: array<f32, ROUND * PLANE>;
var<workgroup> round_w: array<f32, ROUND * PLANE>;
// Gradient to red, green, blue and depth, [row][column].
var<workgroup> pixel_g: array<vec4<f32>, 256>;
var<workgroup> columns: array<f32, ROUND * NUMBERS * TILE>;
var<workgroup> round_center: array<vec2<f32>, ROUND>;
var<workgroup> round_power: array<vec4<f32>, ROUND>;
var<workgroup> round_color: array<vec4<f32>, ROUND>;
var<workgroup> round_conic: array<vec4<f32>, ROUND>;
var<workgroup> round_quadrants: array<u32, ROUND>;
var<workgroup> round_pair: array<u32, ROUND>;

@compute @workgroup_size(256)
fn rasterize_back(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let quadrant = thread / (QUADRANT * QUADRANT);
    let px = (quadrant % 2u) * QUADRANT + thread % QUADRANT;
    let py = (quadrant / 2u) * QUADRANT + thread / QUADRANT % QUADRANT;
    let x = group.x * TILE + px;
    let y = group.y * TILE + py;
    let width = u32(view.size.x);
    let corner = vec2<f32>(f32(group.x * TILE), f32((blend.first_row + group.y) * TILE)) + 0.5;
    let pixel = corner + vec2<f32>(f32(px), f32(py));
    let tile = group.y * groups.x + group.x;
    let first = ranges[3u * tile];
    let end = ranges[3u * tile + 2u];
    let log_min = log2(view.alpha_min);
    let log_max = log2(blend.alpha_max);
    var open = x < width && y < blend.pixel_rows;
    var g = vec4<f32>(0.0);
    // The gradient times the light that is still to come, background included.
    var rest = 0.0;
    var behind = 0.0;
    if (open) {
        let plane = width * blend.pixel_rows;
        let at = y * width + x;
        behind = 1.0 - planes[3u * plane + at];
        g = vec4<f32>(d_planes[at], d_planes[plane + at], d_planes[2u * plane + at], 0.0);
        rest = g.x * planes[at] + g.y * planes[plane + at] + g.z * planes[2u * plane + at];
        if ((blend.flags & BACK_ALPHA) != 0u) {
            rest -= behind * d_planes[3u * plane + at];
        }
        if ((blend.flags & BACK_DEPTH) != 0u) {
            g.w = d_planes[4u * plane + at];
            rest += g.w * planes[4u * plane + at];
        }
    }
    pixel_g[py * TILE + px] = g;
    round_v[py * ROW + px] = behind;
    workgroupBarrier();
    // The background's gradient, in the same two steps as the records' sums.
    if (thread < TILE) {
        var sum = vec3<f32>(0.0);
        for (var row = 0u; row < TILE; row++) {
            sum += round_v[row * ROW + thread] * pixel_g[row * TILE + thread].xyz;
        }
        columns[thread] = sum.x;
        columns[TILE + thread] = sum.y;
        columns[2u * TILE + thread] = sum.z;
    }
    workgroupBarrier();
    if (thread < 3u) {
        var sum = 0.0;
        for (var column = 0u; column < TILE; column++) {
            sum += columns[thread * TILE + column];
        }
        records[blend.sums_at + 3u * tile + thread] = sum;
    }
    // Of the second and the third step.
    let splat_of = thread / 64u;
    let column_of = thread % TILE;
    let part_of = thread / TILE % 4u;
    var t = 1.0;
    for (var start = first; start < end; start += ROUND) {
        // Everybody has read the last round.
        workgroupBarrier();
        if (thread < ROUND && start + thread < end) {
            let pair = values[start + thread];
            let owner = owners[pair];
            let splat = owner & OWNER_SPLAT;
            let conic = shapes[2u * splat + 1u];
            round_pair[thread] = pair;
            round_quadrants[thread] = owner >> OWNER_SHIFT;
            round_center[thread] = shapes[2u * splat].xy;
            round_conic[thread] = conic;
            round_power[thread] = vec4<f32>(-LOG2_E * vec3<f32>(0.5, 1.0, 0.5) * conic.xyz, log2(conic.w));
            round_color[thread] = colors[splat];
        }
        workgroupBarrier();
        let count = min(end - start, ROUND);
        for (var i = 0u; i < count; i++) {
            var v = 0.0;
            var w = 0.0;
            if (open && ((round_quadrants[i] >> quadrant) & 1u) != 0u) {
                let d = round_center[i] - pixel;
                let p = round_power[i];
                let power = min((p.z * d.y + p.y * d.x) * d.y + p.x * d.x * d.x + p.w, p.w);
                if (power >= log_min) {
                    let alpha = min(blend.alpha_max, exp2(power));
                    let next = t * (1.0 - alpha);
                    if (next < blend.transmittance_min) {
                        open = false;
                    } else {
                        w = alpha * t;
                        let light = dot(g, round_color[i]);
                        rest -= w * light;
                        // Nothing passes where alpha is at its ceiling.
                        if (power < log_max) {
                            v = w * light - alpha / (1.0 - alpha) * rest;
                        }
                        t = next;
                    }
                }
            }
            round_v[i * PLANE + py * ROW + px] = v;
            round_w[i * PLANE + py * ROW + px] = w;
        }
        workgroupBarrier();
        if (splat_of < count) {
            let to = splat_of * NUMBERS * TILE + column_of;
            let at = splat_of * PLANE + column_of;
            let center = round_center[splat_of];
            let dx = center.x - corner.x - f32(column_of);
            let top = center.y - corner.y;
            if (part_of == 0u) {
                var s = vec3<f32>(0.0);
                for (var row = 0u; row < TILE; row++) {
                    let v = round_v[at + row * ROW];
                    let dy = top - f32(row);
                    s += vec3<f32>(v, v * dy, v * dy * dy);
                }
                columns[to] = s.x;
                columns[to + TILE] = s.x * dx;
                columns[to + 2u * TILE] = s.x * dx * dx;
                columns[to + 3u * TILE] = s.y;
                columns[to + 4u * TILE] = s.y * dx;
                columns[to + 5u * TILE] = s.z;
            } else if (part_of == 1u) {
                var s = vec2<f32>(0.0);
                for (var row = 0u; row < TILE; row++) {
                    s += round_w[at + row * ROW] * pixel_g[row * TILE + column_of].xy;
                }
                columns[to + 6u * TILE] = s.x;
                columns[to + 7u * TILE] = s.y;
            } else if (part_of == 2u) {
                var s = vec2<f32>(0.0);
                for (var row = 0u; row < TILE; row++) {
                    s += round_w[at + row * ROW] * pixel_g[row * TILE + column_of].zw;
                }
                columns[to + 8u * TILE] = s.x;
                columns[to + 9u * TILE] = s.y;
            } else {
                var s = vec2<f32>(0.0);
                if ((blend.flags & BACK_ABS) != 0u) {
                    let k = round_conic[splat_of];
                    for (var row = 0u; row < TILE; row++) {
                        let dy = top - f32(row);
                        s += abs(round_v[at + row * ROW]) * abs(vec2<f32>(k.x * dx + k.y * dy, k.y * dx + k.z * dy));
                    }
                }
                columns[to + 10u * TILE] = s.x;
                columns[to + 11u * TILE] = s.y;
            }
        }
        workgroupBarrier();
        if (thread < count * NUMBERS) {
            var sum = 0.0;
            for (var column = 0u; column < TILE; column++) {
                sum += columns[thread * TILE + column];
            }
            records[round_pair[thread / NUMBERS] * NUMBERS + thread % NUMBERS] = sum;
        }
    }
}
