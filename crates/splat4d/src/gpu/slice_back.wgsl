// From the gradients of a layer's splats to those of its Gaussians of space and time. Twin of Motion::backward for
// `native4d` (slice_backward in motion/native4d/slice.rs); learnt.wgsl, put.wgsl, numbers.wgsl and slice.wgsl are put
// in front of this file.
//
// Bindings, group 0: 0 query; 1 counts ([3]: stopped); 2 params; 3 back as colors_back.wgsl left it; 4 weights: the
// gradients that it left there; out: 5 d_params, as answer_back.wgsl writes it. Five storage buffers. A thread owns one
// row.

const TAU: f32 = 6.283185307179586;

@group(0) @binding(0) var<uniform> query: Query;
@group(0) @binding(1) var<storage, read> counts: array<u32>;
@group(0) @binding(2) var<storage, read> params: array<f32>;
@group(0) @binding(3) var<storage, read> back: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> weights: array<f32>;
@group(0) @binding(5) var<storage, read_write> d_params: array<f32>;

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
    var s = slice_of(query, row);
    let m = mat3x3<f32>(
        vec3<f32>(d1.x, 0.5 * d1.y, 0.5 * d1.z),
        vec3<f32>(0.5 * d1.y, d1.w, 0.5 * d2.x),
        vec3<f32>(0.5 * d1.z, 0.5 * d2.x, d2.y),
    );
    let d_mean = d0.xyz;
    let opacity = sigmoid(s.logit);
    let life = exp(-0.5 * s.square);
    let d_logit = d0.w * life * opacity * (1.0 - opacity);
    // h w, zero where the exponent has stopped.
    let fade = select(0.0, d0.w * opacity * life, s.near);
    let d_tau = s.inverse * (dot(d_mean, s.v) - fade * s.tau);
    // Where c is free, the terms of dL/dc join those of dL/dv: K replaces L, and -tau dtau/c is left along its row.
    let free = s.c > query.floor;
    let side = s.inverse * (d_mean * s.tau - 2.0 * (m * s.v));
    let along = select(0.0, -s.tau * s.inverse * d_tau, free);
    var d_scales = vec4<f32>(0.0);
    var d_rotation: mat4x4<f32>;
    for (var k = 0u; k < 4u; k++) {
        let e = s.l[3][k];
        let column = vec3<f32>(s.k[0][k], s.k[1][k], s.k[2][k]);
        let through = select(vec3<f32>(s.l[0][k], s.l[1][k], s.l[2][k]), column, free);
        let d_l = vec4<f32>(
            2.0 * (m * column) + d_mean * (s.tau * s.inverse * e),
            dot(side, through) + along * e,
        );
        d_scales[k] = dot(d_l, vec4<f32>(s.rotation[0][k], s.rotation[1][k], s.rotation[2][k], s.rotation[3][k]));
        for (var i = 0u; i < 4u; i++) {
            d_rotation[i][k] = d_l[i] * s.scales[k];
        }
    }
    let a = to_products(d_rotation);
    // Rows times the right quaternion, columns times the left one.
    let d_left = vec4<f32>(dot(a[0], s.right.quat), dot(a[1], s.right.quat), dot(a[2], s.right.quat), dot(a[3], s.right.quat));
    let d_right = a * s.left.quat;
    var d_time = query.speed * d_tau;
    for (var n = 1u; n < query.blocks; n++) {
        // cos(2 pi n (mu - t)/T), whose slope to t has the opposite sign.
        d_time += TAU * f32(n) * query.pace * wave(query, row, n).y * weights[at(row, n, query.blocks)];
    }
    put_three(row, 0u, d_mean);
    put_four(row, QUAT, unit_back(s.left, d_left));
    put_three(row, LOG_SCALE, d_scales.xyz * s.scales.xyz);
    put(row, OPACITY, d_logit);
    put(row, query.own_at, -d_time);
    put(row, query.own_at + LOG_TIME_SCALE, select(0.0, d_scales.w * s.scales.w, s.grows));
    put_four(row, query.own_at + RIGHT, unit_back(s.right, d_right));
}
