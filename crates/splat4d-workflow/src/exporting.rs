//! A scene as files for others to open: one time or each frame as a 3DGS .ply, the whole as a page with its player, and
//! paths of its Gaussians, or of requested points, as JSON or CSV.

use crate::deadline::Deadline;
use crate::events::Listener;
use crate::files;
use crate::folding;
use crate::playable::Playable;
use crate::point_queries::{self, QueryResult};
use crate::run_folder::Run;
use crate::sequence;
use crate::source::{Source, keep_all, not_empty};
use serde_json::json;
use splat4d::flow::tracks::{Member, Tracks, every, nearest};
use splat4d::flow::velocities;
use splat4d::layers::{Evaluation, Scene, freeze};
use splat4d::math::Rng;
use splat4d::scene::{RowEdit, Rows, Space, Table, Time, labels};
use splat4d::{Error, Result, format};
use splat4d_serve::{Page, SceneIn};
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// Numbers of a file of tracks, at most: three for a Gaussian and a time. As text they are some gigabytes.
const MOST_NUMBERS: usize = 300_000_000;
/// Fainter Gaussians than this are not near anything.
const LEAST_OPACITY: f64 = 0.1;

/// Times of a sequence of files or of tracks.
#[derive(Clone, Copy, Debug, Default)]
pub struct Frames {
    /// Times per second; none: the scene's frame rate.
    pub fps: Option<f64>,
    /// First second; none: the clip's.
    pub from: Option<f64>,
    /// Last second; none: the clip's.
    pub to: Option<f64>,
}

impl Frames {
    fn of(&self, scene: &Scene<f32>) -> Result<(f64, Vec<f64>)> {
        sequence::timestamps(scene, self.fps, [self.from, self.to])
    }
}

/// Which Gaussians are tracked.
#[derive(Clone, Debug, Default)]
pub struct TrackOptions {
    /// The times.
    pub frames: Frames,
    /// Every n Gaussians; 0 counts as 1.
    pub every: usize,
    /// Only the Gaussians nearest to this point at the first time, and how many.
    pub near: Option<([f64; 3], usize)>,
    /// Only Gaussians with this label.
    pub label: Option<String>,
    /// Positions in the capture's world, in double precision.
    pub world: bool,
}

/// Opens what `path` names; with `label`, only the Gaussians that have it.
///
/// Errors: it cannot be read; no Gaussian; no such label.
pub fn open(path: &Path, label: Option<&str>) -> Result<Source> {
    let mut source = Source::open(path)?;
    if let Some(name) = label {
        let wanted = Some(labels::named(&source.scene.labels, name).map_err(|e| e.at(path.display()))?);
        for layer in &mut source.scene.layers {
            let of = labels::of(&layer.params);
            layer.edit(&RowEdit::prune(Space::Gaussians, of.iter().map(|l| *l == wanted)), &Rng::new(0, "export", 0));
        }
    }
    not_empty(&source.scene, path)?;
    Ok(source)
}

/// Folds a network that makes colours into spherical harmonics, for files of Gaussians. Errors: its cameras are unknown.
pub fn fold(source: &mut Source, listener: &dyn Listener) -> Result<()> {
    folding::fold(source, "a .ply file", &Deadline::default(), listener).map(drop)
}

/// Writes a file per frame, `frame_00000.ply` and so on, into a folder; returns how many. `force` replaces a sequence
/// of ours.
///
/// Errors: times outside the clip; a folder with other files; a file cannot be written.
pub fn frames(
    path: &Path,
    source: &Source,
    folder: &Path,
    frames: &Frames,
    (options, force): (PlyOptions, bool),
    listener: &dyn Listener,
) -> Result<usize> {
    let (fps, times) = frames.of(&source.scene)?;
    let pattern = sequence::Pattern::in_folder(folder);
    let read = sequence::Read { path, run: source.run.as_ref() };
    let owned = sequence::take(&[&pattern], times.len(), &read, "export", force)?;
    for (i, &time) in times.iter().enumerate() {
        moment(&source.scene, time, options, &pattern.file(i))?;
        listener.phase("exporting", i + 1, times.len());
    }
    owned.finished();
    listener.clear();
    let (from, to) = (times[0], times[times.len() - 1]);
    listener.result(&format!("{} files, {fps} frames per second, from {from} to {to} s", times.len()));
    listener.written(folder);
    Ok(times.len())
}

