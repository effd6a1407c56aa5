// The splats of a layer of Gaussians of space and time, who is alive, and the weights of their blocks of colours. Twin
// of Motion::at for `native4d` and of layers/envelope.rs; learnt.wgsl, numbers.wgsl and slice.wgsl are put in front of
// this file.
//
// Bindings, group 0: 0 query; 1 params; out: 2 geometry and 3 alive as answer.wgsl writes them, 4 weights as
// splats.wgsl reads them, [row / 16][block][16], where there are several blocks; 5 counts ([3]: stopped). Five storage
// buffers. A thread owns one row.

const GEOMETRY_WIDTH: u32 = 10u;

@group(0) @binding(0) var<uniform> query: Query;
@group(0) @binding(1) var<storage, read> params: array<f32>;
@group(0) @binding(2) var<storage, read_write> geometry: array<f32>;
@group(0) @binding(3) var<storage, read_write> alive: array<u32>;
@group(0) @binding(4) var<storage, read_write> weights: array<f32>;
@group(0) @binding(5) var<storage, read> counts: array<u32>;

fn cov(s: Slice, blur: f32, i: u32, j: u32) -> f32 {
    return dot(s.k[i], s.k[j]) + s.v[i] * s.v[j] * blur;
}

@compute @workgroup_size(ROW_THREADS)
fn answer(@builtin(global_invocation_id) id: vec3<u32>) {
    let row = id.x;
    // The list of live rows of a stopped step must stay.
    if (row >= query.rows || counts[3] != 0u) {
        return;
    }
    let s = slice_of(query, row);
    let opacity = sigmoid(s.logit) * exp(-0.5 * s.square);
    // Phrased so that what is not a number is kept and found by Adam, not hidden.
    let lives = !(abs(s.tau) > query.widest * sqrt(s.lifted) || opacity < query.alpha_min);
    // What the floor adds to c leaves a part of v in the slice.
    let blur = (s.lifted - s.c) * s.inverse * s.inverse;
    let mean = s.mean + s.v * (s.tau * s.inverse);
    let to = at(row, 0u, GEOMETRY_WIDTH);
    geometry[to] = mean.x;
    geometry[to + 16u] = mean.y;
    geometry[to + 32u] = mean.z;
    geometry[to + 48u] = cov(s, blur, 0u, 0u);
    geometry[to + 64u] = cov(s, blur, 0u, 1u);
    geometry[to + 80u] = cov(s, blur, 0u, 2u);
    geometry[to + 96u] = cov(s, blur, 1u, 1u);
    geometry[to + 112u] = cov(s, blur, 1u, 2u);
    geometry[to + 128u] = cov(s, blur, 2u, 2u);
    geometry[to + 144u] = select(0.0, opacity, lives);
    var mark = select(0u, 1u, lives);
    if ((query.flags & QUERY_FIRST) == 0u) {
        mark |= alive[row];
    }
    alive[row] = mark;
    if (query.blocks > 1u) {
        for (var n = 0u; n < query.blocks; n++) {
            weights[at(row, n, query.blocks)] = wave(query, row, n).x;
        }
    }
}
