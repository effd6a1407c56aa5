// The image in 8 bits: a quarter of the planes' size to read back. Clamped and rounded as in image files.
//
// Bindings, group 0: 0 view; 1 blend; 2 planes of rasterize.wgsl, whose uniforms these are; out: 3 bytes, a u32 per
// pixel: red in the lowest eight bits, then green, blue and alpha. Two storage buffers. A thread owns every n-th pixel.
// render/project.wgsl is put in front of this file.

const BYTES_THREADS: u32 = 256u;

struct Blend {
    background: vec3<f32>,
    alpha_max: f32,
    transmittance_min: f32,
    first_row: u32,
    pixel_rows: u32,
    flags: u32,
    sums_at: u32,
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> blend: Blend;
@group(0) @binding(2) var<storage, read> planes: array<f32>;
@group(0) @binding(3) var<storage, read_write> bytes: array<u32>;

fn byte_of(v: f32) -> u32 {
    return u32(clamp(v, 0.0, 1.0) * 255.0 + 0.5);
}

@compute @workgroup_size(256)
fn bytes_of(@builtin(global_invocation_id) at: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let pixels = u32(view.size.x) * blend.pixel_rows;
    for (var i = at.x; i < pixels; i += groups.x * BYTES_THREADS) {
        bytes[i] = byte_of(planes[i]) | byte_of(planes[pixels + i]) << 8u | byte_of(planes[2u * pixels + i]) << 16u
            | byte_of(planes[3u * pixels + i]) << 24u;
    }
}
