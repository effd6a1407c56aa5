use super::*;
use crate::scene::{Space, Time};

fn spec() -> HexplaneSpec {
    HexplaneSpec {
        planes: PlaneShape { channels: 16, resolution: 4, time_resolution: 4, multires: vec![1, 2] },
        net_width: 8,
        clip: [2.0, 4.0],
        ..HexplaneSpec::default()
    }
}

/// A cloud whose own tables are all moved at random.
fn cloud<F: Real>(spec: HexplaneSpec, rows: usize) -> (Params<F>, Hexplane) {
    let mut p = Params::<F>::new(rows, 4, &[]);
    let rng = Rng::new(6, "cloud", 0);
    for row in 0..rows {
        let draw = |c: usize| F::of(0.6 * rng.fork(row as u64).normal(c as u64));
        p[GEOMETRY].write::<11>(row, 0, std::array::from_fn(draw));
    }
    let model = Hexplane::new(spec, &mut p).unwrap();
    for key in p.keys().skip(3).collect::<Vec<_>>() {
        for i in 0..p[key].rows() {
            *p[key].get_mut(i, 0) += F::of(0.2 * rng.fork(1000 + u64::from(key.0)).normal(i as u64));
        }
    }
    (p, model)
}

fn splats<F: Real>(p: &Params<F>, model: &dyn Motion<F>, t: f64) -> Table<F> {
    let q = At { p, of: Space::Gaussians, rows: Rows::All, t: Time(t) };
    let mut tape = Tape::default();
    model.at(&q, &Cache::default(), &mut tape);
    tape.out
}

fn gradient<F: Real>(p: &Params<F>, model: &dyn Motion<F>, t: f64) -> Grads<F> {
    let q = At { p, of: Space::Gaussians, rows: Rows::All, t: Time(t) };
    let (mut tape, mut d) = (Tape::default(), Grads::new(p));
    model.at(&q, &Cache::default(), &mut tape);
    let d_out = tape.out.clone();
    let d_out = SplatGrads { out: &d_out, color: None, weights: None };
    model.backward(&q, &Cache::default(), &mut tape, &d_out, &mut Cache::default(), &mut d);
    d
}

#[test]
fn time_outside_the_clip_is_its_end_and_within_it_things_move() {
    let (p, model) = cloud::<f64>(spec(), 20);
    assert_eq!(splats(&p, &model, 1.0), splats(&p, &model, 2.0));
    assert_eq!(splats(&p, &model, 1e300), splats(&p, &model, 4.0));
    assert_ne!(splats(&p, &model, 2.1), splats(&p, &model, 2.0));
}

#[test]
fn the_coarse_stage_is_static_and_trains_no_plane() {
    let (p, model) = cloud::<f64>(spec(), 20);
    let phase = Phase { rests: true, ..Phase::default() };
    let resting = Motion::<f64>::with_phase(&model, &phase).expect("the model has phases");
    assert!(matches!(resting.spec(), Spec::Hexplane(s) if s.coarse));
    let resting: &dyn std::any::Any = resting.as_ref();
    let coarse = resting.downcast_ref::<Hexplane>().expect("a phase keeps the model");
    assert_eq!(splats(&p, coarse, 3.0), splats(&p, &Still, 3.0));
    let d = gradient(&p, coarse, 3.0);
    assert!(d.touched(GEOMETRY) && p.keys().skip(1).all(|k| !d.touched(k)));
    assert_ne!(splats(&p, &model, 3.0), splats(&p, &Still, 3.0));
}

/// A finished scene's file does not state phases; earlier files always stated both numbers.
#[test]
fn files_hold_a_phase_only_while_training_is_not_over() {
    let (_, model) = cloud::<f64>(spec(), 20);
    let whole = serde_json::to_value(Motion::<f64>::spec(&model)).unwrap();
    assert!(whole.get("unlocked").is_none() && whole.get("coarse").is_none(), "{whole}");
    let phase = Phase { rests: false, levels: Some(1) };
    let half = Motion::<f64>::with_phase(&model, &phase).expect("the model has phases").spec();
    let mut old = whole.clone();
    (old["unlocked"], old["coarse"]) = (1.into(), false.into());
    assert_eq!(serde_json::from_value::<Spec>(old).unwrap(), half);
    let json = serde_json::to_value(&half).unwrap();
    assert_eq!((&json["unlocked"], serde_json::from_value::<Spec>(json.clone()).unwrap()), (&1.into(), half));
}

