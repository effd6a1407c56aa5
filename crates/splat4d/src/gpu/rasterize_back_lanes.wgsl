// The backward pass of a tile with a lane per splat: the records of rasterize_back.wgsl without sums between threads.
// render/project.wgsl and blend_back.wgsl, which document the bindings and the CPU implementation, are put in front of
// this file. Source: per-splat backward pass of Mallick et al. 2024 (Taming 3DGS). 7 KiB of workgroup memory.
//
// A workgroup of LANES threads lies in one subgroup. It owns a tile and every WAYS-th bucket of LANES splats of the
// tile's list. A lane holds a splat and its twelve sums in registers. Pixels pass through the lanes one after the other:
// in step s, lane i treats pixel s - i, and hands what is left of the light to lane i + 1. They begin with the state
// that rasterize.wgsl wrote before the bucket, so that buckets do not depend on each other. Quadrants of the tile that
// no splat of the bucket touches are left out. Chosen by a sweep alone (gpu/tuning.rs).

// Splats of a bucket: the threads of the device's smallest subgroup (gpu/kernels.rs).
const LANES: u32 = 32u;
// Workgroups of a tile: enough that the few tiles with long lists do not take longer than all others.
const WAYS: u32 = 8u;
// Pixels of a tile and of a quadrant, and numbers of a pixel's state (rasterize.wgsl).
const PIXELS: u32 = 256u;
const QUARTER: u32 = 64u;
const STATE: u32 = 5u;

var<workgroup> pixel_g: array<vec4<f32>, PIXELS>;
// The gradient times all of a pixel's light; then what is left of it before the bucket, and the transmittance.
var<workgroup> pixel_light: array<f32, PIXELS>;
var<workgroup> pixel_state: array<vec2<f32>, PIXELS>;

// Column and row of a pixel in the tile: quadrant after quadrant, as the threads of rasterize.wgsl.
fn place_of(pixel: u32) -> vec2<u32> {
    let quadrant = pixel / QUARTER;
    let inner = vec2<u32>(pixel % QUADRANT, pixel / QUADRANT % QUADRANT);
    return QUADRANT * vec2<u32>(quadrant % 2u, quadrant / 2u) + inner;
}

fn whole(x: f32) -> f32 {
    var sum = x;
    for (var step = 1u; step < LANES; step *= 2u) {
        sum += subgroupShuffleXor(sum, step);
    }
    return sum;
}

