// What holds the poses of a tracked frame: along the edges of a graph rigidity, rotation and isometry, a floor, and a
// background that stays. Twin of splat4d-train's loss/rigid.rs and loss/tracked.rs, which document the equations;
// learnt.wgsl is put in front of this file.
//
// Bindings, group 0: 0 query; 1 rule; 2 params; 3 before, two vec4 a point: position, quaternion of the frame before; 4
// edges, four words each: where it leads to, length and weight as bits; 5 links: from 0 on the first edge to each point
// and one past the last, from rule.back_at on the edges to points, from rule.rows_at on the rows of points and of the
// background; in and out: 6 turns, a vec4 a point; 7 d_params, which is added to; 8 status: from rule.sums_at on the
// loss of each workgroup, as bits; 9 counts ([3]: stopped). Eight storage buffers. A thread owns one point, or one row
// of the background, and adds what its edges pull at both their ends.

// Keeps the root's derivative finite (loss/rigid.rs).
const UNDER_ROOT: f32 = 1e-20;
const THREADS: u32 = 256u;

struct TieRule {
    points: u32,
    background: u32,
    neighbours: u32,
    back_at: u32,
    rows_at: u32,
    sums_at: u32,
    rigid: f32,      // of an edge
    rot: f32,
    iso: f32,
    floor: f32,      // of a point
    stays: vec2<f32>, // of a row: in place, and its turn
    up: vec3<f32>,
    height: f32,
}

@group(0) @binding(0) var<uniform> query: Query;
@group(0) @binding(1) var<uniform> rule: TieRule;
@group(0) @binding(2) var<storage, read> params: array<f32>;
@group(0) @binding(3) var<storage, read> before: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> edges: array<vec4<u32>>;
@group(0) @binding(5) var<storage, read> links: array<u32>;
@group(0) @binding(6) var<storage, read_write> turns: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read_write> d_params: array<f32>;
@group(0) @binding(8) var<storage, read_write> status: array<atomic<u32>>;
@group(0) @binding(9) var<storage, read> counts: array<u32>;

var<workgroup> sums: array<f32, 256>;

fn product(a: vec4<f32>, b: vec4<f32>) -> vec4<f32> {
    return vec4<f32>(a.x * b.x - dot(a.yzw, b.yzw), a.x * b.yzw + b.x * a.yzw + cross(a.yzw, b.yzw));
}

fn row_of(point: u32) -> u32 {
    return links[rule.rows_at + point];
}

fn place(point: u32) -> vec3<f32> {
    return three(query, row_of(point), query.poses_at);
}

// The turn of each point since the frame before.
@compute @workgroup_size(256)
fn turns_of(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = id.x;
    if (i >= rule.points) {
        return;
    }
    let now = unit_of(four(query, row_of(i), query.poses_at + QUAT)).quat;
    let old = unit_of(before[2u * i + 1u]).quat;
    turns[i] = product(now, vec4<f32>(old.x, -old.yzw));
}

// An edge from i to j: its loss, and its gradient to j's turn and position.
struct Pull {
    loss: f32,
    residual: vec3<f32>, // gradient to the offset in the axes of the frame before
    offset: vec3<f32>,
    force: vec3<f32>,
    turn: vec4<f32>,     // at j's turn; at i's inverted, times sign
    sign: f32,
}

