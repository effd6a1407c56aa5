// From a Gaussian in the world to an ellipse on the screen (EWA splatting). Twin of render/project.rs, where the
// equations and their sources are documented; CPU and GPU differ only by rounding.
//
// No bindings and no entry point: plain functions, put in front of whatever shader calls them, here and in the player.
// A thread owns one Gaussian. Guards look at bits, not at values, because a driver may assume that no NaN occurs.

// x/z and y/z inside J may leave the image by this share of its half-width's tangent (Inria, gsplat).
const PROJECT_J_MARGIN: f32 = 0.3;
// Least compensation of the antialiased mode (gsplat).
const PROJECT_RHO_MIN: f32 = 0.005;
// Added to tau, so that rounding never loses a pixel at the alpha cut-off; the blend decides about each pixel itself.
const PROJECT_TAU_MARGIN: f32 = 1e-3;
// |q| below this is the identity rotation (math/quat.rs).
const PROJECT_TINY_NORM: f32 = 1e-12;
// Bit of View.flags: opacity is dimmed for the low-pass (Mip-Splatting, gsplat).
const VIEW_ANTIALIAS: u32 = 1u;

// A camera and the renderer's settings; 128 bytes, made for a uniform buffer.
struct View {
    camera_from_world: mat4x4<f32>, // columns; the last row is 0 0 0 1; axes x right, y down, z forward
    focal: vec2<f32>,               // px
    center: vec2<f32>,              // principal point, px; the first pixel's centre is at 0.5
    size: vec2<f32>,                // px
    near: f32,                      // Gaussians with z <= near are culled, scene units
    low_pass: f32,                  // added to the screen covariance, px^2
    camera: vec3<f32>,              // the camera's centre in the world
    alpha_min: f32,                 // alpha below this is not rendered; above 0
    sh_degree: u32,
    count: u32,                     // Gaussians
    time: f32,
    flags: u32,
}

// A symmetric 3x3 matrix.
struct Cov {
    xx: f32,
    xy: f32,
    xz: f32,
    yy: f32,
    yz: f32,
    zz: f32,
}

// One Gaussian on the screen.
struct Ellipse {
    center: vec2<f32>, // px
    extent: vec2<f32>, // half sizes of the box of the level alpha = alpha_min, px
    conic: vec3<f32>,  // inverse of cov2d: xx, xy, yy, px^-2
    depth: f32,        // z in camera axes
    cov2d: vec3<f32>,  // with the low-pass: xx, xy, yy, px^2
    visible: u32,      // 0: culled, and nothing else means anything
    rho: f32,          // opacity is to be multiplied by this; 1 without VIEW_ANTIALIAS
}

// Whether x is neither infinite nor NaN.
fn finite(x: f32) -> bool {
    return (bitcast<u32>(x) & 0x7f800000u) != 0x7f800000u;
}

// R S S R^T of a quaternion (normalised here) and activated scales.
fn covariance(quat_wxyz: vec4<f32>, scale: vec3<f32>) -> Cov {
    let norm = length(quat_wxyz);
    var q = vec4<f32>(1.0, 0.0, 0.0, 0.0);
    if (norm > PROJECT_TINY_NORM) {
        q = quat_wxyz / norm;
    }
    let w = q.x;
    let v = q.yzw;
    // Columns of R, each times its scale.
    let d = 2.0 * v * v;
    let xy = 2.0 * v.x * v.y;
    let xz = 2.0 * v.x * v.z;
    let yz = 2.0 * v.y * v.z;
    let wv = 2.0 * w * v;
    // Columns of R, each times its scale.
    let a = scale.x * vec3<f32>(1.0 - d.y - d.z, xy + wv.z, xz - wv.y);
    let b = scale.y * vec3<f32>(xy - wv.z, 1.0 - d.x - d.z, yz + wv.x);
    let c = scale.z * vec3<f32>(xz + wv.y, yz - wv.x, 1.0 - d.x - d.y);
    return Cov(
        a.x * a.x + b.x * b.x + c.x * c.x,
        a.x * a.y + b.x * b.y + c.x * c.y,
        a.x * a.z + b.x * b.z + c.x * c.z,
        a.y * a.y + b.y * b.y + c.y * c.y,
        a.y * a.z + b.y * b.z + c.y * c.z,
        a.z * a.z + b.z * b.z + c.z * c.z,
    );
}

// The matrix times v.
fn cov_times(s: Cov, v: vec3<f32>) -> vec3<f32> {
    return vec3<f32>(
        s.xx * v.x + s.xy * v.y + s.xz * v.z,
        s.xy * v.x + s.yy * v.y + s.yz * v.z,
        s.xz * v.x + s.yz * v.y + s.zz * v.z,
    );
}

