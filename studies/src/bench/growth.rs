//! How a training step's cost grows: with Gaussians, with pixels, with frames of the capture; and where memory is with
//! a million Gaussians.
//!
//! The image stays the same. More Gaussians are those of the trained scene split, fewer are every n-th of them widened,
//! so that together they cover what they covered before: a Gaussian of n children of one parent has √(1/n) of its
//! scales, and is where chance puts it inside the parent. All have the default recipe's model: one velocity each and a
//! Gaussian life.

use super::rows::Row;
use super::scenes::{Pinned, VIEWS, View};
use super::stages::{Way, simd_name};
use super::training::{self, Held};
use image::ExtendedColorType;
use image::codecs::jpeg::JpegEncoder;
use splat4d::layers::{Layer, Scene};
use splat4d::math::{Rng, quat, sh};
use splat4d::motion::{Spacetime, SpacetimeSpec};
use splat4d::render::{Image, ImageGrads, RenderConfig, RenderGrads, Renderer, Shot};
use splat4d::scene::life::{CENTER, LOG_WIDTH};
use splat4d::scene::params::{LOG_SCALE, QUAT};
use splat4d::scene::{Camera, GEOMETRY, LIFE, LifeKind, Params, Planes, SH, Table, Time};
use splat4d::{Error, Result};
use splat4d_train::capture::{Capture, CaptureKind, Convention, Extent, Frame, ImageStore, Lenses, Poses, Rig, Timing};
use splat4d_train::recipe::Recipe;
use splat4d_train::run::dataset::Dataset;
use splat4d_train::run::peak_memory;
use splat4d_workflow::report::chart::{self, Series};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Quantity that grows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(super) enum Axis {
    /// 10,000 to 1,000,000 Gaussians, 800x800
    Gaussians,
    /// 200x200 to 1600x1600 pixels, 30,000 Gaussians
    Pixels,
    /// 10 to 1,000 frames in the capture, 30,000 Gaussians, 400x400
    Frames,
    /// Bytes of training 1,000,000 Gaussians of degree 3
    Memory,
    /// All of them
    All,
}

const GAUSSIANS: [usize; 6] = [10_000, 30_000, 100_000, 250_000, 500_000, 1_000_000];
const SIDES: [usize; 6] = [200, 400, 600, 800, 1200, 1600];
const FRAMES: [usize; 5] = [10, 30, 100, 300, 1000];
/// Gaussians of the memory figure, and the degree of their spherical harmonics.
const MILLION: usize = 1_000_000;
const DEGREE: usize = 3;
/// Side of the images with more Gaussians and in the memory figure; and with more frames.
const SIDE: usize = 800;
const SMALL_SIDE: usize = 400;
/// Steps before times count, and steps of which the median is reported, with more frames.
const WARM_UP: usize = 10;
const STEPS: usize = 60;
/// As the bundled capture's images.
const JPEG_QUALITY: u8 = 90;

/// Measures the requested quantities, in a pool of `way.threads` threads.
pub(super) fn measure(
    base: &Pinned,
    axes: &[Axis],
    way: Way,
    pool: &rayon::ThreadPool,
    note: &dyn Fn(&str),
) -> Result<Vec<Row>> {
    let wanted = |axis: Axis| axes.contains(&axis) || axes.contains(&Axis::All);
    let mut rows = Vec::new();
    // First, while the process holds nothing else.
    if wanted(Axis::Memory) {
        note("memory of a million Gaussians ...");
        rows.extend(pool.install(|| memory(base, MILLION, DEGREE, SIDE, way))?);
    }
    if wanted(Axis::Gaussians) {
        for n in GAUSSIANS {
            note(&format!("{n} Gaussians ..."));
            rows.extend(pool.install(|| gaussians(base, n, SIDE, way))?);
        }
    }
    if wanted(Axis::Pixels) {
        for side in SIDES {
            note(&format!("{side}x{side} pixels ..."));
            rows.extend(pool.install(|| pixels(base, side, way))?);
        }
    }
    if wanted(Axis::Frames) {
        for n in FRAMES {
            note(&format!("{n} frames ..."));
            rows.extend(pool.install(|| frames(base, n, SMALL_SIDE, way))?);
        }
    }
    Ok(rows)
}

fn gaussians(base: &Pinned, count: usize, side: usize, way: Way) -> Result<Vec<Row>> {
    let pinned = grown(base, count, own_degree(base), side);
    Ok(parts("Gaussians", count, way, steps(&pinned, way)?))
}

