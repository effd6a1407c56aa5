//! What every motion model must keep, checked on a model made from its [`Spec`] with random parameters in f64:
//! gradients to every table and to t against central differences, compact rows, random access, files, row edits.

use splat4d::format::scene::{read, spec_from_json, spec_to_json, write};
use splat4d::layers::{Head, Layer, Scene};
use splat4d::math::Rng;
use splat4d::motion::filtered::{Filtered, FilteredSpec, Fusion};
use splat4d::motion::{At, BUILT_IN, Cache, Motion, Spec, Still, Tape, build_as};
use splat4d::scene::{
    Born, Color, GEOMETRY, Grads, HeadKeys, Key, LIFE, LifeKind, Params, RowEdit, Rows, SH, Space, SplatGrads, Table,
    Time,
};
use std::sync::Arc;

/// Half the step of the central differences.
const H: f64 = 1e-6;
/// Largest difference between analytic and central differences: relative, and a floor for what is nearly zero.
const TOLERANCE: (f64, f64) = (2e-5, 1e-7);
/// Numbers of every table that are moved, at most.
const PROBED: usize = 40;
/// The times that are queried: within the clip of one second, on a frame, at its ends and outside.
const TIMES: [f64; 5] = [0.31, 0.7333, 0.0, 1.0, 1.2];

/// A model in f64 with its parameters.
pub(crate) struct Subject {
    /// All tables, filled at random.
    pub p: Params<f64>,
    /// The model.
    pub motion: Arc<dyn Motion<f64>>,
}

/// Makes `rows` random Gaussians of the model. `spread`: how far every number of the model's own tables is moved from
/// what [`build`] made of it (trainable tables only).
pub(crate) fn subject(spec: &Spec, rows: usize, life: LifeKind, spread: f64, seed: u64) -> Subject {
    let mut p = Params::<f64>::new(rows, 4, life.columns());
    let rng = Rng::new(seed, "check", 0);
    for row in 0..rows {
        let draw = |i: usize| rng.fork(row as u64).normal(i as u64);
        p[GEOMETRY].write::<11>(row, 0, std::array::from_fn(|c| if c < 3 { 0.6 * draw(c) } else { 0.5 * draw(c) }));
        p[GEOMETRY].add(row, 3, [1.5]);
        p[SH].write::<12>(row, 0, std::array::from_fn(|c| 0.3 * draw(20 + c)));
        if life != LifeKind::Infinite {
            p[LIFE].write(row, 0, [0.5 + 0.2 * draw(40), 0.3 * draw(41)]);
        }
    }
    let motion = build_as(spec, &mut p).expect("the specification is sound");
    let keys: Vec<Key> = p.keys().skip(3).filter(|&k| p.info(k).trainable).collect();
    for key in keys {
        for row in 0..p[key].rows() {
            for col in 0..p[key].width() {
                let x = rng.fork(1000 + u64::from(key.0)).normal((row * p[key].width() + col) as u64);
                *p[key].get_mut(row, col) += spread * x;
            }
        }
    }
    Subject { p, motion }
}

/// One scalar of all results of a model, and its gradient: random weights on splats, colours and SH weights.
struct Weights(Rng);

impl Weights {
    fn table(&self, like: &Table<f64>, purpose: u64) -> Table<f64> {
        let mut out = like.zeros_like();
        for row in 0..out.rows() {
            for col in 0..out.width() {
                out.set(row, col, self.0.fork(purpose).normal((row * out.width() + col) as u64));
            }
        }
        out
    }
}

fn dot(a: &Table<f64>, b: &Table<f64>) -> f64 {
    a.data().iter().zip(b.data()).map(|(x, y)| x * y).sum()
}

impl Subject {
    fn request(&self, of: Space, rows: Rows<'_>, t: f64) -> (Cache, Tape<f64>) {
        let q = At { p: &self.p, of, rows, t: Time(t) };
        let (mut cache, mut tape) = (Cache::default(), Tape::default());
        self.motion.prepare(&self.p, &[q], &mut cache);
        self.motion.at(&q, &cache, &mut tape);
        (cache, tape)
    }

