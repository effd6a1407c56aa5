// The way back through a tile on devices with subgroups of 8 to 64 threads, a power of two: the records of rasterize_back.wgsl,
// added up in registers and by exchanges between threads, in an order that the size of subgroups alone decides. render/project.wgsl
// and blend_back.wgsl, where bindings and twin stand, are put in front of this file. 7 KiB of workgroup memory.
//
// A workgroup owns a tile and goes front to back; a thread owns four pixels of a column, so that what depends on dx alone is
// multiplied once. Eight of a splat's sums go through a butterfly in which a thread keeps half of them at each of the first three
// exchanges and gives away the other half; what subgroups have then is added in their order.

const THREADS: u32 = 64u;
const PIXELS: u32 = 4u;
// Splats between two barriers.
const SPLATS: u32 = 16u;
// Of 8 threads each.
const MOST_SUBGROUPS: u32 = 8u;

var<workgroup> parts: array<f32, MOST_SUBGROUPS * SPLATS * NUMBERS>;
var<workgroup> centers: array<vec2<f32>, SPLATS>;
var<workgroup> powers: array<vec4<f32>, SPLATS>;
var<workgroup> lights: array<vec4<f32>, SPLATS>;
var<workgroup> conics: array<vec4<f32>, SPLATS>;
var<workgroup> quadrants: array<u32, SPLATS>;
var<workgroup> pairs: array<u32, SPLATS>;

// The sum over a subgroup.
fn whole(x: f32, size: u32) -> f32 {
    var sum = x;
    for (var step = 1u; step < size; step *= 2u) {
        sum += subgroupShuffleXor(sum, step);
    }
    return sum;
}

// The sum over a subgroup of one of eight numbers: of number place_of(lane).
fn share_of_eight(low: vec4<f32>, high: vec4<f32>, lane: u32, size: u32) -> f32 {
    let first = (lane & 1u) != 0u;
    let four = select(low, high, first) + subgroupShuffleXor(select(high, low, first), 1u);
    let second = (lane & 2u) != 0u;
    let two = select(four.xy, four.zw, second) + subgroupShuffleXor(select(four.zw, four.xy, second), 2u);
    let third = (lane & 4u) != 0u;
    var one = select(two.x, two.y, third) + subgroupShuffleXor(select(two.y, two.x, third), 4u);
    for (var step = 8u; step < size; step *= 2u) {
        one += subgroupShuffleXor(one, step);
    }
    return one;
}

fn place_of(lane: u32) -> u32 {
    return 4u * (lane & 1u) + (lane & 2u) + ((lane >> 2u) & 1u);
}

// Number n of splat i: what all subgroups have of it.
fn total(i: u32, n: u32, subgroups: u32) -> f32 {
    var sum = 0.0;
    for (var s = 0u; s < subgroups; s++) {
        sum += parts[(s * SPLATS + i) * NUMBERS + n];
    }
    return sum;
}