fn pixels(base: &Pinned, side: usize, way: Way) -> Result<Vec<Row>> {
    let pinned = grown(base, base.scene.len(), own_degree(base), side);
    Ok(parts("pixels", side * side, way, steps(&pinned, way)?))
}

fn steps(pinned: &Pinned, way: Way) -> Result<training::Times> {
    training::times(pinned.scene.clone(), &Arc::new(Held::of(pinned, way)), way)
}

/// A step and its two halves.
fn parts(scene: &str, x: usize, way: Way, t: training::Times) -> Vec<Row> {
    let all = [("step", t.step), ("renderer in a step", t.renderer), ("rest of a step", t.step - t.renderer)];
    let row = |(stage, ms): (&str, f64)| Row { ms, ..named(scene, stage, x, way) };
    all.map(row).to_vec()
}

fn named(scene: &str, stage: &str, x: usize, way: Way) -> Row {
    Row {
        scene: scene.into(),
        stage: stage.into(),
        threads: way.threads,
        simd: simd_name(way.simd).into(),
        x: Some(x as f64),
        ..Row::default()
    }
}

fn own_degree(base: &Pinned) -> usize {
    let columns = base.scene.layers.iter().map(|l| l.params[SH].width()).max().unwrap_or(3);
    sh::degree_of(columns / 3).unwrap_or(0)
}

/// Steps on a capture of `count` images, on disk, through the trainer's own store: the first use of each decodes it.
fn frames(base: &Pinned, count: usize, side: usize, way: Way) -> Result<Vec<Row>> {
    let pinned = grown(base, base.scene.len(), own_degree(base), side);
    let folder = Folder::new()?;
    let pictures = write_images(&folder.0, Held::of(&pinned, way).pictures())?;
    let capture = capture(&pinned, &folder.0, &pictures, count);
    let train = capture.train.clone();
    let store = Arc::new(ImageStore::new(Arc::new(capture), Recipe::default().run.image_memory as usize));
    let mut trainer = training::trainer(pinned.scene.clone(), Arc::new(Dataset::new(store, train)), way)?;
    let mut all = Vec::with_capacity(STEPS);
    for i in 0..WARM_UP + STEPS {
        let (stepped, seconds) = training::step(&mut trainer)?;
        if i >= WARM_UP {
            all.push((1e3 * seconds, 1e3 * stepped.load.as_secs_f64()));
        }
    }
    all.sort_by(|a, b| a.0.total_cmp(&b.0));
    let waited = all.iter().map(|t| t.1).sum::<f64>() / all.len() as f64;
    let step = Row { ms: all[all.len() / 2].0, ..named("frames", "step", count, way) };
    let load = Row { ms: waited, ..named("frames", "loading in a step", count, way) };
    Ok(vec![step, load])
}

/// A synthetic capture: eight image files, each of which represents every eighth frame.
fn capture(pinned: &Pinned, root: &Path, pictures: &[PathBuf], count: usize) -> Capture {
    let clip = pinned.scene.clip;
    let frame = |i: usize| {
        let camera = pinned.views[i % pinned.views.len()].camera.clone();
        let time = Time(clip[0] + (clip[1] - clip[0]) * (i as f64 + 0.5) / count as f64);
        let image = pictures[i % pictures.len()].clone();
        Frame {
            camera: i % pinned.views.len(),
            view: camera.clone(),
            source: camera,
            time,
            index: i,
            image,
            upright: true,
            depth: None,
            flow: None,
            labels: None,
            features: None,
            tracks: None,
            recorded: None,
            shutter: None,
            vignetting: None,
            residual: [0.0; 2],
            mask: None,
        }
    };
    Capture {
        name: "synthetic".into(),
        root: root.to_owned(),
        elsewhere: BTreeSet::new(),
        kind: CaptureKind::Own,
        cameras: (0..pinned.views.len()).map(|i| Rig { name: format!("camera {i}"), fixed: true }).collect(),
        named: true,
        frames: (0..count).map(frame).collect(),
        take: Extent { frames: 0..count, pictures: count },
        held: Vec::new(),
        train: (0..count).collect(),
        validation: Vec::new(),
        future: Vec::new(),
        timing: Timing::Told,
        fps: pinned.scene.fps,
        points: None,
        geometry: None,
        background: None,
        up: pinned.scene.up,
        offset: [0.0; 3],
        labels: Vec::new(),
        downscale: 1,
        convention: Convention::OPENCV,
        poses: Poses::default(),
        lenses: Lenses::default(),
        account: Vec::new(),
        warnings: Vec::new(),
        notes: Vec::new(),
    }
}

