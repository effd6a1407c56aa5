// From the resident Gaussians of the pages at time t to a list of screen ellipses in the order of depth keys: the part
// before the sort. Concatenated after resident.wgsl, project.wgsl and shade.wgsl.
//
//   cull   a workgroup owns a block of 256: tests the block, then each thread its Gaussian; survivors become records,
//          packed within the block's 256 places, so that the order stays that of the file and repeats from run to run
//   total  one workgroup: exclusive sums of the blocks' counts, and the arguments of the indirect dispatches and draw
//   keys   a workgroup owns a block again: 16-bit depth key and place of every record, without gaps
//
// The same depth key means: the lower place is in front, as in the CPU renderer's (depth, id).

// One picture; 160 bytes.
struct Frame {
    view: View,              // count: blocks in block_list
    background: vec3<f32>,
    channel: u32,            // CHANNEL_*
    depth_range: vec2<f32>,  // near, far of the depth picture, scene units
    flow_scale: f32,         // px/s that is drawn at full brightness
    pad: u32,
}

const CHANNEL_COLOR: u32 = 0u;
const CHANNEL_DEPTH: u32 = 1u;
const CHANNEL_ALPHA: u32 = 2u;
const CHANNEL_FLOW: u32 = 3u;

// One splat on the screen; 32 bytes.
struct Record {
    center: vec2<f32>,  // px
    major: vec2<f32>,   // longer axis of the 1 sigma ellipse, px
    minor: f32,         // length of the shorter one, px
    depth: f32,         // z in camera axes
    color: vec2<u32>,   // r g | b opacity, 16-bit floats
}

// What the GPU decides about a frame. The nearest and farthest depths are positive floats' bits, which sort alike.
struct Range {
    near: atomic<u32>,
    far: atomic<u32>,
}

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> words: array<vec4<u32>>;        // two a Gaussian
@group(0) @binding(2) var<storage, read> blocks: array<BlockHeader>;     // one a resident block
@group(0) @binding(3) var<storage, read> block_list: array<u32>;         // the blocks of the pages at this time
@group(0) @binding(4) var<storage, read> palette: array<u32>;            // a word a coefficient: bytes r, g, b
@group(0) @binding(5) var<storage, read_write> records: array<Record>;   // 256 a listed block
@group(0) @binding(6) var<storage, read_write> counts: array<u32>;       // a listed block's records; after total: sums
@group(0) @binding(7) var<storage, read_write> range: Range;
@group(0) @binding(8) var<storage, read_write> arguments: array<u32>;    // see total
@group(0) @binding(9) var<storage, read_write> keys: array<u32>;
@group(0) @binding(10) var<storage, read_write> places: array<u32>;

const BLOCK: u32 = 256u;
// Standard deviations to alpha = 1/255 of an opaque Gaussian, sqrt(2 ln 255), rounded up.
const SIGMAS: f32 = 3.34;
// What is alive is at most this many reaches from its centre: (h + 3.33 s)/(h + 3 s), rounded up.
const LIFE_REACHES: f32 = 1.12;
// Largest key: two passes of eight bits.
const KEY_MAX: f32 = 65535.0;
// Pairs that a workgroup of sort.wgsl takes (SORT_BLOCK there).
const PAIRS: u32 = 2048u;

var<workgroup> group_mask: array<atomic<u32>, 8>;
var<workgroup> group_near: atomic<u32>;
var<workgroup> group_far: atomic<u32>;
var<workgroup> group_sums: array<u32, 256>;

