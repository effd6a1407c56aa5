//! Shared parts of chunks: the layer of the static background and the cameras' exposures.
//!
//! Temporal medians of every fixed camera over parts of the capture are a capture of their own, on which a still scene
//! is trained as any other run is. Only Gaussians that most cameras see in static regions are kept: chunks can add what
//! is missing in the layer, but cannot correct errors in it.

use super::Chunked;
use crate::Result;
use crate::capture::frames::Picture;
use crate::capture::{Capture, HoldOut, Rgb8};
use crate::encode::{self, Pixels};
use crate::event::Event;
use crate::init::Source;
use crate::recipe::{MotionName, Recipe};
use crate::run::checkpoint::{self, write_atomically};
use crate::run::identity::file_print;
use crate::run::open::{OpenCapture, open_capture};
use crate::run::session::{Outcome, TrainOptions};
use crate::run::start::{resume_with, train as train_run};
use crate::train_state::Exposure;
use crate::vision::view::spread;
use rayon::prelude::*;
use serde_json::json;
use splat4d::Error;
use splat4d::format::{safetensors::SafeTensors, scene};
use splat4d::layers::{Layer, Scene, freeze};
use splat4d::math::{Rng, median_by};
use splat4d::motion::Still;
use splat4d::scene::{Camera, LifeKind, RowEdit, Space, Time};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// The file whose being there states that the part is done: the layer, or a scene without layers.
pub(super) const FILE: &str = "still.safetensors";
/// Name of the layer.
pub(super) const LAYER: &str = "still";
/// Folder of the medians.
const CAPTURE: &str = "capture";
/// Parts of the capture, each of which has a median: more than one, so that exposures can be separated from the scene.
const PARTS: usize = 4;
/// Frames whose median that is.
const MEDIAN_OF: usize = 9;
/// A pixel that differs by more from the median (mean of the channels, in [0, 1]) has changed: above the noise of
/// ordinary cameras.
const CHANGED: f32 = 0.06;
/// A pixel is calm where at most this share of the frames that are examined has changed.
const CALM: f64 = 0.1;
/// Steps of the layer, in those of a chunk: every chunk shows it and none can correct it (docs/scale.md has the
/// figures).
pub(super) const STEPS: usize = 4;
/// A Gaussian stays where it is static in at least this share of the cameras that see it.
const AGREED: f64 = 0.5;

/// Record of a finished part.
pub(super) struct Shared {
    /// The static background, as it was learnt; none: nothing does.
    pub still: Option<Layer<f32>>,
    /// The background.
    pub background: [f32; 3],
    exposures: Vec<(String, [f32; 12])>,
    /// Fingerprint of it all.
    pub print: String,
}

/// Trains the part, or continues with it. `None`: there is nothing that chunks could share.
pub(super) fn train(
    chunked: &Chunked,
    options: &TrainOptions,
    stop: &AtomicBool,
    listen: &mut dyn FnMut(&Event),
) -> Result<Option<Outcome>> {
    let mut listen = listen;
    let folder = chunked.folder(super::Part::Shared);
    let source = folder.join(CAPTURE);
    if !source.join("capture.json").is_file() {
        let looked_at = looked_at(chunked.plan.take);
        let frames = looked_at.iter().flatten().map(|&n| n..n + 1).collect();
        let capture = Arc::new(chunked.capture(frames)?);
        let opened = OpenCapture::new(capture, &chunked.recipe)?;
        if let Some(why) = nothing_still(&opened.capture) {
            listen(&Event::Warning { message: format!("chunks share no still layer: {why}") });
            write_still(&folder, Scene { background: opened.background()?, ..Scene::default() })?;
            return Ok(None);
        }
        medians(&opened, &looked_at, &source, &mut listen)?;
    }
    let recipe = of_medians(&chunked.recipe);
    let minutes = chunked.pace(super::Part::Shared, options).map(|(_, [_, due])| due / 60.0);
    let own = TrainOptions { device: options.device, minutes, clock: options.clock.clone(), ..TrainOptions::default() };
    let outcome = if checkpoint::list(&folder).is_empty() {
        let capture = Arc::new(open_capture(&source, &recipe)?);
        train_run(capture, recipe, &folder, &own, stop, &mut listen)?
    } else {
        resume_with(&folder, &own, stop, &mut listen)?
    };
    if !outcome.interrupted {
        let mut learnt = read_scene(&folder.join(super::SCENE))?;
        calm_only(&mut learnt, &open_capture(&source, &of_medians(&chunked.recipe))?, &source)?;
        write_still(&folder, joined(learnt)?)?;
    }
    Ok(Some(outcome))
}

