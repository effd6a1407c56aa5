use super::*;
use crate::capture::PointCloud;
use crate::capture::frames::Frames;
use crate::init::sky::tests::{FAR, Film};
use crate::init::{self, FarShell, InitSettings, Seeds, Source};
use crate::maintenance::Limits;
use crate::methods::stages;
use crate::recipe::{MotionName, Recipe};
use crate::step::loss::TrainLoss;
use crate::step::trainer::{Settings, Trainer};
use splat4d::layers::{Evaluation, Scene};
use splat4d::math::se3::{norm, sub};
use splat4d::render::{Image, RenderConfig, Renderer, Shot};
use splat4d::scene::{Camera, Time};

const DISTANCE: f64 = 400.0;
const GREY: [f32; 3] = [0.5; 3];

fn recipe(words: &[&str]) -> Recipe {
    let base = ["motion=still", "init.shell=on", "iterations=60", "half_size_until=0", "sh_degree=0", "max_cap=4000"];
    Recipe::of(&[&base[..], words].concat()).unwrap().with(|r| {
        r.init.count = 2000;
        r.init.source = Source::Auto;
        r.run.motion = MotionName::of("still");
    })
}

fn plan(film: &Film, recipe: &Recipe) -> TrainContext {
    let (center, extent) = film.center_and_extent();
    let shell = recipe.init.shell_at();
    TrainContext {
        center,
        extent,
        clip: [0.0; 2],
        fps: 1.0,
        times: 1,
        fixed_cameras: film.len(),
        shell,
        ..recipe.plan()
    }
}

/// The first scene with the distance of a shell, extents; 0: without one.
fn scene(film: &Film, distance: f64) -> (TrainContext, Recipe, Seeds, Scene<f32>) {
    let recipe = recipe(&[&format!("init.shell_distance={distance}")]);
    let plan = plan(film, &recipe);
    let points = film.points();
    let (colors, times) = (vec![GREY; points.len()], vec![None; points.len()]);
    let cloud = PointCloud { points, colors, times, left_out: 0 };
    let program = recipe.program().unwrap();
    let seeds = init::seeds(&plan, &recipe.initial(), film, Some(Seeds::of(&cloud)), false).unwrap();
    let made = init::scene(&plan, &recipe.init, program.as_ref(), &seeds, GREY, [0.0, 1.0, 0.0]).unwrap();
    (plan, recipe, seeds, made)
}

fn render(scene: &Scene<f32>, camera: &Camera) -> Image {
    let (mut seen, mut image) = (Evaluation::default(), Image::default());
    scene.at(Time(0.0), &mut seen);
    Renderer::new(RenderConfig::default()).render(&Shot::new(&scene.splats(&seen), camera, GREY), &mut image);
    image
}

/// Mean alpha over the pixels of the dome, and root mean square error of their colours.
fn over_sky(film: &Film, scene: &Scene<f32>) -> [f64; 2] {
    let (mut sums, mut count) = ([0.0; 2], 0.0);
    for camera in (0..film.len()).map(|i| film.camera(i)) {
        let image = render(scene, camera);
        for p in 0..camera.width * camera.height {
            let pixel = [(p % camera.width) as f64 + 0.5, (p / camera.width) as f64 + 0.5];
            let (color, true) = film.at(camera, pixel) else { continue };
            sums[0] += f64::from(image.alpha.data[p]);
            let square = |c: usize| f64::from(image.color.plane(c)[p] - color[c]).powi(2);
            sums[1] += (0..3).map(square).sum::<f64>() / 3.0;
            count += 1.0;
        }
    }
    [sums[0] / count, (sums[1] / count).sqrt()]
}

#[test]
fn directions_are_even_over_the_sphere() {
    let all: Vec<[f64; 3]> = (0..500).map(|k| direction(k, 500)).collect();
    assert!(all.iter().all(|d| (norm(*d) - 1.0).abs() < 1e-12));
    let nearest = |i: usize| {
        let others = (0..500).filter(|&j| j != i).map(|j| norm(sub(all[i], all[j])));
        others.fold(f64::INFINITY, f64::min)
    };
    let spacing = (4.0 * PI / 500.0).sqrt();
    // At the poles the lattice is a little denser.
    assert!((2..498).map(nearest).all(|d| d > 0.7 * spacing && d < 1.2 * spacing));
}

