// Made from the .wgsl files, whose comments say what they do, by
// `UPDATE_GOLDEN=1 cargo test -p splat4d-serve --test shaders`. A test fails when it is out of date.

export const RESIDENT = `
struct BlockHeader {
f: array<vec4<f32>, 6>,
span: f32,
count: u32,
palette: u32,
degree: u32,
sh_range: vec3<f32>,
entries: u32,
}
struct Life {
delta: f32,
reach: f32,
envelope: f32,
}
struct Gaussian {
mean: vec3<f32>,
label: u32,
quat: vec4<f32>,
scale: vec3<f32>,
opacity: f32,
velocity: vec3<f32>,
base: vec3<f32>,
}
const CODE_8: f32 = 255.0;
const CODE_16: f32 = 65535.0;
const CODE_10_MIDDLE: f32 = 511.0;
const FOREVER: u32 = 255u;
const HALF_WIDTH_STEPS: f32 = 253.0;
const REACH_SOFTNESS: f32 = 3.0;
const LEAST_SECONDS: f32 = 1e-12;
fn lerp(low: f32, high: f32, u: f32) -> f32 {
return low + (high - low) * u;
}
fn lerp3(low: vec3<f32>, high: vec3<f32>, u: vec3<f32>) -> vec3<f32> {
return low + (high - low) * u;
}
fn codes_8(word: u32) -> vec3<f32> {
return vec3<f32>(vec3<u32>(word & 0xffu, (word >> 8u) & 0xffu, (word >> 16u) & 0xffu));
}
fn codes_10(word: u32) -> vec3<f32> {
let code = vec3<f32>(vec3<u32>(word & 0x3ffu, (word >> 10u) & 0x3ffu, (word >> 20u) & 0x3ffu));
return (code - CODE_10_MIDDLE) / CODE_10_MIDDLE;
}
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
fn opacity_at(words: array<u32, 8>, life: Life) -> f32 {
return f32(words[2] >> 24u) / CODE_8 * life.envelope;
}
fn quaternion(word: u32) -> vec4<f32> {
let abc = codes_10(word).zyx * 0.7071067811865476;
let largest = sqrt(max(0.0, 1.0 - dot(abc, abc)));
switch (word >> 30u) {
case 0u: { return vec4<f32>(largest, abc); }
case 1u: { return vec4<f32>(abc.x, largest, abc.yz); }
case 2u: { return vec4<f32>(abc.xy, largest, abc.z); }
default: { return vec4<f32>(abc, largest); }
}
}
fn gaussian(words: array<u32, 8>, header: array<vec4<f32>, 6>, life: Life) -> Gaussian {
var out: Gaussian;
let at = vec3<f32>(vec3<u32>(words[0] & 0xffffu, words[0] >> 16u, words[1] & 0xffffu)) / CODE_16;
let center = lerp3(header[0].xyz, vec3<f32>(header[0].w, header[1].xy), at);
out.velocity = header[3].x * codes_10(words[4]) / life.reach;
out.mean = center + out.velocity * life.delta;
out.scale = exp(lerp3(vec3<f32>(header[2].z), vec3<f32>(header[2].w), codes_8(words[2]) / CODE_8));
let turned = (0.5 * life.delta / life.reach) * header[3].y * codes_10(words[5]);
let q = quaternion(words[3]);
out.quat = normalize(q + vec4<f32>(-dot(turned, q.yzw), q.x * turned + cross(turned, q.yzw)));
out.opacity = opacity_at(words, life);
out.base = lerp3(vec3<f32>(header[4].zw, header[5].x), header[5].yzw, codes_8(words[6]) / CODE_8);
out.label = words[7] & 0xffffu;
return out;
}
`;