/// Reads what the finished part left.
pub(super) fn read(folder: &Path) -> Result<Shared> {
    let path = folder.join(FILE);
    let mut bytes = read_file(&path)?;
    let Scene { mut layers, background, .. } = scene::read(&bytes).map_err(|e| e.at(path.display()))?;
    let mut exposures = Vec::new();
    if let Some(path) = checkpoint::list(folder).last() {
        let own = read_file(path)?;
        let file = SafeTensors::read(&own).map_err(|e| e.at(path.display()))?;
        if let Some(table) = file.get("exposure") {
            let rows = table.as_f32()?;
            let names: Vec<String> = serde_json::from_slice(&read_file(&folder.join(CAPTURE).join("cameras.json"))?)
                .map_err(|e| Error::input(format!("invalid list of names: {e}")).at(folder.display()))?;
            exposures = names.into_iter().zip(rows.as_chunks::<12>().0.iter().copied()).collect();
            bytes.extend(bytemuck::cast_slice::<f32, u8>(&rows));
        }
    }
    Ok(Shared { still: layers.pop(), background, exposures, print: file_print(&bytes) })
}

impl Shared {
    /// The exposures for a capture's cameras; those that are not known show what is rendered. `None`: none was learnt.
    pub(super) fn exposure(&self, capture: &Capture) -> Option<Exposure> {
        if self.exposures.is_empty() {
            return None;
        }
        let mut exposure = Exposure::new(capture.cameras.len(), Vec::new());
        let key = exposure.key();
        for (rig, camera) in capture.cameras.iter().enumerate() {
            if let Some((_, row)) = self.exposures.iter().find(|(name, _)| *name == camera.name) {
                exposure.params[key].write(rig, 0, *row);
            }
        }
        Some(exposure)
    }
}

/// Why medians would not be informative.
fn nothing_still(capture: &Capture) -> Option<&'static str> {
    let mut fixed: Vec<usize> =
        capture.train.iter().map(|&i| capture.frames[i].camera).filter(|&c| capture.cameras[c].fixed).collect();
    fixed.dedup();
    fixed.sort_unstable();
    fixed.dedup();
    let all = capture.train.iter().all(|&i| capture.cameras[capture.frames[i].camera].fixed);
    if fixed.len() < 2 || !all {
        Some("cameras move")
    } else if capture.background.is_some() {
        Some("images are cut out of their background")
    } else {
        None
    }
}

/// The recipe of the still scene.
fn of_medians(recipe: &Recipe) -> Recipe {
    let longer = recipe.unresolved().with(|r| r.run.iterations *= STEPS);
    longer.resolve().with(|r| {
        r.run.motion = MotionName::of("still");
        r.run.half_size_until = r.run.half_size_until.min(0.5);
        r.capture.downscale = 1;
        r.capture.hold_out = Some(HoldOut::None);
        (r.capture.first_frame, r.capture.max_frames, r.capture.fps) = (0, 0, 0.0);
        (r.loss.depth, r.loss.geometry, r.loss.flow, r.loss.tracks) = (0.0, 0.0, 0.0, 0.0);
        // Medians have no shutter and no time.
        (r.capture.rolling_shutter, r.capture.subframes, r.appearance.exposure_knots) = (false, 1, 1);
        r.life.kind = None;
        if r.init.source == Source::Hull {
            r.init.source = Source::Auto;
        }
    })
}

