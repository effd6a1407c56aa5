//! Stage by stage.

use super::*;
use crate::gpu::kernels::Kernel;
use crate::render::project::{Projection, View};
use crate::render::{project, shade};

/// Relative difference of a depth, a colour, an extent or an opacity: a few roundings of f32.
const RELATIVE: f32 = 2e-5;
/// Difference of centres, pixels: the last place of a coordinate of some hundred pixels, a few times.
const PIXELS: f32 = 2e-3;
/// Relative difference of conics and extents: determinants of thin ellipses cancel.
const CONIC: f32 = 2e-3;
/// How far from the cut-off ellipse a tile may be counted or left out, in units of τ.
const TAU: f64 = 5e-3;

fn close(a: f32, b: f32, relative: f32, absolute: f32) -> bool {
    (a - b).abs() <= absolute + relative * a.abs().max(b.abs())
}

/// Renders, so that every buffer holds what its stage wrote.
fn drawn(r: &mut GpuRenderer, shot: &Shot<'_>) {
    r.render(shot, &mut Image::default()).expect("a small scene is drawn");
}

#[test]
fn projection_equals_the_cpus() {
    let Some(mut r) = renderer() else { return };
    let scene = Scenery::new(1, 3000, 2.0, 0.05);
    for (camera, antialias) in [
        (camera([0.0, 0.5, -4.0], 131, 77), Antialias::Off),
        (skewed(200, 120), Antialias::On),
        (camera([0.3, 0.0, 0.2], 64, 64), Antialias::Off),
    ] {
        r.config.antialias = antialias;
        drawn(&mut r, &shot(&scene.splats(), &camera));
        let n = scene.out.rows();
        let shapes: Vec<[f32; 8]> = read(&r.gpu, &r.buffers.shapes, n);
        let colors: Vec<[f32; 4]> = read(&r.gpu, &r.buffers.colors, n);
        let marks: Vec<u32> = read(&r.gpu, &r.buffers.marks, n);
        let view = View::new(&camera, &r.config);
        let (mut seen, mut doubtful) = (0, 0);
        for j in 0..n {
            let p = project::project(&view, scene.out.read(j, 0), scene.out.read(j, 3), scene.out.get(j, 9));
            let inside = p.is_some_and(|p| {
                let meets = |k: usize, size: usize| {
                    let (low, high) = (p.mean2d[k] - p.half[k] - 0.5, p.mean2d[k] + p.half[k] - 0.5);
                    low.ceil().max(0.0) <= high.floor().min(size as f32 - 1.0)
                };
                meets(0, camera.width) && meets(1, camera.height)
            });
            if inside != (marks[j] == 1) {
                doubtful += 1;
                continue;
            }
            let (Some(p), true) = (p, inside) else { continue };
            seen += 1;
            let [x, y, half_x, half_y, a, b, c, opacity] = shapes[j];
            assert!(close(x, p.mean2d[0], RELATIVE, PIXELS) && close(y, p.mean2d[1], RELATIVE, PIXELS), "centre {j}");
            assert!(close(half_x, p.half[0], CONIC, PIXELS) && close(half_y, p.half[1], CONIC, PIXELS), "extent {j}");
            let scale = (p.conic[0] * p.conic[2]).sqrt();
            for (v, w) in [a, b, c].into_iter().zip(p.conic) {
                assert!(close(v, w, CONIC, CONIC * scale), "conic {j}: {v} {w}");
            }
            assert!(close(opacity, p.opacity, CONIC, 0.0), "opacity {j}: {opacity} {}", p.opacity);
            assert!(close(colors[j][3], p.depth, RELATIVE, RELATIVE), "depth {j}");
        }
        assert!(seen > n / 20, "the test must see something: {seen}");
        // Only a splat on the very edge of the image or of the α cut-off may be judged otherwise.
        assert!(doubtful <= 2, "{doubtful} splats are visible on one side only");
    }
}

