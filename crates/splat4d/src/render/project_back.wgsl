// From the gradient of an ellipse on the screen to that of its Gaussian and of the camera's pose. Twin of
// project_backward in render/project.rs, which documents the equations and their sources. render/project.wgsl is put in
// front of this file.
//
// No bindings and no entry point: plain functions, put in front of whatever shader calls them. A thread owns one
// Gaussian.

// Radius in standard deviations that is reported (Inria).
const RADIUS_SIGMAS: f32 = 3.0;

// Gradient to one ellipse.
struct ScreenGrads {
    center: vec2<f32>,
    conic: vec3<f32>,
    opacity: f32, // after the compensation
    depth: f32,
}

// Gradient to one Gaussian, and to a left perturbation of the pose.
struct GaussianGrads {
    mean: vec3<f32>,
    cov: Cov,     // an off-diagonal represents both its entries
    opacity: f32, // before the compensation
    moved: vec3<f32>,
    turned: vec3<f32>,
    focal: f32,   // to the logarithm of the focal lengths, both at once
    radius: f32,  // no gradient: 3 sigma of the larger axis, px
}

// VJP of `project` for a Gaussian that is visible; `conic` is what that made.
fn project_back(view: View, mean: vec3<f32>, cov: Cov, opacity: f32, conic: vec3<f32>, d: ScreenGrads) -> GaussianGrads {
    let p = (view.camera_from_world * vec4<f32>(mean, 1.0)).xyz;
    let inv_z = 1.0 / p.z;
    let f = view.focal * inv_z;
    let local = linear(view, p);
    let uv = local.uv;
    let held = local.held;
    let r0 = local.r0;
    let r1 = local.r1;
    let r2 = local.r2;
    let m0 = local.m0;
    let m1 = local.m1;
    let c0 = cov_times(cov, m0);
    let c1 = cov_times(cov, m1);
    let xx = dot(c0, m0);
    let xy = dot(c0, m1);
    let yy = dot(c1, m1);
    let det0 = max(xx * yy - xy * xy, 0.0);
    let det1 = det0 + view.low_pass * (xx + yy + view.low_pass);
    // Conic to the screen covariance: -K G K.
    let k = conic;
    let g = vec3<f32>(d.conic.x, 0.5 * d.conic.y, d.conic.z);
    let kg0 = vec2<f32>(k.x * g.x + k.y * g.y, k.x * g.y + k.y * g.z);
    let kg1 = vec2<f32>(k.y * g.x + k.z * g.y, k.y * g.y + k.z * g.z);
    var s = -vec3<f32>(kg0.x * k.x + kg0.y * k.y, kg0.x * k.y + kg0.y * k.z, kg1.x * k.y + kg1.y * k.z);
    var out: GaussianGrads;
    var rho = 1.0;
    if ((view.flags & VIEW_ANTIALIAS) != 0u) {
        let least = PROJECT_RHO_MIN * PROJECT_RHO_MIN;
        let square = max(det0 / det1, least);
        rho = sqrt(square);
        if (square > least) {
            let d_square = d.opacity * opacity / (2.0 * rho);
            s += d_square * (vec3<f32>(yy, -xy, xx) / det1 - square * k);
        }
    }
    out.opacity = d.opacity * rho;
    // The covariance is M Sigma M^T.
    let g0 = s.x * m0 + s.y * m1;
    let g1 = s.y * m0 + s.z * m1;
    out.cov = Cov(
        m0.x * g0.x + m1.x * g1.x,
        2.0 * (m0.x * g0.y + m1.x * g1.y),
        2.0 * (m0.x * g0.z + m1.x * g1.z),
        m0.y * g0.y + m1.y * g1.y,
        2.0 * (m0.y * g0.z + m1.y * g1.z),
        m0.z * g0.z + m1.z * g1.z,
    );
    let d_m0 = 2.0 * (s.x * c0 + s.y * c1);
    let d_m1 = 2.0 * (s.y * c0 + s.z * c1);
    // Gradient to J, rows.
    let j0 = vec3<f32>(dot(d_m0, r0), dot(d_m0, r1), dot(d_m0, r2));
    let j1 = vec3<f32>(dot(d_m1, r0), dot(d_m1, r1), dot(d_m1, r2));
    // J = f/z (1, -held) in its two rows; the mean's path comes on top.
    let inside = select(vec2<f32>(0.0), vec2<f32>(j0.z, j1.z) * f, uv == held);
    let stays = select(vec2<f32>(j0.z, j1.z) * f * held, vec2<f32>(0.0), uv == held);
    out.focal = dot(d.center * view.focal, uv) + dot(d_m0, m0) + dot(d_m1, m1) + stays.x + stays.y;
    let d_uv = d.center * view.focal - inside;
    var d_p = vec3<f32>(d_uv * inv_z, d.depth);
    d_p.z += -d_uv.x * uv.x * inv_z - f.x * inv_z * (j0.x - j0.z * held.x);
    d_p.z += -d_uv.y * uv.y * inv_z - f.y * inv_z * (j1.y - j1.z * held.y);
    out.mean = r0 * d_p.x + r1 * d_p.y + r2 * d_p.z;
    out.moved = d_p;
    // Q = J^T d_J for the rotation's path through the covariance: Q_ab = J_0a d_J_0b + J_1a d_J_1b.
    let a = vec3<f32>(f.x, 0.0, -f.x * held.x);
    let b = vec3<f32>(0.0, f.y, -f.y * held.y);
    out.turned = vec3<f32>(
        p.y * d_p.z - p.z * d_p.y + (a.z * j0.y + b.z * j1.y) - (a.y * j0.z + b.y * j1.z),
        p.z * d_p.x - p.x * d_p.z + (a.x * j0.z + b.x * j1.z) - (a.z * j0.x + b.z * j1.x),
        p.x * d_p.y - p.y * d_p.x + (a.y * j0.x + b.y * j1.x) - (a.x * j0.y + b.x * j1.y),
    );
    let middle = 0.5 * (xx + yy) + view.low_pass;
    out.radius = RADIUS_SIGMAS * sqrt(middle + sqrt(max(middle * middle - det1, 0.0)));
    return out;
}