export const PROJECT = `
const PROJECT_J_MARGIN: f32 = 0.3;
const PROJECT_RHO_MIN: f32 = 0.005;
const PROJECT_TAU_MARGIN: f32 = 1e-3;
const PROJECT_TINY_NORM: f32 = 1e-12;
const VIEW_ANTIALIAS: u32 = 1u;
struct View {
camera_from_world: mat4x4<f32>,
focal: vec2<f32>,
center: vec2<f32>,
size: vec2<f32>,
near: f32,
low_pass: f32,
camera: vec3<f32>,
alpha_min: f32,
sh_degree: u32,
count: u32,
time: f32,
flags: u32,
}
struct Cov {
xx: f32,
xy: f32,
xz: f32,
yy: f32,
yz: f32,
zz: f32,
}
struct Ellipse {
center: vec2<f32>,
extent: vec2<f32>,
conic: vec3<f32>,
depth: f32,
cov2d: vec3<f32>,
visible: u32,
rho: f32,
}
fn finite(x: f32) -> bool {
return (bitcast<u32>(x) & 0x7f800000u) != 0x7f800000u;
}
fn covariance(quat_wxyz: vec4<f32>, scale: vec3<f32>) -> Cov {
let norm = length(quat_wxyz);
var q = vec4<f32>(1.0, 0.0, 0.0, 0.0);
if (norm > PROJECT_TINY_NORM) {
q = quat_wxyz / norm;
}
let w = q.x;
let v = q.yzw;
let d = 2.0 * v * v;
let xy = 2.0 * v.x * v.y;
let xz = 2.0 * v.x * v.z;
let yz = 2.0 * v.y * v.z;
let wv = 2.0 * w * v;
let a = scale.x * vec3<f32>(1.0 - d.y - d.z, xy + wv.z, xz - wv.y);
let b = scale.y * vec3<f32>(xy - wv.z, 1.0 - d.x - d.z, yz + wv.x);
let c = scale.z * vec3<f32>(xz + wv.y, yz - wv.x, 1.0 - d.x - d.y);
return Cov(
a.x * a.x + b.x * b.x + c.x * c.x,
a.x * a.y + b.x * b.y + c.x * c.y,
a.x * a.z + b.x * b.z + c.x * c.z,
a.y * a.y + b.y * b.y + c.y * c.y,
a.y * a.z + b.y * b.z + c.y * c.z,
a.z * a.z + b.z * b.z + c.z * c.z,
);
}
fn cov_times(s: Cov, v: vec3<f32>) -> vec3<f32> {
return vec3<f32>(
s.xx * v.x + s.xy * v.y + s.xz * v.z,
s.xy * v.x + s.yy * v.y + s.yz * v.z,
s.xz * v.x + s.yz * v.y + s.zz * v.z,
);
}
fn meets_pixels(center: f32, extent: f32, size: f32) -> bool {
return max(ceil(center - extent - 0.5), 0.0) <= min(floor(center + extent - 0.5), size - 1.0);
}
fn cutoff(view: View, opacity: f32) -> f32 {
return 2.0 * log(opacity / view.alpha_min) + PROJECT_TAU_MARGIN;
}
struct Linear {
uv: vec2<f32>,
held: vec2<f32>,
r0: vec3<f32>,
r1: vec3<f32>,
r2: vec3<f32>,
m0: vec3<f32>,
m1: vec3<f32>,
}
fn linear(view: View, p: vec3<f32>) -> Linear {
let inv_z = 1.0 / p.z;
let uv = p.xy * inv_z;
let margin = PROJECT_J_MARGIN * 0.5 * view.size / view.focal;
let low = -(view.center / view.focal + margin);
let high = (view.size - view.center) / view.focal + margin;
let held = min(max(uv, low), high);
let r0 = vec3<f32>(view.camera_from_world[0].x, view.camera_from_world[1].x, view.camera_from_world[2].x);
let r1 = vec3<f32>(view.camera_from_world[0].y, view.camera_from_world[1].y, view.camera_from_world[2].y);
let r2 = vec3<f32>(view.camera_from_world[0].z, view.camera_from_world[1].z, view.camera_from_world[2].z);
let m0 = view.focal.x * inv_z * (r0 - held.x * r2);
let m1 = view.focal.y * inv_z * (r1 - held.y * r2);
return Linear(uv, held, r0, r1, r2, m0, m1);
}
fn project(view: View, mean: vec3<f32>, cov: Cov, opacity: f32) -> Ellipse {
var out: Ellipse;
out.visible = 0u;
out.rho = 1.0;
let p = (view.camera_from_world * vec4<f32>(mean, 1.0)).xyz;
if (!(finite(p.x) && finite(p.y) && finite(p.z) && finite(opacity))) {
return out;
}
if (!(p.z > view.near && opacity >= view.alpha_min)) {
return out;
}
let local = linear(view, p);
let m0 = local.m0;
let m1 = local.m1;
let s0 = cov_times(cov, m0);
let s1 = cov_times(cov, m1);
let xx = dot(s0, m0);
let xy = dot(s0, m1);
let yy = dot(s1, m1);
let det0 = max(xx * yy - xy * xy, 0.0);
let det1 = det0 + view.low_pass * (xx + yy + view.low_pass);
let wide = vec3<f32>(xx + view.low_pass, xy, yy + view.low_pass);
if (!(finite(det1) && finite(wide.x) && finite(wide.y) && finite(wide.z))) {
return out;
}
if (!(det1 > 0.0 && wide.x > 0.0 && wide.z > 0.0)) {
return out;
}
if ((view.flags & VIEW_ANTIALIAS) != 0u) {
out.rho = sqrt(max(det0 / det1, PROJECT_RHO_MIN * PROJECT_RHO_MIN));
}
let dimmed = opacity * out.rho;
if (!(dimmed >= view.alpha_min)) {
return out;
}
let inv = 1.0 / det1;
out.center = view.focal * local.uv + view.center;
out.extent = sqrt(cutoff(view, dimmed) * wide.xz);
out.conic = vec3<f32>(wide.z * inv, -wide.y * inv, wide.x * inv);
out.depth = p.z;
out.cov2d = wide;
let all = out.center.x + out.center.y + out.conic.x + out.conic.y + out.conic.z + out.extent.x + out.extent.y;
if (finite(all) && meets_pixels(out.center.x, out.extent.x, view.size.x)
&& meets_pixels(out.center.y, out.extent.y, view.size.y)) {
out.visible = 1u;
}
return out;
}
`;

