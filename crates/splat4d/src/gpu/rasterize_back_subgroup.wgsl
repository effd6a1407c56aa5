// The backward pass of a tile on devices with subgroups: the records of rasterize_back.wgsl, added up in registers and
// by exchanges between threads. subgroup_sums.wgsl, where the rest is reported, is put in front of this file.

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
        // All threads have read the last splats and their sums.
        workgroupBarrier();
        read_splats(start, end, thread);
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
                parts[to + eighth_of(lane)] = eighth;
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
        write_records(count, thread, subgroups);
    }
}