/// What a .ply of one time contains.
#[derive(Clone, Copy, Debug, Default)]
pub struct PlyOptions {
    /// Positions in the capture's world, in double precision.
    pub world: bool,
    /// Velocities as `vx`, `vy`, `vz`, scene units per second.
    pub velocities: bool,
}

/// Format of tracks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum TrackFormat {
    Csv,
    Json,
    /// Arrays of NumPy, with velocities.
    Npz,
}

impl TrackFormat {
    /// By the ending. Errors: another one.
    fn of(out: &Path) -> Result<Self> {
        match out.extension().map(|e| e.to_ascii_lowercase()) {
            Some(e) if e == "json" => Ok(Self::Json),
            Some(e) if e == "csv" => Ok(Self::Csv),
            Some(e) if e == "npz" => Ok(Self::Npz),
            _ => Err(Error::input("tracks are written as .csv, .json or .npz")
                .at(out.display())
                .remedy("Use option `tracks` NAME.csv, option `tracks` NAME.json or option `tracks` NAME.npz.")),
        }
    }
}

/// Writes positions over time of points that the file `points` lists (pixels of cameras, or positions), and their
/// visibility.
///
/// Errors: a list that cannot be read; more numbers than a file should have.
pub fn points(source: &Source, points: &Path, frames: &Frames, out: &Path, listener: &dyn Listener) -> Result<()> {
    let (scene, format) = (&source.scene, TrackFormat::of(out)?);
    if format == TrackFormat::Npz {
        return Err(Error::input("paths of given points have no velocities, which an .npz contains")
            .at(out.display())
            .remedy("Use option `tracks` NAME.csv or option `tracks` NAME.json."));
    }
    let (_, times) = frames.of(scene)?;
    let views = source.views()?;
    let asked =
        point_queries::read(&files::read_text(points)?, &views, scene.clip).map_err(|e| e.at(points.display()))?;
    if asked.len().saturating_mul(times.len()).saturating_mul(3) > MOST_NUMBERS {
        return Err(Error::input(format!("{} points at {} times are too many", asked.len(), times.len()))
            .remedy("Give fewer points, or fewer times with option `fps`, option `from` or option `to`."));
    }
    let result = QueryResult::of(scene, asked, &views, &times, &mut |done, of| listener.phase("following", done, of));
    listener.clear();
    if result.missing() > 0 {
        listener.warn(&format!(
            "{} of {} points are not on any Gaussian: they are left out",
            result.missing(),
            result.len()
        ));
    }
    files::write(out, if format == TrackFormat::Json { result.to_json() } else { result.to_csv() }.as_bytes())?;
    listener.result(&format!("{} points at {} times", files::grouped(result.len()), times.len()));
    listener.emit(&json!({
        "type": "exported", "points": result.len(), "moments": times.len(), "missing": result.missing(),
    }));
    listener.written(out);
    Ok(())
}