/// The frames of each part of a capture whose median is taken.
fn looked_at([first, end]: [usize; 2]) -> [Vec<usize>; PARTS] {
    let border = |part: usize| first + part * (end - first) / PARTS;
    std::array::from_fn(|part| {
        let of = border(part)..border(part + 1).max(border(part) + 1).min(end);
        spread(of.len(), MEDIAN_OF).map(|k| of.start + k).collect()
    })
}

/// Writes the medians of all training cameras as a capture, and where next to nothing changes.
fn medians(
    opened: &OpenCapture,
    looked_at: &[Vec<usize>; PARTS],
    folder: &Path,
    listen: &mut dyn FnMut(&Event),
) -> Result<()> {
    let capture = &opened.capture;
    let (mut cameras, mut names) = (Vec::new(), Vec::new());
    for rig in 0..capture.cameras.len() {
        listen(&Event::Phase { name: "static background".into(), done: rig, total: capture.cameras.len() });
        // Frames of the data set are in the order of `train`.
        let frames: Vec<usize> =
            (0..capture.train.len()).filter(|&i| capture.frames[capture.train[i]].camera == rig).collect();
        if frames.is_empty() {
            continue;
        }
        let view = &capture.frames[capture.train[frames[0]]].view;
        let name = format!("{rig:03}");
        let mut changed = vec![0u16; view.width * view.height];
        let (mut looked, mut written) = (0, 0);
        for part in looked_at {
            let within = |i: &&usize| part.contains(&capture.frames[capture.train[**i]].index);
            let pictures = frames.iter().filter(within).map(|&i| bytes(opened, i)).collect::<Result<Vec<Vec<u8>>>>()?;
            let Some(first) = pictures.first() else { continue };
            let middle: Vec<u8> = (0..first.len()).into_par_iter().map(|i| median(&pictures, i)).collect();
            for picture in &pictures {
                looked += 1;
                changed.par_iter_mut().enumerate().for_each(|(p, count)| {
                    let off: u32 = (3 * p..3 * p + 3).map(|i| u32::from(picture[i].abs_diff(middle[i]))).sum();
                    *count += u16::from(off as f32 > 3.0 * 255.0 * CHANGED);
                });
            }
            write_png(&folder.join(format!("images/{name}/{written}.png")), &middle, view, 3)?;
            written += 1;
        }
        let calm: Vec<u8> =
            changed.iter().map(|c| if f64::from(*c) <= CALM * f64::from(looked) { 255 } else { 0 }).collect();
        write_png(&folder.join(format!("calm/{name}.png")), &calm, view, 1)?;
        let (k, pose) = (&view.intrinsics, &view.cam_from_world);
        let row = |r: usize| [pose.rotation[r][0], pose.rotation[r][1], pose.rotation[r][2], pose.translation[r]];
        cameras.push(json!({
            "name": name, "width": view.width, "height": view.height, "fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy,
            "world_to_camera": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]],
            "images": format!("images/{name}/%d.png"), "start": 0, "frames": written,
        }));
        names.push(capture.cameras[rig].name.clone());
    }
    let mut all = json!({"version": 1, "name": "shared", "fps": 1, "up": capture.up, "cameras": cameras});
    // What has a time of its own moves.
    let points = capture.points.clone().map(|mut cloud| {
        let still: Vec<usize> = (0..cloud.points.len()).filter(|&i| cloud.times[i].is_none()).collect();
        cloud.points = still.iter().map(|&i| cloud.points[i]).collect();
        cloud.colors = still.iter().map(|&i| cloud.colors[i]).collect();
        cloud.times = vec![None; still.len()];
        cloud
    });
    if let Some(cloud) = points.filter(|c| !c.points.is_empty()) {
        write_atomically(&folder.join("points.ply"), &cloud.to_ply("comment points of the static background"))?;
        all["points"] = json!("points.ply");
    }
    write_atomically(&folder.join("cameras.json"), json!(names).to_string().as_bytes())?;
    write_atomically(&folder.join("capture.json"), all.to_string().as_bytes())
}

