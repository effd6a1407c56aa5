// Real spherical harmonics up to degree 3. Twin of math/sh.rs (basis) as render/shade.rs uses it: signs, order and the
// offset of one half are those of 3D Gaussian Splatting (Kerbl et al. 2023).
//
// No bindings and no entry point: a plain function, put in front of whatever shader calls it. A thread owns one
// direction.

// Coefficients a channel at degree 3.
const SH_COEFFS: u32 = 16u;
// Added to the sum over coefficients, which is then clamped at 0 from below.
const SH_COLOR_OFFSET: f32 = 0.5;
const SH_C0: f32 = 0.28209479177387814;
const SH_C1: f32 = 0.4886025119029199;
// Degree 2: xy (and, negated, yz and xz), 2zz-xx-yy, xx-yy.
const SH_C2_XY: f32 = 1.0925484305920792;
const SH_C2_ZZ: f32 = 0.31539156525252005;
const SH_C2_XX: f32 = 0.5462742152960396;
// Degree 3: y(3xx-yy) and x(xx-3yy), negated; xyz; y(4zz-xx-yy) and x(4zz-xx-yy), negated; z(2zz-3xx-3yy); z(xx-yy).
const SH_C3_YXX: f32 = 0.5900435899266435;
const SH_C3_XYZ: f32 = 2.890611442640554;
const SH_C3_YZZ: f32 = 0.4570457994644658;
const SH_C3_ZZZ: f32 = 0.3731763325901154;
const SH_C3_ZXX: f32 = 1.445305721320277;

// All 16 basis functions at the unit direction `dir`, which points from the camera to the Gaussian.
fn sh_basis(dir: vec3<f32>) -> array<f32, 16> {
    let x = dir.x;
    let y = dir.y;
    let z = dir.z;
    let xx = x * x;
    let yy = y * y;
    let zz = z * z;
    return array<f32, 16>(
        SH_C0,
        -SH_C1 * y,
        SH_C1 * z,
        -SH_C1 * x,
        SH_C2_XY * x * y,
        -SH_C2_XY * y * z,
        SH_C2_ZZ * (2.0 * zz - xx - yy),
        -SH_C2_XY * x * z,
        SH_C2_XX * (xx - yy),
        -SH_C3_YXX * y * (3.0 * xx - yy),
        SH_C3_XYZ * x * y * z,
        -SH_C3_YZZ * y * (4.0 * zz - xx - yy),
        SH_C3_ZZZ * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        -SH_C3_YZZ * x * (4.0 * zz - xx - yy),
        SH_C3_ZXX * z * (xx - yy),
        -SH_C3_YXX * x * (xx - 3.0 * yy),
    );
}

// Coefficients a channel that are rendered of a table that holds `held` of them, when `degree` is requested.
fn sh_used(held: u32, degree: u32) -> u32 {
    let asked = (degree + 1u) * (degree + 1u);
    if (held >= 16u) { return min(asked, 16u); }
    if (held >= 9u) { return min(asked, 9u); }
    if (held >= 4u) { return min(asked, 4u); }
    return min(held, 1u);
}