export const SHADE = `
const SH_COEFFS: u32 = 16u;
const SH_COLOR_OFFSET: f32 = 0.5;
const SH_C0: f32 = 0.28209479177387814;
const SH_C1: f32 = 0.4886025119029199;
const SH_C2_XY: f32 = 1.0925484305920792;
const SH_C2_ZZ: f32 = 0.31539156525252005;
const SH_C2_XX: f32 = 0.5462742152960396;
const SH_C3_YXX: f32 = 0.5900435899266435;
const SH_C3_XYZ: f32 = 2.890611442640554;
const SH_C3_YZZ: f32 = 0.4570457994644658;
const SH_C3_ZZZ: f32 = 0.3731763325901154;
const SH_C3_ZXX: f32 = 1.445305721320277;
fn sh_basis(dir: vec3<f32>) -> array<f32, 16> {
let x = dir.x;
let y = dir.y;
let z = dir.z;
let xx = x * x;
let yy = y * y;
let zz = z * z;
return array<f32, 16>(
SH_C0,
-SH_C1 * y,
SH_C1 * z,
-SH_C1 * x,
SH_C2_XY * x * y,
-SH_C2_XY * y * z,
SH_C2_ZZ * (2.0 * zz - xx - yy),
-SH_C2_XY * x * z,
SH_C2_XX * (xx - yy),
-SH_C3_YXX * y * (3.0 * xx - yy),
SH_C3_XYZ * x * y * z,
-SH_C3_YZZ * y * (4.0 * zz - xx - yy),
SH_C3_ZZZ * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
-SH_C3_YZZ * x * (4.0 * zz - xx - yy),
SH_C3_ZXX * z * (xx - yy),
-SH_C3_YXX * x * (xx - 3.0 * yy),
);
}
fn sh_used(held: u32, degree: u32) -> u32 {
let asked = (degree + 1u) * (degree + 1u);
if (held >= 16u) { return min(asked, 16u); }
if (held >= 9u) { return min(asked, 9u); }
if (held >= 4u) { return min(asked, 4u); }
return min(held, 1u);
}
`;