@compute @workgroup_size(LANES)
fn rasterize_back(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(subgroup_invocation_id) lane: u32,
) {
    let width = u32(view.size.x);
    let plane = width * blend.plane_rows;
    let corner = vec2<f32>(f32(group.x * TILE), f32((blend.first_row + group.y) * TILE)) + 0.5;
    let tile = group.y * groups.x + group.x;
    let first = ranges[3u * tile];
    let end = ranges[3u * tile + 2u];
    let limits = log2(vec2<f32>(view.alpha_min, blend.alpha_max));
    var d_background = vec3<f32>(0.0);
    for (var pixel = lane; pixel < PIXELS; pixel += LANES) {
        let place = vec2<u32>(group.x, group.y) * TILE + place_of(pixel);
        var own: Seen;
        if (place.x < width && place.y < blend.pixel_rows) {
            own = seen((blend.skipped + place.y) * width + place.x, plane);
        }
        pixel_g[pixel] = own.g;
        pixel_light[pixel] = own.rest;
        d_background += own.behind * own.g.xyz;
    }
    let background = vec3<f32>(whole(d_background.x), whole(d_background.y), whole(d_background.z));
    if (group.z == 0u && lane < 3u) {
        records[blend.sums_at + 3u * tile + lane] = background[lane];
    }
    for (var bucket = group.z; first + bucket * LANES < end; bucket += WAYS) {
        // The lane's splat.
        let at = first + bucket * LANES + lane;
        var pair = 0u;
        var quadrants = 0u;
        var center = vec2<f32>(0.0);
        var conic = vec4<f32>(0.0);
        var power = vec4<f32>(0.0);
        var light = vec4<f32>(0.0);
        if (at < end) {
            pair = values[at];
            let owner = owners[pair];
            let splat = owner & OWNER_SPLAT;
            quadrants = owner >> OWNER_SHIFT;
            center = shapes[2u * splat].xy;
            conic = shapes[2u * splat + 1u];
            power = vec4<f32>(-LOG2_E * vec3<f32>(0.5, 1.0, 0.5) * conic.xyz, log2(conic.w));
            light = colors[splat];
        }
        var near = quadrants;
        for (var step = 1u; step < LANES; step *= 2u) {
            near |= subgroupShuffleXor(near, step);
        }
        // The touched quadrants, two bits each.
        var order = 0u;
        var touched = 0u;
        for (var quadrant = 0u; quadrant < 4u; quadrant++) {
            if (((near >> quadrant) & 1u) != 0u) {
                order |= quadrant << (2u * touched);
                touched += 1u;
            }
        }
        // The state before the bucket. All lanes have read that of the last one.
        workgroupBarrier();
        let state = blend.states_at + (first / LANES + tile + bucket) * STATE * PIXELS;
        for (var pixel = lane; pixel < PIXELS; pixel += LANES) {
            let t = planes[state + 4u * PIXELS + pixel];
            // The colours of a pixel that has stopped are not written.
            if (t > 0.0) {
                let gone = vec4<f32>(
                    planes[state + pixel],
                    planes[state + PIXELS + pixel],
                    planes[state + 2u * PIXELS + pixel],
                    planes[state + 3u * PIXELS + pixel],
                );
                pixel_state[pixel] = vec2<f32>(pixel_light[pixel] - dot(pixel_g[pixel], gone), t);
            } else {
                pixel_state[pixel] = vec2<f32>(0.0);
            }
        }
        workgroupBarrier();
        // v, v dy, v dx, v dx dy; v dx^2, v dy^2.
        var first_sums = vec4<f32>(0.0);
        var second_sums = vec2<f32>(0.0);
        var d_light = vec4<f32>(0.0);
        var far = vec2<f32>(0.0);
        var rest = 0.0;
        var t = 0.0;
        for (var s = 0u; s < touched * QUARTER + LANES - 1u; s++) {
            let rest_before = subgroupShuffleUp(rest, 1u);
            let t_before = subgroupShuffleUp(t, 1u);
            // One block, behind which all lanes are together again for the next exchange.
            if (s >= lane && s - lane < touched * QUARTER) {
                let item = s - lane;
                let quadrant = (order >> (2u * (item / QUARTER))) & 3u;
                let pixel = quadrant * QUARTER + item % QUARTER;
                let begins = pixel_state[pixel];
                rest = select(rest_before, begins.x, lane == 0u);
                t = select(t_before, begins.y, lane == 0u);
                if (t > 0.0 && ((quadrants >> quadrant) & 1u) != 0u) {
                    let d = center - (corner + vec2<f32>(place_of(pixel)));
                    let g = pixel_g[pixel];
                    let now = passed(d, power, light, g, rest, t, limits);
                    rest = now.rest;
                    t = select(0.0, now.t, now.open);
                    first_sums += now.v * vec4<f32>(1.0, d.y, d.x, d.x * d.y);
                    second_sums += now.v * d * d;
                    d_light += now.w * g;
                    if ((blend.flags & BACK_ABS) != 0u) {
                        let slope = vec2<f32>(conic.x * d.x + conic.y * d.y, conic.y * d.x + conic.z * d.y);
                        far += abs(now.v) * abs(slope);
                    }
                }
            }
        }
        if (at < end) {
            let to = pair * NUMBERS;
            records[to] = first_sums.x;
            records[to + 1u] = first_sums.z;
            records[to + 2u] = second_sums.x;
            records[to + 3u] = first_sums.y;
            records[to + 4u] = first_sums.w;
            records[to + 5u] = second_sums.y;
            records[to + 6u] = d_light.x;
            records[to + 7u] = d_light.y;
            records[to + 8u] = d_light.z;
            records[to + 9u] = d_light.w;
            records[to + 10u] = far.x;
            records[to + 11u] = far.y;
        }
    }
}