    /// The splats of a query.
    pub(crate) fn splats(&self, of: Space, rows: Rows<'_>, t: f64) -> Table<f64> {
        self.request(of, rows, t).1.out
    }

    fn queries<'a>(&'a self, spaces: &[Space], rows: &'a [u32], times: &[f64]) -> Vec<At<'a, f64>> {
        let mut out = Vec::new();
        for &of in spaces {
            for (k, &t) in times.iter().enumerate() {
                let rows = if k % 2 == 0 || of == Space::Nodes { Rows::All } else { Rows::Some(rows) };
                out.push(At { p: &self.p, of, rows, t: Time(t) });
            }
        }
        out
    }

    /// Σ weights · results over all queries of a step.
    fn value(&self, spaces: &[Space], rows: &[u32], times: &[f64], w: &Weights) -> f64 {
        let q = self.queries(spaces, rows, times);
        let mut cache = Cache::default();
        self.motion.prepare(&self.p, &q, &mut cache);
        let mut sum = 0.0;
        for (i, q) in q.iter().enumerate() {
            let mut tape = Tape::default();
            self.motion.at(q, &cache, &mut tape);
            sum += dot(&tape.out, &w.table(&tape.out, i as u64));
            match self.motion.color(q, &tape) {
                Color::Sh { weights: Some(b), .. } => sum += dot(b, &w.table(b, 500 + i as u64)),
                Color::Direct { table } => sum += dot(table, &w.table(table, 500 + i as u64)),
                Color::Sh { table, base: false, .. } => sum += dot(table, &w.table(table, 500 + i as u64)),
                Color::Sh { .. } => {}
            }
        }
        sum
    }

    /// The gradient of [`value`](Self::value), and to every query's time.
    fn gradient(&self, spaces: &[Space], rows: &[u32], times: &[f64], w: &Weights) -> (Grads<f64>, Vec<f64>) {
        let q = self.queries(spaces, rows, times);
        let (mut cache, mut d_cache) = (Cache::default(), Cache::default());
        let mut d = Grads::new(&self.p);
        self.motion.prepare(&self.p, &q, &mut cache);
        let mut d_times = Vec::new();
        for (i, q) in q.iter().enumerate() {
            let mut tape = Tape::default();
            self.motion.at(q, &cache, &mut tape);
            d.activate(q.of, q.rows);
            let d_out = w.table(&tape.out, i as u64);
            let (mut color, mut weights) = (None, None);
            match self.motion.color(q, &tape) {
                Color::Sh { weights: Some(b), .. } => weights = Some(w.table(b, 500 + i as u64)),
                Color::Direct { table } => color = Some(w.table(table, 500 + i as u64)),
                Color::Sh { table, base: false, .. } => color = Some(w.table(table, 500 + i as u64)),
                Color::Sh { .. } => {}
            }
            let d_out = SplatGrads { out: &d_out, color: color.as_ref(), weights: weights.as_ref() };
            d_times.push(self.motion.backward(q, &cache, &mut tape, &d_out, &mut d_cache, &mut d));
        }
        self.motion.finish(&self.p, &q, &mut cache, &mut d_cache, &mut d);
        (d, d_times)
    }

