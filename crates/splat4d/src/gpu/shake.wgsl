// Noise on the positions of the rows that are alive, after Adam. Twin of splat4d-train's optim/noise.rs, which
// documents the equation; learnt.wgsl and numbers.wgsl are put in front of this file.
//
// Bindings, group 0: 0 query; 1 noise; 2 counts ([3]: stopped); 3 alive; in and out: 4 params. Three storage buffers. A
// thread owns one row.

struct Noise {
    strength: f32,
    dead: f32,         // opacity at which the gate is half open
    slope: f32,
    limit: f32,        // logit above which there is none
    key: vec2<u32>,    // of the stream, of which a row has a fork
}

@group(0) @binding(0) var<uniform> query: Query;
@group(0) @binding(1) var<uniform> noise: Noise;
@group(0) @binding(2) var<storage, read> counts: array<u32>;
@group(0) @binding(3) var<storage, read> alive: array<u32>;
@group(0) @binding(4) var<storage, read_write> params: array<f32>;

@compute @workgroup_size(ROW_THREADS)
fn shake(@builtin(global_invocation_id) id: vec3<u32>) {
    let row = id.x;
    if (row >= query.rows || counts[3] != 0u) {
        return;
    }
    let logit = params[at(row, OPACITY, query.width)];
    if (alive[row] == 0u || logit > noise.limit) {
        return;
    }
    let gate = sigmoid(-noise.slope * (sigmoid(logit) - noise.dead));
    let r = rotation_rows(unit_of(four(query, row, QUAT)).quat);
    let s = exp(three(query, row, LOG_SCALE));
    let key = fork(noise.key, query.first_row + row);
    let e = gate * noise.strength * vec3<f32>(normal(key, 0u), normal(key, 1u), normal(key, 2u));
    // R S S R^T e, and r holds the rows of R.
    let along = s * s * vec3<f32>(
        r[0].x * e.x + r[1].x * e.y + r[2].x * e.z,
        r[0].y * e.x + r[1].y * e.y + r[2].y * e.z,
        r[0].z * e.x + r[1].z * e.y + r[2].z * e.z,
    );
    params[at(row, 0u, query.width)] += dot(r[0], along);
    params[at(row, 1u, query.width)] += dot(r[1], along);
    params[at(row, 2u, query.width)] += dot(r[2], along);
}
