// From the gradients of a layer's splats to those of its rows. Twin of Motion::backward for `still`, `spacetime` and a
// frame of `tracked`, of the lifespan's VJP in layers/envelope.rs; learnt.wgsl and put.wgsl are put in front of this
// file.
//
// Bindings, group 0: 0 query; 1 counts ([3]: stopped); 2 params; 3 back as colors_back.wgsl left it (mean, opacity;
// covariance); out: 4 d_params, laid out as params: overwritten by the step's first view, added to by the others. Four
// storage buffers. A thread owns one row.

@group(0) @binding(0) var<uniform> query: Query;
@group(0) @binding(1) var<storage, read> counts: array<u32>;
@group(0) @binding(2) var<storage, read> params: array<f32>;
@group(0) @binding(3) var<storage, read> back: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> d_params: array<f32>;

@compute @workgroup_size(ROW_THREADS)
fn answer_back(@builtin(global_invocation_id) id: vec3<u32>) {
    let row = id.x;
    if (row >= query.rows || counts[3] != 0u) {
        return;
    }
    let splat = 5u * (query.first_splat + row);
    let d0 = back[splat];
    let d1 = back[splat + 1u];
    let d2 = back[splat + 2u];
    let delta = delta_of(query, row);
    let g = moved(query, row, delta);
    let life = life_of(query, row);
    let opacity = sigmoid(g.logit);
    let d_logit = d0.w * life.x * opacity * (1.0 - opacity);
    // With M = R S: dL/dM = 2 G M, G the full symmetric gradient to the covariance.
    let unit = unit_of(g.quat);
    let r = rotation_rows(unit.quat);
    let s = exp(g.log_scale);
    let sym = mat3x3<f32>(
        vec3<f32>(d1.x, 0.5 * d1.y, 0.5 * d1.z),
        vec3<f32>(0.5 * d1.y, d1.w, 0.5 * d2.x),
        vec3<f32>(0.5 * d1.z, 0.5 * d2.x, d2.y),
    );
    // Columns of R and of the gradient to it.
    var d_log = vec3<f32>(0.0);
    var d_r: mat3x3<f32>;
    for (var k = 0u; k < 3u; k++) {
        let column = vec3<f32>(r[0][k], r[1][k], r[2][k]);
        let d_m = 2.0 * (sym * (column * s[k]));
        d_log[k] = dot(column, d_m) * s[k];
        d_r[k] = s[k] * d_m;
    }
    let d_quat = unit_back(unit, rotation_back(unit.quat, d_r));
    if (query.poses_at > 0u) {
        // The geometry's own poses are another frame's.
        put_three(row, 0u, vec3<f32>(0.0));
        put_four(row, QUAT, vec4<f32>(0.0));
    }
    put_three(row, query.poses_at, d0.xyz);
    put_four(row, query.poses_at + QUAT, d_quat);
    put_three(row, LOG_SCALE, d_log);
    put(row, OPACITY, d_logit);
    // d/d delta of v_k delta^k is k v_k delta^(k - 1).
    var d_delta = 0.0;
    var power = 1.0;
    for (var k = 0u; k < query.order; k++) {
        let column = query.velocities_at + 3u * k;
        d_delta += f32(k + 1u) * power * dot(three(query, row, column), d0.xyz);
        power *= delta;
        put_three(row, column, power * d0.xyz);
    }
    if ((query.flags & QUERY_ROTATION) != 0u) {
        d_delta += dot(four(query, row, query.rates_at), d_quat);
        put_four(row, query.rates_at, delta * d_quat);
    }
    if (query.life != LIFE_INFINITE) {
        let d_sigma = d0.w * opacity;
        var d_center = -d_sigma * life.y;
        if ((query.flags & QUERY_DETACH) == 0u) {
            d_center -= d_delta;
        }
        put(row, query.life_at, d_center);
        put(row, query.life_at + 1u, d_sigma * life.z);
        if (query.life == LIFE_INTERVAL) {
            put(row, query.life_at + 2u, d_sigma * life.w);
        }
    }
}
