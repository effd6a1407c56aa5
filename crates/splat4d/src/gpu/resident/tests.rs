//! The kernels of Gaussians of space and time against the motion model, in f64, at the edges of the number range too.

use super::*;
use crate::gpu::MOST_PAIRS;
use crate::gpu::tests::{camera, own_renderer, read, renderer};
use crate::layers::{ALPHA_MIN, Evaluation, Layer, Scene};
use crate::math::{Real, Rng};
use crate::motion::native4d::{Native4dSpec, TABLE};
use crate::motion::{At, Cache, Motion, Slices, Spec, Tape, build_as};
use crate::render::{
    Backend, Image, ResidentNoise, ResidentRule, ResidentTies, ResidentView, RowWeights, Shot, Target,
};
use crate::scene::{Camera, GEOMETRY, Grads, Key, Params, Planes, Rows, Space, SplatGrads, Table, Time};
use std::sync::Arc;

const ROWS: usize = 500;
/// Largest difference of a column, of the root of the mean square of its numbers.
const COLUMN: f64 = 1e-4;

/// Thin and thick, short-lived and long-lived ones, some beyond the floor and the ceiling, some with no rotation at
/// all.
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

/// The motion as in the kernels.
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
fn slices_equal_the_model_forward_and_backward() {
    let Some(mut r) = renderer() else { return };
    let spec = Native4dSpec { speed: 2.0, min_life: 0.05, max_life: 3.0, ..Native4dSpec::default() };
    let ((single, own, _), (double, _, motion), t) = (params::<f32>(&spec), params::<f64>(&spec), 0.125);
    // The result and its gradients, in f64.
    let query = At { p: &double, of: Space::Gaussians, rows: Rows::All, t: Time(t) };
    let (mut tape, mut d) = (Tape::default(), Grads::new(&double));
    motion.at(&query, &Cache::default(), &mut tape);
    let mut pulled = Table::<f64>::new(&crate::scene::splats::SPLAT_COLUMNS, ROWS);
    let mut back = Vec::new();
    for row in 0..ROWS {
        let rng = Rng::new(4, "pulled", row as u64);
        let g: [f32; 10] = std::array::from_fn(|c| rng.normal(c as u64) as f32);
        pulled.write(row, 0, g.map(f64::from));
        // Mean and opacity, covariance; nothing was rendered, so that colours add nothing.
        back.extend([g[0], g[1], g[2], g[9], g[3], g[4], g[5], g[6], g[7], g[8], 0.0, 0.0].into_iter().chain([0.0; 8]));
    }
    d.activate(Space::Gaussians, Rows::All);
    let d_out = SplatGrads { out: &pulled, color: None, weights: None };
    motion.backward(&query, &Cache::default(), &mut tape, &d_out, &mut Cache::default(), &mut d);
    // The same by the kernels: the first of two views, after which nothing learns.
    let moves = moves(motion.as_ref());
    let table = |key: Key| ResidentTable { width: single[key].width(), params: single[key].data(), moments: &[] };
    let tables =
        [table(GEOMETRY), ResidentTable::default(), table(own), ResidentTable::default(), table(crate::scene::SH)];
    let stats = vec![0.0; STATS_WIDTH * ROWS.next_multiple_of(BLOCK)];
    let layer = ResidentLayer { rows: ROWS, moves, life: LifeKind::Infinite, tables, stats: &stats, ties: None };
    r.keep(&[layer], None, &[[1.0; 2]]).expect("a small scene");
    let (camera, truth) = (camera([0.0, 0.0, -4.0], 16, 16), Planes::new(3, 16, 16));
    let target = Target { truth: &truth, weight: None, picture: 0, dssim: 0.2, response: None };
    let view = ResidentView { camera: &camera, t: Time(t), background: [0.0; 3], target, rig: 0 };
    let step = ResidentStep {
        views: &[view, view],
        sh_degree: 0,
        alpha_min: 1.0 / 255.0,
        rules: &[[const { None }; KEPT]],
        rows: RowWeights::default(),
        noise: &[None],
        cameras: 0.0,
    };
    let step = r.take_over(&step).expect("it is sent").expect("a small picture");
    r.make_room_for_status(2).expect("room");
    let (geometry, gradient, alive) = r.with_tables(|r, tables| {
        let pass = ResidentPass { tables, step: &step, view: 0 };
        r.make_room_for_splats(ROWS).expect("room");
        r.buffers.back.ensure(&r.gpu, (4 * back.len()) as u64).expect("room");
        r.make_room_for_loss([16, 16], 16).expect("room");
        r.gpu.queue.write_buffer(r.buffers.back.get(), 0, bytemuck::cast_slice(&back));
        pass.write_uniforms(&r.gpu, 1);
        let mut recorder = Recorder::new(&r.gpu, &r.queries, r.clock);
        tables.answer(&r.gpu, &r.buffers, &r.upload, &mut recorder).expect("it runs");
        pass.learn(&r.gpu, &r.buffers, &r.upload, &mut recorder).expect("it runs");
        recorder.submit();
        let padded = ROWS.next_multiple_of(BLOCK);
        (
            read::<f32>(&r.gpu, &r.upload.parts[0].geometry, GEOMETRY_WIDTH * padded),
            read::<f32>(&r.gpu, &tables.pages[0].d_params, tables.pages[0].strides()[0] * padded),
            read::<u32>(&r.gpu, &tables.pages[0].alive, ROWS),
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

/// What steps measured, and the numbers of the layer and of the cameras after them.
type After = (Vec<ResidentStepped>, ResidentNumbers, [Vec<f32>; 2]);

/// Hands a layer over, with ties or without, and cameras that learn their colours: its numbers.
fn kept(r: &mut GpuRenderer, ties: Option<&ResidentTies>) -> Result<Params<f32>> {
    let spec = Native4dSpec::default();
    let (p, own, motion) = params::<f32>(&spec);
    let moves = moves(motion.as_ref());
    let table = |key: Key| ResidentTable { width: p[key].width(), params: p[key].data(), moments: &[] };
    let tables =
        [table(GEOMETRY), ResidentTable::default(), table(own), ResidentTable::default(), table(crate::scene::SH)];
    let stats = vec![0.0; STATS_WIDTH * ROWS.next_multiple_of(BLOCK)];
    let layer = ResidentLayer { rows: ROWS, moves, life: LifeKind::Infinite, tables, stats: &stats, ties };
    let colors: Vec<f32> = (0..12 * BLOCK).map(|i| 0.01 * (i % 5) as f32).collect();
    let table = ResidentTable { width: 12, params: &colors, moments: &[] };
    let cameras = ResidentCameras { count: 3, table, held: &[0, 1] };
    r.keep(&[layer], Some(&cameras), &[[1.0; 2]; 3])?;
    Ok(p)
}

/// Begins a step on these cameras, with losses on rows and noise: steps that are done. Truths that are held are left
/// out.
fn begun(r: &mut GpuRenderer, number: usize, cameras: &[Camera], rate: f64) -> Result<Vec<ResidentStepped>> {
    let number_of = |i: usize, camera: &Camera| 100 * camera.width + i;
    let mut truth = |(i, camera): (usize, &Camera)| {
        let mut truth = Planes::new(3, camera.height, camera.width);
        truth.data.iter_mut().enumerate().for_each(|(i, x)| *x = (i % 7) as f32 / 7.0);
        if r.holds(number_of(i, camera), [camera.width, camera.height], false) {
            truth.data.clear();
        }
        truth
    };
    let truths: Vec<Planes<f32>> = cameras.iter().enumerate().map(&mut truth).collect();
    let view = |(i, camera): (usize, _)| {
        let picture = number_of(i, camera);
        let target = Target { truth: &truths[i], weight: None, picture, dssim: 0.2, response: None };
        ResidentView { camera, t: Time(0.0), background: [0.5; 3], target, rig: i }
    };
    let views: Vec<ResidentView<'_>> = cameras.iter().enumerate().map(view).collect();
    let rule = |width: usize| Some(ResidentRule { rates: vec![rate; width], floor: None });
    let rng = Rng::new(5, "noise", number as u64);
    let noise = ResidentNoise { strength: 0.1, dead: 0.005, slope: 100.0, limit: 0.5, rng };
    let step = ResidentStep {
        views: &views,
        sh_degree: 0,
        alpha_min: 1.0 / 255.0,
        rules: &[[rule(11), None, rule(6), None, rule(3)]],
        rows: RowWeights { opacity: 0.1, ..RowWeights::default() },
        noise: &[Some(noise)],
        cameras: 1e-3,
    };
    Ok(r.step(&step)?.expect("small pictures"))
}

/// Steps that each see these cameras at a rate.
fn tried(r: &mut GpuRenderer, steps: &[(&[Camera], f64)]) -> Result<After> {
    let p = kept(r, None)?;
    let mut done = Vec::new();
    for (number, (cameras, rate)) in steps.iter().enumerate() {
        done.extend(begun(r, number, cameras, *rate)?);
        assert_eq!(done.len(), (number + 1).saturating_sub(r.ahead), "the others are under way");
    }
    done.extend(r.finish()?);
    assert_eq!(done.len(), steps.len());
    let numbers = r.fetch(0)?;
    assert!(numbers.params[0] != p[GEOMETRY].data(), "something was learnt");
    Ok((done, numbers, r.fetch_cameras()?))
}

fn stepped(r: &mut GpuRenderer, steps: &[(&[Camera], f64)]) -> After {
    tried(r, steps).expect("they are taken")
}

fn one(camera: &Camera) -> [(&[Camera], f64); 1] {
    [(std::slice::from_ref(camera), 0.01)]
}

#[test]
fn tunings_change_no_bit() {
    let camera = camera([0.0, 0.0, -4.0], 61, 47);
    // By the forms of the blend's backward pass, which alone change bits.
    let mut first = std::collections::HashMap::<[bool; 3], After>::new();
    for tuning in crate::gpu::Tuning::sweep() {
        let Some(gpu) = crate::gpu::tests::gpu() else { return };
        let mut r = GpuRenderer::new(gpu.tuned(tuning), Default::default()).expect("the kernels compile");
        let now = stepped(&mut r, &one(&camera));
        assert!(now.0[0].bad.is_none() && now.0[0].loss > 0.0 && r.stats().pairs > ROWS, "{:?}", r.stats());
        let first =
            first.entry([tuning.subgroups, tuning.back_vectors, tuning.back_lanes]).or_insert_with(|| now.clone());
        assert!(*first == now, "{:?} changes bits", tuning.changes());
    }
}

#[test]
fn truths_that_are_held_may_be_left_out() {
    let Some(mut r) = own_renderer() else { return };
    let camera = camera([0.0, 0.0, -4.0], 61, 47);
    let steps: [(&[Camera], f64); 3] = [(std::slice::from_ref(&camera), 0.01); 3];
    // With no room, every step sends its truth.
    let poor = &mut own_renderer().expect("it was there");
    poor.pictures.budget = Some(0);
    assert!(stepped(&mut r, &steps) == stepped(poor, &steps));
    assert_eq!((r.pictures.sent, poor.pictures.sent), (1, 3));
    assert!(r.holds(6100, [61, 47], false) && !r.holds(6100, [61, 47], true) && !r.holds(6101, [61, 47], false));
    assert!(!r.holds(6100, [47, 61], false) && !poor.holds(6100, [61, 47], false));
    // One that is not held is required.
    let truth = Planes { data: Vec::new(), ..Planes::new(3, 47, 61) };
    let target = Target { truth: &truth, weight: None, picture: 7, dssim: 0.2, response: None };
    let view = ResidentView { camera: &camera, t: Time(0.0), background: [0.5; 3], target, rig: 0 };
    let step = ResidentStep {
        views: &[view],
        sh_degree: 0,
        alpha_min: 1.0 / 255.0,
        rules: &[[const { None }; KEPT]],
        rows: RowWeights::default(),
        noise: &[None],
        cameras: 0.0,
    };
    assert!(r.step(&step).expect("nothing fails").is_none());
}

/// Images of few pairs, then of more than fit, at a first view and at a later one.
fn far_and_near() -> [Vec<Camera>; 3] {
    let [far, near] = [camera([0.0, 0.0, -80.0], 16, 16), camera([0.0, 0.0, -4.0], 150, 110)];
    [vec![far.clone(), far.clone()], vec![far.clone(), near.clone()], vec![near, far]]
}

#[test]
fn steps_in_flight_buffer_sizes_bands_and_pages_change_no_bit() {
    let Some(mut r) = own_renderer() else { return };
    let [first, then, last] = far_and_near();
    let steps: Vec<(&[Camera], f64)> =
        [&first, &first, &then, &first, &last, &then, &first].iter().map(|c| (&c[..], 0.01)).collect();
    // One after the other, with buffers as large as needed.
    r.ahead = 0;
    stepped(&mut r, &steps);
    let (again, pairs) = (r.flights.again, r.pair_capacity());
    let expected = stepped(&mut r, &steps);
    assert_eq!(r.flights.again, again, "there was room");
    assert!(expected.0.iter().all(|s| s.bad.is_none() && s.loss > 0.0));
    assert!(expected.2[0][..BLOCK].iter().any(|x| *x != 0.0), "cameras learn");
    let poor = |r: &mut GpuRenderer| {
        (r.buffers, r.groups) = (Buffers::new(), None);
        r.make_room_for_pairs(ROWS).expect("a little room");
        assert!(r.pair_capacity() < pairs);
    };
    for ahead in [0, 1, 3, AHEAD] {
        r.ahead = ahead;
        assert!(stepped(&mut r, &steps) == expected, "{ahead} steps under way change bits");
        poor(&mut r);
        let before = r.flights.again;
        assert!(stepped(&mut r, &steps) == expected, "room that runs out changes bits, {ahead} steps under way");
        assert!(r.flights.again > before, "the first room was too little");
    }
    // Fewer pairs at once than an image has: bands.
    stepped(&mut r, &[(&then, 0.01)]);
    let near = r.stats().pairs;
    poor(&mut r);
    r.most_pairs = near / 3;
    assert!(stepped(&mut r, &steps) == expected, "bands change bits");
    assert!(r.band_rows < 7, "{} rows of tiles a band", r.band_rows);
    (r.most_pairs, r.band_rows) = (MOST_PAIRS, usize::MAX);
    // Sums of losses on rows are by workgroup, of which a page has its own; nothing learns from them.
    r.page_rows = Some(64);
    let (done, numbers, cameras) = stepped(&mut r, &steps);
    assert!(numbers == expected.1 && cameras == expected.2, "pages change bits");
    for (a, b) in done.iter().zip(&expected.0) {
        assert!(a.comparisons == b.comparisons && (a.loss - b.loss).abs() < 1e-6 * b.loss);
    }
    r.page_rows = None;
    // A row of tiles that has too many is an error, not a loop.
    r.most_pairs = 10;
    poor(&mut r);
    let error = tried(&mut r, &steps).expect_err("there is no smaller band");
    assert!(error.to_string().contains("too many"), "{error}");
}

#[test]
fn a_non_finite_value_stops_later_steps_and_its_step_is_reported() {
    let Some(mut r) = own_renderer() else { return };
    let [first, then, _] = far_and_near();
    let steps: [(&[Camera], f64); 5] =
        [(&first, 0.01), (&first, 0.01), (&first, f64::INFINITY), (&then, 0.01), (&first, 0.01)];
    for ahead in [0, AHEAD] {
        r.ahead = ahead;
        let (done, numbers, _) = stepped(&mut r, &steps);
        let wrong = done.iter().position(|s| s.bad.is_some());
        assert_eq!(wrong, Some(2), "{done:?}");
        assert!(numbers.params[0].iter().any(|x| !x.is_finite()));
    }
    // It starts again as if nothing had been.
    let steps = &steps[..2];
    let (a, b) = (stepped(&mut r, steps), stepped(&mut own_renderer().expect("it was there"), steps));
    assert!(a == b && a.0.iter().all(|s| s.bad.is_none()));
}

#[test]
fn a_device_lost_during_a_step_is_an_error() {
    let Some(mut r) = own_renderer() else { return };
    let camera = camera([0.0, 0.0, -4.0], 33, 20);
    stepped(&mut r, &one(&camera));
    r.gpu.device.destroy();
    assert!(tried(&mut r, &one(&camera)).is_err(), "an error is returned");
}

/// A request to a renderer.
type Call<'a> = &'a dyn Fn(&mut GpuRenderer) -> Result<()>;

#[test]
fn a_device_lost_with_steps_in_flight_is_an_error_for_every_call() {
    let camera = camera([0.0, 0.0, -4.0], 33, 20);
    let finish = |r: &mut GpuRenderer| r.finish().map(|_| ());
    let fetch = |r: &mut GpuRenderer| r.fetch(0).map(|_| ());
    let step = |r: &mut GpuRenderer, number| begun(r, number, std::slice::from_ref(&camera), 0.01);
    // As many as may be in flight, and one.
    let more = |r: &mut GpuRenderer| (2..=r.ahead).try_for_each(|number| step(r, number).map(|_| ()));
    let ways: [Call<'_>; 3] = [&finish, &fetch, &more];
    for (what, call) in ["finish", "fetch", "more steps"].into_iter().zip(ways) {
        let Some(mut r) = own_renderer() else { return };
        stepped(&mut r, &one(&camera));
        for number in 0..2 {
            assert!(step(&mut r, number).expect("it is begun").is_empty(), "it is under way");
        }
        r.gpu.device.destroy();
        assert!(call(&mut r).is_err(), "{what}: an error is returned");
        assert!(tried(&mut r, &one(&camera)).is_err(), "{what}: and the error is returned again");
    }
}

#[test]
fn only_ties_of_more_rows_than_a_page_are_refused() {
    let Some(mut r) = own_renderer() else { return };
    r.page_rows = Some(ROWS.next_multiple_of(BLOCK) - BLOCK);
    let refused = |r: &mut GpuRenderer, ties: Option<&ResidentTies>| kept(r, ties).err().map(|e| e.to_string());
    let ties = ResidentTies::default();
    let error = refused(&mut r, Some(&ties)).expect("it has two pages");
    assert!(error.contains("tied poses are too many for one buffer"), "{error}");
    assert_eq!(refused(&mut r, None), None, "rows without ties lie in two pages");
    assert_eq!(r.resident.as_ref().expect("they are kept").pages.len(), 2);
    r.page_rows = Some(ROWS.next_multiple_of(BLOCK));
    assert_eq!(refused(&mut r, Some(&ties)), None, "in one page they are tied");
    // And it works on as if nothing had been.
    let camera = camera([0.0, 0.0, -4.0], 33, 20);
    let fresh = &mut own_renderer().expect("it was there");
    assert!(stepped(&mut r, &one(&camera)) == stepped(fresh, &one(&camera)));
}

#[test]
fn failed_allocations_drop_cached_images_first_then_are_errors() {
    let Some(mut r) = own_renderer() else { return };
    let [first, then, _] = far_and_near();
    let steps: [(&[Camera], f64); 3] = [(&first, 0.01), (&first, 0.01), (&then, 0.01)];
    stepped(&mut r, &steps);
    (r.buffers, r.groups) = (Buffers::new(), None);
    r.make_room_for_pairs(ROWS).expect("a little room");
    let budget = r.pictures.budget;
    r.gpu.refused = Some("pairs of tile and splat");
    let error = tried(&mut r, &steps).expect_err("there is too little");
    assert!(error.kind() == ErrorKind::Memory && error.to_string().contains("too little memory"), "{error}");
    assert!(r.pictures.budget < budget, "pictures go first");
    r.gpu.refused = None;
    stepped(&mut r, &steps);
}

#[test]
fn a_film_equals_the_images() {
    let Some(mut r) = own_renderer() else { return };
    let (p, _, motion) = params::<f32>(&Native4dSpec::default());
    let layer = Layer::new("all", p, motion, LifeKind::Infinite);
    let scene = Scene { layers: vec![layer], clip: [0.0, 1.0], ..Scene::default() };
    let [far, near] = [camera([0.0, 0.0, -80.0], 16, 16), camera([0.0, 0.0, -4.0], 150, 110)];
    (r.buffers, r.groups) = (Buffers::new(), None);
    r.make_room_for_pairs(ROWS).expect("a little room");
    let frames: Vec<(Camera, Time)> =
        [(&far, 0.3), (&near, 0.1), (&near, 0.5)].map(|(c, t): (&Camera, f64)| (c.clone(), Time(t))).to_vec();
    let layer = &scene.layers[0];
    let table =
        |key: Key| ResidentTable { width: layer.params[key].width(), params: layer.params[key].data(), moments: &[] };
    let own = layer.params.find(TABLE).expect("the model made it");
    let tables =
        [table(GEOMETRY), ResidentTable::default(), table(own), ResidentTable::default(), table(crate::scene::SH)];
    let stats = vec![0.0; STATS_WIDTH * ROWS.next_multiple_of(BLOCK)];
    let moves = moves(layer.motion.as_ref());
    let kept = ResidentLayer { rows: ROWS, moves, life: layer.life, tables, stats: &stats, ties: None };
    let film = |r: &mut GpuRenderer| -> Vec<f32> {
        let seconds = r.film(&[kept], ALPHA_MIN, scene.background, &frames).expect("it is drawn");
        assert!(seconds.expect("in one piece") > 0.0);
        read(&r.gpu, &r.buffers.planes, 3 * 150 * 110)
    };
    let filmed = film(&mut r);
    r.page_rows = Some(64);
    assert!(film(&mut r) == filmed, "pages change no bit");
    assert_eq!(r.resident.as_ref().expect("they are kept").pages.len(), ROWS.div_ceil(64));
    let mut moment = Evaluation::default();
    scene.at(Time(0.5), &mut moment);
    let splats = scene.splats(&moment);
    let mut image = Image::default();
    r.render(&Shot::new(&splats, &near, scene.background), &mut image).expect("it is drawn");
    let off = filmed.iter().zip(&image.color.data).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(off < 2e-3 && image.color.data.iter().any(|x| *x > 0.2), "{off:.1e}");
}
