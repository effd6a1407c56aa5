// From the gradient to a splat's colour to those of its SH coefficients and, through the direction, of its mean; and
// the statistics of densification. Twin of the VJP in render/shade.rs and of Stats::observe in splat4d-train's
// learner.rs; render/project.wgsl, render/shade.wgsl and learnt.wgsl are put in front of this file.
//
// Bindings, group 0: 0 view; 1 query; 2 counts ([3]: stopped); 3 geometry as answer.wgsl wrote it, 4 params: here the
// SH table; in and out: 5 back as splats_back.wgsl wrote it, whose means are added to; 6 d_sh, as the SH table; 7
// stats, three columns per row: sum of |dL/dmean2d|, number of views that rendered it, largest radius; 8 weights of the
// blocks of SH, which the gradients replace. Seven storage buffers. A thread owns one row.

const GEOMETRY_WIDTH: u32 = 10u;
const STATS_WIDTH: u32 = 3u;

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> query: Query;
@group(0) @binding(2) var<storage, read> counts: array<u32>;
@group(0) @binding(3) var<storage, read> geometry: array<f32>;
@group(0) @binding(4) var<storage, read> params: array<f32>;
@group(0) @binding(5) var<storage, read_write> back: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> d_sh: array<f32>;
@group(0) @binding(7) var<storage, read_write> stats: array<f32>;
@group(0) @binding(8) var<storage, read_write> weights: array<f32>;

// Gradients of the basis functions of shade.wgsl. Twin of math/sh.rs (basis_gradient).
fn sh_basis_gradient(d: vec3<f32>) -> array<vec3<f32>, 16> {
    let x = d.x;
    let y = d.y;
    let z = d.z;
    let xx = x * x;
    let yy = y * y;
    let zz = z * z;
    return array<vec3<f32>, 16>(
        vec3<f32>(0.0),
        vec3<f32>(0.0, -SH_C1, 0.0),
        vec3<f32>(0.0, 0.0, SH_C1),
        vec3<f32>(-SH_C1, 0.0, 0.0),
        SH_C2_XY * vec3<f32>(y, x, 0.0),
        -SH_C2_XY * vec3<f32>(0.0, z, y),
        SH_C2_ZZ * vec3<f32>(-2.0 * x, -2.0 * y, 4.0 * z),
        -SH_C2_XY * vec3<f32>(z, 0.0, x),
        SH_C2_XX * vec3<f32>(2.0 * x, -2.0 * y, 0.0),
        -SH_C3_YXX * vec3<f32>(6.0 * x * y, 3.0 * (xx - yy), 0.0),
        SH_C3_XYZ * vec3<f32>(y * z, x * z, x * y),
        -SH_C3_YZZ * vec3<f32>(-2.0 * x * y, 4.0 * zz - xx - 3.0 * yy, 8.0 * y * z),
        SH_C3_ZZZ * vec3<f32>(-6.0 * x * z, -6.0 * y * z, 6.0 * zz - 3.0 * xx - 3.0 * yy),
        -SH_C3_YZZ * vec3<f32>(4.0 * zz - 3.0 * xx - yy, -2.0 * x * y, 8.0 * x * z),
        SH_C3_ZXX * vec3<f32>(2.0 * x * z, -2.0 * y * z, xx - yy),
        -SH_C3_YXX * vec3<f32>(3.0 * (xx - yy), -6.0 * x * y, 0.0),
    );
}

@compute @workgroup_size(ROW_THREADS)
fn colors_back(@builtin(global_invocation_id) id: vec3<u32>) {
    let row = id.x;
    // Where steps have stopped there are no gradients: the view is rendered again.
    if (row >= query.rows || counts[3] != 0u) {
        return;
    }
    if ((query.flags & QUERY_FIRST) != 0u) {
        for (var c = 0u; c < query.sh_width; c++) {
            d_sh[at(row, c, query.sh_width)] = 0.0;
        }
    }
    var weight = vec3<f32>(1.0);
    if (query.blocks > 1u) {
        for (var b = 0u; b < query.blocks; b++) {
            let i = at(row, b, query.blocks);
            weight[b] = weights[i];
            weights[i] = 0.0;
        }
    }
    let splat = 5u * (query.first_splat + row);
    let radius = back[splat + 2u].z;
    if (radius <= 0.0) {
        return;
    }
    let seen = at(row, 0u, STATS_WIDTH);
    stats[seen] += back[splat + 3u].w;
    stats[seen + 16u] += 1.0;
    stats[seen + 32u] = max(stats[seen + 32u], radius);
    // A channel that was clamped at 0 passes nothing.
    let v = select(vec3<f32>(0.0), back[splat + 3u].xyz, back[splat + 4u].xyz > vec3<f32>(0.0));
    let block = query.sh_width / query.blocks;
    let used = sh_used(block / 3u, view.sh_degree);
    if (all(v == vec3<f32>(0.0)) || used == 0u) {
        return;
    }
    let g = at(row, 0u, GEOMETRY_WIDTH);
    let to = vec3<f32>(geometry[g], geometry[g + 16u], geometry[g + 32u]) - view.camera;
    let inverse = 1.0 / sqrt(dot(to, to));
    let unit = to * inverse;
    var basis = sh_basis(unit);
    var slopes = sh_basis_gradient(unit);
    var d_unit = vec3<f32>(0.0);
    for (var b = 0u; b < query.blocks; b++) {
        var d_weight = 0.0;
        for (var k = 0u; k < used; k++) {
            let i = at(row, b * block + 3u * k, query.sh_width);
            let d = weight[b] * basis[k] * v;
            d_sh[i] += d.x;
            d_sh[i + 16u] += d.y;
            d_sh[i + 32u] += d.z;
            let light = dot(vec3<f32>(params[i], params[i + 16u], params[i + 32u]), v);
            d_weight += basis[k] * light;
            d_unit += weight[b] * light * slopes[k];
        }
        if (query.blocks > 1u) {
            weights[at(row, b, query.blocks)] = d_weight;
        }
    }
    if (used > 1u) {
        let d_mean = (d_unit - unit * dot(unit, d_unit)) * inverse;
        back[splat] += vec4<f32>(d_mean, 0.0);
    }
}
