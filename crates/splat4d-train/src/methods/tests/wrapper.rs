//! A wrapper around any model forwards every method of the contract: wrapping changes no output and no gradient.

use super::*;
use scan::scan_scene;
use splat4d::motion::{At, Cache, Capabilities, Phase, Polynomial, Tape};
use splat4d::scene::{Born, Color, RowEdit, Rows, SplatGrads};

/// Does nothing to what it holds. An omitted method would silently lose gradients.
struct Wrapped<F: Real>(Arc<dyn Motion<F>>);

impl<F: Real> Motion<F> for Wrapped<F> {
    fn spec(&self) -> Spec {
        self.0.spec()
    }

    fn scratch_bytes(&self, p: &Params<F>, rows: usize) -> u64 {
        self.0.scratch_bytes(p, rows)
    }

    fn with_phase(&self, phase: &Phase) -> Option<Arc<dyn Motion<F>>> {
        Some(Arc::new(Wrapped(self.0.with_phase(phase)?)))
    }

    fn capabilities(&self) -> Capabilities {
        self.0.capabilities()
    }

    fn polynomial(&self) -> Option<Polynomial> {
        self.0.polynomial()
    }

    fn prepare(&self, p: &Params<F>, q: &[At<'_, F>], cache: &mut Cache) {
        self.0.prepare(p, q, cache);
    }

    fn at(&self, q: &At<'_, F>, cache: &Cache, tape: &mut Tape<F>) {
        self.0.at(q, cache, tape);
    }

    fn color<'a>(&self, q: &At<'a, F>, tape: &'a Tape<F>) -> Color<'a, F> {
        self.0.color(q, tape)
    }

    fn backward(
        &self,
        q: &At<'_, F>,
        cache: &Cache,
        tape: &mut Tape<F>,
        d_out: &SplatGrads<'_, F>,
        d_cache: &mut Cache,
        d: &mut Grads<F>,
    ) -> f64 {
        self.0.backward(q, cache, tape, d_out, d_cache, d)
    }

    fn finish(&self, p: &Params<F>, q: &[At<'_, F>], cache: &mut Cache, d_cache: &mut Cache, d: &mut Grads<F>) {
        self.0.finish(p, q, cache, d_cache, d);
    }

    fn on_edit(&self, p: &mut Params<F>, edit: &RowEdit, rng: &Rng) {
        self.0.on_edit(p, edit, rng);
    }

    fn resize(&self, p: &mut Params<F>, row: usize, factor: f64) {
        self.0.resize(p, row, factor);
    }

    fn life(&self, p: &Params<F>, out: &mut Table<F>) -> bool {
        self.0.life(p, out)
    }

    fn velocity(&self, q: &At<'_, F>, out: &mut Table<F>) {
        self.0.velocity(q, out);
    }
}

/// Colours of its own, [N, 3], that depend on time, and a lifespan of its own: what no other synthetic model has.
#[derive(Clone, Copy)]
struct Glow {
    color: Key,
}

impl Glow {
    fn new<F: Real>(p: &mut Params<F>) -> Self {
        let rows = p.len();
        Self { color: p.entry("glow", Space::Gaussians, &[("glow", 3)], rows, |_| {}).unwrap() }
    }
}

/// Seconds of a glow's life.
const GLOW_SECONDS: f64 = 0.4;

impl<F: Real> Motion<F> for Glow {
    fn spec(&self) -> Spec {
        Spec::Custom("glow".into())
    }

    fn scratch_bytes(&self, _p: &Params<F>, _rows: usize) -> u64 {
        0
    }

    fn at(&self, q: &At<'_, F>, cache: &Cache, tape: &mut Tape<F>) {
        splat4d::motion::Still.at(q, cache, tape);
        let mut table = Table::new(&[("color", 3)], q.len());
        for j in 0..q.len() {
            let glow = q.p[self.color].read::<3>(q.rows.id(j), 0);
            table.write(j, 0, glow.map(|x| x * F::of(1.0 + q.t.0)));
        }
        *tape.own.get_or_default::<Table<F>>() = table;
    }

    fn color<'a>(&self, _: &At<'a, F>, tape: &'a Tape<F>) -> Color<'a, F> {
        Color::Direct { table: tape.own.get::<Table<F>>().expect("`at` came first") }
    }

    fn backward(
        &self,
        q: &At<'_, F>,
        cache: &Cache,
        tape: &mut Tape<F>,
        d_out: &SplatGrads<'_, F>,
        d_cache: &mut Cache,
        d: &mut Grads<F>,
    ) -> f64 {
        let mut d_time = splat4d::motion::Still.backward(q, cache, tape, d_out, d_cache, d);
        let Some(d_color) = d_out.color else { return d_time };
        for j in 0..q.len() {
            let (id, g) = (q.rows.id(j), d_color.read::<3>(j, 0));
            d.of([self.color])[0].add(id, 0, g.map(|x| x * F::of(1.0 + q.t.0)));
            d_time += (0..3).map(|k| (g[k] * q.p[self.color].get(id, k)).f64()).sum::<f64>();
        }
        d_time
    }

    fn life(&self, p: &Params<F>, out: &mut Table<F>) -> bool {
        out.resize(p.len());
        // Every other Gaussian has died before the clip.
        for r in 0..p.len() {
            let center = if r % 2 == 0 { 0.1 } else { -10.0 };
            out.write(r, 0, [F::of(center), F::of(f64::ln(GLOW_SECONDS))]);
        }
        true
    }

    fn velocity(&self, q: &At<'_, F>, out: &mut Table<F>) {
        *out = Table::new(&[("velocity", 3)], q.len());
        out.fill(F::of(0.25));
    }
}

fn glow_scene<F: Real>() -> Scene<F> {
    let mut p = cloud::<F>(8, LifeKind::Infinite, 5);
    let model = Glow::new(&mut p);
    p[model.color].fill(F::of(0.4));
    shake(&mut p, model.color, 0.1, 1);
    one_layer(p, Arc::new(model), LifeKind::Infinite)
}

fn built(spec: &Spec, life: LifeKind) -> Scene<f64> {
    let mut p = cloud::<f64>(8, life, 9);
    let motion = build_as(spec, &mut p).unwrap();
    for key in p.keys().skip(3).collect::<Vec<_>>() {
        shake(&mut p, key, 0.2, 1);
    }
    one_layer(p, motion, life)
}

#[test]
fn wrapping_changes_neither_output_nor_gradient() {
    let spacetime = Spec::Spacetime(SpacetimeSpec { order: 2, rotation: true, ..SpacetimeSpec::default() });
    let scenes: Vec<Scene<f64>> = vec![
        built(&Spec::Still, LifeKind::Infinite),
        built(&Spec::Still, LifeKind::GaussHalf),
        built(&spacetime, LifeKind::GaussHalf),
        scan_scene(8),
        lobes::lobes_scene(8).0,
        nodes::skinned_scene(3).0,
        glow_scene(),
    ];
    let shots = shots(&[(0, 0.03), (1, 0.12), (2, 0.12)]);
    for scene in scenes {
        let mut wrapped = scene.clone();
        wrapped.layers[0].motion = Arc::new(Wrapped(scene.layers[0].motion.clone()));
        let name = format!("{:?}", scene.layers[0]);
        let mut draws = [Renderer::new(smooth()), Renderer::new(smooth())];
        let (a, d_a, calls_a) = step(&scene, &shots, &Vec::new(), &mut draws[0]);
        let (b, d_b, calls_b) = step(&wrapped, &shots, &Vec::new(), &mut draws[1]);
        assert_eq!((a.loss, &a.d_times, &a.d_cameras, calls_a), (b.loss, &b.d_times, &b.d_cameras, calls_b), "{name}");
        assert_eq!(d_a, d_b, "{name}");
        assert!(d_a[0].table(GEOMETRY).data().iter().any(|x| *x != 0.0), "{name}: something is learnt");
        let q = At { p: &scene.layers[0].params, of: Space::Gaussians, rows: Rows::All, t: Time(0.05) };
        let (mut v, mut w) = (Table::default(), Table::default());
        scene.layers[0].motion.velocity(&q, &mut v);
        wrapped.layers[0].motion.velocity(&q, &mut w);
        assert_eq!(v, w, "{name}");
        assert_eq!(scene.layers[0].spans(), wrapped.layers[0].spans(), "{name}");
        let (mut x, mut y) = (scene.layers[0].clone(), wrapped.layers[0].clone());
        let mut edit = RowEdit::identity(Space::Gaussians, x.params.len());
        edit.born[1] = Born::Split;
        edit.push(1, Born::Split);
        for layer in [&mut x, &mut y] {
            layer.edit(&edit, &Rng::new(3, "edit", 0));
            layer.resize(2, 0.7);
        }
        assert_eq!(x.params, y.params, "{name}");
    }
}

#[test]
fn direct_colours_and_own_lifespans_have_gradients() {
    let shots = shots(&[(0, 0.05), (1, 0.1)]);
    let reached = check_gradients(&glow_scene(), &shots, &Vec::new());
    assert_reached(&reached[0], &["geometry", "glow"]);
}