// Whether nothing of the block can be seen. Errs on the side of drawing.
fn block_hidden(header: array<vec4<f32>, 6>, span: f32) -> bool {
    let t = frame.view.time;
    if (t < header[2].x || t > header[2].y) {
        return true;
    }
    // Within a life a mean strays by the shift; outside its centre's range, by the span at most.
    let late = max(abs(t - header[1].z), abs(t - header[1].w));
    let stray = header[3].x * max(LIFE_REACHES, 2.0 * late / max(span, LEAST_SECONDS));
    let low = header[0].xyz;
    let high = vec3<f32>(header[0].w, header[1].xy);
    let half_size = 0.5 * (high - low) + stray;
    let m = frame.view.camera_from_world;
    let p = (m * vec4<f32>(0.5 * (low + high), 1.0)).xyz;
    let reach = abs(m[0].xyz) * half_size.x + abs(m[1].xyz) * half_size.y + abs(m[2].xyz) * half_size.z;
    if (p.z + reach.z <= frame.view.near) {
        return true;
    }
    // A side of the picture, multiplied by z, is a plane; the ellipse widens it by SIGMAS |J| sigma_max and by the
    // low-pass. |J| is bounded by its clamp to the picture and PROJECT_J_MARGIN.
    let size = frame.view.size;
    let focal = frame.view.focal;
    let edge_low = frame.view.center;
    let edge_high = size - frame.view.center;
    let tangent = max(edge_low, edge_high) / focal + PROJECT_J_MARGIN * 0.5 * size / focal;
    let wide = SIGMAS * exp(header[2].w) * focal * sqrt(1.0 + tangent * tangent);
    let blur = SIGMAS * sqrt(frame.view.low_pass) + 1.0;
    for (var k = 0u; k < 2u; k++) {
        // The middle's distance beyond either plane, and the most by which a corner of the box can be nearer.
        let beyond_high = focal[k] * p[k] - (edge_high[k] + blur) * p.z;
        let beyond_low = -focal[k] * p[k] - (edge_low[k] + blur) * p.z;
        let spread = focal[k] * reach[k] + (max(abs(edge_high[k]), abs(edge_low[k])) + blur) * reach.z;
        if (max(beyond_high, beyond_low) > spread + wide[k]) {
            return true;
        }
    }
    return false;
}

// Hue from the direction (right red, then by the screen's clockwise turn), value from the speed.
fn flow_color(velocity: vec2<f32>) -> vec3<f32> {
    let turn = atan2(velocity.y, velocity.x) * 0.15915494309189535; // 1/(2 pi)
    let hue = fract(vec3<f32>(turn) + vec3<f32>(1.0, 2.0 / 3.0, 1.0 / 3.0)) * 6.0;
    let value = min(length(velocity) / max(frame.flow_scale, 1e-6), 1.0);
    return value * clamp(abs(hue - 3.0) - 1.0, vec3<f32>(0.0), vec3<f32>(1.0));
}

// Screen velocity of a point that moves through the world, px/s.
fn flow(mean: vec3<f32>, velocity: vec3<f32>) -> vec2<f32> {
    let p = (frame.view.camera_from_world * vec4<f32>(mean, 1.0)).xyz;
    let v = (frame.view.camera_from_world * vec4<f32>(velocity, 0.0)).xyz;
    return frame.view.focal * (v.xy - p.xy / p.z * v.z) / p.z;
}

// Base colour plus the palette's harmonics along the line of sight.
fn sight_color(base: vec3<f32>, mean: vec3<f32>, label: u32, block: u32) -> vec3<f32> {
    let degree = min(blocks[block].degree, frame.view.sh_degree);
    var rgb = base;
    if (degree > 0u) {
        let y = sh_basis(normalize(mean - frame.view.camera));
        let held = (blocks[block].degree + 1u) * (blocks[block].degree + 1u) - 1u;
        let first = blocks[block].palette + min(label, blocks[block].entries - 1u) * held;
        var k = 1u;
        for (var l = 1u; l <= degree; l++) {
            var sum = vec3<f32>(0.0);
            for (; k < (l + 1u) * (l + 1u); k++) {
                sum += y[k] * (codes_8(palette[first + k - 1u]) - 128.0);
            }
            rgb += sum * blocks[block].sh_range[l - 1u] / 127.0;
        }
    }
    return max(rgb, vec3<f32>(0.0));
}

// Axes of the ellipse with covariance xx, xy, yy. The shorter is det/longer, not a difference: needles stay sound.
fn set_axes(record: ptr<function, Record>, ellipse: Ellipse) {
    let xx = ellipse.cov2d.x;
    let xy = ellipse.cov2d.y;
    let yy = ellipse.cov2d.z;
    let half_gap = 0.5 * (xx - yy);
    let root = sqrt(half_gap * half_gap + xy * xy);
    let largest = 0.5 * (xx + yy) + root;
    // Of the two ways to write the eigenvector, the one without cancellation.
    let along = select(vec2<f32>(xy, root - half_gap), vec2<f32>(root + half_gap, xy), half_gap >= 0.0);
    let norm = length(along);
    let axis = select(vec2<f32>(1.0, 0.0), along / max(norm, 1e-30), norm > 1e-12 * largest);
    (*record).major = axis * sqrt(largest);
    // det of the covariance, from the conic: conic.xx = yy/det.
    (*record).minor = sqrt(yy / ellipse.conic.x / largest);
}