/// Writes positions of Gaussians over time.
///
/// Errors: no such label; more numbers than a file should have.
pub fn tracks(scene: &Scene<f32>, options: &TrackOptions, out: &Path, listener: &dyn Listener) -> Result<()> {
    let format = TrackFormat::of(out)?;
    let (_, times) = options.frames.of(scene)?;
    let mut members = match options.near {
        None => every(scene, options.every.max(1)),
        Some((point, count)) if point.iter().all(|v| v.is_finite()) => {
            nearest(scene, Time(times[0]), &[point], count, LEAST_OPACITY).remove(0)
        }
        Some(_) => {
            return Err(Error::input("option `near` is not a point")
                .remedy("Give three numbers in scene units, for instance option `near` 0.3,1.2,-0.5"));
        }
    };
    if let Some(name) = &options.label {
        let wanted = Some(labels::named(&scene.labels, name)?);
        let of: Vec<Vec<Option<usize>>> = scene.layers.iter().map(|l| labels::of(&l.params)).collect();
        members.retain(|m| of[m.layer][m.row as usize] == wanted);
    }
    if members.len().saturating_mul(times.len()).saturating_mul(3) > MOST_NUMBERS {
        return Err(Error::input(format!("{} tracks of {} times are too many", members.len(), times.len())).remedy(
            "Select fewer with option `every` N, option `near` X,Y,Z, option `fps`, option `from` or option `to`.",
        ));
    }
    if members.is_empty() {
        listener.warn(&format!("no Gaussian is active at {} s: the file has no tracks", times[0]));
    }
    let followed = Tracks::follow(scene, &members, &times);
    let offset = if options.world { scene.offset } else { [0.0; 3] };
    let bytes = match format {
        TrackFormat::Json => as_json(&followed, scene, offset).into_bytes(),
        TrackFormat::Csv => as_csv(&followed, scene, offset).into_bytes(),
        TrackFormat::Npz => scene_flow(scene, &followed, offset)?,
    };
    files::write(out, &bytes)?;
    listener.result(&format!("{} tracks of {} times", files::grouped(members.len()), times.len()));
    listener.emit(&json!({"type": "exported", "tracks": members.len(), "moments": times.len()}));
    listener.written(out);
    Ok(())
}

/// Tracks as JSON, `offset` added in f64:
/// `{"version": 1, "times": [s], "tracks": [{"layer": name, "gaussian": row, "points": [[x, y, z] or null]}]}`.
fn as_json(tracks: &Tracks, scene: &Scene<f32>, offset: [f64; 3]) -> String {
    let mut out = format!("{{\"version\":1,\"times\":{:?},\"tracks\":[", tracks.times);
    for (i, m) in tracks.members.iter().enumerate() {
        let name = serde_json::Value::from(scene.layers[m.layer].name.as_str());
        let comma = if i > 0 { "," } else { "" };
        let _ = write!(out, "{comma}\n{{\"layer\":{name},\"gaussian\":{},\"points\":[", m.row);
        for (k, point) in tracks.track(i).iter().enumerate() {
            let comma = if k > 0 { "," } else { "" };
            let _ = match point {
                Some(p) => {
                    let [x, y, z] = placed(*p, offset);
                    write!(out, "{comma}[{x},{y},{z}]")
                }
                None => write!(out, "{comma}null"),
            };
        }
        out.push_str("]}");
    }
    out.push_str("\n]}\n");
    out
}

/// Tracks as CSV, `offset` added in f64: a header `layer,gaussian,time,x,y,z` and a line for every time at which a
/// Gaussian is alive.
fn as_csv(tracks: &Tracks, scene: &Scene<f32>, offset: [f64; 3]) -> String {
    let mut out = csv::Writer::from_writer(Vec::new());
    out.write_record(["layer", "gaussian", "time", "x", "y", "z"]).expect("memory takes every row");
    for (i, m) in tracks.members.iter().enumerate() {
        let (name, row) = (&scene.layers[m.layer].name, m.row.to_string());
        for (t, point) in tracks.times.iter().zip(tracks.track(i)) {
            if let Some(p) = point {
                let [x, y, z] = placed(*p, offset);
                out.write_record([name, &row, &t.to_string(), &x, &y, &z]).expect("memory takes every row");
            }
        }
    }
    String::from_utf8(out.into_inner().expect("memory takes every row")).expect("all of it is text")
}

/// A position with the offset added in f64, as text; the shortest of f32 where there is none.
fn placed(p: [f32; 3], offset: [f64; 3]) -> [String; 3] {
    std::array::from_fn(|k| match offset[k] == 0.0 {
        true => p[k].to_string(),
        false => (f64::from(p[k]) + offset[k]).to_string(),
    })
}