fn write_images(folder: &Path, pictures: &[Planes<f32>]) -> Result<Vec<PathBuf>> {
    let write = |(i, picture): (usize, &Planes<f32>)| {
        let path = folder.join(format!("{i}.jpg"));
        let bytes: Vec<u8> = picture.interleaved().iter().map(|x| (255.0 * x).round() as u8).collect();
        let mut file = Vec::new();
        JpegEncoder::new_with_quality(&mut file, JPEG_QUALITY)
            .encode(&bytes, picture.width as u32, picture.height as u32, ExtendedColorType::Rgb8)
            .map_err(|e| Error::input(format!("an image cannot be written as JPEG: {e}")))?;
        splat4d_workflow::files::write(&path, &file)?;
        Ok(path)
    };
    pictures.iter().enumerate().map(write).collect()
}

/// A folder of this process that is deleted when dropped.
struct Folder(PathBuf);

impl Folder {
    fn new() -> Result<Self> {
        let path = std::env::temp_dir().join(format!("splat4d-bench-{}", std::process::id()));
        splat4d_workflow::files::make_folder(&path)?;
        Ok(Self(path))
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// Memory of training by owner: what tables hold, what the renderer holds after a step, and the process's peak.
fn memory(base: &Pinned, count: usize, degree: usize, side: usize, way: Way) -> Result<Vec<Row>> {
    let pinned = grown(base, count, degree, side);
    let columns: usize = pinned.scene.layers[0].params.keys().map(|k| pinned.scene.layers[0].params[k].width()).sum();
    let tables = pinned.scene.layers[0].params.keys().filter(|k| pinned.scene.layers[0].params[*k].width() > 0).count();
    let one = (size_of::<f32>() * count) as u64;
    let renderer = renderer_bytes(&pinned, way);
    let held = Arc::new(Held::of(&pinned, way));
    training::forget_peak();
    let t = training::times(pinned.scene, &held, Way { rounds: 1, ..way })?;
    let row = |stage: &str, bytes: u64| Row {
        bytes: Some(bytes),
        ..named(&format!("memory, SH degree {degree}"), stage, count, way)
    };
    Ok(vec![
        row("parameters", one * columns as u64),
        row("gradients", one * columns as u64),
        row("moments", one * (2 * columns + tables) as u64),
        row("renderer, forward and backward", renderer),
        Row { ms: t.step, ..row("the whole process, training steps", peak_memory()) },
    ])
}

/// Bytes of a renderer that rendered every view and went back.
fn renderer_bytes(pinned: &Pinned, way: Way) -> u64 {
    let mut renderer = Renderer::new(RenderConfig { simd: way.simd, ..RenderConfig::default() });
    let (mut image, mut d) = (Image::default(), RenderGrads::default());
    let mut moment = splat4d::layers::Evaluation::default();
    let mut most = 0;
    for view in &pinned.views {
        pinned.scene.at(view.time, &mut moment);
        let splats = pinned.scene.splats(&moment);
        renderer.render(&Shot::new(&splats, &view.camera, pinned.scene.background), &mut image);
        let grads = ImageGrads { color: &image.color.clone(), alpha: None, depth: None, extra: None };
        let mut d_sh: Vec<Option<&mut Table>> = splats.parts.iter().map(|_| None).collect();
        renderer.backward(&Shot::new(&splats, &view.camera, pinned.scene.background), &grads, &mut d_sh, &mut d);
        most = most.max(renderer.memory_bytes());
    }
    most as u64
}

/// The scene with another number of Gaussians and another degree, seen in square images of `side`; see the module.
fn grown(base: &Pinned, count: usize, degree: usize, side: usize) -> Pinned {
    let view = |v: &View| {
        let k = &v.camera.intrinsics;
        let fov = 2.0 * (0.5 * v.camera.height as f64 / k.fy).atan();
        View { camera: Camera::with_fov_y(v.camera.cam_from_world, fov, side, side), time: v.time }
    };
    let views = base.views.iter().take(VIEWS).map(view).collect();
    Pinned { name: base.name.clone(), scene: split(&base.scene, count, degree), views }
}

fn split(from: &Scene<f32>, count: usize, degree: usize) -> Scene<f32> {
    let had = from.len();
    assert!(had > 0 && count > 0, "a scene of {had} Gaussians cannot become one of {count}");
    let mut params = Params::new(count, sh::coeffs(degree), LifeKind::GaussHalf.columns());
    let motion = Spacetime::new(SpacetimeSpec::default(), &mut params).expect("a built-in model fits new parameters");
    let velocities = motion.velocities();
    let rng = Rng::new(1, "split", 0);
    let parents: Vec<(&Layer, usize)> =
        from.layers.iter().flat_map(|l| (0..l.params.len()).map(move |row| (l, row))).collect();
    let [geometry, colors, lives, speeds] = params.get_mut([GEOMETRY, SH, LIFE, velocities]);
    for child in 0..count {
        // Children of one parent are together, so that the order in space stays.
        let (layer, row) = parents[child * had / count];
        let p = &layer.params;
        let mut g = p[GEOMETRY].read::<11>(row, 0);
        let share = had as f64 / count as f64;
        if share < 1.0 {
            // Spread of the places and of the children together is that of the parent.
            let (unit, _) = quat::normalize([g[QUAT], g[QUAT + 1], g[QUAT + 2], g[QUAT + 3]]);
            let turn = quat::to_rotation(unit);
            let own = rng.fork(child as u64);
            let inside: [f32; 3] =
                std::array::from_fn(|k| g[LOG_SCALE + k].exp() * ((1.0 - share).sqrt() * own.normal(k as u64)) as f32);
            for i in 0..3 {
                g[i] += (0..3).map(|k| turn[i][k] * inside[k]).sum::<f32>();
            }
        }
        for k in 0..3 {
            g[LOG_SCALE + k] += (0.5 * share.ln()) as f32;
        }
        geometry.write(child, 0, g);
        let own = p[SH].width().min(colors.width());
        (0..own).for_each(|c| colors.set(child, c, p[SH].get(row, c)));
        let [center, log_width] = match p[LIFE].width() {
            0 => {
                let [from, to] = from.clip;
                [0.5 * (from + to), (10.0 * (to - from).max(1.0)).ln()].map(|x| x as f32)
            }
            // An interval's tails count as its width: bakes of Gaussian lives have next to nothing else.
            3 => {
                let [center, width, softness] = p[LIFE].read::<3>(row, 0);
                [center, (width.exp() + softness.exp()).ln()]
            }
            _ => [p[LIFE].get(row, CENTER), p[LIFE].get(row, LOG_WIDTH)],
        };
        lives.write(child, 0, [center, log_width]);
        if let Some(v) = p.find(splat4d::motion::spacetime::VELOCITIES).filter(|v| p[*v].width() >= 3) {
            speeds.write(child, 0, p[v].read::<3>(row, 0));
        }
    }
    let layer = Layer::new("grown", params, Arc::new(motion), LifeKind::GaussHalf);
    Scene { layers: vec![layer], ..from.clone() }
}

/// One image an axis: its name and the SVG.
pub(super) fn plots(rows: &[Row]) -> Vec<(String, String)> {
    let axes = [("Gaussians", "gaussians"), ("pixels", "pixels"), ("frames", "frames")];
    let mut out = Vec::new();
    for (scene, name) in axes {
        let mut stages: Vec<&str> = Vec::new();
        for row in rows.iter().filter(|r| r.scene == scene) {
            if !stages.contains(&row.stage.as_str()) {
                stages.push(&row.stage);
            }
        }
        let series = |stage: &&str| {
            let of = rows.iter().filter(|r| r.scene == scene && r.stage == *stage);
            Series { name: (*stage).to_owned(), points: of.filter_map(|r| Some((r.x?, r.ms))).collect() }
        };
        let all: Vec<Series> = stages.iter().map(series).collect();
        if let Some(svg) = chart::file(&all, scene, "ms") {
            out.push((format!("growth-{name}.svg"), svg));
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::math::Se3;
    use splat4d::math::sym3;
    use splat4d::motion::{Spec, build};
    use splat4d::render::Simd;

    /// 40 Gaussians in front of one camera.
    fn small() -> Pinned {
        let mut params = Params::new(40, 4, LifeKind::Interval.columns());
        let spec = Spec::Spacetime(SpacetimeSpec { rotation: true, ..SpacetimeSpec::default() });
        let motion = build(&spec, &mut params).unwrap();
        let rng = Rng::new(4, "small", 0);
        for i in 0..40 {
            let r = rng.fork(i as u64);
            let [geometry, lives] = params.get_mut([GEOMETRY, LIFE]);
            let mean: [f32; 3] = std::array::from_fn(|k| r.uniform(k as u64) as f32 - 0.5);
            geometry.write(i, 0, mean);
            geometry.write(i, QUAT, [1.0, 0.2, 0.0, -0.4]);
            geometry.write(i, LOG_SCALE, [-2.0, -2.5, -1.7]);
            lives.write(i, 0, [0.5, 1.0, -3.0]);
        }
        let layer = Layer::new("x", params, motion, LifeKind::Interval);
        let scene = Scene { layers: vec![layer], clip: [0.0, 1.0], fps: 10.0, up: [0.0, 1.0, 0.0], ..Scene::default() };
        let pose = Se3::look_at([0.0, 0.0, -3.0], [0.0; 3], [0.0, 1.0, 0.0]);
        let view = |k: usize| View { camera: Camera::with_fov_y(pose, 0.6, 40, 40), time: Time(0.1 * k as f64) };
        Pinned { name: "small".into(), scene, views: (0..3).map(view).collect() }
    }

    fn way() -> Way {
        Way { threads: 1, simd: Simd::detect(), rounds: 1 }
    }

    /// Second moments of a scene's matter about the origin: mean of cov + mean·meanᵀ, area-weighted.
    fn matter(scene: &Scene<f32>) -> [f64; 3] {
        let p = &scene.layers[0].params[GEOMETRY];
        let mut sum = [0.0; 3];
        for row in 0..p.rows() {
            let cov = sym3::from_quat_log_scales(p.read::<4>(row, QUAT), p.read::<3>(row, LOG_SCALE));
            let m = p.read::<3>(row, 0);
            for (k, c) in [0, 3, 5].into_iter().enumerate() {
                sum[k] += f64::from(cov[c] + m[k] * m[k]) / p.rows() as f64;
            }
        }
        sum
    }

    #[test]
    fn a_split_scene_has_the_requested_count_and_the_same_coverage() {
        let base = small();
        let many = split(&base.scene, 40 * 500, 3);
        assert_eq!((many.len(), many.layers[0].params[SH].width()), (20_000, 48));
        let (a, b) = (matter(&base.scene), matter(&many));
        for k in 0..3 {
            assert!((a[k] / b[k] - 1.0).abs() < 0.05, "{a:?} {b:?}");
        }
        let area = |s: &Scene<f32>| {
            let p = &s.layers[0].params[GEOMETRY];
            (0..p.rows()).map(|r| f64::from(p.get(r, LOG_SCALE) + p.get(r, LOG_SCALE + 1)).exp()).sum::<f64>()
        };
        assert!((area(&many) / area(&base.scene) - 1.0).abs() < 1e-3, "the covered area");
        let few = split(&base.scene, 10, 0);
        assert_eq!(few.len(), 10);
        assert!((area(&few) / area(&base.scene) - 1.0).abs() < 1e-3, "fewer Gaussians are wider");
    }

    #[test]
    fn every_axis_gives_rows_and_a_plot() {
        let (base, way) = (small(), way());
        let mut rows = gaussians(&base, 20, 32, way).unwrap();
        rows.extend(gaussians(&base, 90, 32, way).unwrap());
        rows.extend(pixels(&base, 24, way).unwrap());
        rows.extend(frames(&base, 11, 32, way).unwrap());
        let memory = memory(&base, 200, 2, 32, way).unwrap();
        assert!(memory.iter().all(|r| r.bytes.is_some()) && memory[0].bytes == Some(4 * 200 * (11 + 27 + 2 + 3)));
        assert!(memory[3].bytes > Some(1000), "{memory:?}");
        assert!(rows.iter().all(|r| r.ms.is_finite() && r.ms >= 0.0 && r.x.is_some()), "{rows:?}");
        assert!(rows.iter().filter(|r| r.stage == "step").all(|r| r.ms > 0.0));
        let plots = plots(&rows);
        let names: Vec<&str> = plots.iter().map(|p| p.0.as_str()).collect();
        assert_eq!(names, ["growth-gaussians.svg", "growth-pixels.svg", "growth-frames.svg"]);
        for (_, svg) in &plots {
            assert!(svg.starts_with("<svg ") && svg.contains("xmlns") && svg.trim_end().ends_with("</svg>"), "{svg}");
            assert!(svg.contains("step") && !svg.contains("NaN") && !svg.contains("<div"), "{svg}");
        }
    }
}
