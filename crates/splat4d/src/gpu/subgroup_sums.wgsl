// What both ways back through a tile with subgroups share: what lies in workgroup memory, how it is filled and records
// are written, and sums over subgroups of 8 to 64 threads, a power of two, in an order that the size of subgroups alone
// decides. render/project.wgsl and blend_back.wgsl are put in front of this file, rasterize_back_subgroup.wgsl or
// rasterize_back_vector.wgsl behind it. 7 KiB of workgroup memory.
//
// A workgroup owns a tile and goes front to back; a thread owns four pixels of a column, so that what depends on dx
// alone is multiplied once. Sums go through butterflies in which a thread keeps half of its numbers at each of the
// first exchanges and gives away the other half; what subgroups have then is added in their order.

const THREADS: u32 = 64u;
const PIXELS: u32 = 4u;
// Splats between two barriers, at most one per thread, and subgroups at most, of 8 threads each. The form with vectors
// has others where no subgroup is so small (gpu/kernels.rs).
const SPLATS: u32 = 16u;
const MOST_SUBGROUPS: u32 = 8u;

var<workgroup> parts: array<f32, MOST_SUBGROUPS * SPLATS * NUMBERS>;
var<workgroup> centers: array<vec2<f32>, SPLATS>;
var<workgroup> powers: array<vec4<f32>, SPLATS>;
var<workgroup> lights: array<vec4<f32>, SPLATS>;
var<workgroup> conics: array<vec4<f32>, SPLATS>;
var<workgroup> quadrants: array<u32, SPLATS>;
var<workgroup> pairs: array<u32, SPLATS>;

// The sum over a subgroup.
fn whole(x: f32, size: u32) -> f32 {
    var sum = x;
    for (var step = 1u; step < size; step *= 2u) {
        sum += subgroupShuffleXor(sum, step);
    }
    return sum;
}

// The sum over a subgroup of one of four numbers: of number quarter_of(lane).
fn share_of_four(four: vec4<f32>, lane: u32, size: u32) -> f32 {
    let first = (lane & 1u) != 0u;
    let two = select(four.xy, four.zw, first) + subgroupShuffleXor(select(four.zw, four.xy, first), 1u);
    let second = (lane & 2u) != 0u;
    var one = select(two.x, two.y, second) + subgroupShuffleXor(select(two.y, two.x, second), 2u);
    for (var step = 4u; step < size; step *= 2u) {
        one += subgroupShuffleXor(one, step);
    }
    return one;
}

fn quarter_of(lane: u32) -> u32 {
    return 2u * (lane & 1u) + ((lane >> 1u) & 1u);
}

// The same of one of eight: of number eighth_of(lane).
fn share_of_eight(low: vec4<f32>, high: vec4<f32>, lane: u32, size: u32) -> f32 {
    let first = (lane & 1u) != 0u;
    let four = select(low, high, first) + subgroupShuffleXor(select(high, low, first), 1u);
    let second = (lane & 2u) != 0u;
    let two = select(four.xy, four.zw, second) + subgroupShuffleXor(select(four.zw, four.xy, second), 2u);
    let third = (lane & 4u) != 0u;
    var one = select(two.x, two.y, third) + subgroupShuffleXor(select(two.y, two.x, third), 4u);
    for (var step = 8u; step < size; step *= 2u) {
        one += subgroupShuffleXor(one, step);
    }
    return one;
}

fn eighth_of(lane: u32) -> u32 {
    return 4u * (lane & 1u) + (lane & 2u) + ((lane >> 2u) & 1u);
}

// Number n of splat i: what all subgroups have of it.
fn total(i: u32, n: u32, subgroups: u32) -> f32 {
    var sum = 0.0;
    for (var s = 0u; s < subgroups; s++) {
        sum += parts[(s * SPLATS + i) * NUMBERS + n];
    }
    return sum;
}

// Reads the splats from `start` on into workgroup memory, one per thread.
fn read_splats(start: u32, end: u32, thread: u32) {
    if (thread < SPLATS && start + thread < end) {
        let pair = values[start + thread];
        let owner = owners[pair];
        let splat = owner & OWNER_SPLAT;
        let conic = shapes[2u * splat + 1u];
        pairs[thread] = pair;
        quadrants[thread] = owner >> OWNER_SHIFT;
        centers[thread] = shapes[2u * splat].xy;
        conics[thread] = conic;
        powers[thread] = vec4<f32>(-LOG2_E * vec3<f32>(0.5, 1.0, 0.5) * conic.xyz, log2(conic.w));
        lights[thread] = colors[splat];
    }
}

// Writes the records of the splats that were read.
fn write_records(count: u32, thread: u32, subgroups: u32) {
    for (var n = thread; n < count * NUMBERS; n += THREADS) {
        records[pairs[n / NUMBERS] * NUMBERS + n % NUMBERS] = total(n / NUMBERS, n % NUMBERS, subgroups);
    }
}
