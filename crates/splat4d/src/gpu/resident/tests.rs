//! The kernels of Gaussians of space and time against the motion model, in f64, at the edges of what numbers can stand too.

use super::*;
use crate::gpu::tests::{camera, read, renderer};
use crate::math::{Real, Rng};
use crate::motion::native4d::{Native4dSpec, TABLE};
use crate::motion::{At, Cache, Motion, Slices, Spec, Tape, build_as};
use crate::render::{KeptRule, KeptView, Target};
use crate::scene::{Camera, GEOMETRY, Grads, Key, Params, Planes, Rows, Space, SplatGrads, Table, Time};
use std::sync::Arc;

const ROWS: usize = 500;
/// Largest difference of a column, of the root of the mean square of its numbers.
const COLUMN: f64 = 1e-4;

/// Thin and thick, short-lived and long-lived ones, some beyond the floor and the ceiling, some with no rotation at all.
fn params<F: Real>(spec: &Native4dSpec) -> (Params<F>, Key, Arc<dyn Motion<F>>) {
    let mut p = Params::<F>::new(ROWS, 1, &[]);
    let motion = build_as(&Spec::Native4d(*spec), &mut p).expect("a sound specification");
    let own = p.find(TABLE).expect("the model made it");
    for row in 0..ROWS {
        let r = Rng::new(3, "slices", row as u64);
        // Both precisions hold the same numbers.
        let number = |k: u64, scale: f64| F::of(f64::from((scale * r.normal(k)) as f32));
        p[GEOMETRY].write(row, 0, [0, 1, 2].map(|k| number(k, 1.0)));
        let turned = if row % 50 == 7 { 0.0 } else { 1.0 };
        p[GEOMETRY].write(row, 3, [3, 4, 5, 6].map(|k| number(k, turned)));
        p[GEOMETRY].write(row, 7, [7, 8, 9].map(|k| number(k, 1.5) - F::TWO));
        p[GEOMETRY].set(row, 10, number(10, 2.0));
        p[own].write(row, 0, [number(11, 0.3), number(12, 2.0)]);
        p[own].write(row, 2, [13, 14, 15, 16].map(|k| number(k, 1.0)));
    }
    (p, own, motion)
}

/// The motion as kernels know it.
fn moves<F: Real>(motion: &dyn Motion<F>) -> Moves {
    let Slices { speed, floor, ceiling, harmonics, period, .. } = motion.slices().expect("it is of slices");
    Moves::Sliced { speed, floor, ceiling, harmonics, period }
}

/// Asserts that a column of rows is as expected.
fn compare(what: &str, got: &[f64], expected: &[f64]) {
    let size = (expected.iter().map(|x| x * x).sum::<f64>() / expected.len() as f64).sqrt();
    let worst = got.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(got.iter().all(|x| x.is_finite()) && size > 0.0, "{what} is there");
    println!("{what}: {:.1e} of {size:.1e}", worst / size);
    assert!(worst <= COLUMN * size, "{what}: {worst:.1e} beside {size:.1e}");
}

