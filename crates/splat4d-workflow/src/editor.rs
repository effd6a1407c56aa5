//! The work behind `view --edit`: a page sends requests, and a list of edits is replayed, examined, baked and saved, by
//! the same code as `edit`. It writes one file, the list, and reads nothing that a page names but files next to the
//! list.

use crate::baking::{Baking, pack_scene};
use crate::draw::color_rgb;
use crate::editing::{self, Bring};
use crate::events::{Listener, ignore};
use crate::files;
use crate::picking::{Drawn, Shape, draw, number, there};
use crate::source::Source;
use serde::Deserialize;
use serde_json::{Value, json};
use splat4d::device;
use splat4d::edit::{Done, DragHandle, Dragging, Edits, Expr, Selected, Step, has_nodes, replay_after, seen, select};
use splat4d::layers::{Evaluation, Scene};
use splat4d::math::{Se3, quat, se3};
use splat4d::render::{Backend, Image, RenderConfig, Shot};
use splat4d::scene::{Camera, Intrinsics, Lens, Time};
use splat4d::{Error, Result};
use splat4d_serve::EditResponse;
use splat4d_train::encode;
use std::path::{Component, Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Replayed lists that are kept: undo and redo are then there at once.
const KEPT: usize = 4;
/// Most pixels of an image's side that a page may request.
const MOST_SIDE: usize = 1280;
/// Longer side of the image in which depths are looked up, pixels.
const PICK_SIDE: usize = 240;
/// Quality of the JPEG shown until the scene is baked.
const QUALITY: u8 = 80;
/// Most selected Gaussians whose places a page gets: more dots cannot be distinguished.
const POINTS: usize = 3000;
/// Times for which the page gets how many of a selection are visible.
const MOMENTS: usize = 5;

/// The view of a page: a pinhole camera.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Eye {
    position: [f64; 3],
    /// World from camera, wxyz.
    quat: [f64; 4],
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    near: f64,
    width: usize,
    height: usize,
}

impl Eye {
    fn camera(&self) -> Result<Camera> {
        let numbers =
            self.position.iter().chain(&self.quat).chain([&self.fx, &self.fy, &self.cx, &self.cy, &self.near]);
        let sized = (1..=MOST_SIDE).contains(&self.width) && (1..=MOST_SIDE).contains(&self.height);
        let length: f64 = self.quat.iter().map(|x| x * x).sum();
        if !(numbers.copied().all(f64::is_finite) && sized && length > 0.0 && self.fx > 0.0 && self.fy > 0.0) {
            return Err(Error::input("invalid view: expected a camera").remedy("Reload the page"));
        }
        let rotation = quat::to_rotation(quat::normalize(self.quat).0);
        let world_from_cam = Se3 { rotation, translation: self.position };
        let intrinsics = Intrinsics { fx: self.fx, fy: self.fy, cx: self.cx, cy: self.cy };
        Ok(Camera {
            cam_from_world: world_from_cam.inverse(),
            intrinsics,
            lens: Lens::Pinhole,
            width: self.width,
            height: self.height,
            near: self.near.max(0.0),
        })
    }

    /// The same view in a small image.
    fn small(&self) -> Result<Camera> {
        let camera = self.camera()?;
        Ok(camera.downscaled(self.width.max(self.height).div_ceil(PICK_SIDE).max(1)))
    }
}

/// Target of a handle.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Pulled {
    place: [f64; 3],
    radius: f64,
    by: [f64; 3],
}

/// Requests of a page.
#[derive(Clone, Debug, Deserialize)]
#[serde(tag = "do", rename_all = "kebab-case", deny_unknown_fields)]
enum PageRequest {
    /// The state and the current list; `kept`: the list that the page has instead.
    Open { kept: Option<Vec<Step>> },
    /// The edited scene as an image.
    Show { steps: Vec<Step>, view: Eye, t: f64 },
    /// The edited scene as a playback file.
    Bake { steps: Vec<Step> },
    /// Saves the list to its file.
    Save { steps: Vec<Step> },
    /// The selected Gaussians.
    Select { steps: Vec<Step>, select: String, t: f64 },
    /// A selection in words, by what was drawn on the image: corners as x/z and y/z in the camera's axes.
    Pick { steps: Vec<Step>, shape: Shape, corners: Vec<[f64; 2]>, view: Eye, t: f64, through: bool, now: bool },
    /// The floaters.
    Floaters { steps: Vec<Step>, strength: f64, t: f64 },
    /// The nodes by which a selection can be bent: their places are meant at second `at`, and shown at `t`.
    Bend { steps: Vec<Step>, select: String, at: f64, t: f64, nodes: usize },
    /// Nodes pulled: where all are, and an image.
    Pull { number: u64, handles: Vec<Pulled>, pins: Vec<[f64; 4]>, view: Eye },
}

