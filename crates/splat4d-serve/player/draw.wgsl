// The sorted ellipses as quads, farthest first, blended into a 16-bit float image; then that image onto the canvas.
// Concatenated after resident.wgsl, project.wgsl, shade.wgsl and cull.wgsl, whose bindings 0, 5, 8 and 10 have
// read-only twins here.

@group(0) @binding(12) var<storage, read> drawn: array<Record>;
@group(0) @binding(13) var<storage, read> order: array<u32>;      // indices, nearest first
@group(0) @binding(14) var<storage, read> drawn_count: array<u32>; // `arguments` of cull.wgsl
@group(0) @binding(15) var picture: texture_2d<f32>;

// Alpha is never above this (Kerbl et al. 2023).
const ALPHA_MAX: f32 = 0.99;
// Which corner (bit 0 right, bit 1 lower) each vertex of a splat is, two bits a vertex: 0 1 2 2 1 3.
const CORNER_BITS: u32 = 0xda4u;
// Index of the number of records in drawn_count.
const COUNT: u32 = 3u;

// Flat, and measured from the pixel's centre: what is interpolated carries the rounding of the corners to the raster's
// grid, a sixteenth of a pixel on some devices.
struct Corner {
    @builtin(position) position: vec4<f32>,
    @location(0) @interpolate(flat) center: vec2<f32>, // px
    @location(1) @interpolate(flat) axes: vec4<f32>,   // the two axes over their squared lengths, 1/px
    @location(2) @interpolate(flat) color: vec4<f32>,  // rgb, opacity
}

// Vertices 6 i to 6 i + 5 are two triangles: the box along the axes, as large as the ellipse on which alpha is the
// cut-off. No instances: those of a few vertices each run badly on many devices, and very badly on software ones.
@vertex
fn corner(@builtin(vertex_index) vertex: u32) -> Corner {
    let record = drawn[order[drawn_count[COUNT] - 1u - vertex / CORNERS]];
    let k = (CORNER_BITS >> (2u * (vertex % CORNERS))) & 3u;
    let rg = unpack2x16float(record.color.x);
    let ba = vec2<f32>(unpack2x16float(record.color.y).x, unpack2x16unorm(record.color.y).y);
    let radius = sqrt(max(cutoff(frame.view, ba.y), 0.0));
    let axis = record.major / length(record.major);
    let minor = record.minor * vec2<f32>(-axis.y, axis.x);
    let sigmas = radius * (vec2<f32>(vec2<u32>(k & 1u, k >> 1u)) * 2.0 - 1.0);
    var out: Corner;
    out.center = record.center;
    out.axes = vec4<f32>(axis / length(record.major), minor / (record.minor * record.minor));
    let at = (record.center + sigmas.x * record.major + sigmas.y * minor) / frame.view.size * 2.0 - 1.0;
    out.position = vec4<f32>(at.x, -at.y, 0.0, 1.0);
    out.color = vec4<f32>(rg, ba);
    if (frame.channel == CHANNEL_DEPTH) {
        // Shares of the range, so that 16-bit floats resolve it; held where they would overflow.
        let share = (record.depth - frame.depth_range.x) / max(frame.depth_range.y - frame.depth_range.x, 1e-6);
        out.color = vec4<f32>(vec3<f32>(clamp(share, -16.0, 16.0)), ba.y);
    }
    return out;
}

@fragment
fn splat(in: Corner) -> @location(0) vec4<f32> {
    let d = in.position.xy - in.center;
    let sigmas = vec2<f32>(dot(d, in.axes.xy), dot(d, in.axes.zw));
    let alpha = min(in.color.a * exp(-0.5 * dot(sigmas, sigmas)), ALPHA_MAX);
    if (alpha < frame.view.alpha_min) {
        discard;
    }
    return vec4<f32>(in.color.rgb * alpha, alpha);
}

// One triangle that covers the canvas.
@vertex
fn cover(@builtin(vertex_index) k: u32) -> @builtin(position) vec4<f32> {
    return vec4<f32>(f32((k << 1u) & 2u) * 2.0 - 1.0, f32(k & 2u) * 2.0 - 1.0, 0.0, 1.0);
}

@fragment
fn resolve(@builtin(position) at: vec4<f32>) -> @location(0) vec4<f32> {
    let c = textureLoad(picture, vec2<i32>(at.xy), 0);
    switch (frame.channel) {
        case CHANNEL_DEPTH: {
            // Near is white, far and what is hardly covered black.
            let share = c.r / max(c.a, 1e-6);
            return vec4<f32>(vec3<f32>(select(0.0, clamp(1.0 - share, 0.0, 1.0), c.a >= 0.5)), 1.0);
        }
        case CHANNEL_ALPHA: { return vec4<f32>(vec3<f32>(c.a), 1.0); }
        default: { return vec4<f32>(c.rgb + frame.background * (1.0 - c.a), 1.0); }
    }
}
