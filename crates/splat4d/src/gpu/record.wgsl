// The record of a step on resident tables: sums over the tiles of each view, the cameras' colour matrices, and the
// record that the CPU reads some steps later. Twin of Exposure::step in splat4d-train's learner/exposure.rs.
//
// Three entries of one workgroup each: view_sums after each view, cameras and record after the step's last. Bindings,
// group 0: 0 rule; 1 counts ([1]: visible splats, [2]: pairs, [3]: where steps stopped, [4]: pairs that were requested
// then); 2 partials of loss.wgsl; 3 status: eight words of the step, eight a view, then those of the other kernels; 4
// responses: of every camera the twelve numbers that loss.wgsl reads, then in the same order their gradients, first
// moments, second moments, and behind them all a step count a camera and 1 for each that is held about the mean; 5
// corrections of adam.wgsl. Five storage buffers.

const THREADS: u32 = 256u;
const NUMBERS: u32 = 16u;  // of a tile
const COLUMNS: u32 = 12u;  // of a camera
const FIRST: u32 = 4u;     // of these among a tile's
const LANES: u32 = 16u;    // that add up one of them
const STEP_WORDS: u32 = 8u;
const VIEW_WORDS: u32 = 8u;
const STOP: u32 = 3u;
const WANTED: u32 = 4u;
// Where steps stop because of a number that is none.
const NOT_FINITE: u32 = 0xffffffffu;
// Of adam.wgsl.
const BETA1: f32 = 0.8;
const BETA2: f32 = 0.99;
const EPSILON: f32 = 1e-15;

struct Rule {
    tiles: u32,
    view: u32,
    camera: u32,     // 0xffffffff: it shows what is rendered
    cameras: u32,
    bad_at: u32,     // words of status that are not 0 where a number is none, and how many
    bad_words: u32,
    counted: u32,    // entries of corrections
    rate: f32,       // of the cameras; 0: they rest
}

@group(0) @binding(0) var<uniform> rule: Rule;
@group(0) @binding(1) var<storage, read_write> counts: array<u32>;
@group(0) @binding(2) var<storage, read> partials: array<f32>;
@group(0) @binding(3) var<storage, read_write> status: array<u32>;
@group(0) @binding(4) var<storage, read_write> responses: array<f32>;
@group(0) @binding(5) var<storage, read> corrections: array<vec2<f32>>;

var<workgroup> sums: array<f32, 256>;

// The sums of a view over its tiles, sixteen lanes a number in a fixed order. A thread owns a lane, then a number.
@compute @workgroup_size(256)
fn view_sums(@builtin(local_invocation_index) thread: u32) {
    let number = thread % NUMBERS;
    var sum = 0.0;
    for (var tile = thread / NUMBERS; tile < rule.tiles; tile += LANES) {
        sum += partials[NUMBERS * tile + number];
    }
    sums[thread] = sum;
    workgroupBarrier();
    // The view is rendered again, and what others gave must stay as it is.
    if (thread >= NUMBERS || counts[STOP] != 0u) {
        return;
    }
    sum = 0.0;
    for (var lane = 0u; lane < LANES; lane++) {
        sum += sums[lane * NUMBERS + thread];
    }
    let to = STEP_WORDS + VIEW_WORDS * rule.view;
    if (thread < 3u) {
        status[to + thread] = bitcast<u32>(sum);
    }
    if (thread == 3u) {
        status[to + 3u] = counts[1];
        status[to + 4u] = counts[2];
    }
    if (thread >= FIRST && rule.camera < rule.cameras) {
        responses[COLUMNS * (rule.cameras + rule.camera) + thread - FIRST] += sum;
    }
}

// Adam on all cameras, whose mean stays the identity. A thread owns a column.
@compute @workgroup_size(16)
fn cameras(@builtin(local_invocation_index) column: u32) {
    if (column >= COLUMNS || counts[STOP] != 0u) {
        return;
    }
    let all = COLUMNS * rule.cameras;
    let steps = 4u * all;
    var mean = 0.0;
    var held = 0.0;
    for (var camera = 0u; camera < rule.cameras; camera++) {
        let i = COLUMNS * camera + column;
        if (rule.rate != 0.0) {
            let count = responses[steps + camera] + 1.0;
            let correct = corrections[min(u32(count), rule.counted - 1u)];
            let d = responses[all + i];
            let m1 = BETA1 * responses[2u * all + i] + (1.0 - BETA1) * d;
            let m2 = BETA2 * responses[3u * all + i] + (1.0 - BETA2) * d * d;
            responses[2u * all + i] = m1;
            responses[3u * all + i] = m2;
            responses[i] -= rule.rate * (m1 * correct.x) / (sqrt(m2 * correct.y) + EPSILON);
            let part = responses[steps + rule.cameras + camera];
            mean += part * responses[i];
            held += part;
        }
        responses[all + i] = 0.0;
    }
    if (rule.rate == 0.0) {
        return;
    }
    mean /= max(held, 1.0);
    for (var camera = 0u; camera < rule.cameras; camera++) {
        responses[COLUMNS * camera + column] -= responses[steps + rule.cameras + camera] * mean;
    }
}

// The step's own words; counts the cameras' steps. A number that is none stops all steps that follow.
@compute @workgroup_size(256)
fn record(@builtin(local_invocation_index) thread: u32) {
    let stopped = counts[STOP] != 0u;
    if (!stopped && rule.rate != 0.0) {
        for (var camera = thread; camera < rule.cameras; camera += THREADS) {
            responses[4u * COLUMNS * rule.cameras + camera] += 1.0;
        }
    }
    storageBarrier();
    if (thread == 0u) {
        if (!stopped) {
            for (var i = 0u; i < rule.bad_words; i++) {
                if (status[rule.bad_at + i] != 0u) {
                    counts[STOP] = NOT_FINITE;
                }
            }
        }
        status[0] = counts[STOP];
        status[1] = counts[WANTED];
    }
}