    /// Central differences of every trainable table (at most [`PROBED`] numbers each) and of t.
    /// `frozen`: column groups whose gradient is stopped on purpose (the model's documentation states so).
    pub(crate) fn gradients(&mut self, spaces: &[Space], frozen: &[&str]) {
        let rows: Vec<u32> = (0..self.p.len() as u32).filter(|r| r % 3 != 1).collect();
        let w = Weights(Rng::new(77, "weights", 0));
        let (d, d_times) = self.gradient(spaces, &rows, &TIMES, &w);
        let near = |a: f64, b: f64| (a - b).abs() <= TOLERANCE.0 * a.abs().max(b.abs()) + TOLERANCE.1;
        for key in self.p.keys().collect::<Vec<_>>() {
            let (count, width) = (self.p[key].rows(), self.p[key].width());
            if !self.p.info(key).trainable || key == SH || key == LIFE {
                continue;
            }
            let numbers = count * width;
            let mut met = false;
            for i in (0..numbers).step_by(numbers.div_ceil(PROBED).max(1)) {
                let (row, col) = (i / width, i % width);
                if frozen.contains(&self.p.column_name(key, col)) {
                    met = true;
                    continue;
                }
                let old = self.p[key].get(row, col);
                self.p[key].set(row, col, old + H);
                let up = self.value(spaces, &rows, &TIMES, &w);
                self.p[key].set(row, col, old - H);
                let down = self.value(spaces, &rows, &TIMES, &w);
                self.p[key].set(row, col, old);
                let (fd, got) = ((up - down) / (2.0 * H), d.table(key).get(row, col));
                met |= fd.abs() > TOLERANCE.1;
                let name = self.p.column_name(key, col);
                assert!(near(fd, got), "{name}[{row}, {col}]: differences {fd}, gradient {got}");
            }
            assert!(met || numbers == 0, "nothing depends on {}: the check would be empty", self.p.info(key).name);
        }
        for (k, &t) in TIMES.iter().enumerate() {
            // One-sided slopes differ at the clip's ends and at key frames.
            if k > 1 {
                continue;
            }
            let at = |h: f64| {
                let mut times = TIMES;
                times[k] = t + h;
                self.value(spaces, &rows, &times, &w)
            };
            let fd = (at(H) - at(-H)) / (2.0 * H);
            let got: f64 = (0..spaces.len()).map(|s| d_times[s * TIMES.len() + k]).sum();
            assert!(near(fd, got), "dL/dt at {t}: differences {fd}, gradient {got}");
        }
    }

    /// A query for some rows returns the same as one for all.
    pub(crate) fn compact(&self) {
        let rows: Vec<u32> = (0..self.p.len() as u32).filter(|r| r % 4 == 1 || r % 7 == 0).collect();
        for t in TIMES {
            let all = self.splats(Space::Gaussians, Rows::All, t);
            let some = self.splats(Space::Gaussians, Rows::Some(&rows), t);
            assert_eq!(some.rows(), rows.len());
            for (j, &row) in rows.iter().enumerate() {
                for c in 0..some.width() {
                    let (a, b) = (all.get(row as usize, c), some.get(j, c));
                    assert!((a - b).abs() <= 1e-12 * a.abs().max(1.0), "row {row} column {c} at {t}: {a} and {b}");
                }
            }
            assert_eq!(self.splats(Space::Gaussians, Rows::Some(&[]), t).rows(), 0);
        }
    }

    /// Any time has a result, alone as together with others.
    pub(crate) fn random_access(&self) {
        for t in [-1e4, -0.3, 0.0, 0.5, 1.0, 1.7, 1e4] {
            let out = self.splats(Space::Gaussians, Rows::All, t);
            assert!(out.first_non_finite().is_none(), "at {t} something is not finite");
        }
        let q = [0.9, 0.1, 0.5].map(|t| At { p: &self.p, of: Space::Gaussians, rows: Rows::All, t: Time(t) });
        let mut cache = Cache::default();
        self.motion.prepare(&self.p, &q, &mut cache);
        for q in &q {
            let mut tape = Tape::default();
            self.motion.at(q, &cache, &mut tape);
            let alone = self.splats(Space::Gaussians, Rows::All, q.t.0);
            for (a, b) in alone.data().iter().zip(tape.out.data()) {
                assert!((a - b).abs() <= 1e-12 * a.abs().max(1.0), "at {} alone {a}, together {b}", q.t.0);
            }
        }
    }

