// A step of Adam on one table of a layer. Twin of splat4d-train's optim/adam.rs, which documents the equations.
//
// Bindings, group 0: 0 rule; 1 counts ([3]: stopped); 2 params, 3 gradient: buffers of `stride` columns, of which the
// table has some; 4 moments: a buffer of `moments_stride` columns, first and second moments and the row's step count; 5
// alive: the rows that take part; 6 corrections by step count, made by the CPU; 7 status, a word a table: one more than
// the last row whose number is not finite. Seven storage buffers. A thread owns one row. A table with more columns than
// there is room for rates is taken in pieces, in order.

const TABLE_BLOCK: u32 = 16u;
const ROW_THREADS: u32 = 256u;
const BETA1: f32 = 0.8;
const BETA2: f32 = 0.99;
const EPSILON: f32 = 1e-15;
const LARGEST: f32 = 3.4028234e38;

struct Rule {
    rows: u32,
    width: u32,           // columns of the table
    stride: u32,          // columns of params and gradient, and the table's first
    first: u32,
    moments_stride: u32,
    moments_first: u32,
    counted: u32,         // entries of corrections
    floor_column: u32,    // lifted to floor_least; none: width
    floor_least: f32,
    first_row: u32,       // of this page of the table
    word: u32,            // of status
    start: u32,           // first column of this piece, and how many it has
    columns: u32,
    unused_0: u32,
    unused_1: u32,
    unused_2: u32,
    rates: array<vec4<f32>, 12>, // a rate a column; 0: frozen
}

@group(0) @binding(0) var<uniform> rule: Rule;
@group(0) @binding(1) var<storage, read> counts: array<u32>;
@group(0) @binding(2) var<storage, read_write> params: array<f32>;
@group(0) @binding(3) var<storage, read> gradient: array<f32>;
@group(0) @binding(4) var<storage, read_write> moments: array<f32>;
@group(0) @binding(5) var<storage, read> alive: array<u32>;
@group(0) @binding(6) var<storage, read> corrections: array<vec2<f32>>;
@group(0) @binding(7) var<storage, read_write> status: array<atomic<u32>>;

fn at(row: u32, column: u32, width: u32) -> u32 {
    return (row / TABLE_BLOCK * width + column) * TABLE_BLOCK + row % TABLE_BLOCK;
}

@compute @workgroup_size(ROW_THREADS)
fn adam(@builtin(global_invocation_id) id: vec3<u32>) {
    let row = id.x;
    if (row >= rule.rows || counts[3] != 0u) {
        return;
    }
    if (alive[row] == 0u) {
        return;
    }
    let first = at(row, rule.first, rule.stride);
    let first_moment = at(row, rule.moments_first, rule.moments_stride);
    let second_moment = first_moment + rule.width * TABLE_BLOCK;
    let steps = second_moment + rule.width * TABLE_BLOCK;
    let count = moments[steps] + 1.0;
    // The last piece counts.
    if (rule.start + rule.columns == rule.width) {
        moments[steps] = count;
    }
    let correct = corrections[min(u32(count), rule.counted - 1u)];
    var bad = false;
    for (var i = 0u; i < rule.columns; i++) {
        let rate = rule.rates[i / 4u][i % 4u];
        if (rate != 0.0) {
            let c = rule.start + i;
            let step = c * TABLE_BLOCK;
            let d = gradient[first + step];
            let m1 = BETA1 * moments[first_moment + step] + (1.0 - BETA1) * d;
            let m2 = BETA2 * moments[second_moment + step] + (1.0 - BETA2) * d * d;
            moments[first_moment + step] = m1;
            moments[second_moment + step] = m2;
            var x = params[first + step] - rate * (m1 * correct.x) / (sqrt(m2 * correct.y) + EPSILON);
            // Before the floor, because a maximum would hide what is not a number.
            bad = bad || !(abs(x) <= LARGEST);
            if (c == rule.floor_column) {
                x = max(x, rule.floor_least);
            }
            params[first + step] = x;
        }
    }
    if (bad) {
        atomicMax(&status[rule.word], rule.first_row + row + 1u);
    }
}
