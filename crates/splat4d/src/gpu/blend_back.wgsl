// What all ways back through a tile share: bindings, and one splat at one pixel. Twin of Returning in render/blend.rs,
// which documents the equations. render/project.wgsl is put in front of this file.
//
// Bindings, group 0: 0 view; 1 blend; 2 ranges (three u32 per tile), 3 values, 4 owners, 5 shapes, 6 colors and 7
// planes as rasterize.wgsl read and wrote them, states behind them; 8 d_planes: gradient to the planes, laid out as they are; out: 9
// records, twelve numbers a pair, cleared to 0 before, and behind them (at blend.sums_at) three per tile, the gradient
// to the background. Eight storage buffers.
//
// Of a record: 0 v, 1 v dx, 2 v dx^2, 3 v dy, 4 v dx dy, 5 v dy^2, 6 to 9 gradient to red, green, blue and depth, 10
// and 11 absolute gradients to the centre, where they are needed; v = dL/d ln alpha.

const TILE: u32 = 16u;
// Pixels across and down a quadrant, and the split of an owner (tiles.wgsl).
const QUADRANT: u32 = 8u;
const OWNER_SHIFT: u32 = 28u;
const OWNER_SPLAT: u32 = 0x0fffffffu;
const LOG2_E: f32 = 1.4426950408889634;
const NUMBERS: u32 = 12u;
// Bits of blend.flags: there is a gradient to alpha, to depth; absolute gradients are needed.
const BACK_ALPHA: u32 = 1u;
const BACK_DEPTH: u32 = 2u;
const BACK_ABS: u32 = 4u;

struct Blend {
    background: vec3<f32>,
    alpha_max: f32,
    transmittance_min: f32,
    first_row: u32,
    pixel_rows: u32,
    flags: u32,
    sums_at: u32, // number of the first sum behind the records
    skipped: u32, // rows of pixels of the planes above the band, and all of theirs
    plane_rows: u32,
    states_at: u32, // number of the first state behind the planes
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> blend: Blend;
@group(0) @binding(2) var<storage, read> ranges: array<u32>;
@group(0) @binding(3) var<storage, read> values: array<u32>;
@group(0) @binding(4) var<storage, read> owners: array<u32>;
@group(0) @binding(5) var<storage, read> shapes: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read> colors: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read> planes: array<f32>;
@group(0) @binding(8) var<storage, read> d_planes: array<f32>;
@group(0) @binding(9) var<storage, read_write> records: array<f32>;

struct Passed {
    v: f32,
    w: f32,     // alpha T
    rest: f32,  // the gradient times the light that is still to come
    t: f32,
    open: bool,
}

// A splat at offset d with the exponent's factors p (rasterize.wgsl) before what is left of the light at a pixel whose
// gradient is g. limits: log2 of the least and of the largest alpha.
fn passed(d: vec2<f32>, p: vec4<f32>, color: vec4<f32>, g: vec4<f32>, rest: f32, t: f32, limits: vec2<f32>) -> Passed {
    var out = Passed(0.0, 0.0, rest, t, true);
    let power = min((p.z * d.y + p.y * d.x) * d.y + p.x * d.x * d.x + p.w, p.w);
    if (power >= limits.x) {
        let alpha = min(blend.alpha_max, exp2(power));
        let next = t * (1.0 - alpha);
        if (next < blend.transmittance_min) {
            out.open = false;
        } else {
            out.w = alpha * t;
            let light = dot(g, color);
            out.rest = rest - out.w * light;
            // Nothing passes where alpha is at its ceiling.
            if (power < limits.y) {
                out.v = out.w * light - alpha / (1.0 - alpha) * out.rest;
            }
            out.t = next;
        }
    }
    return out;
}

// The gradient to a pixel's colour and depth, the gradient times all of its light, and what shows through to the
// background.
struct Seen {
    g: vec4<f32>,
    rest: f32,
    behind: f32,
}

fn seen(at: u32, plane: u32) -> Seen {
    var out: Seen;
    out.behind = 1.0 - planes[3u * plane + at];
    out.g = vec4<f32>(d_planes[at], d_planes[plane + at], d_planes[2u * plane + at], 0.0);
    out.rest = out.g.x * planes[at] + out.g.y * planes[plane + at] + out.g.z * planes[2u * plane + at];
    if ((blend.flags & BACK_ALPHA) != 0u) {
        out.rest -= out.behind * d_planes[3u * plane + at];
    }
    if ((blend.flags & BACK_DEPTH) != 0u) {
        out.g.w = d_planes[4u * plane + at];
        out.rest += out.g.w * planes[4u * plane + at];
    }
    return out;
}
