// The splats of a layer's rows at time t, and who is alive then. Twin of Motion::at for `still`, `spacetime` and a
// frame of `tracked`, with the lifespan of layers/envelope.rs; learnt.wgsl is put in front of this file.
//
// Bindings, group 0: 0 query; 1 params; out: 2 geometry as splats.wgsl reads it (mean 3, covariance 6, opacity 1;
// opacity 0 where the row is not alive), 3 alive, 1 a row that is alive at the time of any of the step's views; 4
// counts ([3]: stopped). Four storage buffers. A thread owns one row.

const GEOMETRY_WIDTH: u32 = 10u;

@group(0) @binding(0) var<uniform> query: Query;
@group(0) @binding(1) var<storage, read> params: array<f32>;
@group(0) @binding(2) var<storage, read_write> geometry: array<f32>;
@group(0) @binding(3) var<storage, read_write> alive: array<u32>;
@group(0) @binding(4) var<storage, read> counts: array<u32>;

// Phrased so that what is not a number is kept and found by Adam, not hidden.
fn dead(row: u32, opacity: f32, sigma: f32) -> bool {
    if (query.life == LIFE_INFINITE) {
        return false;
    }
    var reach = exp(params[at(row, query.life_at + 1u, query.width)]);
    if (query.life == LIFE_INTERVAL) {
        reach += exp(params[at(row, query.life_at + 2u, query.width)]) * query.widest;
    } else {
        reach *= query.widest;
    }
    return abs(delta_of(query, row)) > reach || opacity * sigma < query.alpha_min;
}

@compute @workgroup_size(ROW_THREADS)
fn answer(@builtin(global_invocation_id) id: vec3<u32>) {
    let row = id.x;
    // The list of live rows of a stopped step must stay.
    if (row >= query.rows || counts[3] != 0u) {
        return;
    }
    let g = moved(query, row, delta_of(query, row));
    let opacity = sigmoid(g.logit);
    let sigma = life_of(query, row).x;
    let lives = !dead(row, opacity, sigma);
    let r = rotation_rows(unit_of(g.quat).quat);
    let s = exp(g.log_scale);
    let s2 = s * s;
    let to = at(row, 0u, GEOMETRY_WIDTH);
    geometry[to] = g.mean.x;
    geometry[to + 16u] = g.mean.y;
    geometry[to + 32u] = g.mean.z;
    geometry[to + 48u] = dot(r[0] * r[0], s2);
    geometry[to + 64u] = dot(r[0] * r[1], s2);
    geometry[to + 80u] = dot(r[0] * r[2], s2);
    geometry[to + 96u] = dot(r[1] * r[1], s2);
    geometry[to + 112u] = dot(r[1] * r[2], s2);
    geometry[to + 128u] = dot(r[2] * r[2], s2);
    geometry[to + 144u] = select(0.0, opacity * sigma, lives);
    var mark = select(0u, 1u, lives);
    if ((query.flags & QUERY_FIRST) == 0u) {
        mark |= alive[row];
    }
    alive[row] = mark;
}
