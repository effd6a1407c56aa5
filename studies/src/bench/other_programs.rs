//! The same training in other programs: a scene, its cameras and images as plain files, and next to them what each
//! program's losses
//! and times were. A time is compared only where the losses agree, because else it is of other work.

use super::rows::Row;
use super::scenes::{Pinned, View};
use super::stages::Way;
use super::training::{self, Held};
use serde::{Deserialize, Serialize};
use serde_json::json;
use splat4d::format::npy;
use splat4d::layers::{Layer, Scene, freeze};
use splat4d::motion::Still;
use splat4d::render::{Backend, RenderConfig};
use splat4d::scene::params::{LOG_SCALE, OPACITY, QUAT};
use splat4d::scene::{GEOMETRY, LifeKind, Planes, SH};
use splat4d::{Error, ErrorKind, Result};
use splat4d_train::capture::frames::Frames;
use splat4d_train::methods::{Group, Rate};
use splat4d_train::step::trainer::{Fault, Trainer};
use splat4d_workflow::files;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

/// Steps before the clock runs, and while it does.
const WARM_UP: usize = 50;
const TIMED: usize = 300;
/// Steps at which losses must agree, and how far apart they may be, relatively: other roundings grow.
const AGREE: [(usize, f64); 3] = [(1, 1e-3), (10, 1e-2), (100, 1e-2)];
/// Ceiling of a splat's alpha: gsplat 1.5.3 has it compiled in (RasterizeToPixels3DGSFwd.cu).
const ALPHA_MAX: f64 = 0.999;
/// A rate's name, the columns that it is of, which of them, and the rate.
type RateOf = (&'static str, &'static str, Option<(usize, usize)>, f64);
/// Rates, columns and their parts (3DGS; positions for an extent of 1).
const RATES: [RateOf; 6] = [
    ("means", "means", None, 1.6e-4),
    ("quats", "quats", None, 1e-3),
    ("scales", "log_scales", None, 5e-3),
    ("opacities", "opacity_logits", None, 5e-2),
    ("sh0", "sh", Some((0, 3)), 2.5e-3),
    ("shN", "sh", Some((3, 45)), 2.5e-3 / 20.0),
];
/// The files of a scene and of this program; every other `.json` next to them is of another program.
const SCENE: &str = "scene.json";
const OURS: &str = "splat4d.json";

/// Report of a program's run.
#[derive(Debug, Serialize, Deserialize)]
struct Ran {
    program: String,
    device: String,
    /// Milliseconds a step, by the wall.
    ms: f64,
    /// Of every step.
    losses: Vec<f64>,
}

/// The limits of other programs' renderers.
pub(super) fn config() -> RenderConfig {
    RenderConfig { alpha_max: ALPHA_MAX, ..RenderConfig::default() }
}

/// A scene at the time of its first view, seen so by all, as a still one.
fn still(pinned: &Pinned) -> Result<Pinned> {
    let time = pinned.views[0].time;
    let layer = Layer::new("still", freeze(&pinned.scene, time)?, Arc::new(Still), LifeKind::Infinite);
    let views = pinned.views.iter().map(|v| View { camera: v.camera.clone(), time }).collect();
    let scene = Scene { layers: vec![layer], clip: pinned.scene.clip, ..Scene::default() };
    Ok(Pinned { name: pinned.name.clone(), scene, views })
}

fn write_npy(path: &Path, shape: &[usize], data: &[f32]) -> Result<()> {
    let mut bytes = Vec::new();
    npy::write_f32(shape, data, &mut bytes)?;
    files::write(path, &bytes)
}

/// Row after row, pixel after pixel.
fn interleaved(picture: &Planes<f32>) -> Vec<f32> {
    (0..picture.pixels()).flat_map(|p| (0..picture.channels).map(move |c| picture.plane(c)[p])).collect()
}