#[test]
fn colours_equal_the_cpus() {
    let Some(mut r) = renderer() else { return };
    let (scene, camera) = (Scenery::new(2, 1000, 1.0, 0.05), camera([0.0, 0.5, -4.0], 131, 77));
    for degree in 0..=3 {
        let splats = scene.splats();
        let shot = Shot { sh_degree: degree, ..shot(&splats, &camera) };
        drawn(&mut r, &shot);
        let n = scene.out.rows();
        let colors: Vec<[f32; 4]> = read(&r.gpu, &r.buffers.colors, n);
        let (cpu, _) = on_cpu(&shot, &r.config);
        let mut expected = vec![[0.0; 3]; n];
        let view = View::new(&camera, &r.config);
        let simd = r.config.simd;
        let projection = Projection { splats: &splats, view: &view, simd, projected: cpu.projected() };
        shade::forward(&projection, degree, &mut expected);
        let marks: Vec<u32> = read(&r.gpu, &r.buffers.marks, n);
        let both = (0..n).filter(|&j| marks[j] == 1 && cpu.projected()[j].radius > 0.0);
        let mut seen = 0;
        for j in both {
            seen += 1;
            let [r, g, b] = expected[j];
            for (c, value) in [r, g, b, cpu.projected()[j].depth].into_iter().enumerate() {
                assert!(close(colors[j][c], value, RELATIVE, RELATIVE), "degree {degree}, splat {j}, {c}");
            }
        }
        assert!(seen > n / 2);
    }
}

/// Pairs sorted by the low `passes` bytes of their keys on the GPU.
fn sorted(gpu: &Gpu, kernel: &Kernel, keys: &[u32], values: &[u32], passes: u32) -> (Vec<u32>, Vec<u32>) {
    let n = keys.len();
    let keys = [storage(gpu, keys), storage(gpu, keys)];
    let values = [storage(gpu, values), storage(gpu, values)];
    let counts = storage(gpu, &[7, n as u32, 9]);
    // Not cleared, on purpose: the kernels must not rely on it.
    let sums = storage(gpu, &vec![0xdead_beefu32; DIGITS * (n.div_ceil(block()) + 1)]);
    for pass in 0..passes {
        let mut uniform = Grown::new("pass", wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST);
        uniform.ensure(gpu, 8).expect("a small buffer");
        gpu.queue.write_buffer(uniform.get(), 0, bytemuck::cast_slice(&[8 * pass, 1]));
        let (from, to) = (pass as usize % 2, 1 - pass as usize % 2);
        let resources = [&uniform, &counts, &keys[from], &values[from], &keys[to], &values[to], &sums].map(Grown::all);
        let group = kernel.bind(gpu, &resources);
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        {
            let mut cp = encoder.begin_compute_pass(&Default::default());
            cp.set_bind_group(0, &group, &[]);
            // More workgroups than blocks: the spare ones do nothing.
            let blocks = n.div_ceil(block()) as u32 + 1;
            for (pipeline, groups) in kernel.pipelines.iter().zip([blocks, DIGITS as u32, blocks]) {
                cp.set_pipeline(pipeline);
                cp.dispatch_workgroups(groups, 1, 1);
            }
        }
        gpu.queue.submit([encoder.finish()]);
    }
    let last = passes as usize % 2;
    gpu.wait().expect("the sort runs");
    (read(gpu, &keys[last], n), read(gpu, &values[last], n))
}

/// The sort with emulated subgroups of this many threads on any device: votes use the workgroup's memory.
fn as_if_subgroups_had(size: u32) -> String {
    let stand_in = "
        var<private> stand_in_thread: u32;
        var<workgroup> stand_in_votes: array<atomic<u32>, 64>;
        fn stand_in_ballot(vote: bool) -> vec4<u32> {
            let first = 2u * (stand_in_thread / SIZE);
            let lane = stand_in_thread % SIZE;
            workgroupBarrier();
            if (stand_in_thread < 64u) {
                atomicStore(&stand_in_votes[stand_in_thread], 0u);
            }
            workgroupBarrier();
            if (vote) {
                atomicOr(&stand_in_votes[first + lane / 32u], 1u << (lane % 32u));
            }
            workgroupBarrier();
            return vec4<u32>(atomicLoad(&stand_in_votes[first]), atomicLoad(&stand_in_votes[first + 1u]), 0u, 0u);
        }
";
    let parameters = [
        "    @builtin(subgroup_id) subgroup: u32,\n",
        "    @builtin(subgroup_size) size: u32,\n",
        "    @builtin(subgroup_invocation_id) lane: u32,\n",
    ];
    let mut text = crate::wgsl::SORT_SUBGROUP.replace("subgroupBallot(", "stand_in_ballot(");
    for parameter in parameters {
        assert!(text.contains(parameter));
        text = text.replace(parameter, "");
    }
    let begin = "    let pairs = sort_pairs();\n";
    assert!(text.contains(begin));
    let own = format!(
        "    stand_in_thread = index;\n    let size = {size}u;\n    let subgroup = index / size;\n    let lane = index % size;\n{begin}"
    );
    stand_in.replace("SIZE", &format!("{size}u")) + &text.replace(begin, &own)
}