fn pull(edge: vec4<u32>, i: u32, j: u32) -> Pull {
    var out: Pull;
    let rest = bitcast<f32>(edge.y);
    let weight = bitcast<f32>(edge.z);
    let turn_i = turns[i];
    let turn_j = turns[j];
    out.offset = place(j) - place(i);
    // transpose(R) offset: rotation_rows holds the rows of R, as the columns of a matrix.
    let rows = rotation_rows(turn_i);
    let r = rows * out.offset - (before[2u * j].xyz - before[2u * i].xyz);
    let root = sqrt(weight * dot(r, r) + UNDER_ROOT);
    out.residual = (rule.rigid * weight / root) * r;
    out.force = transpose(rows) * out.residual;
    out.sign = select(1.0, -1.0, dot(turn_i, turn_j) < 0.0);
    let turned = turn_j - out.sign * turn_i;
    let turned_root = sqrt(weight * dot(turned, turned) + UNDER_ROOT);
    out.turn = (rule.rot * weight / turned_root) * turned;
    let long = length(out.offset);
    let stretch = long - rest;
    let stretched_root = sqrt(weight * stretch * stretch + UNDER_ROOT);
    if (long > 0.0) {
        out.force += (rule.iso * weight * stretch / (stretched_root * long)) * out.offset;
    }
    out.loss = rule.rigid * root + rule.rot * turned_root + rule.iso * stretched_root;
    return out;
}

fn add(row: u32, d_x: vec3<f32>, d_quat: vec4<f32>) {
    let x = at(row, query.poses_at, query.width);
    for (var k = 0u; k < 3u; k++) {
        d_params[x + k * TABLE_BLOCK] += d_x[k];
    }
    for (var k = 0u; k < 4u; k++) {
        d_params[x + (QUAT + k) * TABLE_BLOCK] += d_quat[k];
    }
}

fn hold_point(i: u32) -> f32 {
    var sum = 0.0;
    var d_x = vec3<f32>(0.0);
    var d_turn = vec4<f32>(0.0);
    var d_rotation = mat3x3<f32>(vec3<f32>(0.0), vec3<f32>(0.0), vec3<f32>(0.0));
    for (var e = i * rule.neighbours; e < (i + 1u) * rule.neighbours; e++) {
        let edge = edges[e];
        if (edge.x != i) {
            let p = pull(edge, i, edge.x);
            sum += p.loss;
            d_x -= p.force;
            d_turn -= p.sign * p.turn;
            // d[j][i] is the gradient to row i, column j: offset_i residual_j.
            for (var j = 0u; j < 3u; j++) {
                d_rotation[j] += p.residual[j] * p.offset;
            }
        }
    }
    for (var l = links[i]; l < links[i + 1u]; l++) {
        let e = links[rule.back_at + l];
        let p = pull(edges[e], e / rule.neighbours, i);
        d_x += p.force;
        d_turn += p.turn;
    }
    let row = row_of(i);
    let below = rule.height - dot(rule.up, place(i));
    if (below > 0.0) {
        sum += rule.floor * below;
        d_x -= rule.floor * rule.up;
    }
    d_turn += rotation_back(turns[i], d_rotation);
    let now = unit_of(four(query, row, query.poses_at + QUAT));
    add(row, d_x, unit_back(now, product(d_turn, unit_of(before[2u * i + 1u]).quat)));
    return sum;
}

fn hold_background(row: u32) -> f32 {
    let now = four(query, row, query.poses_at + QUAT);
    let then = four(query, row, QUAT);
    let off = three(query, row, query.poses_at) - three(query, row, 0u);
    // Both signs of a quaternion are one turn.
    let turned = now - select(then, -then, dot(now, then) < 0.0);
    add(row, rule.stays.x * sign(off), rule.stays.y * sign(turned));
    return rule.stays.x * dot(abs(off), vec3<f32>(1.0)) + rule.stays.y * dot(abs(turned), vec4<f32>(1.0));
}

@compute @workgroup_size(256)
fn hold(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    var sum = 0.0;
    // Where steps have stopped the view is rendered again, and what other views gave must stay as it is.
    if (counts[3] == 0u) {
        if (id.x < rule.points) {
            sum = hold_point(id.x);
        } else if (id.x < rule.points + rule.background) {
            sum = hold_background(row_of(id.x));
        }
    }
    sums[thread] = sum;
    for (var step = THREADS / 2u; step > 0u; step /= 2u) {
        workgroupBarrier();
        if (thread < step) {
            sums[thread] += sums[thread + step];
        }
    }
    if (thread == 0u) {
        atomicStore(&status[rule.sums_at + group.x], bitcast<u32>(sums[0]));
    }
}