export const SORT = `
const SORT_THREADS: u32 = 256u;
const SORT_ROUNDS: u32 = 8u;
const SORT_BLOCK: u32 = 2048u;
const SORT_ROW: u32 = 16u;
const SORT_FEW: u32 = 32u;
const SORT_WORDS: u32 = 64u;
struct SortPass {
shift: u32,
count_index: u32,
}
@group(0) @binding(0) var<uniform> sort_pass: SortPass;
@group(0) @binding(1) var<storage, read> sort_count: array<u32>;
@group(0) @binding(2) var<storage, read> keys_in: array<u32>;
@group(0) @binding(3) var<storage, read> values_in: array<u32>;
@group(0) @binding(4) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(5) var<storage, read_write> values_out: array<u32>;
@group(0) @binding(6) var<storage, read_write> sort_counts: array<u32>;
var<workgroup> sort_digits: array<atomic<u32>, 256>;
var<workgroup> sort_sums: array<u32, 256>;
var<workgroup> sort_rows: array<u32, 16>;
var<workgroup> sort_bytes: array<atomic<u32>, 64>;
fn sort_pairs() -> u32 {
return min(sort_count[sort_pass.count_index], arrayLength(&keys_in));
}
fn sort_blocks() -> u32 {
return (sort_pairs() + SORT_BLOCK - 1u) / SORT_BLOCK;
}
fn sort_digit(key: u32) -> u32 {
return (key >> sort_pass.shift) & 0xffu;
}
@compute @workgroup_size(256)
fn histogram(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
let pairs = sort_pairs();
let blocks = sort_blocks();
let block = group.x;
atomicStore(&sort_digits[thread], 0u);
workgroupBarrier();
for (var round = 0u; round < SORT_ROUNDS; round++) {
let i = block * SORT_BLOCK + round * SORT_THREADS + thread;
if (i < pairs) {
atomicAdd(&sort_digits[sort_digit(keys_in[i])], 1u);
}
}
workgroupBarrier();
if (block < blocks) {
sort_counts[thread * blocks + block] = atomicLoad(&sort_digits[thread]);
}
}
fn sort_exclusive(thread: u32, value: u32) -> u32 {
sort_sums[thread] = value;
workgroupBarrier();
if (thread < SORT_ROW) {
var sum = 0u;
for (var i = 0u; i < SORT_ROW; i++) {
sum += sort_sums[thread * SORT_ROW + i];
}
sort_rows[thread] = sum;
}
workgroupBarrier();
let row = thread / SORT_ROW;
var before = 0u;
for (var r = 0u; r < row; r++) {
before += sort_rows[r];
}
for (var i = row * SORT_ROW; i < thread; i++) {
before += sort_sums[i];
}
return before;
}
@compute @workgroup_size(256)
fn scan(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
let blocks = sort_blocks();
if (blocks <= SORT_FEW) {
if (group.x == 0u) {
sort_counts[SORT_THREADS * blocks + thread] = sort_run(thread * blocks, thread * blocks + blocks, 0u);
}
return;
}
let digit = group.x;
let run = (blocks + SORT_THREADS - 1u) / SORT_THREADS;
let first = min(thread * run, blocks);
let end = min(first + run, blocks);
var sum = 0u;
for (var b = first; b < end; b++) {
sum += sort_counts[digit * blocks + b];
}
let before = sort_exclusive(thread, sum);
if (thread == SORT_THREADS - 1u) {
sort_counts[SORT_THREADS * blocks + digit] = before + sum;
}
_ = sort_run(digit * blocks + first, digit * blocks + end, before);
}
fn sort_run(first: u32, end: u32, start: u32) -> u32 {
var before = start;
for (var i = first; i < end; i++) {
let count = sort_counts[i];
sort_counts[i] = before;
before += count;
}
return before;
}
@compute @workgroup_size(256)
fn scatter(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
let pairs = sort_pairs();
let blocks = sort_blocks();
let block = group.x;
let total = select(0u, sort_counts[SORT_THREADS * blocks + thread], block < blocks);
var next = sort_exclusive(thread, total);
if (block < blocks) {
next += sort_counts[thread * blocks + block];
}
workgroupBarrier();
let word = thread / 4u;
let byte = 8u * (thread % 4u);
for (var round = 0u; round < SORT_ROUNDS; round++) {
let i = block * SORT_BLOCK + round * SORT_THREADS + thread;
let there = i < pairs;
var key = 0u;
var digit = 0u;
sort_sums[thread] = next;
atomicStore(&sort_digits[thread], 0u);
if (thread < SORT_WORDS) {
atomicStore(&sort_bytes[thread], 0u);
}
workgroupBarrier();
if (there) {
key = keys_in[i];
digit = sort_digit(key);
atomicOr(&sort_bytes[word], digit << byte);
atomicAdd(&sort_digits[digit], 1u);
}
workgroupBarrier();
if (there) {
var rank = countOneBits(sort_equal(atomicLoad(&sort_bytes[word]), digit) & ((1u << byte) - 1u));
for (var w = 0u; w < word; w++) {
rank += countOneBits(sort_equal(atomicLoad(&sort_bytes[w]), digit));
}
let to = sort_sums[digit] + rank;
keys_out[to] = key;
values_out[to] = values_in[i];
}
workgroupBarrier();
next += atomicLoad(&sort_digits[thread]);
}
}
fn sort_equal(bytes: u32, digit: u32) -> u32 {
let other = bytes ^ (digit * 0x01010101u);
return ~(((other & 0x7f7f7f7fu) + 0x7f7f7f7fu) | other | 0x7f7f7f7fu);
}
`;