@compute @workgroup_size(64)
fn rasterize_back(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(subgroup_id) subgroup: u32,
    @builtin(subgroup_size) size: u32,
    @builtin(subgroup_invocation_id) lane: u32,
) {
    // Neighbours in a subgroup are neighbours in the tile, whatever the device calls them.
    let thread = subgroup * size + lane;
    let subgroups = THREADS / size;
    let column = thread % TILE;
    let top = thread / TILE * PIXELS;
    let quadrant = 1u << (column / QUADRANT + 2u * (top / QUADRANT));
    var near = quadrant;
    for (var step = 1u; step < size; step *= 2u) {
        near |= subgroupShuffleXor(near, step);
    }
    let x = group.x * TILE + column;
    let width = u32(view.size.x);
    let pixel = vec2<f32>(f32(x), f32((blend.first_row + group.y) * TILE + top)) + 0.5;
    let tile = group.y * groups.x + group.x;
    let first = ranges[3u * tile];
    let end = ranges[3u * tile + 2u];
    let limits = log2(vec2<f32>(view.alpha_min, blend.alpha_max));
    var g: array<vec4<f32>, PIXELS>;
    var rest: array<f32, PIXELS>;
    var t: array<f32, PIXELS>;
    var open: array<bool, PIXELS>;
    var d_background = vec3<f32>(0.0);
    for (var p = 0u; p < PIXELS; p++) {
        let y = group.y * TILE + top + p;
        open[p] = x < width && y < blend.pixel_rows;
        var own: Seen;
        if (open[p]) {
            own = seen((blend.skipped + y) * width + x, width * blend.plane_rows);
        }
        g[p] = own.g;
        rest[p] = own.rest;
        t[p] = 1.0;
        d_background += own.behind * own.g.xyz;
    }
    for (var c = 0u; c < 3u; c++) {
        let sum = whole(d_background[c], size);
        if (lane == 0u) {
            parts[subgroup * SPLATS * NUMBERS + c] = sum;
        }
    }
    workgroupBarrier();
    if (thread < 3u) {
        records[blend.sums_at + 3u * tile + thread] = total(0u, thread, subgroups);
    }
    for (var start = first; start < end; start += SPLATS) {
        // Everybody has read the last splats and their sums.
        workgroupBarrier();
        if (thread < SPLATS && start + thread < end) {
            let pair = values[start + thread];
            let owner = owners[pair];
            let splat = owner & OWNER_SPLAT;
            let conic = shapes[2u * splat + 1u];
            pairs[thread] = pair;
            quadrants[thread] = owner >> OWNER_SHIFT;
            centers[thread] = shapes[2u * splat].xy;
            conics[thread] = conic;
            powers[thread] = vec4<f32>(-LOG2_E * vec3<f32>(0.5, 1.0, 0.5) * conic.xyz, log2(conic.w));
            lights[thread] = colors[splat];
        }
        workgroupBarrier();
        let count = min(end - start, SPLATS);
        for (var i = 0u; i < count; i++) {
            let to = (subgroup * SPLATS + i) * NUMBERS;
            // The same for all of a subgroup.
            if ((quadrants[i] & near) == 0u) {
                for (var n = lane; n < NUMBERS; n += size) {
                    parts[to + n] = 0.0;
                }
                continue;
            }
            let d = centers[i] - pixel;
            let conic = conics[i];
            // v, v dy, v dy^2.
            var s = vec3<f32>(0.0);
            var light = vec4<f32>(0.0);
            var far = vec2<f32>(0.0);
            if ((quadrants[i] & quadrant) != 0u) {
                for (var p = 0u; p < PIXELS; p++) {
                    if (open[p]) {
                        let dy = d.y - f32(p);
                        let now = passed(vec2<f32>(d.x, dy), powers[i], lights[i], g[p], rest[p], t[p], limits);
                        rest[p] = now.rest;
                        t[p] = now.t;
                        open[p] = now.open;
                        s += now.v * vec3<f32>(1.0, dy, dy * dy);
                        light += now.w * g[p];
                        if ((blend.flags & BACK_ABS) != 0u) {
                            let slope = vec2<f32>(conic.x * d.x + conic.y * dy, conic.y * d.x + conic.z * dy);
                            far += abs(now.v) * abs(slope);
                        }
                    }
                }
            }
            let low = vec4<f32>(s.x, s.x * d.x, s.x * d.x * d.x, s.y);
            let high = vec4<f32>(s.y * d.x, s.z, light.x, light.y);
            let eighth = share_of_eight(low, high, lane, size);
            if (lane < 8u) {
                parts[to + place_of(lane)] = eighth;
            }
            let blue = whole(light.z, size);
            var depth = 0.0;
            if ((blend.flags & BACK_DEPTH) != 0u) {
                depth = whole(light.w, size);
            }
            var absolute = vec2<f32>(0.0);
            if ((blend.flags & BACK_ABS) != 0u) {
                absolute = vec2<f32>(whole(far.x, size), whole(far.y, size));
            }
            if (lane == 0u) {
                parts[to + 8u] = blue;
                parts[to + 9u] = depth;
                parts[to + 10u] = absolute.x;
                parts[to + 11u] = absolute.y;
            }
        }
        workgroupBarrier();
        for (var n = thread; n < count * NUMBERS; n += THREADS) {
            records[pairs[n / NUMBERS] * NUMBERS + n % NUMBERS] = total(n / NUMBERS, n % NUMBERS, subgroups);
        }
    }
}