/// Tracks with their velocities as an .npz: `times` [T] in seconds, `positions` [T, N, 3] in scene units and `velocities` [T, N, 3]
/// in scene units per second, NaN where a Gaussian is not active, `layers` and `gaussians` [N].
fn scene_flow(scene: &Scene<f32>, tracks: &Tracks, offset: [f64; 3]) -> Result<Vec<u8>> {
    let (members, times) = (&tracks.members, &tracks.times);
    let shape = [times.len(), members.len(), 3];
    let mut positions = vec![f32::NAN; shape.iter().product()];
    let mut velocities = positions.clone();
    let mut first = 0;
    for of_layer in members.chunk_by(|a, b| a.layer == b.layer) {
        let layer = &scene.layers[of_layer[0].layer];
        let rows: Vec<u32> = of_layer.iter().map(|m| m.row).collect();
        let mut own = Table::default();
        for (k, &t) in times.iter().enumerate() {
            let seen = Evaluation::of_layer(layer, Space::Gaussians, Rows::Some(&rows), Time(t));
            layer.motion.velocity(&seen.tape(0).query(&layer.params), &mut own);
            for j in 0..rows.len() {
                let Some(point) = tracks.track(first + j)[k] else { continue };
                let moving = layer.frame.vector(own.read::<3>(j, 0).map(f64::from));
                let at = 3 * (k * members.len() + first + j);
                for axis in 0..3 {
                    positions[at + axis] = (f64::from(point[axis]) + offset[axis]) as f32;
                    velocities[at + axis] = moving[axis] as f32;
                }
            }
        }
        first += of_layer.len();
    }
    let numbers = |f: &dyn Fn(&Member) -> f32| members.iter().map(f).collect::<Vec<f32>>();
    let (layers, gaussians) = (numbers(&|m| m.layer as f32), numbers(&|m| m.row as f32));
    let times: Vec<f32> = times.iter().map(|t| *t as f32).collect();
    let mut out = Vec::new();
    format::npy::write_archive(
        &[
            ("times", &[times.len()], &times),
            ("positions", &shape, &positions),
            ("velocities", &shape, &velocities),
            ("layers", &[members.len()], &layers),
            ("gaussians", &[members.len()], &gaussians),
        ],
        &mut out,
    )?;
    Ok(out)
}

/// Writes the Gaussians alive at a time, seconds of the scene, as a 3DGS .ply; returns how many.
pub fn moment(scene: &Scene<f32>, time: f64, options: PlyOptions, out: &Path) -> Result<usize> {
    let params = freeze(scene, Time(time))?;
    let moving = options.velocities.then(|| {
        let mut instant = Evaluation::default();
        scene.at(Time(time), &mut instant);
        velocities(scene, &instant)
    });
    let mut bytes = Vec::new();
    format::ply::write_placed(&params, (scene.offset, options.world), moving.as_ref(), &mut bytes)?;
    files::write(out, &bytes)?;
    Ok(params.len())
}

/// Reports if a file of one time is empty.
pub fn warn_of_empty(scene: &Scene<f32>, time: f64, count: usize, listener: &dyn Listener) {
    if count == 0 {
        listener.warn(&format!(
            "no Gaussian is active at {time} s: the file is empty. The scene lasts from {} to {} s.",
            scene.clip[0], scene.clip[1]
        ));
    }
}

/// Writes the whole scene as one page with its player; with `link` the scene is a file of its own, for web servers.
pub fn page(path: &Path, out: &Path, link: Option<&Path>, listener: &dyn Listener) -> Result<()> {
    if !["html", "htm"].iter().any(|e| out.extension().is_some_and(|own| own.eq_ignore_ascii_case(e)))
        && !files::is_stream(out)
    {
        return Err(Error::input("a page's name ends in .html")
            .at(out.display())
            .remedy("Use option `output` NAME.html."));
    }
    let run = Run::is(path).then(|| Run::open(path)).transpose()?;
    if let Some(link) = link.filter(|link| !files::is_playback(link)) {
        return Err(Error::input("the name does not end in .s4d")
            .at(link.display())
            .remedy("Use option `link` NAME.s4d."));
    }
    // A playback file may be next to its page unchanged.
    let is_read = |link: &&Path| link.canonicalize().ok().is_some_and(|l| path.canonicalize().is_ok_and(|p| p == l));
    let outputs: Vec<&Path> = std::iter::once(out).chain(link.filter(|link| !is_read(link))).collect();
    keep_all(path, run.as_ref(), &outputs, &[])?;
    let address = link.map(|link| address(link, out)).transpose()?;
    let scene = Playable::open(path, listener)?;
    let bytes = scene.bytes()?;
    let inside = SceneIn::Inside(&bytes);
    let html = Page { title: &scene.title, scene: address.as_deref().map_or(inside, SceneIn::Linked) }.html()?;
    if let Some(link) = link {
        files::write(link, &bytes)?;
        listener.written(link);
    }
    files::write(out, html.as_bytes())?;
    listener.result(&format!("the page has {}", files::human_bytes(html.len() as u64)));
    listener.written(out);
    if link.is_some() {
        listener.result("put both on a web server: browsers do not let a page opened from disk read another file");
    }
    Ok(())
}