#[test]
fn slices_equal_the_model_forth_and_back() {
    let Some(mut r) = renderer() else { return };
    let spec = Native4dSpec { speed: 2.0, min_life: 0.05, max_life: 3.0, ..Native4dSpec::default() };
    let ((single, own, _), (double, _, motion), t) = (params::<f32>(&spec), params::<f64>(&spec), 0.125);
    // The answer and its gradients, in f64.
    let question = At { p: &double, of: Space::Gaussians, rows: Rows::All, t: Time(t) };
    let (mut tape, mut d) = (Tape::default(), Grads::new(&double));
    motion.at(&question, &Cache::default(), &mut tape);
    let mut pulled = Table::<f64>::new(&crate::scene::splats::SPLAT_COLUMNS, ROWS);
    let mut back = Vec::new();
    for row in 0..ROWS {
        let rng = Rng::new(4, "pulled", row as u64);
        let g: [f32; 10] = std::array::from_fn(|c| rng.normal(c as u64) as f32);
        pulled.write(row, 0, g.map(f64::from));
        // Mean and opacity, covariance; nothing was drawn, so that colours add nothing.
        back.extend([g[0], g[1], g[2], g[9], g[3], g[4], g[5], g[6], g[7], g[8], 0.0, 0.0].into_iter().chain([0.0; 8]));
    }
    d.activate(Space::Gaussians, Rows::All);
    let d_out = SplatGrads { out: &pulled, color: None, weights: None };
    motion.backward(&question, &Cache::default(), &mut tape, &d_out, &mut Cache::default(), &mut d);
    // The same by the kernels: the first of two views, after which nothing learns.
    let moves = moves(motion.as_ref());
    let table = |key: Key| KeptTable { width: single[key].width(), params: single[key].data(), moments: &[] };
    let tables = [table(GEOMETRY), KeptTable::default(), table(own), KeptTable::default(), table(crate::scene::SH)];
    let stats = vec![0.0; STATS_WIDTH * ROWS.next_multiple_of(BLOCK)];
    let layer = KeptLayer { rows: ROWS, moves, life: LifeKind::Infinite, tables, stats: &stats, ties: None };
    r.keep(&[layer], &[[1.0; 2]]).expect("a small scene");
    let (camera, truth) = (camera([0.0, 0.0, -4.0], 16, 16), Planes::new(3, 16, 16));
    let target = Target { truth: &truth, weight: None, picture: 0, dssim: 0.2, response: None };
    let view = KeptView { camera: &camera, t: Time(t), background: [0.0; 3], target };
    let step = KeptStep {
        views: &[view, view],
        sh_degree: 0,
        alpha_min: 1.0 / 255.0,
        rules: &[[const { None }; KEPT]],
        rows: RowWeights::default(),
        noise: &[None],
    };
    let (geometry, gradient, alive) = r.with_tables(|r, tables| {
        let pass = KeptPass { tables, step: &step, view: 0 };
        r.make_room_for_splats(ROWS).expect("room");
        r.buffers.back.ensure(&r.gpu, (4 * back.len()) as u64).expect("room");
        r.buffers.partials.ensure(&r.gpu, (4 * pass.words()) as u64).expect("room");
        r.gpu.queue.write_buffer(r.buffers.back.get(), 0, bytemuck::cast_slice(&back));
        pass.write_uniforms(&r.gpu, 1);
        let mut recorder = Recorder::new(&r.gpu, &r.queries, r.clock);
        pass.answer(&r.gpu, &r.upload, &mut recorder).expect("it runs");
        pass.learn(&r.gpu, &r.buffers, &r.upload, 0, &mut recorder).expect("it runs");
        recorder.submit();
        let padded = ROWS.next_multiple_of(BLOCK);
        (
            read::<f32>(&r.gpu, &r.upload.parts[0].geometry, GEOMETRY_WIDTH * padded),
            read::<f32>(&r.gpu, &tables.layers[0].d_params, tables.layers[0].strides()[0] * padded),
            read::<u32>(&r.gpu, &tables.layers[0].alive, ROWS),
        )
    });
    let column = |data: &[f32], width: usize, c: usize| -> Vec<f64> {
        (0..ROWS).map(|row| f64::from(data[(row / BLOCK * width + c) * BLOCK + row % BLOCK])).collect()
    };
    for (c, name) in ["x", "y", "z", "xx", "xy", "xz", "yy", "yz", "zz"].into_iter().enumerate() {
        let expected: Vec<f64> = (0..ROWS).map(|row| tape.out.get(row, c)).collect();
        compare(name, &column(&geometry, GEOMETRY_WIDTH, c), &expected);
    }
    let opacities = column(&geometry, GEOMETRY_WIDTH, 9);
    let (mut living, mut others) = (0, 0);
    for row in 0..ROWS {
        let expected = tape.out.get(row, 9);
        living += alive[row] as usize;
        // Who is alive may differ at the very edge only.
        let edge = (expected - step.alpha_min).abs() < 1e-5;
        others += usize::from((alive[row] == 1) != (expected >= step.alpha_min) && !edge);
        let shown = if alive[row] == 1 { expected } else { 0.0 };
        assert!((opacities[row] - shown).abs() < 1e-5, "{row}: {} {shown}", opacities[row]);
    }
    assert!(others == 0 && living > ROWS / 4 && living < ROWS, "{living} live, {others} otherwise");
    let of = |key: Key, columns: Range<usize>, first: usize, what: &str| {
        for c in columns {
            let expected: Vec<f64> = (0..ROWS).map(|row| d.table(key).get(row, c)).collect();
            compare(&format!("gradient of {what} {c}"), &column(&gradient, 17, first + c), &expected);
        }
    };
    of(GEOMETRY, 0..11, 0, "geometry");
    of(own, 0..6, 11, "time");
}

