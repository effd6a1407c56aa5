// From the sums of a splat's records to the gradients of its Gaussian. Twin of Raster::collect in render/rasterize.rs
// and of the VJP in render/project.rs; render/project.wgsl and render/project_back.wgsl are put in front of this file.
//
// Bindings, group 0: 0 view; 1 piece; 2 geometry as in splats.wgsl; 3 shapes, 4 colors, 5 marks as that wrote them; 6
// sums of gather.wgsl; out: 7 back, five vec4 a splat (mean, opacity; covariance xx xy xz yy; yz zz, radius, 0; colour,
// norm of the centre's gradient; the colour that was rendered, norm of the absolute gradients), all 0 where it was not
// visible; 8 cameras, seven sums a workgroup (the pose's six, the focal lengths'). Seven storage buffers, 7 KiB of
// workgroup memory. A thread owns one row.

const TABLE_BLOCK: u32 = 16u;
const GEOMETRY_WIDTH: u32 = 10u;
const BACK_THREADS: u32 = 256u;

struct Piece {
    first_row: u32,
    rows: u32,
    first_splat: u32,
    width: u32,
    blocks: u32,
    flags: u32,
    first_id: u32,
    first_group: u32, // number of the first workgroup's sums
    layer_from_world: mat3x3<f32>,
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> piece: Piece;
@group(0) @binding(2) var<storage, read> geometry: array<f32>;
@group(0) @binding(3) var<storage, read> shapes: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> colors: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read> marks: array<u32>;
@group(0) @binding(6) var<storage, read> sums: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read_write> back: array<vec4<f32>>;
@group(0) @binding(8) var<storage, read_write> cameras: array<f32>;

var<workgroup> camera_sums: array<array<f32, 7>, 256>;

@compute @workgroup_size(256)
fn splats_back(
    @builtin(global_invocation_id) at: vec3<u32>,
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let splat = piece.first_splat + at.x;
    var camera = array<f32, 7>(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
    if (at.x < piece.rows) {
        var rows = array<vec4<f32>, 5>();
        if (marks[splat] == 2u) {
            let j = piece.first_row + at.x;
            let g = (j / TABLE_BLOCK * GEOMETRY_WIDTH) * TABLE_BLOCK + j % TABLE_BLOCK;
            let mean = vec3<f32>(geometry[g], geometry[g + 16u], geometry[g + 32u]);
            let cov = Cov(geometry[g + 48u], geometry[g + 64u], geometry[g + 80u], geometry[g + 96u],
                geometry[g + 112u], geometry[g + 128u]);
            let shape = shapes[2u * splat + 1u];
            let k = shape.xyz;
            let s0 = sums[3u * splat];
            let s1 = sums[3u * splat + 1u];
            let s2 = sums[3u * splat + 2u];
            var d: ScreenGrads;
            d.center = -vec2<f32>(k.x * s0.y + k.y * s0.w, k.y * s0.y + k.z * s0.w);
            d.conic = -vec3<f32>(0.5 * s0.z, s1.x, 0.5 * s1.y);
            d.opacity = s0.x / shape.w;
            d.depth = s2.y;
            let out = project_back(view, mean, cov, geometry[g + 144u], k, d);
            let scale = 0.5 * view.size;
            rows[0] = vec4<f32>(out.mean, out.opacity);
            rows[1] = vec4<f32>(out.cov.xx, out.cov.xy, out.cov.xz, out.cov.yy);
            rows[2] = vec4<f32>(out.cov.yz, out.cov.zz, out.radius, 0.0);
            rows[3] = vec4<f32>(s1.z, s1.w, s2.x, length(d.center * scale));
            rows[4] = vec4<f32>(colors[splat].xyz, length(s2.zw * scale));
            let moved = out.moved;
            let turned = out.turned;
            camera = array<f32, 7>(moved.x, moved.y, moved.z, turned.x, turned.y, turned.z, out.focal);
        }
        for (var i = 0u; i < 5u; i++) {
            back[5u * splat + i] = rows[i];
        }
    }
    camera_sums[thread] = camera;
    for (var step = BACK_THREADS / 2u; step > 0u; step /= 2u) {
        workgroupBarrier();
        if (thread < step) {
            for (var i = 0u; i < 7u; i++) {
                camera_sums[thread][i] += camera_sums[thread + step][i];
            }
        }
    }
    if (thread == 0u) {
        for (var i = 0u; i < 7u; i++) {
            cameras[7u * (piece.first_group + group.x) + i] = camera_sums[0][i];
        }
    }
}
