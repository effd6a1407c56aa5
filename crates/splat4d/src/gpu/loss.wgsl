// The image loss of 3DGS, (1 - lambda) L1 + lambda (1 - SSIM), and its gradient. Twin of splat4d-train's
// loss/kernel.rs, which documents the equations, and, for the cameras' colour matrices, of learner/exposure.rs.
//
// Two dispatches, a workgroup a tile of 16 x 16 pixels: `moments` writes the derivatives of SSIM to the local moments,
// and what the tile adds to the value; `gradient` blurs these derivatives and writes the gradient to the rendered
// image. Bindings, group 0: 0 loss; 1 planes as rasterize.wgsl wrote them; 2 truth: bytes of pixel
// after pixel, red, green, blue and, where pixels have weights of 8 bits, the weight; or three planes of f32. Behind
// either, a plane of f32 of weights that are not of 8 bits; 3 maps: nine planes, three a colour; 4 d_planes: gradient to red, green and blue; 5 partials: sixteen
// numbers per tile, |error|, SSIM and squared error with weights, one unused, the twelve of the camera's matrix and
// offsets; 6 responses: those twelve, a camera after the other, without the identity. Six storage buffers, 14.5 KiB of
// workgroup memory. A thread owns a pixel; in the passes along rows, every 256th number of the tile and its halo.

const TILE: u32 = 16u;
const THREADS: u32 = 256u;
// Taps of the window and their reach on either side, and a tile with its halo.
const TAPS: u32 = 11u;
const REACH: u32 = 5u;
const WIDE: u32 = 26u;   // TILE + 2 REACH
const PIXELS: u32 = 676u; // WIDE x WIDE
const HALF: u32 = 416u;  // WIDE x TILE
const NUMBERS: u32 = 16u; // of a tile
// (0.01 L)^2 and (0.03 L)^2 for the range L = 1.
const C1: f32 = 1e-4;
const C2: f32 = 9e-4;
// Bits of loss.flags.
const LOSS_PACKED: u32 = 1u;
const LOSS_WEIGHTED: u32 = 2u;
const LOSS_RESPONSE: u32 = 4u;
const LOSS_PLANE: u32 = 8u; // of weights

struct Loss {
    width: u32,
    height: u32,
    flags: u32,
    d_l1: f32,   // dL/d sum of w |x - y|
    d_ssim: f32, // dL/d sum of w S
    response: u32, // the camera's first number
    taps: array<vec4<f32>, 3>,
}

@group(0) @binding(0) var<uniform> loss: Loss;
@group(0) @binding(1) var<storage, read> planes: array<f32>;
@group(0) @binding(2) var<storage, read> truth: array<u32>;
@group(0) @binding(3) var<storage, read_write> maps: array<f32>;
@group(0) @binding(4) var<storage, read_write> d_planes: array<f32>;
@group(0) @binding(5) var<storage, read_write> partials: array<f32>;
@group(0) @binding(6) var<storage, read> responses: array<f32>;

// Of `moments` the image and the truth, of `gradient` three maps.
var<workgroup> wide: array<array<f32, 676>, 3>;
// Means along rows; then sums of a tile.
var<workgroup> narrow: array<vec4<f32>, 416>;

fn tap(k: u32) -> f32 {
    return loss.taps[k / 4u][k % 4u];
}

fn weight_of(at: u32) -> f32 {
    if ((loss.flags & LOSS_WEIGHTED) == 0u) {
        return 1.0;
    }
    if ((loss.flags & LOSS_PLANE) == 0u) {
        return f32(truth[at] >> 24u) / 255.0;
    }
    let numbers = 3u * loss.width * loss.height;
    let before = select(numbers, (numbers + 3u) / 4u, (loss.flags & LOSS_PACKED) != 0u);
    return bitcast<f32>(truth[before + at]);
}