/// A step that these cameras see, with losses on rows; what it was, and the numbers after it.
fn stepped(r: &mut GpuRenderer, cameras: &[Camera]) -> (KeptStepped, KeptNumbers) {
    let spec = Native4dSpec::default();
    let (p, own, motion) = params::<f32>(&spec);
    let moves = moves(motion.as_ref());
    let table = |key: Key| KeptTable { width: p[key].width(), params: p[key].data(), moments: &[] };
    let tables = [table(GEOMETRY), KeptTable::default(), table(own), KeptTable::default(), table(crate::scene::SH)];
    let stats = vec![0.0; STATS_WIDTH * ROWS.next_multiple_of(BLOCK)];
    let layer = KeptLayer { rows: ROWS, moves, life: LifeKind::Infinite, tables, stats: &stats, ties: None };
    r.keep(&[layer], &[[1.0; 2]; 3]).expect("a small scene");
    let truth = |camera: &Camera| {
        let mut truth = Planes::new(3, camera.height, camera.width);
        truth.data.iter_mut().enumerate().for_each(|(i, x)| *x = (i % 7) as f32 / 7.0);
        truth
    };
    let truths: Vec<Planes<f32>> = cameras.iter().map(truth).collect();
    let view = |(i, camera)| {
        let target = Target { truth: &truths[i], weight: None, picture: i, dssim: 0.2, response: None };
        KeptView { camera, t: Time(0.0), background: [0.5; 3], target }
    };
    let views: Vec<KeptView<'_>> = cameras.iter().enumerate().map(view).collect();
    let rule = |width: usize| Some(KeptRule { rates: vec![0.01; width], floor: None });
    let step = KeptStep {
        views: &views,
        sh_degree: 0,
        alpha_min: 1.0 / 255.0,
        rules: &[[rule(11), None, rule(6), None, rule(3)]],
        rows: RowWeights { opacity: 0.1, ..RowWeights::default() },
        noise: &[None],
    };
    let stepped = r.step(&step).expect("it runs").expect("small pictures");
    assert!(stepped.bad.is_none() && stepped.loss > 0.0 && r.stats().pairs > ROWS, "{:?}", r.stats());
    let numbers = r.fetch(0).expect("it is read");
    assert!(numbers.params[0] != p[GEOMETRY].data(), "something was learnt");
    (stepped, numbers)
}

#[test]
fn tunings_change_no_bit() {
    let camera = camera([0.0, 0.0, -4.0], 61, 47);
    // Without subgroups and with them.
    let mut first: [Option<(KeptStepped, KeptNumbers)>; 2] = [None, None];
    for tuning in crate::gpu::Tuning::sweep() {
        let Some(gpu) = crate::gpu::tests::gpu() else { return };
        let mut r = GpuRenderer::new(gpu.tuned(tuning), Default::default()).expect("the kernels compile");
        let now = stepped(&mut r, std::slice::from_ref(&camera));
        let first = first[usize::from(tuning.subgroups)].get_or_insert_with(|| now.clone());
        assert!(*first == now, "{:?} changes bits", tuning.changes());
    }
}

#[test]
fn room_that_runs_out_at_a_later_view_changes_no_bit() {
    let Some(mut r) = renderer() else { return };
    // Few pairs at first, then more than there was room for.
    let cameras = [camera([0.0, 0.0, -80.0], 16, 16), camera([0.0, 0.0, -4.0], 150, 110)];
    let plenty = stepped(&mut r, &cameras);
    (r.buffers, r.groups) = (Buffers::new(), None);
    r.make_room_for_pairs(ROWS).expect("a little room");
    let first = r.pair_capacity();
    assert!(stepped(&mut r, &cameras) == plenty, "room changes bits");
    assert!(r.pair_capacity() > first, "the first room was too little");
}