    /// Copies, removals and their order reach every table.
    pub(crate) fn row_edits(&mut self) {
        let before = self.splats(Space::Gaussians, Rows::All, 0.4);
        let n = self.p.len();
        let mut edit = RowEdit::prune(Space::Gaussians, (0..n).map(|r| r % 3 != 0));
        edit.parent.reverse();
        let parents = edit.parent.clone();
        self.p.apply(&edit);
        self.motion.clone().on_edit(&mut self.p, &edit, &Rng::new(5, "edit", 0));
        let after = self.splats(Space::Gaussians, Rows::All, 0.4);
        assert_eq!(after.rows(), parents.len());
        for (j, &row) in parents.iter().enumerate() {
            for c in 0..10 {
                let (a, b) = (before.get(row as usize, c), after.get(j, c));
                assert!((a - b).abs() <= 1e-9 * a.abs().max(1.0), "old row {row}, column {c}: {a} became {b}");
            }
        }
        let mut edit = RowEdit::identity(Space::Gaussians, self.p.len());
        edit.push(0, Born::Clone);
        edit.push(1, Born::Split);
        self.p.apply(&edit);
        self.motion.clone().on_edit(&mut self.p, &edit, &Rng::new(5, "edit", 1));
        assert!(self.splats(Space::Gaussians, Rows::All, 0.4).first_non_finite().is_none());
    }
}

/// The model agrees with its capabilities: own motion and lifespan, the SH table, scratch, and the polynomial of its
/// path.
pub(crate) fn capabilities(spec: &Spec, rows: usize, life: LifeKind) {
    let s = subject(spec, rows, life, 0.1, 4);
    let told = s.motion.capabilities();
    assert_eq!(spec.capabilities(), Some(told), "the spec and the model say the same");
    assert_eq!(told.own_life, s.motion.life(&s.p, &mut Table::new(&[("center", 1), ("log_width", 1)], rows)));
    let mut plain = Params::<f64>::new(rows, 4, &[]);
    build_as(spec, &mut plain).expect("the specification is sound");
    assert_eq!(plain[SH].width(), 12 * told.color_blocks);
    let [few, many] = [rows, 10 * rows].map(|n| s.motion.scratch_bytes(&s.p, n));
    assert!(few <= many, "more rows take more: {few}, {many}");
    let [a, b] = [0.2, 0.7].map(|t| s.splats(Space::Gaussians, Rows::All, t));
    assert!(told.moves || a.data() == b.data(), "what does not move stays to the bit");
    let Some(path) = s.motion.polynomial() else { return };
    for row in 0..rows {
        let center = if life == LifeKind::Infinite { path.origin } else { s.p[LIFE].get(row, 0) };
        for (t, splats) in [(0.2, &a), (0.7, &b)] {
            let mut mean = s.p[GEOMETRY].read::<3>(row, 0);
            for k in 0..path.order {
                let v = s.p[path.velocities.expect("an order has coefficients")].read::<3>(row, 3 * k);
                (0..3).for_each(|i| mean[i] += v[i] * (t - center).powi(k as i32 + 1));
            }
            let shown = splats.read::<3>(row, 0);
            assert!((0..3).all(|i| (mean[i] - shown[i]).abs() < 1e-9), "row {row} at {t}: {mean:?} {shown:?}");
        }
    }
    if life != LifeKind::Infinite {
        let mut moved = subject(spec, rows, life, 0.1, 4);
        for row in 0..rows {
            let (from, shift) = (moved.p[LIFE].get(row, 0), 0.13 * (row as f64 - 2.5));
            let [there, back] = [shift, 0.0].map(|delta| path.travel(&moved.p, row, delta));
            path.recentre(&mut moved.p, row, shift);
            let mean = s.p[GEOMETRY].read::<3>(row, 0);
            assert!((moved.p[LIFE].get(row, 0) - from - shift).abs() < 1e-12, "row {row}: the life's centre moves");
            let now = moved.p[GEOMETRY].read::<3>(row, 0);
            assert!((0..3).all(|i| back[i] == 0.0 && (now[i] - mean[i] - there[i]).abs() < 1e-12), "row {row}");
        }
        for (t, before) in [(0.2, &a), (0.7, &b)] {
            let after = moved.splats(Space::Gaussians, Rows::All, t);
            let near = before.data().iter().zip(after.data()).all(|(a, b)| (a - b).abs() < 1e-9);
            assert!(near, "a life that is moved leaves the path at {t} as it was");
        }
    }
    if path.rotation_rates.is_none() {
        assert!((0..rows).all(|row| (3..9).all(|c| (a.get(row, c) - b.get(row, c)).abs() < 1e-12)), "nothing turns");
    }
}