/// A training image, pixel by pixel.
fn bytes(opened: &OpenCapture, i: usize) -> Result<Vec<u8>> {
    use crate::capture::frames::Frames;
    let mut picture = Picture::default();
    opened.frames.load(i, &mut picture)?;
    let pixels = picture.color.pixels();
    let byte = |v: f32| (v * 255.0).round().clamp(0.0, 255.0) as u8;
    Ok((0..3 * pixels).map(|i| byte(picture.color.plane(i % 3)[i / 3])).collect())
}

fn median(pictures: &[Vec<u8>], i: usize) -> u8 {
    let mut values = [0u8; MEDIAN_OF];
    let values = &mut values[..pictures.len()];
    values.iter_mut().zip(pictures).for_each(|(v, picture)| *v = picture[i]);
    median_by(values, u8::cmp).expect("there are images")
}

fn write_png(path: &Path, data: &[u8], view: &Camera, channels: usize) -> Result<()> {
    write_atomically(path, &encode::png(Pixels::Eight(data), [view.width, view.height], channels))
}

/// Keeps the Gaussians of a scene in static image regions.
fn calm_only(scene: &mut Scene<f32>, capture: &Capture, folder: &Path) -> Result<()> {
    let mut views: Vec<(Camera, Vec<u8>)> = Vec::new();
    for (rig, camera) in capture.cameras.iter().enumerate() {
        let Some(&frame) = capture.train.iter().find(|&&i| capture.frames[i].camera == rig) else { continue };
        let path = folder.join(format!("calm/{}.png", camera.name));
        let picture = Rgb8::read(&path).map_err(|e| e.remedy("Delete the folder"))?;
        let camera = &capture.frames[frame].view;
        views.push((camera.clone(), picture.data.into_iter().step_by(3).collect()));
    }
    for layer in &mut scene.layers {
        let stays: Vec<bool> = layer.means().map(|mean| is_calm(mean, &views)).collect();
        layer.edit(&RowEdit::prune(Space::Gaussians, stays.into_iter()), &Rng::new(0, "calm", 0));
        layer.name = LAYER.into();
    }
    scene.layers.retain(|l| !l.params.is_empty());
    Ok(())
}

/// Whether a position is static in most cameras that see it.
fn is_calm(mean: [f64; 3], views: &[(Camera, Vec<u8>)]) -> bool {
    let (mut seen, mut calm) = (0, 0);
    for (camera, map) in views {
        let p = camera.cam_from_world.apply(mean);
        if p[2] <= camera.near {
            continue;
        }
        let k = &camera.intrinsics;
        let [u, v] = [k.fx * p[0] / p[2] + k.cx, k.fy * p[1] / p[2] + k.cy];
        if u >= 0.0 && v >= 0.0 && u < camera.width as f64 && v < camera.height as f64 {
            seen += 1;
            calm += usize::from(map[v as usize * camera.width + u as usize] > 127);
        }
    }
    seen > 0 && calm as f64 >= AGREED * f64::from(seen)
}

/// The scene with a far shell and what is before it in one layer: chunks take over one.
fn joined(scene: Scene<f32>) -> Result<Scene<f32>> {
    if scene.layers.len() < 2 {
        return Ok(scene);
    }
    let still = Layer::new(LAYER, freeze(&scene, Time(scene.clip[0]))?, Arc::new(Still), LifeKind::Infinite);
    Ok(Scene { layers: vec![still], ..scene })
}

fn write_still(folder: &Path, scene: Scene<f32>) -> Result<()> {
    let mut bytes = Vec::new();
    scene::write(&scene, &mut bytes)?;
    write_atomically(&folder.join(FILE), &bytes)
}

/// A scene of a run.
pub(super) fn read_scene(path: &Path) -> Result<Scene<f32>> {
    scene::read(&read_file(path)?).map_err(|e| e.at(path.display()))
}

pub(super) fn read_file(path: &Path) -> Result<Vec<u8>> {
    crate::files::read_with(path, "Train the chunk again: delete its folder")
}