#[test]
fn every_sort_is_the_stable_one() {
    let Some(gpu) = gpu() else { return };
    the_sort_is_the_stable_one(&gpu, &Kernels::sort(&gpu, false), "portable");
    if gpu.has_subgroups() {
        the_sort_is_the_stable_one(&gpu, &Kernels::sort(&gpu, true), "with subgroups");
    }
    for size in [8, 16, 32, 64] {
        let text = as_if_subgroups_had(size);
        let kernel = Kernels::sort_of(&gpu, &[crate::wgsl::SORT, &text], "scatter_subgroup");
        the_sort_is_the_stable_one(&gpu, &kernel, &format!("as if subgroups had {size} threads"));
    }
}

fn the_sort_is_the_stable_one(gpu: &Gpu, kernel: &Kernel, what: &str) {
    let rng = Rng::new(3, "sort", 0);
    for (n, mask) in [
        (0, u32::MAX),
        (1, u32::MAX),
        (2, 0),
        (255, 3),
        (257, u32::MAX),
        (2048, 0xff),
        (2049, 0x00ff_ff00),
        (5000, 0),
        (70_001, 0x3f),
        (100_000, u32::MAX),
    ] {
        let keys: Vec<u32> = (0..n as u64).map(|i| (rng.uniform(i) * 4_294_967_296.0) as u32 & mask).collect();
        // Values that are not in order, so that sorting by them would be seen.
        let values: Vec<u32> = (0..n as u32).map(|i| i ^ 0x5555).collect();
        let mut expected: Vec<(u32, u32)> = keys.iter().copied().zip(values.iter().copied()).collect();
        expected.sort_by_key(|p| p.0);
        let (keys, values) = sorted(gpu, kernel, &keys, &values, 4);
        let got: Vec<(u32, u32)> = keys.into_iter().zip(values).collect();
        assert!(got == expected, "{what}: {n} pairs, mask {mask:x}: the order is not that of a stable sort");
    }
    // One pass sorts by its eight bits alone.
    let keys: Vec<u32> = (0..5000u32).map(|i| i.wrapping_mul(2_654_435_761)).collect();
    let values: Vec<u32> = (0..5000).collect();
    let mut expected = values.clone();
    expected.sort_by_key(|&i| keys[i as usize] & 0xff);
    assert_eq!(sorted(gpu, kernel, &keys, &values, 1).1, expected, "{what}");
}

#[test]
fn sums_are_exclusive_and_stop_at_the_top() {
    let Some(gpu) = gpu() else { return };
    let kernels = Kernels::new(&gpu);
    let rng = Rng::new(4, "scan", 0);
    for (n, top) in [(0, 3.0), (1, 3.0), (2047, 3.0), (2049, 100.0), (70_001, 5.0), (300_001, 1.0), (5000, 4e6)] {
        let input: Vec<u32> = (0..n as u64).map(|i| (rng.uniform(i) * (top + 1.0)) as u32).collect();
        let counts = storage(&gpu, &[n as u32, 0, 0, 0, 0]);
        let arguments = storage(&gpu, &[0u32; 12]);
        let (scan_in, out) = (storage(&gpu, &input), storage(&gpu, &vec![0u32; n]));
        let sums = storage(&gpu, &vec![0u32; n.div_ceil(block())]);
        let mut uniform = Grown::new("pass", wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST);
        uniform.ensure(&gpu, 32).expect("a small buffer");
        // Of the second view of a step.
        gpu.queue.write_buffer(uniform.get(), 0, bytemuck::cast_slice(&[0u32, 2, 6, 1_000_000, 2, 0, 0, 0]));
        let resources = [&uniform, &counts, &scan_in, &out, &sums, &arguments].map(Grown::all);
        let group = kernels.scan.bind(&gpu, &resources);
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        {
            let mut cp = encoder.begin_compute_pass(&Default::default());
            cp.set_bind_group(0, &group, &[]);
            let blocks = n.div_ceil(block()) as u32;
            for (pipeline, groups) in kernels.scan.pipelines.iter().zip([blocks, 1, blocks]) {
                cp.set_pipeline(pipeline);
                cp.dispatch_workgroups(groups, 1, 1);
            }
        }
        gpu.queue.submit([encoder.finish()]);
        let mut sum = 0u32;
        let mut expected = Vec::new();
        for v in &input {
            expected.push(sum);
            sum = sum.saturating_add(*v);
        }
        assert!(read::<u32>(&gpu, &out, n) == expected, "{n} sums");
        let (stop, things) = if sum > 1_000_000 { ([2, sum], 0) } else { ([0, 0], sum) };
        assert_eq!(read::<u32>(&gpu, &counts, 5), [n as u32, 0, sum, stop[0], stop[1]], "{n}: the total");
        let written = [things.div_ceil(256), 1, 1, things.div_ceil(2048), 1, 1];
        assert_eq!(read::<u32>(&gpu, &arguments, 12)[6..], written, "{n}: sizes of dispatches");
    }
}