/// A list that was replayed.
struct Replayed {
    steps: Vec<Step>,
    scene: Arc<Scene<f32>>,
    done: Vec<Done>,
}

/// The interactively deformed part.
struct Bent {
    number: u64,
    dragging: Dragging,
    seen: Evaluation,
    image: Image<f32>,
    backend: Box<dyn Backend>,
}

#[derive(Default)]
struct State {
    replayed: Vec<Replayed>,
    bent: Option<Bent>,
    bends: u64,
    /// The list's file as it was read or written last; none: it was not there.
    saved: Option<String>,
    /// The list in that file, and the one of the scene that pages get.
    listed: Vec<Step>,
    shown: Vec<Step>,
}

/// Edits one scene by one list.
pub struct Editor {
    source: Source,
    title: String,
    file: PathBuf,
    /// The list as it was at the start; what it names may be read.
    listed: Edits,
    state: Mutex<State>,
    bakings: AtomicU64,
}

impl Editor {
    /// Errors: the list is there and is none, or belongs to another scene, or its folder is not there.
    pub fn new(source: Source, title: String, file: &Path) -> Result<Self> {
        let folder = file.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
        if !folder.is_dir() {
            return Err(Error::input("its folder does not exist").at(file.display()).remedy("Create the folder"));
        }
        let text = file.exists().then(|| files::read_text(file)).transpose()?;
        let listed = if text.is_some() { editing::read(file)? } else { Edits::default() };
        listed.check(&title).map_err(|e| e.at(file.display()))?;
        let [shown, steps] = [0; 2].map(|_| listed.steps.clone());
        let state = Mutex::new(State { saved: text, listed: steps, shown, ..State::default() });
        Ok(Self { source, title, file: file.to_owned(), listed, state, bakings: AtomicU64::new(0) })
    }

    /// The edited scene as a playback file, after the initial list; none: the list is empty.
    pub fn start(&self, console: &dyn Listener) -> Result<Option<Vec<u8>>> {
        if self.listed.steps.is_empty() {
            return Ok(None);
        }
        let (scene, done) = self.replayed(&self.listed.steps)?;
        for step in &done {
            console.result(&format!("{}: {} Gaussians", step.step, files::grouped(step.selected)));
        }
        self.bake(&scene, console).map(Some)
    }

    /// Does what a page requests.
    ///
    /// Errors: what is no query, and those of its work; nothing is changed then.
    pub fn answer(&self, asked: Value) -> Result<EditResponse> {
        let ask: PageRequest = serde_json::from_value(asked)
            .map_err(|e| Error::input(format!("unknown request of the page: {e}")).remedy("Reload the page"))?;
        let result = |result: Value| Ok(EditResponse { result, scene: None });
        match ask {
            PageRequest::Open { kept } => result(self.open(kept)),
            PageRequest::Show { steps, view, t } => {
                let camera = view.camera()?;
                let (scene, done) = self.replayed(&steps)?;
                let mut image = Image::default();
                draw(&scene, &camera, t, false, &mut image)?;
                result(json!({ "done": done, "gaussians": scene.len(), "picture": jpeg(&image)? }))
            }
            PageRequest::Bake { steps } => {
                let number = self.bakings.fetch_add(1, Ordering::SeqCst) + 1;
                let (scene, _) = self.replayed(&steps)?;
                let bytes = self.bake(&scene, &ignore)?;
                // A repeated request in the meantime must see that.
                let newest = self.bakings.load(Ordering::SeqCst) == number;
                if newest {
                    self.lock().shown = steps;
                }
                Ok(EditResponse { result: json!({ "stale": !newest }), scene: newest.then(|| bytes.into()) })
            }
            PageRequest::Save { steps } => self.save(steps).and_then(result),
            PageRequest::Select { steps, select, t } => {
                let (scene, _) = self.replayed(&steps)?;
                let selected = self.select(&select, &scene)?;
                result(held(&select, &scene, &selected, t))
            }
            PageRequest::Pick { steps, shape, corners, view, t, through, now } => {
                let (scene, _) = self.replayed(&steps)?;
                let drawn = Drawn { shape, corners: &corners, through };
                let words = drawn.words(&scene, &view.small()?, t)?;
                let select = if now && scene.is_moving() { format!("at({}, {words})", number(t)) } else { words };
                let selected = self.select(&select, &scene)?;
                result(held(&select, &scene, &selected, t))
            }
            PageRequest::Floaters { steps, strength, t } => {
                let (scene, _) = self.replayed(&steps)?;
                let found = Bring::new(&self.source, Some(self.file.as_path()), &ignore)?.propose(&scene, strength)?;
                let mut value = held("", &scene, &found.selected, t);
                value["psnr"] = json!([found.before, found.after]);
                value["pictures"] = json!(found.pictures);
                result(value)
            }
            PageRequest::Bend { steps, select, at, t, nodes } => {
                self.bend(&steps, &select, [at, t], nodes).and_then(result)
            }
            PageRequest::Pull { number, handles, pins, view } => {
                self.pull(number, handles, &pins, &view).and_then(result)
            }
        }
    }

