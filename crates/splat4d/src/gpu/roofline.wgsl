// The arithmetic of the blend alone, from registers: no list is read, no tile changes. Twin of render/roofline.rs.
//
// Bindings, group 0: 0 out, a number per thread. One storage buffer. A thread owns a pixel that ROOFLINE_SPLATS splats
// pass.

const ROOFLINE_SPLATS: u32 = 1024u;

@group(0) @binding(0) var<storage, read_write> out: array<f32>;

@compute @workgroup_size(256)
fn roofline(@builtin(global_invocation_id) at: vec3<u32>) {
    var d = vec2<f32>(f32(at.x % 16u), f32(at.x / 16u % 16u)) * 0.1;
    let p = vec4<f32>(-0.05, -0.01, -0.05, -3.0);
    var sum = vec4<f32>(0.0);
    var t = 1.0;
    for (var i = 0u; i < ROOFLINE_SPLATS; i++) {
        let power = min((p.z * d.y + p.y * d.x) * d.y + p.x * d.x * d.x + p.w, p.w);
        if (power >= -8.0) {
            let alpha = min(0.99, exp2(power));
            let next = t * (1.0 - alpha);
            sum += (alpha * t) * vec4<f32>(d, 0.3, 2.0);
            // Kept above the stop, so that all splats are work.
            t = max(next, 0.5);
        }
        d -= vec2<f32>(1e-4, 2e-4);
    }
    out[at.x] = sum.x + sum.y + sum.z + sum.w + t;
}
