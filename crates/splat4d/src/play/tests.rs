use super::*;
use crate::format::playback::{Draft, Node, Primitive, WriteConfig, read, write};
use crate::layers::Evaluation;
use crate::math::Rng;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// Seconds of the clip.
const CLIP: f64 = 8.0;

fn primitive(rng: &Rng, center: f64, half_width: f64) -> Primitive {
    let f = |k: u64| rng.uniform(k) as f32;
    Primitive {
        mean: std::array::from_fn(|k| 2.0 * rng.uniform(k as u64) - 1.0),
        center,
        half_width,
        softness: 0.05,
        quat: [1.0, f(4), f(5), f(6)],
        scales: [0.1 + 0.1 * f(7), 0.1, 0.1],
        opacity: 0.2 + 0.7 * f(8),
        velocity: [f(9) - 0.5, f(10) - 0.5, 0.0],
        turn: [0.0, f(11), 0.0],
        base_color: [f(12), f(13), f(14)],
        sh_rest: std::array::from_fn(|k| 0.1 * (f(20 + k as u64) - 0.5)),
        importance: f(15),
        label: None,
        features: Vec::new(),
    }
}

/// A root that has an infinite lifespan and a node a second.
fn take() -> Vec<u8> {
    let rng = Rng::new(3, "play", 0);
    let mut nodes = vec![Node { from: 0.0, to: CLIP + 0.1, primitives: Vec::new() }];
    nodes[0].primitives.extend((0..600).map(|i| primitive(&rng.fork(i), 4.0, f64::INFINITY)));
    for s in 0..CLIP as u64 {
        let end = if s + 1 == CLIP as u64 { CLIP + 0.1 } else { (s + 1) as f64 };
        let own = (0..400).map(|i| primitive(&rng.fork(1000 * (s + 1) + i), s as f64 + 0.5, 0.3));
        nodes.push(Node { from: s as f64, to: end, primitives: own.collect() });
    }
    let mut draft = Draft { nodes, ..Draft::default() };
    (draft.meta.clip, draft.meta.fps, draft.meta.up, draft.meta.sh_degree) = ([0.0, CLIP], 10.0, [0.0, 1.0, 0.0], 2);
    let mut file = Vec::new();
    write(&draft, &WriteConfig::default(), &mut file).unwrap();
    file
}

/// All numbers of some splats, part by part.
fn numbers(splats: &Splats<'_>) -> Vec<f32> {
    let row = |p: &crate::scene::Part<'_>, j| p.out.read::<10>(j, 0);
    splats.parts.iter().flat_map(|p| (0..p.out.rows()).flat_map(move |j| row(p, j))).collect()
}

struct Counted(Vec<u8>, Arc<AtomicU64>);

impl ReadAt for Counted {
    fn read_at(&mut self, offset: u64, out: &mut [u8]) -> Result<()> {
        self.1.fetch_add(out.len() as u64, Ordering::Relaxed);
        (&self.0[..]).read_at(offset, out)
    }
}

#[test]
fn a_player_shows_exactly_the_scene() {
    let file = take();
    let scene = read(&file).unwrap();
    let mut whole = Player::of_scene(&scene);
    let length = file.len() as u64;
    let mut streamed = Player::open(Box::new(Counted(file, Arc::default())), length, 1).unwrap();
    let mut instant = Evaluation::default();
    let mut shown = 0;
    for t in [0.0, 0.999, 1.0, 5.5, 5.99, 2.2, CLIP, 0.1] {
        scene.at(Time(t), &mut instant);
        let truth = numbers(&scene.splats(&instant));
        assert_eq!(10 * whole.alive(Time(t)), truth.len(), "looked up at {t}");
        assert_eq!(numbers(&whole.at(Time(t)).unwrap()), truth, "in memory at {t}");
        assert_eq!(numbers(&streamed.at(Time(t)).unwrap()), truth, "from the file at {t}");
        shown += truth.len();
    }
    assert!(shown > 50_000, "the test must look at something: {shown}");
}

#[test]
fn a_layer_with_infinite_lifespans_is_shown_whole() {
    let mut params = crate::scene::Params::new(3, 1, &[]);
    let motion = crate::motion::build(&crate::motion::Spec::Still, &mut params).unwrap();
    // A model may raise an opacity whose raw value is nearly zero: the lookup must not judge by it.
    params[crate::scene::GEOMETRY].set(1, crate::scene::params::OPACITY, -20.0);
    let life = crate::scene::LifeKind::Infinite;
    for span in [ALWAYS, [0.5, 2.0]] {
        let layer = Layer { span, ..Layer::new("a", params.clone(), motion.clone(), life) };
        let scene = Scene { layers: vec![layer], clip: [0.0, 1.0], ..Scene::default() };
        let mut player = Player::of_scene(&scene);
        assert_eq!(player.at(Time(0.7)).unwrap().len(), 3);
        assert_eq!(player.at(Time(0.2)).unwrap().len(), if span == ALWAYS { 3 } else { 0 });
    }
}

#[test]
fn time_is_clamped_to_the_clip_of_a_file() {
    let scene = read(&take()).unwrap();
    let mut player = Player::of_scene(&scene);
    let end = numbers(&player.at(Time(CLIP)).unwrap());
    assert_eq!(numbers(&player.at(Time(1e6)).unwrap()), end);
    assert!(!end.is_empty());
}

#[test]
fn memory_and_bytes_read_are_bounded() {
    let file = take();
    let (length, read) = (file.len() as u64, Arc::new(AtomicU64::new(0)));
    let mut player = Player::open(Box::new(Counted(file, read.clone())), length, 1).unwrap();
    player.at(Time(0.5)).unwrap();
    let first = read.load(Ordering::Relaxed);
    assert_eq!(first, player.bytes_read());
    assert!(first < length / 2, "a first picture needs its own pages only: {first} of {length}");
    let held = player.held_bytes();
    for s in 0..CLIP as usize {
        player.at(Time(s as f64 + 0.5)).unwrap();
        assert!(player.held_bytes() <= held * 11 / 10, "only this moment's pages are held");
    }
    let played = read.load(Ordering::Relaxed);
    player.at(Time(7.6)).unwrap();
    assert_eq!(read.load(Ordering::Relaxed), played, "what is held is not read again");
}

#[test]
fn a_truncated_file_plays_to_its_end_and_reports_it() {
    let mut file = take();
    file.truncate(file.len() - 300);
    let length = file.len() as u64;
    let mut player = Player::open(Box::new(Counted(file, Arc::default())), length, DEFAULT_BUDGET).unwrap();
    assert!(!numbers(&player.at(Time(0.5)).unwrap()).is_empty());
    let error = player.at(Time(CLIP)).unwrap_err().to_string();
    assert!(error.contains("cut short"), "{error}");
    assert!(!numbers(&player.at(Time(0.5)).unwrap()).is_empty(), "what was read can still be played");
    for cut in [0, 7, 63, 64, 200] {
        let part = take()[..cut].to_vec();
        assert!(Player::open(Box::new(Counted(part, Arc::default())), cut as u64, 1).is_err(), "{cut} bytes");
    }
}