@compute @workgroup_size(256)
fn cull(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let slot = group.x + group.y * groups.x;
    if (slot >= frame.view.count) {
        return;
    }
    let block = block_list[slot];
    let header = blocks[block].f;
    let span = blocks[block].span;
    if (block_hidden(header, span)) {
        if (thread == 0u) {
            counts[slot] = 0u;
        }
        return;
    }
    var record: Record;
    var visible = false;
    if (thread < blocks[block].count) {
        let i = 2u * (block * BLOCK + thread);
        let a = words[i];
        let b = words[i + 1u];
        let w = array<u32, 8>(a.x, a.y, a.z, a.w, b.x, b.y, b.z, b.w);
        let life = life_at(w, header, span, frame.view.time);
        if (opacity_at(w, life) >= frame.view.alpha_min) {
            let g = gaussian(w, header, life);
            let ellipse = project(frame.view, g.mean, covariance(g.quat, g.scale), g.opacity);
            visible = ellipse.visible != 0u;
            if (visible) {
                record.center = ellipse.center;
                record.depth = ellipse.depth;
                set_axes(&record, ellipse);
                var rgb = vec3<f32>(0.0);
                if (frame.channel == CHANNEL_COLOR) {
                    rgb = sight_color(g.base, g.mean, g.label, block);
                } else if (frame.channel == CHANNEL_FLOW) {
                    rgb = flow_color(flow(g.mean, g.velocity));
                }
                record.color = vec2<u32>(pack2x16float(rgb.xy), pack2x16float(vec2<f32>(rgb.z, g.opacity * ellipse.rho)));
            }
        }
    }
    // Workgroup memory starts as zeros.
    if (thread == 0u) {
        atomicStore(&group_near, 0xffffffffu);
    }
    workgroupBarrier();
    if (visible) {
        atomicOr(&group_mask[thread / 32u], 1u << (thread % 32u));
        atomicMin(&group_near, bitcast<u32>(record.depth));
        atomicMax(&group_far, bitcast<u32>(record.depth));
    }
    workgroupBarrier();
    // A record's place is the number of visible threads below.
    var rank = countOneBits(atomicLoad(&group_mask[thread / 32u]) & ((1u << (thread % 32u)) - 1u));
    for (var w = 0u; w < thread / 32u; w++) {
        rank += countOneBits(atomicLoad(&group_mask[w]));
    }
    if (visible) {
        records[slot * BLOCK + rank] = record;
    }
    if (thread == BLOCK - 1u) {
        let count = rank + u32(visible);
        counts[slot] = count;
        if (count > 0u) {
            atomicMin(&range.near, atomicLoad(&group_near));
            atomicMax(&range.far, atomicLoad(&group_far));
        }
    }
}

// Exclusive sums of counts, the sum of all behind them, and in `arguments`:
// 0-2 workgroups of histogram and scatter, 3 number of records, 4-7 drawIndirect: vertices, instances, 0, 0.
@compute @workgroup_size(256)
fn total(@builtin(local_invocation_index) thread: u32) {
    let n = frame.view.count;
    let run = (n + BLOCK - 1u) / BLOCK;
    let first = min(thread * run, n);
    let end = min(first + run, n);
    var sum = 0u;
    for (var i = first; i < end; i++) {
        sum += counts[i];
    }
    group_sums[thread] = sum;
    workgroupBarrier();
    for (var step = 1u; step < BLOCK; step *= 2u) {
        var below = 0u;
        if (thread >= step) {
            below = group_sums[thread - step];
        }
        workgroupBarrier();
        group_sums[thread] += below;
        workgroupBarrier();
    }
    var before = group_sums[thread] - sum;
    for (var i = first; i < end; i++) {
        let count = counts[i];
        counts[i] = before;
        before += count;
    }
    if (thread == BLOCK - 1u) {
        let all = group_sums[thread];
        counts[n] = all;
        arguments[0] = (all + PAIRS - 1u) / PAIRS;
        arguments[1] = 1u;
        arguments[2] = 1u;
        arguments[3] = all;
        arguments[4] = 4u;
        arguments[5] = all;
        arguments[6] = 0u;
        arguments[7] = 0u;
    }
}

// The key grows with the depth's bits, that is about with its logarithm, from 0 at the nearest to KEY_MAX.
@compute @workgroup_size(256)
fn keys_of_depths(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let slot = group.x + group.y * groups.x;
    if (slot >= frame.view.count) {
        return;
    }
    let first = counts[slot];
    if (thread >= counts[slot + 1u] - first) {
        return;
    }
    let place = slot * BLOCK + thread;
    let near = atomicLoad(&range.near);
    let width = max(f32(atomicLoad(&range.far) - near), 1.0);
    let above = f32(bitcast<u32>(records[place].depth) - near);
    keys[first + thread] = u32(min(above / width, 1.0) * KEY_MAX);
    places[first + thread] = place;
}
