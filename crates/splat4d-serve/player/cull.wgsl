// From the resident Gaussians of the pages at time t to a list of screen ellipses in the order of depth keys: the part
// before the sort. Concatenated after resident.wgsl, project.wgsl and shade.wgsl.
//
//   cull            a workgroup owns a block of 256: tests the block, then each thread its Gaussian, if the page's key
//                   masks admit it; what is visible becomes a record at its own index and a bit of the block's mask
//   total           one workgroup: exclusive sums of the masks' bits, and the arguments of indirect dispatches and draw
//   keys_of_depths  a workgroup owns a block again: 16-bit depth key and index of every record, without gaps
//
// Places are in the file's order, so all of this repeats from run to run, and where two depth keys are the same the
// lower index is in front, as in the CPU renderer's order (depth, id). Threads of cull do not wait for each other:
// software devices, which are what tests run on, would take three times as long.

// One image; 160 bytes.
struct Frame {
    view: View,              // count: blocks in block_list
    background: vec3<f32>,
    channel: u32,            // CHANNEL_*
    depth_range: vec2<f32>,  // near, far of the depth image, scene units
    flow_scale: f32,         // px/s rendered at full brightness
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
    color: vec2<u32>,   // r g | b as 16-bit floats, opacity as a 16-bit share of one
}

// What the GPU decides about a frame. The nearest and farthest depths are positive floats' bits, which sort alike.
struct Range {
    near: atomic<u32>,
    far: atomic<u32>,
}

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> words: array<vec4<u32>>;        // two per Gaussian
@group(0) @binding(2) var<storage, read> blocks: array<BlockHeader>;     // one a resident block
@group(0) @binding(3) var<storage, read> block_list: array<u32>;         // the blocks of the pages at this time
@group(0) @binding(4) var<storage, read> palette: array<u32>;            // a word a coefficient: bytes r, g, b
@group(0) @binding(5) var<storage, read_write> records: array<Record>;   // 256 a listed block
@group(0) @binding(6) var<storage, read_write> masks: array<atomic<u32>>; // 8 a listed block; cleared before cull
@group(0) @binding(7) var<storage, read_write> range: Range;
@group(0) @binding(8) var<storage, read_write> arguments: array<u32>;    // see total
@group(0) @binding(9) var<storage, read_write> keys: array<u32>;
@group(0) @binding(10) var<storage, read_write> places: array<u32>;
@group(0) @binding(11) var<storage, read_write> firsts: array<u32>;      // records before a listed block
@group(0) @binding(16) var<storage, read> admitted: array<u32>;          // 8 a resident block: key masks at this time

const BLOCK: u32 = 256u;
// Standard deviations to alpha = 1/255 of an opaque Gaussian, sqrt(2 ln 255), rounded up.
const SIGMAS: f32 = 3.34;
// What is alive is at most this many reaches from its centre: (h + 3.33 s)/(h + 3 s), rounded up.
const LIFE_REACHES: f32 = 1.12;
// Largest key: two passes of eight bits.
const KEY_MAX: f32 = 65535.0;
// Vertices of a splat in draw.wgsl.
const CORNERS: u32 = 6u;
// 32-bit words that hold a bit for each Gaussian of a block.
const MASKS: u32 = 8u;
// Pairs that a workgroup of sort.wgsl takes (SORT_BLOCK there).
const PAIRS: u32 = 2048u;
// Its scan takes a workgroup a digit, or one for all up to this many pairs (SORT_FEW blocks there).
const SCAN_GROUPS: u32 = 256u;
const FEW_PAIRS: u32 = 65536u;

var<workgroup> group_sums: array<u32, 256>;

