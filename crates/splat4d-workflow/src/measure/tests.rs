use super::*;
use splat4d::layers::Layer;
use splat4d::math::{Rng, Se3};
use splat4d::motion::Still;
use splat4d::scene::params::{LOG_SCALE, OPACITY, QUAT};
use splat4d::scene::{GEOMETRY, LIFE, LifeKind, Params};

/// Gaussians of which each lives through one half of a second, in front of the cameras.
fn small(rows: usize) -> Scene<f32> {
    let life = LifeKind::Interval;
    let mut params = Params::new(rows, 1, life.columns());
    let rng = Rng::new(7, "measure", 0);
    for i in 0..rows {
        let r = rng.fork(i as u64);
        let [geometry, lives] = params.get_mut([GEOMETRY, LIFE]);
        geometry.write(i, 0, std::array::from_fn::<f32, 3, _>(|k| r.uniform(k as u64) as f32 - 0.5));
        geometry.write(i, QUAT, [1.0, 0.0, 0.0, 0.0]);
        geometry.write(i, LOG_SCALE, [-2.5; 3]);
        geometry.write(i, OPACITY, [1.0]);
        // Centre, log half width and log softness: hard edges, the first half or the second.
        lives.write(i, 0, [0.25 + 0.5 * (i % 2) as f32, 0.2f32.ln(), 1e-3f32.ln()]);
    }
    let layer = Layer::new("x", params, Arc::new(Still), life);
    Scene { layers: vec![layer], clip: [0.0, 1.0], fps: 10.0, up: [0.0, 1.0, 0.0], ..Scene::default() }
}

fn views(count: usize) -> Vec<View> {
    let view = |i: usize| {
        let a = i as f64;
        let pose = Se3::look_at([3.0 * a.sin(), 0.0, -3.0 * a.cos()], [0.0; 3], [0.0, 1.0, 0.0]);
        View { camera: Camera::with_fov_y(pose, 0.6, 64, 48), name: format!("cam{i}"), time: 0.0, held: false }
    };
    (0..count).flat_map(|i| [view(i), view(i)]).collect()
}

#[test]
fn a_scene_and_the_file_of_it_are_measured_alike() {
    let scene = small(400);
    let baked = splat4d::bake::bake(&scene, &splat4d::bake::Options::default(), &mut |_, _| ()).unwrap();
    let meta = playback::Meta { clip: baked.clip, fps: scene.fps, up: scene.up, ..playback::Meta::default() };
    let draft = playback::Draft { meta, nodes: baked.nodes, poster: None };
    let mut bytes = Vec::new();
    playback::write(&draft, &playback::WriteConfig::default(), &mut bytes).unwrap();
    let length = bytes.len() as u64;
    let measured_views = measured_views(&views(5), scene.clip, [40, 40]);
    let subject = |what| Subject { what, antialias: Antialias::Off };
    let subjects = [subject(What::Scene(&scene)), subject(What::File(bytes.into()))];
    let mut heard = Vec::new();
    let sides = in_turns(&subjects, &measured_views, &mut |done, total| heard.push((done, total))).unwrap();
    assert!(heard.windows(2).all(|w| w[0].0 + 1 == w[1].0) && heard.last().is_some_and(|(d, t)| d == t), "{heard:?}");
    let [scene_side, file] = &sides[..] else { panic!("two sides") };
    assert_eq!((scene_side.gaussians, file.bytes), (400, length));
    assert_eq!(scene_side.float_bytes, 4 * 400 * (11 + 3 + 3));
    assert!(scene_side.bytes > scene_side.float_bytes && file.bytes < scene_side.bytes, "{sides:?}");
    assert!((file.mbit_per_s.unwrap() - 8e-6 * length as f64).abs() < 1e-12);
    // Of eleven frames, 0.1 to 0.4 s show one half and 0.6 to 0.9 s the other.
    let alive = 200.0 * 8.0 / 11.0;
    for side in &sides {
        assert!((side.active_mean / alive - 1.0).abs() < 0.05 && side.active_max == 200, "half live: {side:?}");
        assert!(side.fps > 0.0 && side.raster_fps > side.fps && side.decode_ms > 0.0 && side.pairs > 100.0, "{side:?}");
    }
    // Both render the same image, so the blend loop has about the same work.
    assert!((scene_side.pairs / file.pairs - 1.0).abs() < 0.1, "{sides:?}");
    let text = serde_json::to_string(&sides).unwrap();
    assert_eq!(serde_json::from_str::<Vec<Side>>(&text).unwrap().len(), 2);
    assert!(in_turns(&[subject(What::File(Arc::from(*b"SPL4D")))], &measured_views, &mut |_, _| ()).is_err());
}

#[test]
fn sampled_views_cover_the_rig_and_the_clip() {
    for cameras in [1, 2, 3, 20, 23, 100] {
        let all = measured_views(&views(cameras), [1.0, 3.0], [80, 40]);
        assert!(all.windows(2).all(|w| w[0].time.0 < w[1].time.0));
        assert!(all[0].time.0 > 1.0 && all[VIEWS - 1].time.0 < 3.0);
        let places: BTreeSet<[u64; 3]> = all.iter().map(|l| l.camera.center().map(f64::to_bits)).collect();
        assert_eq!(places.len(), cameras.min(VIEWS), "all cameras take part");
        // 48 rows at 0.6 rad became 40 at 0.6 rad.
        let fov = 2.0 * (20.0 / all[0].camera.intrinsics.fy).atan();
        assert!((fov - 0.6).abs() < 1e-12 && (all[0].camera.width, all[0].camera.height) == (80, 40));
    }
}

#[test]
fn frames_are_those_of_the_clip() {
    let times: Vec<f64> = frames([0.0, 1.0], 4.0).into_iter().map(|t| t.0).collect();
    assert_eq!(times, [0.0, 0.25, 0.5, 0.75, 1.0]);
    assert_eq!(frames([2.0, 2.0], 30.0).len(), 1);
    assert_eq!(frames([0.0, 1e9], f64::NAN).len(), COUNTED);
}
