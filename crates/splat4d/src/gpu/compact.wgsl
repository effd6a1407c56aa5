// Gathers the visible splats, in the order of their numbers, as pairs (depth bits, number): sorted stably by the key
// they are in the order (depth, number) that render/bin.rs defines. Depths are positive, so their bits sort as they do.
//
// Bindings, group 0: 0 counts ([0]: splats); 1 marks (1: visible), 2 indices (exclusive sums of marks), 3 colors (depth
// in w); out: 4 keys, 5 values. Six storage buffers. A thread owns one splat.

@group(0) @binding(0) var<storage, read> counts: array<u32>;
@group(0) @binding(1) var<storage, read> marks: array<u32>;
@group(0) @binding(2) var<storage, read> places: array<u32>;
@group(0) @binding(3) var<storage, read> colors: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> keys: array<u32>;
@group(0) @binding(5) var<storage, read_write> values: array<u32>;

@compute @workgroup_size(256)
fn compact(@builtin(global_invocation_id) at: vec3<u32>) {
    if (at.x < counts[0] && marks[at.x] != 0u) {
        keys[places[at.x]] = bitcast<u32>(colors[at.x].w);
        values[places[at.x]] = at.x;
    }
}