/// The scene file gives back the same model and the same numbers; files with a wrong specification are refused.
pub(crate) fn files(spec: &Spec, rows: usize, life: LifeKind) {
    let s = subject(spec, rows, life, 0.1, 3);
    let params = s.p.cast::<f32>();
    let mut fresh = Params::<f32>::new(rows, 4, life.columns());
    let motion = build_as::<f32>(spec, &mut fresh).expect("the specification is sound");
    assert!(fresh.keys().eq(params.keys()), "a model makes the same tables in any precision");
    let layer = Layer::new("a", params.clone(), motion, life);
    let head = if HeadKeys::of(&params).is_some() { Head::Features } else { Head::Identity };
    let up = [0.0, 0.0, 1.0];
    let scene = Scene { layers: vec![layer], clip: [0.0, 1.0], fps: 30.0, up, head, ..Scene::default() };
    let mut bytes = Vec::new();
    write(&scene, &mut bytes).expect("memory takes every byte");
    let again = read(&bytes).expect("what was written can be read");
    assert_eq!(again.layers[0].motion.spec(), *spec);
    for key in params.keys().collect::<Vec<_>>() {
        assert_eq!(params[key].data(), again.layers[0].params[key].data(), "{}", params.info(key).name);
    }
    assert!(BUILT_IN.contains(&spec.name()));
    let json = spec_to_json(spec);
    let mut strange = json.clone();
    strange["no such field"] = serde_json::json!(1);
    let refused = spec_from_json(&strange);
    assert!(*spec == Spec::Still || refused.is_err(), "unknown fields are refused");
}

/// A result at the start is the canonical cloud: what `build` makes does not move anything.
pub(crate) fn starts_still(spec: &Spec, rows: usize) {
    let s = subject(spec, rows, LifeKind::Infinite, 0.0, 9);
    let mut still = Params::<f64>::new(rows, 4, &[]);
    still[GEOMETRY] = s.p[GEOMETRY].clone();
    let rest = Subject { p: still, motion: Arc::new(Still) };
    for t in TIMES {
        let (a, b) = (s.splats(Space::Gaussians, Rows::All, t), rest.splats(Space::Gaussians, Rows::All, t));
        // Numbers past the last row are undefined, so blocks are not compared directly.
        for (row, col) in (0..rows).flat_map(|row| (0..10).map(move |col| (row, col))) {
            let (a, b) = (a.get(row, col), b.get(row, col));
            assert!((a - b).abs() < 1e-9, "row {row} at {t}: {a}, the canonical cloud has {b}");
        }
    }
}

/// One thread and four give the same bits, forward and backward, in f32.
pub(crate) fn any_threads(spec: &Spec, rows: usize) {
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads can be made");
        pool.install(|| {
            let p = subject(spec, rows, LifeKind::Infinite, 0.1, 4).p.cast::<f32>();
            let mut fresh = Params::<f32>::new(rows, 4, &[]);
            let motion = build_as::<f32>(spec, &mut fresh).expect("the specification is sound");
            let q = [0.25, 0.8].map(|t| At { p: &p, of: Space::Gaussians, rows: Rows::All, t: Time(t) });
            let (mut cache, mut d_cache, mut d) = (Cache::default(), Cache::default(), Grads::new(&p));
            motion.prepare(&p, &q, &mut cache);
            let mut bits: Vec<u32> = Vec::new();
            for q in &q {
                let mut tape = Tape::default();
                motion.at(q, &cache, &mut tape);
                bits.extend(tape.out.data().iter().map(|x| x.to_bits()));
                d.activate(q.of, q.rows);
                let d_out = tape.out.clone();
                let d_out = SplatGrads { out: &d_out, color: None, weights: None };
                motion.backward(q, &cache, &mut tape, &d_out, &mut d_cache, &mut d);
            }
            motion.finish(&p, &q, &mut cache, &mut d_cache, &mut d);
            for key in p.keys() {
                bits.extend(d.table(key).data().iter().map(|x| x.to_bits()));
            }
            bits
        })
    };
    assert!(run(1) == run(4), "the bits depend on the number of threads");
}

