// Cosines and logarithms by polynomials, since those of WGSL may be good to 2^-11 only; random numbers that are a function of
// a counter, the same bits as the CPU's. Twin of math/rng.rs.
//
// No bindings and no entry point. 64 bits are two words, the lower one first.

// Cosine and sine of x turns.
fn turned(x: f32) -> vec2<f32> {
    let quarters = 4.0 * (x - round(x));
    let quadrant = i32(round(quarters));
    // At most an eighth of a turn: Taylor's series end at 4e-9.
    let a = 1.5707963267948966 * (quarters - f32(quadrant));
    let b = a * a;
    let s = a * (1.0 + b * (-1.0 / 6.0 + b * (1.0 / 120.0 + b * (-1.0 / 5040.0 + b / 362880.0))));
    let c = 1.0 + b * (-0.5 + b * (1.0 / 24.0 + b * (-1.0 / 720.0 + b * (1.0 / 40320.0 - b / 3628800.0))));
    switch (quadrant & 3) {
        case 0: { return vec2<f32>(c, s); }
        case 1: { return vec2<f32>(-s, c); }
        case 2: { return vec2<f32>(-c, -s); }
        default: { return vec2<f32>(s, -c); }
    }
}

// ln(1 + f) for f from sqrt(1/2) - 1 to sqrt(2) - 1: twice the series of the area tangent, which ends at 2e-9.
fn log_of_one_and(f: f32) -> f32 {
    let s = f / (2.0 + f);
    let z = s * s;
    return 2.0 * s * (1.0 + z * (1.0 / 3.0 + z * (0.2 + z * (1.0 / 7.0 + z / 9.0))));
}

const LN_2: f32 = 0.6931471805599453;

// Of a positive number that is not subnormal.
fn ln(x: f32) -> f32 {
    let word = bitcast<u32>(x);
    // The mantissa is taken from sqrt(1/2), whose bits these are, to sqrt(2).
    let exponent = i32((word - 0x3f3504f3u) & 0xff800000u) >> 23u;
    return f32(exponent) * LN_2 + log_of_one_and(bitcast<f32>(word - (u32(exponent) << 23u)) - 1.0);
}

fn product_of_words(a: u32, b: u32) -> vec2<u32> {
    let al = a & 0xffffu;
    let ah = a >> 16u;
    let bl = b & 0xffffu;
    let bh = b >> 16u;
    let low = al * bl;
    let middle = ah * bl + (low >> 16u);
    let other = al * bh + (middle & 0xffffu);
    return vec2<u32>((other << 16u) | (low & 0xffffu), ah * bh + (middle >> 16u) + (other >> 16u));
}

fn product64(a: vec2<u32>, b: vec2<u32>) -> vec2<u32> {
    let low = product_of_words(a.x, b.x);
    return vec2<u32>(low.x, low.y + a.x * b.y + a.y * b.x);
}

fn sum64(a: vec2<u32>, b: vec2<u32>) -> vec2<u32> {
    let low = a.x + b.x;
    return vec2<u32>(low, a.y + b.y + select(0u, 1u, low < a.x));
}

// z xor z >> by, by less than 32.
fn folded(z: vec2<u32>, by: u32) -> vec2<u32> {
    return z ^ vec2<u32>((z.x >> by) | (z.y << (32u - by)), z.y >> by);
}

const GOLDEN: vec2<u32> = vec2<u32>(0x7f4a7c15u, 0x9e3779b9u);

// SplitMix64's finaliser.
fn mixed(key: vec2<u32>) -> vec2<u32> {
    var z = sum64(key, GOLDEN);
    z = product64(folded(z, 30u), vec2<u32>(0x1ce4e5b9u, 0xbf58476du));
    z = product64(folded(z, 27u), vec2<u32>(0x133111ebu, 0x94d049bbu));
    return folded(z, 31u);
}

fn fork(key: vec2<u32>, index: u32) -> vec2<u32> {
    return mixed(key ^ product64(vec2<u32>(index, 0u), vec2<u32>(0xde82ef95u, 0xd1342543u)));
}

fn bits_of(key: vec2<u32>, i: u32) -> vec2<u32> {
    return mixed(sum64(key, product64(vec2<u32>(i, 0u), GOLDEN)));
}

const WORD: f32 = 4294967296.0;
// 2^-53.
const UNIT: f32 = 1.1102230246251565e-16;

// Standard normal for draw i (Box-Muller).
fn normal(key: vec2<u32>, i: u32) -> f32 {
    // u is 1 - n 2^-53: of both sides of it, the one whose digits count.
    let bits = bits_of(fork(key, 1u), i);
    let n = vec2<u32>((bits.x >> 11u) | (bits.y << 21u), bits.y >> 11u);
    let without = (f32(n.y) * WORD + f32(n.x)) * UNIT;
    var log_u: f32;
    if (without < 0.25) {
        log_u = log_of_one_and(-without);
    } else {
        // 2^53 - n.
        let rest = vec2<u32>(0u - n.x, 0x200000u - n.y - select(0u, 1u, n.x > 0u));
        log_u = ln((f32(rest.y) * WORD + f32(rest.x)) * UNIT);
    }
    let v = bits_of(fork(key, 2u), i);
    return sqrt(-2.0 * log_u) * turned(f32(bitcast<i32>(v.y)) / WORD).x;
}