export const CULL = `
struct Frame {
view: View,
background: vec3<f32>,
channel: u32,
depth_range: vec2<f32>,
flow_scale: f32,
pad: u32,
}
const CHANNEL_COLOR: u32 = 0u;
const CHANNEL_DEPTH: u32 = 1u;
const CHANNEL_ALPHA: u32 = 2u;
const CHANNEL_FLOW: u32 = 3u;
struct Record {
center: vec2<f32>,
major: vec2<f32>,
minor: f32,
depth: f32,
color: vec2<u32>,
}
struct Range {
near: atomic<u32>,
far: atomic<u32>,
}
@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> words: array<vec4<u32>>;
@group(0) @binding(2) var<storage, read> blocks: array<BlockHeader>;
@group(0) @binding(3) var<storage, read> block_list: array<u32>;
@group(0) @binding(4) var<storage, read> palette: array<u32>;
@group(0) @binding(5) var<storage, read_write> records: array<Record>;
@group(0) @binding(6) var<storage, read_write> masks: array<atomic<u32>>;
@group(0) @binding(7) var<storage, read_write> range: Range;
@group(0) @binding(8) var<storage, read_write> arguments: array<u32>;
@group(0) @binding(9) var<storage, read_write> keys: array<u32>;
@group(0) @binding(10) var<storage, read_write> places: array<u32>;
@group(0) @binding(11) var<storage, read_write> firsts: array<u32>;
@group(0) @binding(16) var<storage, read> admitted: array<u32>;
const BLOCK: u32 = 256u;
const SIGMAS: f32 = 3.34;
const LIFE_REACHES: f32 = 1.12;
const KEY_MAX: f32 = 65535.0;
const CORNERS: u32 = 6u;
const MASKS: u32 = 8u;
const PAIRS: u32 = 2048u;
const SCAN_GROUPS: u32 = 256u;
const FEW_PAIRS: u32 = 65536u;
var<workgroup> group_sums: array<u32, 256>;
fn block_hidden(header: array<vec4<f32>, 6>, span: f32) -> bool {
let t = frame.view.time;
if (t < header[2].x || t > header[2].y) {
return true;
}
let late = max(abs(t - header[1].z), abs(t - header[1].w));
let stray = header[3].x * max(LIFE_REACHES, 2.0 * late / max(span, LEAST_SECONDS));
let low = header[0].xyz;
let high = vec3<f32>(header[0].w, header[1].xy);
let half_size = 0.5 * (high - low) + stray;
let m = frame.view.camera_from_world;
let p = (m * vec4<f32>(0.5 * (low + high), 1.0)).xyz;
let reach = abs(m[0].xyz) * half_size.x + abs(m[1].xyz) * half_size.y + abs(m[2].xyz) * half_size.z;
if (p.z + reach.z <= frame.view.near) {
return true;
}
let size = frame.view.size;
let focal = frame.view.focal;
let edge_low = frame.view.center;
let edge_high = size - frame.view.center;
let tangent = max(edge_low, edge_high) / focal + PROJECT_J_MARGIN * 0.5 * size / focal;
let wide = SIGMAS * exp(header[2].w) * focal * sqrt(1.0 + tangent * tangent);
let blur = SIGMAS * sqrt(frame.view.low_pass) + 1.0;
for (var k = 0u; k < 2u; k++) {
let beyond_high = focal[k] * p[k] - (edge_high[k] + blur) * p.z;
let beyond_low = -focal[k] * p[k] - (edge_low[k] + blur) * p.z;
let spread = focal[k] * reach[k] + (max(abs(edge_high[k]), abs(edge_low[k])) + blur) * reach.z;
if (max(beyond_high, beyond_low) > spread + wide[k]) {
return true;
}
}
return false;
}
fn flow_color(velocity: vec2<f32>) -> vec3<f32> {
let turn = atan2(velocity.y, velocity.x) * 0.15915494309189535;
let hue = fract(vec3<f32>(turn) + vec3<f32>(1.0, 2.0 / 3.0, 1.0 / 3.0)) * 6.0;
let value = min(length(velocity) / max(frame.flow_scale, 1e-6), 1.0);
return value * clamp(abs(hue - 3.0) - 1.0, vec3<f32>(0.0), vec3<f32>(1.0));
}
fn flow(mean: vec3<f32>, velocity: vec3<f32>) -> vec2<f32> {
let p = (frame.view.camera_from_world * vec4<f32>(mean, 1.0)).xyz;
let v = (frame.view.camera_from_world * vec4<f32>(velocity, 0.0)).xyz;
return frame.view.focal * (v.xy - p.xy / p.z * v.z) / p.z;
}
fn sight_color(base: vec3<f32>, mean: vec3<f32>, label: u32, block: u32) -> vec3<f32> {
let degree = min(blocks[block].degree, frame.view.sh_degree);
var rgb = base;
if (degree > 0u) {
let y = sh_basis(normalize(mean - frame.view.camera));
let held = (blocks[block].degree + 1u) * (blocks[block].degree + 1u) - 1u;
let first = blocks[block].palette + min(label, blocks[block].entries - 1u) * held;
var k = 1u;
for (var l = 1u; l <= degree; l++) {
var sum = vec3<f32>(0.0);
for (; k < (l + 1u) * (l + 1u); k++) {
sum += y[k] * (codes_8(palette[first + k - 1u]) - 128.0);
}
rgb += sum * blocks[block].sh_range[l - 1u] / 127.0;
}
}
return max(rgb, vec3<f32>(0.0));
}
fn set_axes(record: ptr<function, Record>, ellipse: Ellipse) {
let xx = ellipse.cov2d.x;
let xy = ellipse.cov2d.y;
let yy = ellipse.cov2d.z;
let half_gap = 0.5 * (xx - yy);
let root = sqrt(half_gap * half_gap + xy * xy);
let largest = 0.5 * (xx + yy) + root;
let along = select(vec2<f32>(xy, root - half_gap), vec2<f32>(root + half_gap, xy), half_gap >= 0.0);
let norm = length(along);
let axis = select(vec2<f32>(1.0, 0.0), along / max(norm, 1e-30), norm > 1e-12 * largest);
(*record).major = axis * sqrt(largest);
(*record).minor = sqrt(yy / ellipse.conic.x / largest);
}
@compute @workgroup_size(256)
fn cull(
@builtin(workgroup_id) group: vec3<u32>,
@builtin(num_workgroups) groups: vec3<u32>,
@builtin(local_invocation_index) thread: u32,
) {
let slot = group.x + group.y * groups.x;
if (slot >= frame.view.count) {
return;
}
let block = block_list[slot];
let header = blocks[block].f;
let span = blocks[block].span;
if (thread >= blocks[block].count || block_hidden(header, span)) {
return;
}
if (((admitted[block * MASKS + thread / 32u] >> (thread % 32u)) & 1u) == 0u) {
return;
}
let i = 2u * (block * BLOCK + thread);
let a = words[i];
let b = words[i + 1u];
let w = array<u32, 8>(a.x, a.y, a.z, a.w, b.x, b.y, b.z, b.w);
let life = life_at(w, header, span, frame.view.time);
if (!(opacity_at(w, life) >= frame.view.alpha_min)) {
return;
}
let g = gaussian(w, header, life);
let ellipse = project(frame.view, g.mean, covariance(g.quat, g.scale), g.opacity);
if (ellipse.visible == 0u) {
return;
}
var record: Record;
record.center = ellipse.center;
record.depth = ellipse.depth;
set_axes(&record, ellipse);
var rgb = vec3<f32>(0.0);
if (frame.channel == CHANNEL_COLOR) {
rgb = sight_color(g.base, g.mean, g.label, block);
} else if (frame.channel == CHANNEL_FLOW) {
rgb = flow_color(flow(g.mean, g.velocity));
}
let opacity = pack2x16unorm(vec2<f32>(0.0, g.opacity * ellipse.rho));
record.color = vec2<u32>(pack2x16float(rgb.xy), pack2x16float(vec2<f32>(rgb.z, 0.0)) | opacity);
records[slot * BLOCK + thread] = record;
atomicOr(&masks[slot * MASKS + thread / 32u], 1u << (thread % 32u));
let depth = bitcast<u32>(record.depth);
if (depth < atomicLoad(&range.near)) {
atomicMin(&range.near, depth);
}
if (depth > atomicLoad(&range.far)) {
atomicMax(&range.far, depth);
}
}
fn records_of(slot: u32) -> u32 {
var sum = 0u;
for (var w = 0u; w < MASKS; w++) {
sum += countOneBits(atomicLoad(&masks[slot * MASKS + w]));
}
return sum;
}
@compute @workgroup_size(256)
fn total(@builtin(local_invocation_index) thread: u32) {
let n = frame.view.count;
let run = (n + BLOCK - 1u) / BLOCK;
let first = min(thread * run, n);
let end = min(first + run, n);
var sum = 0u;
for (var i = first; i < end; i++) {
sum += records_of(i);
}
group_sums[thread] = sum;
workgroupBarrier();
for (var step = 1u; step < BLOCK; step *= 2u) {
var below = 0u;
if (thread >= step) {
below = group_sums[thread - step];
}
workgroupBarrier();
group_sums[thread] += below;
workgroupBarrier();
}
var before = group_sums[thread] - sum;
for (var i = first; i < end; i++) {
firsts[i] = before;
before += records_of(i);
}
if (thread == BLOCK - 1u) {
let all = group_sums[thread];
arguments[0] = (all + PAIRS - 1u) / PAIRS;
arguments[1] = 1u;
arguments[2] = 1u;
arguments[3] = all;
arguments[4] = CORNERS * all;
arguments[5] = 1u;
arguments[6] = 0u;
arguments[7] = 0u;
arguments[8] = select(SCAN_GROUPS, 1u, all <= FEW_PAIRS);
arguments[9] = 1u;
arguments[10] = 1u;
}
}
@compute @workgroup_size(256)
fn keys_of_depths(
@builtin(workgroup_id) group: vec3<u32>,
@builtin(num_workgroups) groups: vec3<u32>,
@builtin(local_invocation_index) thread: u32,
) {
let slot = group.x + group.y * groups.x;
if (slot >= frame.view.count) {
return;
}
let word = thread / 32u;
let bit = 1u << (thread % 32u);
let mask = atomicLoad(&masks[slot * MASKS + word]);
if ((mask & bit) == 0u) {
return;
}
var to = firsts[slot] + countOneBits(mask & (bit - 1u));
for (var w = 0u; w < word; w++) {
to += countOneBits(atomicLoad(&masks[slot * MASKS + w]));
}
let place = slot * BLOCK + thread;
let near = atomicLoad(&range.near);
let width = max(f32(atomicLoad(&range.far) - near), 1.0);
let above = f32(bitcast<u32>(records[place].depth) - near);
keys[to] = u32(min(above / width, 1.0) * KEY_MAX);
places[to] = place;
}
`;