#[test]
fn a_shell_covers_the_sky_at_its_distance_in_its_colours() {
    let film = Film::new(FAR);
    let shell = Shell::new(&film.sky_at(DISTANCE), 4000, 30_000);
    let (center, _) = film.center_and_extent();
    assert!(shell.points.iter().all(|&x| (norm(sub(x, center)) / DISTANCE - 1.0).abs() < 1e-9));
    assert!((2000..8000).contains(&shell.len()), "{}", shell.len());
    let plan = TrainContext::default();
    let scene = Scene { layers: vec![shell.layer(&plan)], background: GREY, fps: 1.0, ..Scene::default() };
    let [alpha, error] = over_sky(&film, &scene);
    assert!(alpha > 0.94 && error < 0.04, "alpha {alpha}, error {error}");
    let few = Shell::new(&film.sky_at(DISTANCE), 4000, 1200).len();
    assert!(few < 600, "{few} of at most a quarter of 1200, and those behind outlines");
}

#[test]
fn seeds_with_a_shell_leave_the_sky_free() {
    let film = Film::new(FAR);
    let (_, extent) = film.center_and_extent();
    let (_, _, seeds, made) = scene(&film, DISTANCE / extent);
    let names: Vec<&str> = made.layers.iter().map(|l| l.name.as_str()).collect();
    assert_eq!(names, ["scene", FAR_SHELL]);
    assert_eq!(made.layers[1].params.len(), seeds.shell.len());
    let before =
        |made: &Scene<f32>| over_sky(&film, &Scene { layers: vec![made.layers[0].clone()], ..made.clone() })[0];
    let (_, _, _, without) = scene(&film, 0.0);
    assert_eq!(without.layers.len(), 1);
    // 0.05 and 0.80: some are left next to the outline of the ball.
    assert!(before(&made) < 0.1 && before(&without) > 0.5, "{} {}", before(&made), before(&without));
}

#[test]
fn nothing_grows_before_the_sky_in_training() {
    let film = Arc::new(Film::new(FAR));
    let (_, extent) = film.center_and_extent();
    let (plan, recipe, _, made) = scene(&film, DISTANCE / extent);
    let program = recipe.program().unwrap();
    let settings = Settings {
        seed: 5,
        limits: Limits { cap: 4000, extent, min_opacity: 0.02 },
        background: GREY,
        sh_degree: 0,
        exposure_lr: 0.0,
    };
    let draw = Box::new(Renderer::new(RenderConfig::default()));
    let stages = stages(program.as_ref(), &plan);
    let positions: Vec<(usize, f64)> =
        stages[0].groups.iter().filter(|g| g.column == "means").map(|g| (g.layer, g.rate.start)).collect();
    assert_eq!(positions.iter().map(|p| p.0).collect::<Vec<_>>(), [0, 1]);
    assert!((positions[1].1 / positions[0].1 - DISTANCE / extent).abs() < 1e-9);
    let first = over_sky(&film, &made);
    let mut trainer = Trainer::new(made, stages, film.clone(), draw, TrainLoss::photometric(0.2), settings);
    while !trainer.is_done() {
        trainer.step().unwrap().expect("no fault");
    }
    let scene = trainer.scene();
    let last = over_sky(&film, scene);
    assert!(last[1] < 0.8 * first[1] && last[0] > 0.85, "{first:?} became {last:?}");
    let near = over_sky(&film, &Scene { layers: vec![scene.layers[0].clone()], ..scene.clone() })[0];
    assert!(near < 0.1, "{near}");
    let (center, _) = film.center_and_extent();
    assert!(scene.layers[1].means().all(|x| (0.5..2.0).contains(&(norm(sub(x, center)) / DISTANCE))));
}

#[test]
fn a_shell_needs_a_decision_and_a_distance() {
    let of = |shell, distance| InitSettings { shell, shell_distance: distance, ..InitSettings::default() }.shell_at();
    assert_eq!(of(FarShell::On, 30.0), Some(30.0));
    assert_eq!([of(FarShell::Auto, 30.0), of(FarShell::Off, 30.0), of(FarShell::On, 0.0)], [None; 3]);
}