/// How the page names the file: relative to its own folder, percent-encoded.
fn address(link: &Path, page: &Path) -> Result<String> {
    let folder = |path: &Path| -> Result<PathBuf> {
        let parent = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
        std::fs::canonicalize(parent).map_err(|e| files::cannot_write(path, e))
    };
    let (at, below) = (folder(page)?, folder(link)?);
    let (Ok(below), Some(name)) = (below.strip_prefix(&at), link.file_name()) else {
        return Err(Error::input("is not in the page's folder")
            .at(link.display())
            .remedy("Give option `link` a file in the page's folder or below it."));
    };
    let parts = below.iter().chain([name]).map(|part| percent(&part.to_string_lossy()));
    Ok(format!("./{}", parts.collect::<Vec<_>>().join("/")))
}

/// A part of an address (RFC 3986): everything but unreserved characters as bytes in hexadecimal.
fn percent(text: &str) -> String {
    let one = |b: u8| {
        let plain = b.is_ascii_alphanumeric() || b"-._~".contains(&b);
        if plain { char::from(b).to_string() } else { format!("%{b:02X}") }
    };
    text.bytes().map(one).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::layers::Layer;
    use splat4d::motion::{Spec, build};
    use splat4d::scene::{LifeKind, Params};

    #[test]
    fn a_page_refers_to_its_scene_relative_to_itself() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join("a b")).unwrap();
        let at = |name: &str| folder.path().join(name);
        assert_eq!(address(&at("x.s4d"), &at("page.html")).unwrap(), "./x.s4d");
        assert_eq!(address(&at("a b/ü#?.s4d"), &at("page.html")).unwrap(), "./a%20b/%C3%BC%23%3F.s4d");
        assert!(address(&at("x.s4d"), &at("a b/page.html")).is_err(), "browsers would ask above the page");
        assert!(address(&at("none/x.s4d"), &at("page.html")).is_err());
    }

    #[test]
    fn tracks_are_written_as_text() {
        let mut params = Params::new(5, 1, &[]);
        let motion = build(&Spec::Still, &mut params).unwrap();
        let layer = Layer::new("a, b", params, motion, LifeKind::Infinite);
        let scene = Scene { layers: vec![layer], ..Scene::default() };
        let members = vec![Member { layer: 0, row: 2 }, Member { layer: 0, row: 4 }];
        let points = vec![Some([2.0, 0.0, 0.0]), Some([2.0, 0.5, 0.0]), Some([4.0, 0.0, 0.0]), None];
        let tracks = Tracks { times: vec![0.0, 1.0], members, points };
        let csv = as_csv(&tracks, &scene, [0.0; 3]);
        assert_eq!(csv.lines().count(), 4, "{csv}");
        assert!(csv.contains("\n\"a, b\",2,1,2,0.5,0\n"), "{csv}");
        let json: serde_json::Value = serde_json::from_str(&as_json(&tracks, &scene, [0.0; 3])).unwrap();
        assert_eq!(json["tracks"][0]["points"][1][1], 0.5);
        assert_eq!(json["tracks"][1]["layer"], "a, b");
        assert!(json["tracks"][1]["points"][1].is_null() && json["times"][1] == 1.0);
        // With an offset that f32 does not resolve.
        assert!(as_csv(&tracks, &scene, [1e9, 0.0, 0.0]).contains("\n\"a, b\",2,1,1000000002,0.5,0\n"));
    }
}