fn truth_of(at: u32, channel: u32) -> f32 {
    if ((loss.flags & LOSS_PACKED) != 0u) {
        let byte = select(3u, 4u, (loss.flags & (LOSS_WEIGHTED | LOSS_PLANE)) == LOSS_WEIGHTED) * at + channel;
        return f32((truth[byte / 4u] >> (8u * (byte % 4u))) & 255u) / 255.0;
    }
    return bitcast<f32>(truth[channel * loss.width * loss.height + at]);
}

fn drawn_of(at: u32) -> vec3<f32> {
    let plane = loss.width * loss.height;
    return vec3<f32>(planes[at], planes[plane + at], planes[2u * plane + at]);
}

// What the camera makes of the colours: its matrix without the identity, and an offset.
fn response_of(channel: u32) -> vec4<f32> {
    let row = loss.response + 3u * channel;
    return vec4<f32>(responses[row], responses[row + 1u], responses[row + 2u], responses[loss.response + 9u + channel]);
}

// A channel as the camera shows it.
fn shown_of(at: u32, channel: u32) -> f32 {
    if ((loss.flags & LOSS_RESPONSE) == 0u) {
        return planes[channel * loss.width * loss.height + at];
    }
    let drawn = drawn_of(at);
    let row = response_of(channel);
    return drawn[channel] + dot(row.xyz, drawn) + row.w;
}

// Number of the i-th pixel of a tile with its halo; 0xffffffff outside of the image.
fn pixel_of(tile: vec2<u32>, i: u32) -> u32 {
    // Negative numbers wrap to large ones.
    let x = tile.x * TILE + i % WIDE - REACH;
    let y = tile.y * TILE + i / WIDE - REACH;
    if (x >= loss.width || y >= loss.height) {
        return 0xffffffffu;
    }
    return y * loss.width + x;
}

// The sum over the tile of what every thread gives, at thread 0.
fn tile_sum(thread: u32, own: vec4<f32>) -> vec4<f32> {
    workgroupBarrier();
    narrow[thread] = own;
    for (var step = THREADS / 2u; step > 0u; step /= 2u) {
        workgroupBarrier();
        if (thread < step) {
            narrow[thread] += narrow[thread + step];
        }
    }
    workgroupBarrier();
    return narrow[0];
}

@compute @workgroup_size(256)
fn moments(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let plane = loss.width * loss.height;
    let px = thread % TILE;
    let py = thread / TILE;
    let own = (py + REACH) * WIDE + px + REACH;
    let at = pixel_of(group.xy, own);
    var weight = 0.0;
    if (at != 0xffffffffu) {
        weight = weight_of(at);
    }
    var sums = vec4<f32>(0.0);
    for (var channel = 0u; channel < 3u; channel++) {
        workgroupBarrier();
        for (var i = thread; i < PIXELS; i += THREADS) {
            let source = pixel_of(group.xy, i);
            var x = 0.0;
            var y = 0.0;
            if (source != 0xffffffffu) {
                // A pixel without weight is as one outside.
                if (weight_of(source) > 0.0) {
                    x = shown_of(source, channel);
                    y = truth_of(source, channel);
                }
            }
            wide[0][i] = x;
            wide[1][i] = y;
        }
        workgroupBarrier();
        for (var i = thread; i < HALF; i += THREADS) {
            let first = i / TILE * WIDE + i % TILE;
            var sum = vec4<f32>(0.0);
            for (var k = 0u; k < TAPS; k++) {
                let x = wide[0][first + k];
                let y = wide[1][first + k];
                sum += tap(k) * vec4<f32>(x, y, x * x + y * y, x * y);
            }
            narrow[i] = sum;
        }
        workgroupBarrier();
        var m = vec4<f32>(0.0);
        for (var k = 0u; k < TAPS; k++) {
            m += tap(k) * narrow[(py + k) * TILE + px];
        }
        let product = m.x * m.y;
        let squares = m.x * m.x + m.y * m.y;
        let half_a1 = product + 0.5 * C1;
        let half_a2 = m.w - product + 0.5 * C2;
        let b1 = squares + C1;
        // Rounding can make a variance negative; b2 must not follow.
        let b2 = max(m.z - squares, 0.0) + C2;
        let inverse = 2.0 / (b1 * b2);
        let half_s = half_a1 * half_a2 * inverse;
        if (at != 0xffffffffu) {
            let scaled = weight * inverse;
            let to = 3u * channel * plane + at;
            maps[to] = scaled * (m.y * (half_a2 - half_a1) + m.x * half_s * (b1 - b2));
            maps[to + plane] = half_s * b1 * scaled;
            maps[to + 2u * plane] = half_a1 * scaled;
            let x = wide[0][own];
            let y = wide[1][own];
            let e = clamp(x, 0.0, 1.0) - y;
            sums += weight * vec4<f32>(abs(x - y), 2.0 * half_s, e * e, 0.0);
        }
    }
    let sum = tile_sum(thread, sums);
    if (thread == 0u) {
        let to = NUMBERS * (group.y * groups.x + group.x);
        for (var i = 0u; i < 4u; i++) {
            partials[to + i] = sum[i];
        }
    }
}