// Whether some pixel's centre (first pixel: 0.5) lies in [center - extent, center + extent] along one axis.
fn meets_pixels(center: f32, extent: f32, size: f32) -> bool {
    return max(ceil(center - extent - 0.5), 0.0) <= min(floor(center + extent - 0.5), size - 1.0);
}

// tau of the cut-off ellipse: d^T conic d <= tau where alpha >= alpha_min. `opacity` is the dimmed one.
fn cutoff(view: View, opacity: f32) -> f32 {
    return 2.0 * log(opacity / view.alpha_min) + PROJECT_TAU_MARGIN;
}

// The projection around one point in camera axes: J W, its rows m0 and m1, and what they are made of.
struct Linear {
    uv: vec2<f32>,   // direction, x/z and y/z
    held: vec2<f32>, // the direction inside J
    r0: vec3<f32>,   // rows of W
    r1: vec3<f32>,
    r2: vec3<f32>,
    m0: vec3<f32>,
    m1: vec3<f32>,
}

fn linear(view: View, p: vec3<f32>) -> Linear {
    let inv_z = 1.0 / p.z;
    let uv = p.xy * inv_z;
    // J clamps the direction, so that a Gaussian far outside the image does not become a huge streak.
    let margin = PROJECT_J_MARGIN * 0.5 * view.size / view.focal;
    let low = -(view.center / view.focal + margin);
    let high = (view.size - view.center) / view.focal + margin;
    let held = min(max(uv, low), high);
    let r0 = vec3<f32>(view.camera_from_world[0].x, view.camera_from_world[1].x, view.camera_from_world[2].x);
    let r1 = vec3<f32>(view.camera_from_world[0].y, view.camera_from_world[1].y, view.camera_from_world[2].y);
    let r2 = vec3<f32>(view.camera_from_world[0].z, view.camera_from_world[1].z, view.camera_from_world[2].z);
    // Row k of J W is (f_k / z)(W_k - held_k W_2).
    let m0 = view.focal.x * inv_z * (r0 - held.x * r2);
    let m1 = view.focal.y * inv_z * (r1 - held.y * r2);
    return Linear(uv, held, r0, r1, r2, m0, m1);
}

// Projects one Gaussian. Culled: z <= near, opacity below alpha_min, a degenerate or non-finite ellipse, off screen.
fn project(view: View, mean: vec3<f32>, cov: Cov, opacity: f32) -> Ellipse {
    var out: Ellipse;
    out.visible = 0u;
    out.rho = 1.0;
    let p = (view.camera_from_world * vec4<f32>(mean, 1.0)).xyz;
    if (!(finite(p.x) && finite(p.y) && finite(p.z) && finite(opacity))) {
        return out;
    }
    if (!(p.z > view.near && opacity >= view.alpha_min)) {
        return out;
    }
    let local = linear(view, p);
    let m0 = local.m0;
    let m1 = local.m1;
    let s0 = cov_times(cov, m0);
    let s1 = cov_times(cov, m1);
    let xx = dot(s0, m0);
    let xy = dot(s0, m1);
    let yy = dot(s1, m1);
    // det(S + l I) = det S + l tr S + l^2: written so, a needle's determinant cannot cancel to nothing.
    let det0 = max(xx * yy - xy * xy, 0.0);
    let det1 = det0 + view.low_pass * (xx + yy + view.low_pass);
    let wide = vec3<f32>(xx + view.low_pass, xy, yy + view.low_pass);
    if (!(finite(det1) && finite(wide.x) && finite(wide.y) && finite(wide.z))) {
        return out;
    }
    if (!(det1 > 0.0 && wide.x > 0.0 && wide.z > 0.0)) {
        return out;
    }
    if ((view.flags & VIEW_ANTIALIAS) != 0u) {
        out.rho = sqrt(max(det0 / det1, PROJECT_RHO_MIN * PROJECT_RHO_MIN));
    }
    let dimmed = opacity * out.rho;
    if (!(dimmed >= view.alpha_min)) {
        return out;
    }
    let inv = 1.0 / det1;
    out.center = view.focal * local.uv + view.center;
    out.extent = sqrt(cutoff(view, dimmed) * wide.xz);
    out.conic = vec3<f32>(wide.z * inv, -wide.y * inv, wide.x * inv);
    out.depth = p.z;
    out.cov2d = wide;
    let all = out.center.x + out.center.y + out.conic.x + out.conic.y + out.conic.z + out.extent.x + out.extent.y;
    if (finite(all) && meets_pixels(out.center.x, out.extent.x, view.size.x)
        && meets_pixels(out.center.y, out.extent.y, view.size.y)) {
        out.visible = 1u;
    }
    return out;
}