// Whether nothing of the block is visible. When in doubt the block is rendered.
fn block_hidden(header: array<vec4<f32>, 6>, span: f32) -> bool {
    let t = frame.view.time;
    if (t < header[2].x || t > header[2].y) {
        return true;
    }
    // Within a lifespan a mean strays by the shift; outside its centre's range, by the span at most.
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
    // A side of the image, multiplied by z, is a plane; the ellipse widens it by SIGMAS |J| sigma_max and by the
    // low-pass. |J| is bounded by its clamp to the image and PROJECT_J_MARGIN.
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
    if (thread >= blocks[block].count || block_hidden(header, span)) {
        return;
    }
    if (((admitted[block * MASKS + thread / 32u] >> (thread % 32u)) & 1u) == 0u) {
        return;
    }
    let i = 2u * (block * BLOCK + thread);
    let a = words[i];
    let b = words[i + 1u];
    let w = array<u32, 8>(a.x, a.y, a.z, a.w, b.x, b.y, b.z, b.w);
    let life = life_at(w, header, span, frame.view.time);
    if (!(opacity_at(w, life) >= frame.view.alpha_min)) {
        return;
    }
    let g = gaussian(w, header, life);
    let ellipse = project(frame.view, g.mean, covariance(g.quat, g.scale), g.opacity);
    if (ellipse.visible == 0u) {
        return;
    }
    var record: Record;
    record.center = ellipse.center;
    record.depth = ellipse.depth;
    set_axes(&record, ellipse);
    var rgb = vec3<f32>(0.0);
    if (frame.channel == CHANNEL_COLOR) {
        rgb = sight_color(g.base, g.mean, g.label, block);
    } else if (frame.channel == CHANNEL_FLOW) {
        rgb = flow_color(flow(g.mean, g.velocity));
    }
    let opacity = pack2x16unorm(vec2<f32>(0.0, g.opacity * ellipse.rho));
    record.color = vec2<u32>(pack2x16float(rgb.xy), pack2x16float(vec2<f32>(rgb.z, 0.0)) | opacity);
    records[slot * BLOCK + thread] = record;
    atomicOr(&masks[slot * MASKS + thread / 32u], 1u << (thread % 32u));
    // Looking first keeps all but a few threads from queueing for these two.
    let depth = bitcast<u32>(record.depth);
    if (depth < atomicLoad(&range.near)) {
        atomicMin(&range.near, depth);
    }
    if (depth > atomicLoad(&range.far)) {
        atomicMax(&range.far, depth);
    }
}

// Records of a listed block.
fn records_of(slot: u32) -> u32 {
    var sum = 0u;
    for (var w = 0u; w < MASKS; w++) {
        sum += countOneBits(atomicLoad(&masks[slot * MASKS + w]));
    }
    return sum;
}

// Exclusive sums of the blocks' records, and in `arguments`:
// 0-2 workgroups of histogram and scatter, 3 number of records, 4-7 drawIndirect: vertices, one instance, 0, 0,
// 8-10 workgroups of scan.
@compute @workgroup_size(256)
fn total(@builtin(local_invocation_index) thread: u32) {
    let n = frame.view.count;
    let run = (n + BLOCK - 1u) / BLOCK;
    let first = min(thread * run, n);
    let end = min(first + run, n);
    var sum = 0u;
    for (var i = first; i < end; i++) {
        sum += records_of(i);
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
        firsts[i] = before;
        before += records_of(i);
    }
    if (thread == BLOCK - 1u) {
        let all = group_sums[thread];
        arguments[0] = (all + PAIRS - 1u) / PAIRS;
        arguments[1] = 1u;
        arguments[2] = 1u;
        arguments[3] = all;
        arguments[4] = CORNERS * all;
        arguments[5] = 1u;
        arguments[6] = 0u;
        arguments[7] = 0u;
        arguments[8] = select(SCAN_GROUPS, 1u, all <= FEW_PAIRS);
        arguments[9] = 1u;
        arguments[10] = 1u;
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
    let word = thread / 32u;
    let bit = 1u << (thread % 32u);
    let mask = atomicLoad(&masks[slot * MASKS + word]);
    if ((mask & bit) == 0u) {
        return;
    }
    var to = firsts[slot] + countOneBits(mask & (bit - 1u));
    for (var w = 0u; w < word; w++) {
        to += countOneBits(atomicLoad(&masks[slot * MASKS + w]));
    }
    let place = slot * BLOCK + thread;
    let near = atomicLoad(&range.near);
    let width = max(f32(atomicLoad(&range.far) - near), 1.0);
    let above = f32(bitcast<u32>(records[place].depth) - near);
    keys[to] = u32(min(above / width, 1.0) * KEY_MAX);
    places[to] = place;
}
