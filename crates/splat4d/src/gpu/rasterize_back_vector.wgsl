// rasterize_back_subgroup.wgsl with a thread's four pixels in the components of vectors: nothing lies in an array,
// splats of which no pixel of a subgroup takes anything are not added up, and more of them are read between two
// barriers. subgroup_sums.wgsl is put in front of this file. Chosen by a sweep alone (gpu/tuning.rs): no card has
// measured it yet.

// Where a thread's pixels lie below its first.
const DOWN: vec4<f32> = vec4<f32>(0.0, 1.0, 2.0, 3.0);

fn sum_of(four: vec4<f32>) -> f32 {
    return (four.x + four.y) + (four.z + four.w);
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
    // The gradients to red, green, blue and depth; of each, of four pixels.
    var red = vec4<f32>(0.0);
    var green = vec4<f32>(0.0);
    var blue = vec4<f32>(0.0);
    var depth = vec4<f32>(0.0);
    var rest = vec4<f32>(0.0);
    var t = vec4<f32>(1.0);
    var open = vec4<bool>(false);
    var d_background = vec3<f32>(0.0);
    for (var p = 0u; p < PIXELS; p++) {
        let y = group.y * TILE + top + p;
        if (x < width && y < blend.pixel_rows) {
            let own = seen((blend.skipped + y) * width + x, width * blend.plane_rows);
            let at = vec4<u32>(p) == vec4<u32>(0u, 1u, 2u, 3u);
            red = select(red, vec4<f32>(own.g.x), at);
            green = select(green, vec4<f32>(own.g.y), at);
            blue = select(blue, vec4<f32>(own.g.z), at);
            depth = select(depth, vec4<f32>(own.g.w), at);
            rest = select(rest, vec4<f32>(own.rest), at);
            open = open | at;
            d_background += own.behind * own.g.xyz;
        }
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
            var lives = vec4<bool>(false);
            var power = vec4<f32>(0.0);
            var alpha = vec4<f32>(0.0);
            var next = vec4<f32>(0.0);
            let d = centers[i] - pixel;
            let dy = d.y - DOWN;
            // The same for all of a subgroup.
            if ((quadrants[i] & near) != 0u) {
                // A splat at a pixel, as `passed` has it, four times.
                let p = powers[i];
                power = min((p.z * dy + p.y * d.x) * dy + p.x * d.x * d.x + p.w, vec4<f32>(p.w));
                let meets = open & vec4<bool>((quadrants[i] & quadrant) != 0u) & (power >= vec4<f32>(limits.x));
                alpha = min(vec4<f32>(blend.alpha_max), exp2(power));
                next = t * (1.0 - alpha);
                let ends = meets & (next < vec4<f32>(blend.transmittance_min));
                open = open & !ends;
                lives = meets & !ends;
            }
            // None of its pixels takes any of it.
            if (!subgroupAny(any(lives))) {
                for (var n = lane; n < NUMBERS; n += size) {
                    parts[to + n] = 0.0;
                }
                continue;
            }
            let color = lights[i];
            let w = select(vec4<f32>(0.0), alpha * t, lives);
            let light = w * (red * color.x + green * color.y + blue * color.z + depth * color.w);
            rest -= light;
            // Nothing passes where alpha is at its ceiling.
            let passes = lives & (power < vec4<f32>(limits.y));
            let v = select(vec4<f32>(0.0), light - alpha / (1.0 - alpha) * rest, passes);
            t = select(t, next, lives);
            let s = vec3<f32>(sum_of(v), dot(v, dy), dot(v * dy, dy));
            let low = vec4<f32>(s.x, s.x * d.x, s.x * d.x * d.x, s.y);
            let high = vec4<f32>(s.y * d.x, s.z, dot(w, red), dot(w, green));
            let eighth = share_of_eight(low, high, lane, size);
            if (lane < 8u) {
                parts[to + eighth_of(lane)] = eighth;
            }
            var more = vec4<f32>(dot(w, blue), 0.0, 0.0, 0.0);
            if ((blend.flags & BACK_DEPTH) != 0u) {
                more.y = dot(w, depth);
            }
            if ((blend.flags & BACK_ABS) != 0u) {
                let conic = conics[i];
                let strong = abs(v);
                more.z = dot(strong, abs(conic.x * d.x + conic.y * dy));
                more.w = dot(strong, abs(conic.y * d.x + conic.z * dy));
            }
            let quarter = share_of_four(more, lane, size);
            if (lane < 4u) {
                parts[to + 8u + quarter_of(lane)] = quarter;
            }
        }
        workgroupBarrier();
        write_records(count, thread, subgroups);
    }
}