    fn open(&self, kept: Option<Vec<Step>>) -> Value {
        let state = self.lock();
        let stale = kept.as_ref().unwrap_or(&state.listed) != &state.shown;
        let scene = &self.source.scene;
        // A playback file's layers are its pages: parts of the file, not of the scene.
        let named = scene.layers.iter().filter(|_| self.source.playback.is_none());
        let mut layers: Vec<&str> = named.map(|l| l.name.as_str()).collect();
        layers.dedup();
        let name = self.file.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        json!({
            "title": self.title, "file": name, "steps": state.listed, "layers": layers, "clip": scene.clip, "fps": scene.fps,
            // Another page, or this one before it was loaded again, has changed the scene that pages get.
            "stale": stale, "moving": scene.is_moving(), "gaussians": scene.len(),
            // A playback file's Gaussians are time segments, which no node carries through the whole clip.
            "drag": self.source.playback.is_none(), "floaters": self.source.run.is_some(),
        })
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Refuses files elsewhere that the list did not name at the start.
    fn check(&self, steps: &[Step]) -> Result<()> {
        let edits = Edits { scene: Some(self.title.clone()), steps: steps.to_vec(), ..Edits::default() };
        edits.check(&self.title)?;
        for step in steps.iter().filter(|s| !self.listed.steps.contains(s)) {
            let mut names = Vec::new();
            if let Step::Merge { scene, .. } = step {
                names.push(scene.clone());
            }
            if let Some(text) = step.selection() {
                names.extend(Expr::parse(text)?.files());
            }
            let outside = |name: &String| !Path::new(name).components().all(|c| matches!(c, Component::Normal(_)));
            if let Some(name) = names.into_iter().find(outside) {
                return Err(Error::input(format!("`{name}` is not in the folder of the list"))
                    .remedy("Move it there, or write the step into the file by hand"));
            }
        }
        Ok(())
    }

    /// The scene after these steps, from the longest part of them that is known.
    fn replayed(&self, steps: &[Step]) -> Result<(Arc<Scene<f32>>, Vec<Done>)> {
        self.check(steps)?;
        let known = {
            let state = self.lock();
            let best = state.replayed.iter().filter(|r| steps.starts_with(&r.steps)).max_by_key(|r| r.steps.len());
            best.map(|r| (r.steps.len(), r.scene.clone(), r.done.clone()))
        };
        let (first, scene, done) = known.unwrap_or_else(|| (0, Arc::new(self.source.scene.clone()), Vec::new()));
        if first == steps.len() {
            return Ok((scene, done));
        }
        let bring = Bring::new(&self.source, Some(self.file.as_path()), &ignore)?;
        let (scene, done) = replay_after(done, &steps[first..], (*scene).clone(), &bring, &mut |_, _| {})?;
        let scene = Arc::new(scene);
        let mut state = self.lock();
        if state.replayed.len() >= KEPT {
            state.replayed.remove(0);
        }
        state.replayed.push(Replayed { steps: steps.to_vec(), scene: scene.clone(), done: done.clone() });
        Ok((scene, done))
    }

    fn bake(&self, scene: &Scene<f32>, console: &dyn Listener) -> Result<Vec<u8>> {
        let baking = Baking { poster: false, ..Baking::default() };
        let packed = pack_scene(scene, &self.source, &self.title, &baking, console);
        console.clear();
        Ok(packed?.bytes)
    }

    fn save(&self, steps: Vec<Step>) -> Result<Value> {
        // Lists that cannot be replayed are not written.
        self.replayed(&steps)?;
        let edits = Edits { scene: Some(self.title.clone()), steps, ..Edits::default() };
        let mut state = self.lock();
        let there = self.file.exists().then(|| files::read_text(&self.file)).transpose()?;
        if there != state.saved {
            return Err(Error::input("was changed by another program since it was read")
                .at(self.file.display())
                .remedy("Move it away to keep both, or start `view --edit` again"));
        }
        editing::write(&self.file, &edits)?;
        state.saved = Some(files::read_text(&self.file)?);
        state.listed = edits.steps;
        Ok(json!({ "saved": state.listed.len() }))
    }

    fn select(&self, text: &str, scene: &Scene<f32>) -> Result<Selected> {
        self.check(&[Step::Delete { select: text.to_owned() }])?;
        select(&Expr::parse(text)?, scene, &Bring::new(&self.source, Some(self.file.as_path()), &ignore)?)
    }

    fn bend(&self, steps: &[Step], select: &str, times: [f64; 2], nodes: usize) -> Result<Value> {
        if self.source.playback.is_some() {
            return Err(
                Error::input("a playback file cannot be deformed").remedy("Give the run folder or scene.safetensors")
            );
        }
        let (scene, _) = self.replayed(steps)?;
        let selected = self.select(select, &scene)?;
        let own = has_nodes(&scene, &selected);
        let bring = Bring::new(&self.source, Some(self.file.as_path()), &ignore)?;
        let dragging = Dragging::new(&scene, &selected, times, nodes, &bring)?;
        let [places, nodes] = [dragging.places(), dragging.nodes()].map(rounded);
        let mut state = self.lock();
        state.bends += 1;
        let number = state.bends;
        let (seen, image) = (Evaluation::default(), Image::default());
        let backend = device::cpu(RenderConfig::default());
        state.bent = Some(Bent { number, dragging, seen, image, backend });
        Ok(json!({ "number": number, "places": places, "nodes": nodes, "own": own }))
    }

    fn pull(&self, number: u64, handles: Vec<Pulled>, pins: &[[f64; 4]], view: &Eye) -> Result<Value> {
        let camera = view.camera()?;
        let mut state = self.lock();
        let Some(bent) = state.bent.as_mut().filter(|b| b.number == number) else {
            return Err(Error::input("these nodes are no longer stored").remedy("Select them again"));
        };
        let handles: Vec<(DragHandle, [f64; 3])> = handles
            .into_iter()
            .map(|h| (DragHandle { place: h.place, radius: h.radius, keys: Vec::new() }, h.by))
            .collect();
        let nodes = rounded(&bent.dragging.pull(&handles, pins)?);
        let scene = bent.dragging.scene();
        scene.at(Time(0.0), &mut bent.seen);
        let splats = scene.splats(&bent.seen);
        device::draw(&mut bent.backend, &Shot::new(&splats, &camera, scene.background), &mut bent.image);
        Ok(json!({ "nodes": nodes, "picture": jpeg(&bent.image)? }))
    }
}

/// An image as a data URI.
fn jpeg(image: &Image<f32>) -> Result<String> {
    let rgb = color_rgb(&image.color);
    let bytes = encode::jpeg(&rgb.data, [rgb.width, rgb.height], QUALITY)?;
    Ok(format!("data:image/jpeg;base64,{}", files::base64(&bytes)))
}

fn rounded(of: &[[f64; 3]]) -> Vec<[f32; 3]> {
    of.iter().map(|x| x.map(|x| x as f32)).collect()
}

/// Response for a selection.
fn held(select: &str, scene: &Scene<f32>, selected: &Selected, t: f64) -> Value {
    let [start, end] = scene.clip;
    let mut times: Vec<f64> = (0..MOMENTS).map(|i| start + (end - start) * i as f64 / (MOMENTS - 1) as f64).collect();
    times.dedup();
    let counts = seen(selected, scene, &times);
    let all = there(scene, t, |layer, row| selected[layer][row]);
    let n = all.len().max(1) as f64;
    let mean: [f64; 3] = std::array::from_fn(|k| all.iter().map(|x| x[k]).sum::<f64>() / n);
    let spread = (all.iter().map(|x| se3::norm(se3::sub(*x, mean)).powi(2)).sum::<f64>() / n).sqrt();
    let step = all.len().div_ceil(POINTS).max(1);
    let points: Vec<[f64; 3]> = all.iter().step_by(step).copied().collect();
    json!({
        "select": select, "gaussians": selected.iter().flatten().filter(|s| **s).count(), "of": scene.len(),
        "seen": times.iter().zip(&counts).map(|(t, n)| json!([t, n])).collect::<Vec<_>>(), "now": all.len(),
        "points": rounded(&points), "center": mean, "spread": spread,
    })
}

/// A token that cannot be guessed, from the system's randomness.
pub fn token() -> Result<String> {
    let mut bytes = [0; 16];
    getrandom::fill(&mut bytes).map_err(|e| {
        Error::input(format!("the system provides no random numbers ({e})"))
            .remedy("Without them, other pages cannot be prevented from editing")
    })?;
    Ok(bytes.iter().map(|b| format!("{b:02x}")).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::layers::Layer;
    use splat4d::math::Rng;
    use splat4d::motion::Still;
    use splat4d::scene::params::{LOG_SCALE, OPACITY, QUAT};
    use splat4d::scene::{GEOMETRY, LifeKind, Params, SH};

    const ROWS: usize = 400;

    /// A red ball left of a green one, both a unit away from the origin, seen from below z.
    fn source() -> Source {
        balls([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    }

    /// A red and a green ball at two places: even and odd rows.
    fn balls(places: [[f64; 3]; 2]) -> Source {
        let mut p = Params::new(ROWS, 1, LifeKind::Infinite.columns());
        for row in 0..ROWS {
            let r = Rng::new(4, "balls", 0).fork(row as u64);
            let side = if row % 2 == 0 { -1.0 } else { 1.0 };
            let x: [f64; 3] = std::array::from_fn(|k| places[row % 2][k] + 0.2 * r.normal(k as u64));
            p[GEOMETRY].write(row, 0, x.map(|x| x as f32));
            p[GEOMETRY].write(row, QUAT, [1.0, 0.0, 0.0, 0.0]);
            p[GEOMETRY].write(row, LOG_SCALE, [-2.2; 3]);
            p[GEOMETRY].set(row, OPACITY, 3.0);
            p[SH].write(row, 0, if side < 0.0 { [1.5f32, -1.5, -1.5] } else { [-1.5, 1.5, -1.5] });
        }
        let layer = Layer::new("balls", p, Arc::new(Still), LifeKind::Infinite);
        Source::own(Scene {
            layers: vec![layer],
            clip: [0.0, 1.0],
            fps: 10.0,
            up: [0.0, -1.0, 0.0],
            ..Scene::default()
        })
    }

    fn view() -> Value {
        json!({"position": [0, 0, -5], "quat": [1, 0, 0, 0], "fx": 160.0, "fy": 160.0, "cx": 80.0, "cy": 60.0,
            "near": 0.01, "width": 160, "height": 120})
    }

    struct Bench {
        folder: tempfile::TempDir,
        editor: Editor,
    }

    impl Bench {
        fn new() -> Self {
            let folder = tempfile::tempdir().unwrap();
            let editor = Editor::new(source(), "balls".into(), &folder.path().join("edits.toml")).unwrap();
            Self { folder, editor }
        }

        fn list(&self) -> PathBuf {
            self.folder.path().join("edits.toml")
        }

        fn ask(&self, asked: Value) -> Value {
            self.editor.answer(asked.clone()).unwrap_or_else(|e| panic!("{asked}: {e}")).result
        }

        /// The message for an impossible request; the list is unchanged.
        fn refused(&self, asked: Value) -> String {
            let before = std::fs::read(self.list()).ok();
            let error = self.editor.answer(asked.clone()).map(|a| a.result).expect_err(&asked.to_string()).to_string();
            assert_eq!(std::fs::read(self.list()).ok(), before, "{asked}");
            error
        }
    }

    #[test]
    fn shapes_on_the_image_become_selection_text() {
        let bench = Bench::new();
        let pick = |shape: &str, corners: Value, through: bool| {
            bench.ask(json!({"do": "pick", "steps": [], "shape": shape, "corners": corners, "view": view(), "t": 0.0,
                "through": through, "now": false}))
        };
        // Around the left ball, at x/z = -0.2.
        let frame = json!([[-0.4, -0.2], [-0.05, 0.2]]);
        let polygon = json!([[-0.4, -0.2], [-0.05, -0.2], [-0.05, 0.2], [-0.4, 0.2]]);
        for (result, word) in [
            (pick("box", frame.clone(), false), "box("),
            (pick("lasso", polygon.clone(), false), "lasso("),
            (pick("lasso", polygon, true), "lasso("),
            (pick("sphere", json!([[-0.2, 0.0], [-0.02, 0.0]]), false), "sphere("),
            (pick("color", json!([[-0.2, 0.0]]), false), "color("),
        ] {
            assert!(result["select"].as_str().unwrap().starts_with(word), "{result}");
            let held = result["gaussians"].as_u64().unwrap();
            assert!((180..=200).contains(&held), "{word} {held}");
            let x = result["center"][0].as_f64().unwrap();
            assert!((x + 1.0).abs() < 0.1, "{word} {x}");
        }
        let nothing = bench
            .refused(json!({"do": "pick", "steps": [], "shape": "box", "corners": [[0.4, 0.3], [0.45, 0.35]],
            "view": view(), "t": 0.0, "through": false, "now": false}));
        assert!(nothing.contains("nothing is visible there"), "{nothing}");
    }

    #[test]
    fn shapes_select_hidden_gaussians_only_with_through() {
        let folder = tempfile::tempdir().unwrap();
        let hidden = balls([[0.0; 3], [0.0, 0.0, 3.0]]);
        let editor = Editor::new(hidden, "balls".into(), &folder.path().join("edits.toml")).unwrap();
        for (shape, corners) in [
            ("box", json!([[-0.2, -0.2], [0.2, 0.2]])),
            ("lasso", json!([[-0.2, -0.2], [0.2, -0.2], [0.2, 0.2], [-0.2, 0.2]])),
        ] {
            let [front, both] = [false, true].map(|through| {
                let ask = json!({"do": "pick", "steps": [], "shape": shape, "corners": corners, "view": view(), "t": 0.0,
                    "through": through, "now": false});
                editor.answer(ask).unwrap().result
            });
            let held = front["gaussians"].as_u64().unwrap();
            assert!((170..=200).contains(&held), "{shape} {held}");
            let z = front["center"][2].as_f64().unwrap();
            assert!(z.abs() < 0.1, "{shape}: none of the ball behind, {z}");
            assert!(both["gaussians"].as_u64().unwrap() > 380, "{shape} {both}");
        }
    }

    #[test]
    fn a_list_is_shown_baked_and_saved_and_another_programs_is_kept() {
        let bench = Bench::new();
        let open = bench.ask(json!({"do": "open"}));
        assert_eq!((&open["layers"], &open["steps"], &open["drag"]), (&json!(["balls"]), &json!([]), &json!(true)));
        let steps = json!([{"do": "delete", "select": "box(-9,-9,-9, 0,9,9)"}]);
        let shown = bench.ask(json!({"do": "show", "steps": steps, "view": view(), "t": 0.0}));
        assert_eq!((&shown["gaussians"], &shown["done"][0]["selected"]), (&json!(200), &json!(200)));
        assert!(shown["picture"].as_str().unwrap().starts_with("data:image/jpeg;base64,/9j/"));
        let baked = bench.editor.answer(json!({"do": "bake", "steps": steps})).unwrap();
        let scene = splat4d::format::playback::read(&baked.scene.unwrap()).unwrap();
        assert_eq!(scene.len(), 200);
        assert!(!bench.list().exists());
        // A page that is loaded again has no list; one that kept it has that of the scene.
        let stale = |kept: &Value| bench.ask(json!({"do": "open", "kept": kept}))["stale"].clone();
        assert_eq!([stale(&Value::Null), stale(&steps)], [true, false]);
        bench.ask(json!({"do": "save", "steps": steps}));
        assert_eq!(stale(&Value::Null), false);
        let edits = editing::read(&bench.list()).unwrap();
        assert_eq!((edits.scene.as_deref(), edits.steps.len()), (Some("balls"), 1));
        bench.ask(json!({"do": "save", "steps": []}));
        std::fs::write(bench.list(), "# mine\nversion = 1\n").unwrap();
        assert!(bench.refused(json!({"do": "save", "steps": steps})).contains("another program"));
        // The list of another scene, and no list at all, are not taken up.
        for text in ["version = 1\nscene = \"others\"\n", "[package]\nname = \"x\"\n"] {
            std::fs::write(bench.list(), text).unwrap();
            assert!(Editor::new(source(), "balls".into(), &bench.list()).is_err(), "{text}");
        }
        let nowhere = bench.folder.path().join("no/where.toml");
        assert!(Editor::new(source(), "balls".into(), &nowhere).err().unwrap().to_string().contains("folder"));
    }

    #[test]
    fn invalid_requests_are_refused_and_change_nothing() {
        let bench = Bench::new();
        bench.ask(json!({"do": "save", "steps": [{"do": "delete", "select": "color(1,0,0, 0.5)"}]}));
        let save = |step: Value| bench.refused(json!({"do": "save", "steps": [step]}));
        for (step, word) in [
            (json!({"do": "delete", "select": "bux(1)"}), "bux"),
            (json!({"do": "delete", "select": "sphere(99,0,0, 1)"}), "empty"),
            (json!({"do": "delete", "select": "all"}), "nothing"),
            (json!({"do": "delete", "select": "all", "path": "/etc/passwd"}), "path"),
            (json!({"do": "explode"}), "explode"),
            (json!({"do": "merge", "scene": "../other.ply", "name": "x"}), "folder of the list"),
            (json!({"do": "merge", "scene": "/etc/passwd", "name": "x"}), "folder of the list"),
            (json!({"do": "delete", "select": "not mask('../../m.png', cam)"}), "folder of the list"),
            (json!({"do": "floaters", "strength": 0.5}), "run folder"),
            (json!("delete"), "known"),
        ] {
            let error = save(step.clone());
            assert!(error.contains(word), "{step}: {error}");
        }
        for asked in [
            json!(null),
            json!({"do": "save"}),
            json!({"do": "save", "steps": {}, "file": "/tmp/x"}),
            json!({"do": "show", "steps": [], "view": {}, "t": 0}),
            json!({"do": "pull", "number": 7, "handles": [], "pins": [], "view": view()}),
        ] {
            bench.refused(asked);
        }
        let mut wide = view();
        wide["width"] = json!(100_000);
        assert!(bench.refused(json!({"do": "show", "steps": [], "view": wide, "t": 0.0})).contains("camera"));
    }

    /// Requests that would exhaust memory or give invalid numbers: the server responds and continues with the page's
    /// steps.
    #[test]
    fn excessive_requests_are_refused_and_others_continue() {
        let bench = Bench::new();
        let good = json!({"do": "delete", "select": "box(-9,-9,-9, 0,9,9)"});
        for (bad, word) in [
            (vec![json!({"do": "retime", "rate": 1e-300})], "frames"),
            (vec![json!({"do": "retime", "rate": 1e-12})], "frames"),
            (vec![json!({"do": "move", "select": "all", "to": {"shift": [1e39, 0, 0]}})], "too large"),
        ] {
            let steps: Vec<Value> = [vec![good.clone()], bad].concat();
            for what in ["bake", "save"] {
                let said = bench.refused(json!({"do": what, "steps": steps}));
                assert!(said.contains(word), "{said}");
            }
            bench.ask(json!({"do": "save", "steps": [good]}));
            assert_eq!(editing::read(&bench.list()).unwrap().steps.len(), 1);
        }
    }

    #[test]
    fn nodes_are_pulled_and_the_image_follows() {
        let bench = Bench::new();
        let bent = bench.ask(
            json!({"do": "bend", "steps": [], "select": "box(-9,-9,-9, 0,9,9)", "at": 0.5, "t": 0.5, "nodes": 16}),
        );
        assert_eq!((bent["nodes"].as_array().unwrap().len(), &bent["own"]), (16, &json!(false)));
        let pull = |by: [f64; 3]| {
            let handle = json!({"place": bent["places"][0], "radius": 0.1, "by": by});
            bench.ask(json!({"do": "pull", "number": bent["number"], "handles": [handle], "pins": [], "view": view()}))
        };
        let (rest, moved) = (pull([0.0; 3]), pull([0.0, 0.5, 0.0]));
        let y = |result: &Value| result["nodes"][0][1].as_f64().unwrap();
        assert!((y(&moved) - y(&rest) - 0.5).abs() < 1e-5);
        assert_ne!(moved["picture"], rest["picture"]);
    }
}