#[test]
fn every_head_can_be_left_out() {
    for mask in 0..32 {
        let on = |bit: usize| mask >> bit & 1 == 1;
        let heads = Heads { position: on(0), scale: on(1), rotation: on(2), opacity: on(3), sh: on(4) };
        let (p, model) = cloud::<f64>(HexplaneSpec { heads, ..spec() }, 20);
        let (a, b) = (splats(&p, &model, 3.0), splats(&p, &Still, 3.0));
        let changed = |from: usize, to: usize| (0..20).any(|r| (from..to).any(|c| a.get(r, c) != b.get(r, c)));
        assert_eq!(changed(0, 3), heads.position);
        assert_eq!(changed(3, 9), heads.scale || heads.rotation);
        assert_eq!(changed(9, 10), heads.opacity);
        let q = At { p: &p, of: Space::Gaussians, rows: Rows::All, t: Time(3.0) };
        let mut tape = Tape::default();
        model.at(&q, &Cache::default(), &mut tape);
        assert!(matches!(Motion::<f64>::color(&model, &q, &tape), Color::Sh { base, .. } if base != heads.sh));
        let d = gradient(&p, &model, 3.0);
        // A position moves the planes' look-ups, whatever the heads.
        assert!(d.table(GEOMETRY).first_non_finite().is_none());
    }
}

/// The splats depend on their positions as in the original: the planes cover the box.
#[test]
fn cloud_and_box_moved_together_deform_alike() {
    let (p, model) = cloud::<f64>(spec(), 30);
    let mut moved = p.clone();
    let shift = [3.0, -2.0, 0.5];
    let place = |x: f64, k: usize| 2.0 * x + shift[k];
    for row in 0..30 {
        let x = p[GEOMETRY].read::<3>(row, 0);
        moved[GEOMETRY].write::<3>(row, 0, [0, 1, 2].map(|k| place(x[k], k)));
    }
    let s = spec();
    let corner = |x: [f64; 3]| [0, 1, 2].map(|k| place(x[k], k));
    let other = model.with_box([corner(s.low), corner(s.high)]).unwrap();
    let (a, b) = (splats(&p, &model, 2.7), splats(&moved, &other, 2.7));
    for row in 0..30 {
        let (a, b) = (a.read::<10>(row, 0), b.read::<10>(row, 0));
        assert!((0..3).all(|k| (place(a[k], k) - b[k]).abs() < 1e-9), "row {row}: {a:?} {b:?}");
        assert!((3..10).all(|c| (a[c] - b[c]).abs() < 1e-9), "row {row}: {a:?} {b:?}");
    }
}

/// Chunks of rows and what is computed again for them give the same splats and gradients up to rounding.
#[test]
fn more_rows_than_are_kept_are_the_same_rows() {
    let rows = ROWS + 70;
    let (p, model) = cloud::<f32>(spec(), rows);
    let edit = crate::scene::RowEdit::prune(Space::Gaussians, (0..rows).map(|r| r >= ROWS - 10));
    let mut tail = p.clone();
    tail.apply(&edit);
    let (all, some) = (splats(&p, &model, 3.3), splats(&tail, &model, 3.3));
    for j in 0..80 {
        let (a, b) = (all.read::<10>(ROWS - 10 + j, 0), some.read::<10>(j, 0));
        // Matrix products round a row by where it is in its chunk.
        assert!((0..10).all(|c| (a[c] - b[c]).abs() <= 1e-5 * a[c].abs().max(1.0)), "{a:?} {b:?}");
    }
    let (all, some) = (gradient(&p, &model, 3.3), gradient(&tail, &model, 3.3));
    for j in 0..80 {
        let (a, b) = (all.table(GEOMETRY).read::<11>(ROWS - 10 + j, 0), some.table(GEOMETRY).read::<11>(j, 0));
        assert!((0..11).all(|c| (a[c] - b[c]).abs() <= 1e-5 * a[c].abs().max(1.0)), "{a:?} {b:?}");
    }
}

#[test]
fn hostile_specs_are_refused() {
    let refused = |spec: HexplaneSpec| Hexplane::new(spec, &mut Params::<f32>::new(3, 1, &[])).is_err();
    assert!(!refused(spec()));
    for bad in [
        HexplaneSpec { low: [f64::NAN; 3], ..spec() },
        HexplaneSpec { high: [-1.0; 3], ..spec() },
        HexplaneSpec { high: [f64::INFINITY; 3], ..spec() },
        HexplaneSpec { clip: [1.0, 0.0], ..spec() },
        HexplaneSpec { net_width: 0, ..spec() },
        HexplaneSpec { net_width: usize::MAX, ..spec() },
        HexplaneSpec { defor_depth: usize::MAX, ..spec() },
        HexplaneSpec { unlocked: Some(0), ..spec() },
        HexplaneSpec { unlocked: Some(3), ..spec() },
        HexplaneSpec {
            planes: PlaneShape { multires: vec![usize::MAX], ..spec().planes },
            unlocked: Some(1),
            ..spec()
        },
    ] {
        assert!(refused(bad.clone()), "{bad:?}");
    }
}
