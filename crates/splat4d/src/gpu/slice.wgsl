// One Gaussian of space and time and what its slice at t is made of. Twin of motion/native4d/slice.rs, where the
// equations are documented; learnt.wgsl and numbers.wgsl are put in front of this file.
//
// No bindings and no entry point. A row's own columns: time of the mean, log scale in time, right quaternion. Matrices
// are held by rows: m[i] is row i.

const LOG_TIME_SCALE: u32 = 1u;
const RIGHT: u32 = 2u;
// The lifespan's exponent stops at half of this.
const FAINTEST: f32 = 60.0;

struct Slice {
    mean: vec3<f32>,
    logit: f32,
    left: Unit,
    right: Unit,
    rotation: mat4x4<f32>,
    scales: vec4<f32>,
    l: mat4x4<f32>,     // R diag(s)
    c: f32,
    lifted: f32,        // c, not below the floor
    inverse: f32,
    v: vec3<f32>,
    k: array<vec4<f32>, 3>,
    tau: f32,
    square: f32,        // tau^2 / c, not above FAINTEST
    near: bool,
    grows: bool,        // whether the scale in time is below its ceiling
}

fn time_of(query: Query, row: u32) -> f32 {
    return params[at(row, query.own_at, query.width)];
}

// Cosine and sine of block n's wave.
fn wave(query: Query, row: u32, n: u32) -> vec2<f32> {
    return turned(f32(n) * query.pace * (time_of(query, row) - query.t));
}

fn from_products(l: vec4<f32>, r: vec4<f32>) -> mat4x4<f32> {
    let a = l.x * r;
    let b = l.y * r;
    let c = l.z * r;
    let d = l.w * r;
    return mat4x4<f32>(
        vec4<f32>(a.x + b.y - c.z - d.w, b.z + c.y - a.w - d.x, a.z + b.w + c.x + d.y, b.x + d.z - a.y - c.w),
        vec4<f32>(a.w + b.z + c.y + d.x, a.x + c.z - b.y - d.w, c.w + d.z - a.y - b.x, b.w + c.x - a.z - d.y),
        vec4<f32>(b.w + d.y - a.z - c.x, a.y + b.x + c.w + d.z, a.x + d.w - b.y - c.z, c.y + d.x - a.w - b.z),
        vec4<f32>(a.y + d.z - b.x - c.w, a.z + b.w - c.x - d.y, a.w + c.y - b.z - d.x, a.x + b.y + c.z + d.w),
    );
}

fn to_products(d: mat4x4<f32>) -> mat4x4<f32> {
    let x = d[0];
    let y = d[1];
    let z = d[2];
    let t = d[3];
    return mat4x4<f32>(
        vec4<f32>(x.x + y.y + z.z + t.w, t.x + z.y - y.z - x.w, t.y + x.z - z.x - y.w, y.x + t.z - x.y - z.w),
        vec4<f32>(z.y + x.w - t.x - y.z, x.x + t.w - y.y - z.z, y.x + x.y - t.z - z.w, z.x + t.y + x.z + y.w),
        vec4<f32>(x.z + y.w - z.x - t.y, y.x + x.y + t.z + z.w, y.y + t.w - x.x - z.z, z.y + y.z - t.x - x.w),
        vec4<f32>(y.x + z.w - x.y - t.z, z.x + x.z - t.y - y.w, t.x + z.y + y.z + x.w, z.z + t.w - x.x - y.y),
    );
}

fn slice_of(query: Query, row: u32) -> Slice {
    var s: Slice;
    s.mean = three(query, row, 0u);
    s.logit = params[at(row, OPACITY, query.width)];
    s.left = unit_of(four(query, row, QUAT));
    s.right = unit_of(four(query, row, query.own_at + RIGHT));
    s.rotation = from_products(s.left.quat, s.right.quat);
    let log_time = params[at(row, query.own_at + LOG_TIME_SCALE, query.width)];
    s.grows = log_time < query.ceiling;
    s.scales = vec4<f32>(exp(three(query, row, LOG_SCALE)), query.speed * exp(min(log_time, query.ceiling)));
    for (var i = 0u; i < 4u; i++) {
        s.l[i] = s.rotation[i] * s.scales;
    }
    let e = s.l[3];
    let q = e * e;
    s.c = q.x + q.y + q.z + q.w;
    s.lifted = max(s.c, query.floor);
    s.inverse = 1.0 / s.lifted;
    let rest = s.lifted - s.c;
    // The projector's diagonal as sums of the other squares: 1 - e_k^2/c would lose the digits that matter.
    let diagonal = vec4<f32>(q.y + q.z + q.w + rest, q.x + q.z + q.w + rest, q.x + q.y + q.w + rest,
        q.x + q.y + q.z + rest) * s.inverse;
    let scaled = e * s.inverse;
    for (var i = 0u; i < 3u; i++) {
        let g = s.l[i] * e;
        s.v[i] = g.x + g.y + g.z + g.w;
        let others = vec4<f32>(g.y + g.z + g.w, g.x + g.z + g.w, g.x + g.y + g.w, g.x + g.y + g.z);
        s.k[i] = s.l[i] * diagonal - others * scaled;
    }
    s.tau = query.speed * (query.t - time_of(query, row));
    let square = s.tau * s.tau * s.inverse;
    s.near = square < FAINTEST;
    s.square = min(square, FAINTEST);
    return s;
}
