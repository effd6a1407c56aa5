// A copy, sixteen bytes at a time: how many bytes per second kernels can read and write.
//
// Bindings, group 0: 0 from; out: 1 to, as long as `from`. Two storage buffers. A thread owns COPY_EACH vectors,
// THREADS apart.

const THREADS: u32 = 256u;
const COPY_EACH: u32 = 4u;

@group(0) @binding(0) var<storage, read> from_here: array<vec4<f32>>;
@group(0) @binding(1) var<storage, read_write> to_there: array<vec4<f32>>;

@compute @workgroup_size(256)
fn copy(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let first = group.x * THREADS * COPY_EACH + thread;
    for (var i = 0u; i < COPY_EACH; i++) {
        to_there[first + i * THREADS] = from_here[first + i * THREADS];
    }
}
