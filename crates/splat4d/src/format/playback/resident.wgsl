// A Gaussian of a playback file at time t, from its eight resident words and its block's header: docs/format.md,
// "Page", in WGSL. Names follow that page.
//
// No bindings and no entry point: plain functions, put in front of whatever shader calls them, here and in the player.
// A thread owns one Gaussian.

// Header of a block as 32 numbers, 128 bytes: the file's 24, then what the page states once for all of its blocks.
struct BlockHeader {
    f: array<vec4<f32>, 6>, // header numbers 0-3, 4-7, ... of docs/format.md
    span: f32,              // to - from of the page, s
    count: u32,             // Gaussians of the block, 1 to 256
    palette: u32,           // where the page's palette begins, in the palette buffer's words
    degree: u32,            // SH degree of that palette; 0: base colour only
    sh_range: vec3<f32>,    // the palette's ranges of degree 1, 2, 3
    entries: u32,           // entries of the palette, at least 1
}

// What the words contain about time.
struct Life {
    delta: f32,    // t - c, s
    reach: f32,    // R, s: what shift and turn are measured over
    envelope: f32, // sigma
}

struct Gaussian {
    mean: vec3<f32>,
    label: u32,            // palette entry
    quat: vec4<f32>,       // wxyz, unit
    scale: vec3<f32>,      // standard deviations, scene units
    opacity: f32,          // o * sigma
    velocity: vec3<f32>,   // scene units/s
    base: vec3<f32>,       // base colour, not clamped
}

// Largest codes of 8 and 16 bits, and the signed 10-bit code's middle, which is its scale too.
const CODE_8: f32 = 255.0;
const CODE_16: f32 = 65535.0;
const CODE_10_MIDDLE: f32 = 511.0;
// Half-width codes: 0 is zero, 255 has an infinite lifespan, between them 253 steps.
const FOREVER: u32 = 255u;
const HALF_WIDTH_STEPS: f32 = 253.0;
// A dying Gaussian's reach has this many softnesses on either side.
const REACH_SOFTNESS: f32 = 3.0;
// A reach or softness of zero cannot be divided by; a sound file has none below this (s).
const LEAST_SECONDS: f32 = 1e-12;

fn lerp(low: f32, high: f32, u: f32) -> f32 {
    return low + (high - low) * u;
}

fn lerp3(low: vec3<f32>, high: vec3<f32>, u: vec3<f32>) -> vec3<f32> {
    return low + (high - low) * u;
}

// Three 8-bit codes from bit 0 on.
fn codes_8(word: u32) -> vec3<f32> {
    return vec3<f32>(vec3<u32>(word & 0xffu, (word >> 8u) & 0xffu, (word >> 16u) & 0xffu));
}

// Three signed 10-bit codes, bits 0-9, 10-19, 20-29, over 511: -1 to 1 and a little more.
fn codes_10(word: u32) -> vec3<f32> {
    let code = vec3<f32>(vec3<u32>(word & 0x3ffu, (word >> 10u) & 0x3ffu, (word >> 20u) & 0x3ffu));
    return (code - CODE_10_MIDDLE) / CODE_10_MIDDLE;
}

// Centre, reach and envelope. Reads words 1, 6 and 7 only.
fn life_at(words: array<u32, 8>, header: array<vec4<f32>, 6>, span: f32, t: f32) -> Life {
    var out: Life;
    out.delta = t - lerp(header[1].z, header[1].w, f32(words[1] >> 16u) / CODE_16);
    let code = words[6] >> 24u;
    if (code == FOREVER) {
        out.reach = max(0.5 * span, LEAST_SECONDS);
        out.envelope = 1.0;
        return out;
    }
    let half_width = select(
        0.0,
        exp(lerp(header[3].z, header[3].w, (f32(code) - 1.0) / HALF_WIDTH_STEPS)),
        code > 0u,
    );
    let soft = exp(lerp(header[4].x, header[4].y, f32((words[7] >> 16u) & 0xffu) / CODE_8));
    let softness = max(soft, LEAST_SECONDS);
    out.reach = max(min(half_width + REACH_SOFTNESS * softness, span), LEAST_SECONDS);
    let outside = max(0.0, abs(out.delta) - half_width) / softness;
    out.envelope = exp(-0.5 * outside * outside);
    return out;
}

// o * sigma alone: culling by it needs nothing else unpacked.
fn opacity_at(words: array<u32, 8>, life: Life) -> f32 {
    return f32(words[2] >> 24u) / CODE_8 * life.envelope;
}

// The unit quaternion wxyz of word 3: the largest component is left out and positive.
fn quaternion(word: u32) -> vec4<f32> {
    let abc = codes_10(word).zyx * 0.7071067811865476; // 1/sqrt(2): no other component can be larger
    let largest = sqrt(max(0.0, 1.0 - dot(abc, abc)));
    switch (word >> 30u) {
        case 0u: { return vec4<f32>(largest, abc); }
        case 1u: { return vec4<f32>(abc.x, largest, abc.yz); }
        case 2u: { return vec4<f32>(abc.xy, largest, abc.z); }
        default: { return vec4<f32>(abc, largest); }
    }
}

// The Gaussian at the time for which `life` was computed.
fn gaussian(words: array<u32, 8>, header: array<vec4<f32>, 6>, life: Life) -> Gaussian {
    var out: Gaussian;
    let at = vec3<f32>(vec3<u32>(words[0] & 0xffffu, words[0] >> 16u, words[1] & 0xffffu)) / CODE_16;
    let center = lerp3(header[0].xyz, vec3<f32>(header[0].w, header[1].xy), at);
    out.velocity = header[3].x * codes_10(words[4]) / life.reach;
    out.mean = center + out.velocity * life.delta;
    out.scale = exp(lerp3(vec3<f32>(header[2].z), vec3<f32>(header[2].w), codes_8(words[2]) / CODE_8));
    // q0 + delta/2 (0, w) x q0, with (0, w) x (s, v) = (-w.v, s w + w cross v).
    let turned = (0.5 * life.delta / life.reach) * header[3].y * codes_10(words[5]);
    let q = quaternion(words[3]);
    out.quat = normalize(q + vec4<f32>(-dot(turned, q.yzw), q.x * turned + cross(turned, q.yzw)));
    out.opacity = opacity_at(words, life);
    out.base = lerp3(vec3<f32>(header[4].zw, header[5].x), header[5].yzw, codes_8(words[6]) / CODE_8);
    out.label = words[7] & 0xffffu;
    return out;
}