fn export(pinned: &Pinned, held: &Held, order: &[usize], folder: &Path) -> Result<()> {
    let params = &pinned.scene.layers[0].params;
    let (n, geometry, sh) = (params.len(), &params[GEOMETRY], &params[SH]);
    for (name, first, width) in
        [("means", 0, 3), ("quats", QUAT, 4), ("log_scales", LOG_SCALE, 3), ("opacity_logits", OPACITY, 1)]
    {
        write_npy(&folder.join(format!("{name}.npy")), &[n, width], &geometry.column_to_rows(first, width))?;
    }
    let colors = sh.column_to_rows(0, sh.width());
    write_npy(&folder.join("sh.npy"), &[n, sh.width() / 3, 3], &colors)?;
    for (i, picture) in held.pictures().iter().enumerate() {
        let path = folder.join(format!("truth_{i}.npy"));
        write_npy(&path, &[picture.height, picture.width, 3], &interleaved(picture))?;
    }
    let config = config();
    let view = |v: &View| {
        let (k, pose) = (&v.camera.intrinsics, &v.camera.cam_from_world);
        let row = |i: usize| {
            let [a, b, c] = pose.rotation[i];
            [a, b, c, pose.translation[i]]
        };
        json!({
            "k": [[k.fx, 0.0, k.cx], [0.0, k.fy, k.cy], [0.0, 0.0, 1.0]],
            "world_to_camera": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]],
            "near": v.camera.near,
        })
    };
    let camera = &pinned.views[0].camera;
    let rates: serde_json::Map<String, serde_json::Value> =
        RATES.iter().map(|(name, _, _, rate)| ((*name).to_owned(), json!(rate))).collect();
    let text = json!({
        "name": pinned.name,
        "width": camera.width,
        "height": camera.height,
        "background": pinned.scene.background,
        "low_pass": config.low_pass,
        "alpha": [config.alpha_min, config.alpha_max],
        "dssim": training::LAMBDA_DSSIM,
        "warm_up": WARM_UP,
        "timed": TIMED,
        "agree": AGREE,
        "rates": rates,
        "adam": {"betas": [0.9, 0.999], "eps": 1e-15},
        "order": order,
        "views": pinned.views.iter().map(view).collect::<Vec<_>>(),
    });
    files::write(&folder.join(SCENE), serde_json::to_string_pretty(&text).expect("plain data is JSON").as_bytes())
}

fn learn(pinned: &Pinned, held: &Arc<Held>, backend: Box<dyn Backend>, device: &str) -> Result<(Ran, Vec<usize>)> {
    let mut trainer = training::trainer_on(pinned.scene.clone(), held.clone(), backend)?;
    trainer.progress.rate_scale = 1.0;
    let group = |&(_, column, part, rate): &RateOf| Group { part, ..Group::new(column, Rate::constant(rate)) };
    trainer.stages[0].groups = RATES.iter().map(group).collect();
    let (mut losses, mut order) = (Vec::new(), Vec::new());
    let failed = |fault: Fault| Error::new(ErrorKind::Diverged, fault.0);
    let mut steps = |trainer: &mut Trainer<'_>, count: usize| -> Result<()> {
        for _ in 0..count {
            losses.extend(trainer.step()?.map_err(failed)?.measured.iter().map(|m| m.loss));
            order.push(held.last());
        }
        losses.extend(trainer.catch_up().map_err(failed)?.iter().map(|m| m.loss));
        Ok(())
    };
    steps(&mut trainer, WARM_UP)?;
    let clock = Instant::now();
    steps(&mut trainer, TIMED)?;
    let ms = 1e3 * clock.elapsed().as_secs_f64() / TIMED as f64;
    Ok((Ran { program: "splat4d".into(), device: device.into(), ms, losses }, order))
}

/// Disagreement of two runs.
fn apart(ours: &Ran, theirs: &Ran) -> Option<String> {
    AGREE.iter().find_map(|&(step, most)| {
        let of = |ran: &Ran| ran.losses.get(step - 1).copied().unwrap_or(f64::NAN);
        let (a, b) = (of(ours), of(theirs));
        // Phrased so that a number that is none does not agree.
        let agree = ((a - b) / a).abs() <= most;
        (!agree).then(|| format!("at step {step} its loss is {b:.6}, ours {a:.6}"))
    })
}

/// Report of all other programs whose runs are in a scene's folder.
fn verdicts(ours: &Ran, folder: &Path) -> Result<Vec<String>> {
    let unread = |e: std::io::Error| Error::io("the folder cannot be read", e).at(folder.display());
    let mut paths: Vec<_> = std::fs::read_dir(folder).map_err(unread)?.flatten().map(|entry| entry.path()).collect();
    paths.sort();
    let other = |path: &&std::path::PathBuf| {
        let name = path.file_name().and_then(|n| n.to_str()).unwrap_or_default();
        name.ends_with(".json") && name != SCENE && name != OURS
    };
    let verdict = |path: &std::path::PathBuf| {
        let theirs: Ran = serde_json::from_str(&files::read_text(path)?)
            .map_err(|e| Error::input(format!("invalid run of another program: {e}")).at(path.display()))?;
        Ok(match apart(ours, &theirs) {
            Some(why) => format!("{}: void, {why}", theirs.program),
            None => format!(
                "{} on {}: {:.3} ms a step, {:.2} times ours ({:.3} ms)",
                theirs.program,
                theirs.device,
                theirs.ms,
                theirs.ms / ours.ms,
                ours.ms
            ),
        })
    };
    paths.iter().filter(other).map(verdict).collect()
}