@compute @workgroup_size(256)
fn gradient(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let plane = loss.width * loss.height;
    let px = thread % TILE;
    let py = thread / TILE;
    let at = pixel_of(group.xy, (py + REACH) * WIDE + px + REACH);
    var weight = 0.0;
    if (at != 0xffffffffu) {
        weight = weight_of(at);
    }
    // To what the camera shows.
    var d = vec3<f32>(0.0);
    for (var channel = 0u; channel < 3u; channel++) {
        workgroupBarrier();
        for (var i = thread; i < PIXELS; i += THREADS) {
            let source = pixel_of(group.xy, i);
            var values = vec3<f32>(0.0);
            if (source != 0xffffffffu) {
                let map = 3u * channel * plane + source;
                values = vec3<f32>(maps[map], maps[map + plane], maps[map + 2u * plane]);
            }
            wide[0][i] = values.x;
            wide[1][i] = values.y;
            wide[2][i] = values.z;
        }
        workgroupBarrier();
        for (var i = thread; i < HALF; i += THREADS) {
            let first = i / TILE * WIDE + i % TILE;
            var sum = vec3<f32>(0.0);
            for (var k = 0u; k < TAPS; k++) {
                sum += tap(k) * vec3<f32>(wide[0][first + k], wide[1][first + k], wide[2][first + k]);
            }
            narrow[i] = vec4<f32>(sum, 0.0);
        }
        workgroupBarrier();
        var m = vec3<f32>(0.0);
        for (var k = 0u; k < TAPS; k++) {
            m += tap(k) * narrow[(py + k) * TILE + px].xyz;
        }
        if (weight > 0.0) {
            let x = shown_of(at, channel);
            let y = truth_of(at, channel);
            d[channel] = 2.0 * loss.d_ssim * (y * m.z + (m.x - x * m.y)) + loss.d_l1 * weight * sign(x - y);
        }
    }
    var d_drawn = d;
    if ((loss.flags & LOSS_RESPONSE) != 0u) {
        var drawn = vec3<f32>(0.0);
        if (at != 0xffffffffu) {
            drawn = drawn_of(at);
        }
        for (var channel = 0u; channel < 3u; channel++) {
            d_drawn += d[channel] * response_of(channel).xyz;
        }
        let to = NUMBERS * (group.y * groups.x + group.x);
        for (var channel = 0u; channel < 3u; channel++) {
            let sum = tile_sum(thread, d[channel] * vec4<f32>(drawn, 1.0));
            if (thread == 0u) {
                let row = to + 4u + 3u * channel;
                partials[row] = sum.x;
                partials[row + 1u] = sum.y;
                partials[row + 2u] = sum.z;
                partials[to + 13u + channel] = sum.w;
            }
        }
    }
    if (at != 0xffffffffu) {
        d_planes[at] = d_drawn.x;
        d_planes[plane + at] = d_drawn.y;
        d_planes[2u * plane + at] = d_drawn.z;
    }
}
