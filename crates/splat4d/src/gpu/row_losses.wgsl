// Losses on the geometry of the rows that are alive, each a mean over them: opacity, its entropy, scale. Twin of
// MeanOpacity, OpacityEntropy and MeanScale in splat4d-train's loss/scene.rs; learnt.wgsl and numbers.wgsl are put in
// front of this file.
//
// Bindings, group 0: 0 query; 1 rule; 2 counts ([3]: stopped); 3 params; 4 alive, as answer.wgsl left it; in and out: 5
// d_params, which is added to; 6 status, cleared to 0 before: rows alive at rule.count_at, and from rule.sums_at on the
// loss of each workgroup's rows, as bits. Five storage buffers. A thread owns one row; the rows of a workgroup are
// added in a fixed order.

// Probabilities are kept this far from 0 and 1 (loss/image/entropy.rs).
const MARGIN: f32 = 1e-4;
const THREADS: u32 = 256u;

struct RowRule {
    opacity: f32,
    entropy: f32,
    scale: f32,
    count_at: u32,
    sums_at: u32,
}

@group(0) @binding(0) var<uniform> query: Query;
@group(0) @binding(1) var<uniform> rule: RowRule;
@group(0) @binding(2) var<storage, read> counts: array<u32>;
@group(0) @binding(3) var<storage, read> params: array<f32>;
@group(0) @binding(4) var<storage, read> alive: array<u32>;
@group(0) @binding(5) var<storage, read_write> d_params: array<f32>;
@group(0) @binding(6) var<storage, read_write> status: array<atomic<u32>>;

var<workgroup> marks: array<u32, 256>;
var<workgroup> sums: array<f32, 256>;

// None where steps have stopped: the view is rendered again, and what other views gave must stay as it is.
fn lives(row: u32) -> bool {
    return counts[3] == 0u && row < query.rows && alive[min(row, query.rows - 1u)] != 0u;
}

@compute @workgroup_size(256)
fn count_rows(@builtin(global_invocation_id) id: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    marks[thread] = select(0u, 1u, lives(id.x));
    for (var step = THREADS / 2u; step > 0u; step /= 2u) {
        workgroupBarrier();
        if (thread < step) {
            marks[thread] += marks[thread + step];
        }
    }
    if (thread == 0u) {
        atomicAdd(&status[rule.count_at], marks[0]);
    }
}

@compute @workgroup_size(256)
fn row_losses(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let row = id.x;
    var sum = 0.0;
    if (lives(row)) {
        let share = 1.0 / f32(max(atomicLoad(&status[rule.count_at]), 1u));
        let o = sigmoid(params[at(row, OPACITY, query.width)]);
        let held = clamp(o, MARGIN, 1.0 - MARGIN);
        let entropy = -held * ln(held) - (1.0 - held) * ln(1.0 - held);
        var slope = rule.opacity;
        if (held == o) {
            slope += rule.entropy * ln((1.0 - o) / o);
        }
        let s = exp(three(query, row, LOG_SCALE)) / 3.0;
        sum = share * (rule.opacity * o + rule.entropy * entropy + rule.scale * (s.x + s.y + s.z));
        d_params[at(row, OPACITY, query.width)] += share * slope * o * (1.0 - o);
        for (var k = 0u; k < 3u; k++) {
            d_params[at(row, LOG_SCALE + k, query.width)] += share * rule.scale * s[k];
        }
    }
    sums[thread] = sum;
    for (var step = THREADS / 2u; step > 0u; step /= 2u) {
        workgroupBarrier();
        if (thread < step) {
            sums[thread] += sums[thread + step];
        }
    }
    if (thread == 0u) {
        atomicStore(&status[rule.sums_at + group.x], bitcast<u32>(sums[0]));
    }
}