/// `count` and `emit` may disagree by a rounding: here every splat claims one tile more than `emit` finds.
#[test]
fn a_pair_without_a_tile_is_in_no_list() {
    let Some(mut r) = renderer() else { return };
    let (scene, camera) = (Scenery::new(7, 300, 1.2, 0.1), camera([0.0, 0.5, -4.0], 131, 77));
    drawn(&mut r, &shot(&scene.splats(), &camera));
    let (across, down) = (camera.width.div_ceil(TILE), camera.height.div_ceil(TILE));
    let [_, visible, pairs] = read::<u32>(&r.gpu, &r.buffers.counts, 3)[..] else { panic!("three counts") };
    let true_counts: Vec<u32> = read(&r.gpu, &r.buffers.tile_counts, visible as usize);
    let firsts: Vec<u32> = true_counts.iter().scan(0, |sum, n| Some(std::mem::replace(sum, *sum + n + 1))).collect();
    let all = (pairs + visible) as usize;
    assert!(all <= r.pair_capacity());
    let put = |buffer: &Grown, data: &[u32]| r.gpu.queue.write_buffer(buffer.get(), 0, bytemuck::cast_slice(data));
    put(&r.buffers.first_pairs, &firsts);
    put(&r.buffers.counts, &[300, visible, all as u32]);
    // What an earlier frame left there names a tile.
    put(&r.buffers.pair_keys[0], &vec![3; all]);
    let group = [
        frame::uniform(&r.buffers, slot::VIEW, 128),
        frame::uniform(&r.buffers, slot::BAND, 16),
        r.buffers.counts.all(),
        r.buffers.depth_values[0].all(),
        r.buffers.shapes.all(),
        r.buffers.tile_counts.all(),
        r.buffers.first_pairs.all(),
        r.buffers.pair_keys[0].all(),
        r.buffers.pair_values[0].all(),
        r.buffers.owners.all(),
    ];
    let group = r.kernels.tiles.bind(&r.gpu, &group);
    let mut encoder = r.gpu.device.create_command_encoder(&Default::default());
    {
        let mut pass = encoder.begin_compute_pass(&Default::default());
        pass.set_bind_group(0, &group, &[]);
        pass.set_pipeline(&r.kernels.tiles.pipelines[1]);
        pass.dispatch_workgroups(visible.div_ceil(THREADS as u32), 1, 1);
    }
    r.gpu.queue.submit([encoder.finish()]);
    r.gpu.wait().expect("it runs");
    let keys: Vec<u32> = read(&r.gpu, &r.buffers.pair_keys[0], all);
    for (first, n) in firsts.iter().zip(&true_counts) {
        let own = &keys[*first as usize..=(first + n) as usize];
        let (last, tiles) = own.split_last().expect("there is one more");
        assert!(*last == (across * down) as u32, "a slot without a tile holds {last}");
        assert!(tiles.iter().all(|t| *t < (across * down) as u32));
    }
}

#[test]
fn the_roofline_is_measured_and_pairs_are_counted() {
    let Some(mut r) = renderer() else { return };
    let roofline = r.roofline().expect("it is measured");
    assert!(roofline.pairs > 1e6 && roofline.pairs.is_finite() && roofline.bytes > 1e7 && roofline.bytes.is_finite());
    let (scene, camera) = (Scenery::new(8, 300, 1.2, 0.1), camera([0.0, 0.5, -4.0], 131, 77));
    drawn(&mut r, &shot(&scene.splats(), &camera));
    let (count, pairs) = (r.evaluations().expect("they are read"), r.stats().pairs as u64);
    assert!(count > 64 * pairs && count < 256 * pairs, "{count} evaluations of {pairs} pairs");
}

