// The backward pass of a tile: of each pair of tile and splat one record of twelve sums, at a position that is known
// beforehand, so that nothing is added atomically. render/project.wgsl and blend_back.wgsl, which document the bindings
// and the CPU implementation, are put in front of this file. 16 KiB of workgroup memory; rasterize_back_subgroup.wgsl
// is for devices with subgroups.
//
// A workgroup owns a tile and goes front to back in rounds of up to four splats: a thread owns a pixel and writes v =
// dL/d ln alpha and the weight w = alpha T of each splat; then a thread owns a splat, a column of the tile and a
// quarter of the sums; then a thread owns one sum of one splat, and adds the columns in order.

// Splats in a round, at most one for 64 threads: more need more than 16 KiB (gpu/tuning.rs).
const ROUND: u32 = 4u;
// Numbers between two rows of pixels in workgroup memory, and in a splat's plane of them: one more than pixels, so that
// columns lie in different banks.
const ROW: u32 = 17u;
const PLANE: u32 = 272u;

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
    let limits = log2(vec2<f32>(view.alpha_min, blend.alpha_max));
    var open = x < width && y < blend.pixel_rows;
    var own: Seen;
    if (open) {
        own = seen((blend.skipped + y) * width + x, width * blend.plane_rows);
    }
    let g = own.g;
    var rest = own.rest;
    pixel_g[py * TILE + px] = g;
    round_v[py * ROW + px] = own.behind;
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
        // All threads have read the last round.
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
                let s = passed(round_center[i] - pixel, round_power[i], round_color[i], g, rest, t, limits);
                v = s.v;
                w = s.w;
                rest = s.rest;
                t = s.t;
                open = s.open;
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