export const DRAW = `
@group(0) @binding(12) var<storage, read> drawn: array<Record>;
@group(0) @binding(13) var<storage, read> order: array<u32>;
@group(0) @binding(14) var<storage, read> drawn_count: array<u32>;
@group(0) @binding(15) var picture: texture_2d<f32>;
const ALPHA_MAX: f32 = 0.99;
const CORNER_BITS: u32 = 0xda4u;
const COUNT: u32 = 3u;
struct Corner {
@builtin(position) position: vec4<f32>,
@location(0) @interpolate(flat) center: vec2<f32>,
@location(1) @interpolate(flat) axes: vec4<f32>,
@location(2) @interpolate(flat) color: vec4<f32>,
}
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
@vertex
fn cover(@builtin(vertex_index) k: u32) -> @builtin(position) vec4<f32> {
return vec4<f32>(f32((k << 1u) & 2u) * 2.0 - 1.0, f32(k & 2u) * 2.0 - 1.0, 0.0, 1.0);
}
@fragment
fn resolve(@builtin(position) at: vec4<f32>) -> @location(0) vec4<f32> {
let c = textureLoad(picture, vec2<i32>(at.xy), 0);
switch (frame.channel) {
case CHANNEL_DEPTH: {
let share = c.r / max(c.a, 1e-6);
return vec4<f32>(vec3<f32>(select(0.0, clamp(1.0 - share, 0.0, 1.0), c.a >= 0.5)), 1.0);
}
case CHANNEL_ALPHA: { return vec4<f32>(vec3<f32>(c.a), 1.0); }
default: { return vec4<f32>(c.rgb + frame.background * (1.0 - c.a), 1.0); }
}
}
`;