/// Writes a scene into a folder of its name, trains it with `backend`, and prints how it compares with programs that
/// were measured before.
pub(super) fn measure(
    pinned: &Pinned,
    folder: &Path,
    way: Way,
    backend: Box<dyn Backend>,
    device: &str,
) -> Result<(Row, Vec<String>)> {
    let folder = folder.join(&pinned.name);
    files::make_folder(&folder)?;
    let pinned = still(pinned)?;
    let held = Arc::new(Held::of(&pinned, way));
    assert!(!held.is_empty(), "a pinned scene has views");
    let (ran, order) = learn(&pinned, &held, backend, device)?;
    export(&pinned, &held, &order, &folder)?;
    let text = serde_json::to_string_pretty(&ran).expect("plain data is JSON");
    files::write(&folder.join(OURS), text.as_bytes())?;
    let verdicts = verdicts(&ran, &folder)?;
    let stage = "step, still, against others".into();
    Ok((Row { scene: pinned.name, stage, threads: way.threads, ms: ran.ms, ..Row::default() }, verdicts))
}

#[cfg(test)]
mod tests {
    use super::super::scenes::made_up;
    use super::*;
    use splat4d::gpu::{Adapters, Gpu, GpuRenderer};
    use splat4d::render::Simd;

    #[test]
    fn another_program_is_compared_only_where_its_losses_agree() {
        let pinned = made_up("small", 60, [20, 15]);
        let way = Way { threads: 1, simd: Simd::detect(), rounds: 1 };
        let place = tempfile::tempdir().unwrap();
        let gpu = match Gpu::open(Adapters::Any) {
            Ok(gpu) => GpuRenderer::new(gpu, config()).unwrap(),
            Err(e) => {
                assert!(std::env::var_os("REQUIRE_GPU").is_none(), "REQUIRE_GPU is set: {e}");
                return println!("skipped: {e}");
            }
        };
        // The CPU represents another program.
        let folder = place.path().join("small");
        let cpu = || splat4d::device::cpu(config());
        assert!(measure(&pinned, place.path(), way, cpu(), "the CPU").unwrap().1.is_empty(), "nobody else is there");
        std::fs::rename(folder.join(OURS), folder.join("other.json")).unwrap();
        let (row, said) = measure(&pinned, place.path(), way, Box::new(gpu), "a GPU").unwrap();
        assert!(row.ms > 0.0);
        assert!(said.len() == 1 && said[0].contains("times ours"), "{said:?}");
        let read = |name: &str| std::fs::read(folder.join(name)).unwrap();
        let shape = |name: &str| npy::Npy::read(&read(name)).unwrap().shape;
        assert_eq!((shape("means.npy"), shape("sh.npy")), (vec![60, 3], vec![60, 16, 3]));
        assert_eq!(shape("truth_7.npy"), [15, 20, 3]);
        let scene: serde_json::Value = serde_json::from_slice(&read(SCENE)).unwrap();
        assert_eq!(scene["order"].as_array().unwrap().len(), WARM_UP + TIMED);
        assert_eq!(scene["views"].as_array().unwrap().len(), 8);
        let mut other: Ran = serde_json::from_slice(&read("other.json")).unwrap();
        let ours: Ran = serde_json::from_slice(&read(OURS)).unwrap();
        assert_eq!(ours.losses.len(), WARM_UP + TIMED);
        assert!(ours.losses[WARM_UP + TIMED - 8..].iter().sum::<f64>() < ours.losses[..8].iter().sum(), "it learns");
        for (step, by) in [(1, 1.002), (10, 1.02), (100, f64::NAN)] {
            let kept = std::mem::replace(&mut other.losses[step - 1], by * ours.losses[step - 1]);
            assert!(apart(&ours, &other).is_some_and(|why| why.contains(&format!("step {step} "))));
            other.losses[step - 1] = kept;
        }
        other.losses.truncate(99);
        assert!(apart(&ours, &other).is_some(), "a run that is too short");
    }
}
