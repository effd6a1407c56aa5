// Learnable rows of a layer that stays on the GPU, and what they are at time t. Twin of motion/still.rs (activate and
// its VJP), motion/spacetime.rs, scene/life.rs, and of motion/tracked.rs on a frame.
//
// No bindings and no entry point, but for `params`, which the including shader binds: all tables of a layer but the SH,
// one after the other, [row / 16][column][16].

const TABLE_BLOCK: u32 = 16u;
// Threads of a workgroup of the kernels over rows (gpu/tuning.rs).
const ROW_THREADS: u32 = 256u;
// Columns of geometry: mean, raw quaternion wxyz, log scales, opacity logit (scene/params.rs).
const QUAT: u32 = 3u;
const LOG_SCALE: u32 = 7u;
const OPACITY: u32 = 10u;
// Bits of query.flags: quaternions have rates; the lifespan's centre learns from opacity alone; this is the step's
// first view.
const QUERY_ROTATION: u32 = 1u;
const QUERY_DETACH: u32 = 2u;
const QUERY_FIRST: u32 = 4u;
// Kinds of lifespan.
const LIFE_INFINITE: u32 = 0u;
const LIFE_HALF: u32 = 1u;
const LIFE_ONE: u32 = 2u;
const LIFE_INTERVAL: u32 = 3u;
// A quaternion shorter than this is the identity (math/quat.rs).
const TINY_NORM: f32 = 1e-12;

struct Query {
    rows: u32,
    width: u32,         // columns of params
    order: u32,         // of the polynomial
    flags: u32,
    life: u32,
    life_at: u32,       // first columns
    velocities_at: u32,
    rates_at: u32,
    t: f32,
    delta: f32,         // of rows that have infinite lifespans
    alpha_min: f32,     // least opacity of a row that is alive
    widest: f32,        // widths from the centre at which no row is
    first_splat: u32,
    first_row: u32,     // of this page of the layer
    sh_width: u32,
    blocks: u32,        // of spherical harmonics
    poses_at: u32,      // mean and quaternion: 0, or where the poses of a tracked frame are
    own_at: u32,        // further columns of Gaussians of space and time (slice.wgsl), and their numbers
    speed: f32,
    floor: f32,
    ceiling: f32,
    pace: f32,
}

struct Moved {
    mean: vec3<f32>,
    quat: vec4<f32>,
    log_scale: vec3<f32>,
    logit: f32,
}

fn at(row: u32, column: u32, width: u32) -> u32 {
    return (row / TABLE_BLOCK * width + column) * TABLE_BLOCK + row % TABLE_BLOCK;
}

fn sigmoid(x: f32) -> f32 {
    return 1.0 / (1.0 + exp(-x));
}

fn three(query: Query, row: u32, column: u32) -> vec3<f32> {
    let i = at(row, column, query.width);
    return vec3<f32>(params[i], params[i + TABLE_BLOCK], params[i + 2u * TABLE_BLOCK]);
}

fn four(query: Query, row: u32, column: u32) -> vec4<f32> {
    return vec4<f32>(three(query, row, column), params[at(row, column + 3u, query.width)]);
}

fn delta_of(query: Query, row: u32) -> f32 {
    if (query.life == LIFE_INFINITE) {
        return query.delta;
    }
    return query.t - params[at(row, query.life_at, query.width)];
}

fn moved(query: Query, row: u32, delta: f32) -> Moved {
    var out: Moved;
    out.mean = three(query, row, query.poses_at);
    out.quat = four(query, row, query.poses_at + QUAT);
    out.log_scale = three(query, row, LOG_SCALE);
    out.logit = params[at(row, OPACITY, query.width)];
    var power = 1.0;
    for (var k = 0u; k < query.order; k++) {
        power *= delta;
        out.mean += power * three(query, row, query.velocities_at + 3u * k);
    }
    if ((query.flags & QUERY_ROTATION) != 0u) {
        out.quat += delta * four(query, row, query.rates_at);
    }
    return out;
}

// The envelope, and its derivatives to time, log width and log softness.
fn life_of(query: Query, row: u32) -> vec4<f32> {
    if (query.life == LIFE_INFINITE) {
        return vec4<f32>(1.0, 0.0, 0.0, 0.0);
    }
    let delta = delta_of(query, row);
    let log_width = params[at(row, query.life_at + 1u, query.width)];
    if (query.life == LIFE_INTERVAL) {
        let width = exp(log_width);
        let over = abs(delta) - width;
        if (over <= 0.0) {
            return vec4<f32>(1.0, 0.0, 0.0, 0.0);
        }
        let inverse = exp(-params[at(row, query.life_at + 2u, query.width)]);
        let e = over * inverse;
        let sigma = exp(-0.5 * e * e);
        let slope = sigma * e * inverse;
        return vec4<f32>(sigma, select(-slope, slope, delta < 0.0), slope * width, sigma * e * e);
    }
    let half = select(1.0, 0.5, query.life == LIFE_HALF);
    let inverse = exp(-log_width);
    let u = delta * inverse;
    let sigma = exp(-half * u * u);
    let slope = 2.0 * half * sigma * u;
    return vec4<f32>(sigma, -slope * inverse, slope * u, 0.0);
}

struct Unit {
    quat: vec4<f32>,
    norm: f32, // 0: the quaternion was none
}

fn unit_of(q: vec4<f32>) -> Unit {
    let norm = sqrt(dot(q, q));
    if (norm > TINY_NORM) {
        return Unit(q * (1.0 / norm), norm);
    }
    return Unit(vec4<f32>(1.0, 0.0, 0.0, 0.0), 0.0);
}

// Rows of the rotation of a unit quaternion (wxyz), as columns of the matrix: its transpose.
fn rotation_rows(q: vec4<f32>) -> mat3x3<f32> {
    let w = q.x;
    let x = q.y;
    let y = q.z;
    let z = q.w;
    return mat3x3<f32>(
        vec3<f32>(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        vec3<f32>(2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        vec3<f32>(2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    );
}

// From the gradient of that rotation to the quaternion's: d[j][i] is the one to row i, column j. Twin of math/quat.rs.
fn rotation_back(q: vec4<f32>, d: mat3x3<f32>) -> vec4<f32> {
    let w = q.x;
    let x = q.y;
    let y = q.z;
    let z = q.w;
    return 2.0 * vec4<f32>(
        x * (d[1][2] - d[2][1]) + y * (d[2][0] - d[0][2]) + z * (d[0][1] - d[1][0]),
        w * (d[1][2] - d[2][1]) + y * (d[1][0] + d[0][1]) + z * (d[2][0] + d[0][2])
            - 2.0 * x * (d[1][1] + d[2][2]),
        w * (d[2][0] - d[0][2]) + x * (d[1][0] + d[0][1]) + z * (d[2][1] + d[1][2])
            - 2.0 * y * (d[0][0] + d[2][2]),
        w * (d[0][1] - d[1][0]) + x * (d[2][0] + d[0][2]) + y * (d[2][1] + d[1][2])
            - 2.0 * z * (d[0][0] + d[1][1]),
    );
}

// From the gradient of the unit quaternion to that of the one before.
fn unit_back(unit: Unit, d: vec4<f32>) -> vec4<f32> {
    if (unit.norm > 0.0) {
        return (d - unit.quat * dot(unit.quat, d)) / unit.norm;
    }
    return vec4<f32>(0.0);
}