/// A filter around the model: switched off it changes nothing; switched on, a step along a random direction of all
/// learnable numbers changes the results as the gradient states.
pub(crate) fn filtered(spec: &Spec, rows: usize, life: LifeKind, spaces: &[Space], frozen: &[&str]) {
    let plain = subject(spec, rows, life, 0.1, 1);
    let around = |fusion: Fusion| {
        let mut p = plain.p.clone();
        // The clip begins so early that every query has a past.
        let own = FilteredSpec::around(spec.clone(), 0.05, -1.0);
        let own = FilteredSpec { fusion, stop_gradient: false, ..own };
        let motion = Arc::new(Filtered::around(plain.motion.clone(), own, &mut p).expect("settings are sound"));
        Subject { p, motion }
    };
    let ids: Vec<u32> = (0..rows as u32).filter(|r| r % 3 != 1).collect();
    let w = Weights(Rng::new(78, "weights", 0));
    let off = around(Fusion::Off);
    let (a, b) = (plain.gradient(spaces, &ids, &TIMES, &w), off.gradient(spaces, &ids, &TIMES, &w));
    assert_eq!(a.1, b.1, "dL/dt");
    for key in plain.p.keys() {
        assert!(a.0.table(key).data() == b.0.table(key).data(), "gradient to {}", plain.p.info(key).name);
    }
    assert_eq!(plain.value(spaces, &ids, &TIMES, &w), off.value(spaces, &ids, &TIMES, &w));
    let q = |s| At { p: s, of: Space::Gaussians, rows: Rows::All, t: Time(0.4) };
    let (mut x, mut y) = (Table::default(), Table::default());
    plain.motion.velocity(&q(&plain.p), &mut x);
    off.motion.velocity(&q(&off.p), &mut y);
    assert_eq!(x, y, "velocities");

    let on = around(Fusion::Geodesic);
    let (d, _) = on.gradient(spaces, &ids, &TIMES, &w);
    let rng = Rng::new(79, "direction", 0);
    let mut slope = 0.0;
    let mut sides = [H, -H].map(|h| (h, Subject { p: on.p.clone(), motion: on.motion.clone() }));
    for key in on.p.keys().filter(|&k| on.p.info(k).trainable && k != SH && k != LIFE) {
        for row in 0..on.p[key].rows() {
            for col in (0..on.p[key].width()).filter(|&c| !frozen.contains(&on.p.column_name(key, c))) {
                let x = rng.fork(u64::from(key.0)).normal((row * on.p[key].width() + col) as u64);
                slope += x * d.table(key).get(row, col);
                for (h, side) in &mut sides {
                    *side.p[key].get_mut(row, col) += *h * x;
                }
            }
        }
    }
    let [up, down] = sides.map(|(_, s)| s.value(spaces, &ids, &TIMES, &w));
    let fd = (up - down) / (2.0 * H);
    assert!((fd - slope).abs() <= 1e-4 * fd.abs() + 1e-5, "through a filter: differences {fd}, gradient {slope}");
}

/// All of the above for one model.
pub(crate) fn model(spec: &Spec, rows: usize, life: LifeKind, spaces: &[Space], frozen: &[&str]) {
    subject(spec, rows, life, 0.1, 1).gradients(spaces, frozen);
    subject(spec, rows, life, 0.1, 2).compact();
    subject(spec, rows, life, 0.1, 2).random_access();
    subject(spec, rows, life, 0.1, 2).row_edits();
    files(spec, rows, life);
    super::frame::framed(spec, rows, life, frozen);
    capabilities(spec, rows, life);
    any_threads(spec, 200);
    if !matches!(spec, Spec::Filtered(_)) {
        filtered(spec, rows, life, spaces, frozen);
    }
}