/// Least dᵀ conic d over the pixel centres of a square of `side`, in f64.
fn least_distance(shape: &[f32; 8], tile: [usize; 2], side: usize, size: [usize; 2]) -> f64 {
    let mut least = f64::INFINITY;
    let [a, b, c] = [4, 5, 6].map(|k| f64::from(shape[k]));
    for y in tile[1] * side..((tile[1] + 1) * side).min(size[1]) {
        for x in tile[0] * side..((tile[0] + 1) * side).min(size[0]) {
            let (dx, dy) = (x as f64 + 0.5 - f64::from(shape[0]), y as f64 + 0.5 - f64::from(shape[1]));
            least = least.min(a * dx * dx + 2.0 * b * dx * dy + c * dy * dy);
        }
    }
    least
}

#[test]
fn lists_of_tiles_are_complete_and_in_the_cpus_order() {
    let Some(mut r) = renderer() else { return };
    // The last has rows twice over: equal depths are distinguished by the splats' numbers.
    let mut twins = Scenery::new(6, 400, 1.0, 0.1);
    for j in 200..400 {
        let mean: [f32; 3] = twins.out.read(j - 200, 0);
        twins.out.write(j, 0, mean);
    }
    for (scene, camera) in [
        (Scenery::new(5, 600, 1.5, 0.05), camera([0.0, 0.5, -4.0], 131, 77)),
        (Scenery::new(6, 200, 1.0, 0.4), skewed(331, 90)),
        (twins, skewed(97, 145)),
    ] {
        drawn(&mut r, &shot(&scene.splats(), &camera));
        let n = scene.out.rows();
        let (across, down) = (camera.width.div_ceil(TILE), camera.height.div_ceil(TILE));
        let shapes: Vec<[f32; 8]> = read(&r.gpu, &r.buffers.shapes, n);
        let colors: Vec<[f32; 4]> = read(&r.gpu, &r.buffers.colors, n);
        let marks: Vec<u32> = read(&r.gpu, &r.buffers.marks, n);
        let ranges: Vec<[u32; 3]> = read(&r.gpu, &r.buffers.ranges, across * down);
        let last = frame::tile_passes(across * down) % 2;
        let values: Vec<u32> = read(&r.gpu, &r.buffers.pair_values[last], r.stats().pairs);
        let owners: Vec<u32> = read(&r.gpu, &r.buffers.owners, r.stats().pairs);
        assert_eq!(
            ranges.iter().map(|[a, b, _]| (b - a) as usize).sum::<usize>(),
            values.len(),
            "every pair has a tile"
        );
        let (mut spare, mut spared, mut kept) = (0, 0, 0);
        for (tile, [first, end, used]) in ranges.iter().enumerate() {
            assert!(used <= end && (used >= first || first == end), "tile {tile}: {first} {used} {end}");
            let own: Vec<u32> =
                values[*first as usize..*end as usize].iter().map(|&pair| owners[pair as usize]).collect();
            let list: Vec<u32> = own.iter().map(|owner| owner & 0x0fff_ffff).collect();
            let key = |&s: &u32| (colors[s as usize][3].to_bits(), s);
            assert!(list.windows(2).all(|p| key(&p[0]) < key(&p[1])), "tile {tile} is not in order");
            let place = [tile % across, tile / across];
            for j in 0..n {
                let (listed, visible) = (list.contains(&(j as u32)), marks[j] == 1);
                assert!(visible || !listed, "splat {j} is not visible, but listed");
                if !visible {
                    continue;
                }
                let tau = 2.0 * (f64::from(shapes[j][7]) / r.config.alpha_min).ln();
                let distance = least_distance(&shapes[j], place, TILE, [camera.width, camera.height]);
                if let Some(k) = list.iter().position(|&s| s == j as u32) {
                    for quadrant in 0..4 {
                        let place = [2 * place[0] + quadrant % 2, 2 * place[1] + quadrant / 2];
                        let distance = least_distance(&shapes[j], place, TILE / 2, [camera.width, camera.height]);
                        let meant = own[k] >> (28 + quadrant) & 1 == 1;
                        assert!(meant || distance > tau, "tile {tile}, splat {j}: quadrant {quadrant} is left out");
                        (spared, kept) = (spared + usize::from(!meant), kept + usize::from(meant));
                    }
                }
                assert!(listed || distance > tau, "tile {tile} lacks splat {j}: {distance} of {tau}");
                // The span of a row of tiles is exact for lines; pixel centres are fewer, so a little is spare.
                spare += usize::from(listed && distance > tau + TAU * tau.max(1.0));
            }
        }
        assert!(spare * 5 < values.len(), "{spare} of {} pairs touch no pixel", values.len());
        println!("{spared} of {} quadrants are left out", spared + kept);
        assert!(spared > 0 && kept > values.len() / 2, "{spared} quadrants are left out, {kept} are not");
    }
}
