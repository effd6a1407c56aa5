use super::*;
use crate::nodes::observe;
use splat4d::layers::{Evaluation, Layer};
use splat4d::math::{Rng, Se3};
use splat4d::motion::{SpacetimeSpec, Spec, build};
use splat4d::render::{Image, RenderConfig, Renderer, Shot};
use splat4d::scene::{Camera, GEOMETRY, LifeKind, Params, SH, Time};
use splat4d_train::capture::frames::Picture;

const FPS: f64 = 10.0;
const SIZE: usize = 48;

/// A striped body that drifts to the right.
fn scene() -> Scene<f32> {
    const ROWS: usize = 120;
    let mut params = Params::new(ROWS, 1, LifeKind::Infinite.columns());
    let motion = build(&Spec::Spacetime(SpacetimeSpec::default()), &mut params).unwrap();
    let key = params.find("velocities").unwrap();
    for row in 0..ROWS {
        let rng = Rng::new(2, "rows", row as u64);
        let x: [f32; 3] = std::array::from_fn(|c| (rng.uniform(c as u64) - 0.5) as f32);
        params[GEOMETRY].write(row, 0, [x[0], x[1], x[2], 1.0, 0.0, 0.0, 0.0, -2.5, -2.5, -2.5, 3.0]);
        (0..3).for_each(|c| params[SH].set(row, c, if row % 3 == c { 1.5 } else { -1.0 }));
        params[key].set(row, 0, 0.4);
    }
    let layer = Layer::new("body", params, motion, LifeKind::Infinite);
    Scene { layers: vec![layer], clip: [0.0, 0.9], fps: FPS, ..Scene::default() }
}

fn cameras() -> Vec<Camera> {
    let at = |eye| Camera::with_fov_y(Se3::look_at(eye, [0.4, 0.0, 0.0], [0.0, 1.0, 0.0]), 0.7, SIZE, SIZE);
    [[0.4, 0.3, -4.0], [3.5, 0.3, -2.0], [-3.0, 0.5, -2.0]].map(at).to_vec()
}

/// Images of a scene, labelled with another time.
struct ShiftedImages {
    cameras: Vec<Camera>,
    pictures: Vec<splat4d::scene::Planes<f32>>,
    time: f64,
}

impl Frames for ShiftedImages {
    fn len(&self) -> usize {
        self.cameras.len()
    }
    fn camera(&self, i: usize) -> &Camera {
        &self.cameras[i]
    }
    fn time(&self, _: usize) -> Time {
        Time(self.time)
    }
    fn rig(&self, i: usize) -> usize {
        i
    }
    fn name(&self, i: usize) -> String {
        format!("camera {i}")
    }
    fn load(&self, i: usize, out: &mut Picture) -> Result<()> {
        *out = Picture { color: self.pictures[i].clone(), ..Picture::default() };
        Ok(())
    }
}

#[test]
fn a_wrong_forecast_is_corrected_by_images() {
    let scene = scene();
    let ticks: Vec<f64> = (0..10).map(|i| f64::from(i) / FPS).collect();
    let observed = observe(&scene, &ticks, 8).unwrap();
    let clock = Clock { until: 0.9, fps: FPS };
    let mut filter = Filter::new(&scene, &observed, clock);
    // The truth one frame on: the drift; the forecast lags by three frames and has sunk.
    let moved =
        |way: [f64; 3]| -> Moment { observed.paths.last().iter().map(|p| Pose { x: add(p.x, way), q: p.q }).collect() };
    let (truth, forecast) = (moved([0.04, 0.0, 0.0]), moved([-0.08, -0.06, 0.0]));
    let mut instant = Evaluation::default();
    scene.at(Time(1.0), &mut instant);
    let splats = scene.splats(&instant);
    let mut renderer = Renderer::new(RenderConfig::default());
    let mut image = Image::default();
    let cameras = cameras();
    let pictures = cameras.iter().map(|camera| {
        renderer.render(&Shot::new(&splats, camera, scene.background), &mut image);
        image.color.clone()
    });
    let pictures = pictures.collect();
    let seen = ShiftedImages { pictures, cameras, time: filter.time() };
    let sure = vec![0.0; 8];
    let unsure = vec![observed.size.powi(2); 8];
    let error = |m: &Moment| m.iter().zip(&truth).map(|(a, b)| norm(sub(a.x, b.x))).sum::<f64>() / 8.0;
    let seen = Arc::new(seen);
    let draw = || Box::new(Renderer::new(RenderConfig::default()));
    let corrected = filter.update(&forecast, &unsure, seen.clone(), draw()).unwrap();
    assert!(error(&corrected) < 0.5 * error(&forecast), "{} of {}", error(&corrected), error(&forecast));
    // Who is sure of a forecast believes images less.
    let doubted = Filter::new(&scene, &observed, clock).update(&forecast, &sure, seen, draw()).unwrap();
    assert!(error(&doubted) > error(&corrected) && error(&doubted) < error(&forecast));
}
