//! `export`: times of a scene as plain 3DGS .ply files, the whole of it as one page with its player, or where its
//! Gaussians, or points that are asked for, go as JSON or CSV.

use crate::console::Console;
use serde_json::json;
use splat4d::Error;
use splat4d::flow::tracks::{Tracks, every, nearest};
use splat4d::layers::Scene;
use splat4d::math::Rng;
use splat4d::scene::{RowEdit, Space, Time, labels};
use splat4d_workflow::exporting;
use splat4d_workflow::files;
use splat4d_workflow::point_queries::{self, QueryResult};
use splat4d_workflow::sequence;
use splat4d_workflow::source::{Source, not_empty};
use std::path::{Path, PathBuf};

const EXAMPLES: &str = "\
Examples:
  splat4d export runs/knight -o now.ply --time 0.5         one time; every 3DGS viewer opens it
  splat4d export runs/knight --sequence frames/            frame_00000.ply ...; SuperSplat plays them
  splat4d export runs/knight --sequence frames/ --fps 10 --from 0.2 --to 0.8
  splat4d export runs/knight --html -o knight.html         player and scene in one page
  splat4d export runs/knight --html -o index.html --link knight.s4d    for a web server
  splat4d export runs/knight --tracks tracks.csv           positions at every frame; .json too
  splat4d export runs/knight --tracks tracks.json --every 50
  splat4d export runs/knight --tracks hand.csv --near 0.3,1.2,-0.5 --count 20
  splat4d export runs/knight --tracks paths.csv --points asked.csv    given points, and their visibility
  splat4d export runs/knight -o knight.ply --time 0.5 --label knight

A file of points has a header and one line per point, either a camera's pixel at a time or a position at a time:
  camera,x,y,time          time,x,y,z           time,x,y,z,camera
  cam03,151.5,88,0.2       0,0.31,1.2,-0.5      0,0.31,1.2,-0.5,cam03
Pixels are those of the camera's image, the first one's centre at 0.5; times are seconds. `visible` is 1 where the \
camera sees the point, and empty without a camera.";

/// Write a scene as 3DGS .ply files, as an HTML page, or as tracks of its Gaussians
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// The run, scene file or .ply; for a page also a playback file
    #[arg(value_name = "RUN|FILE", required_unless_present = "model")]
    source: Option<PathBuf>,
    /// The file of one time, or the page
    #[arg(short, long, value_name = "OUT", required_unless_present_any = ["sequence", "tracks"])]
    output: Option<PathBuf>,
    /// The time, seconds of the scene [default: the clip's start]
    #[arg(long, value_name = "T", allow_negative_numbers = true, conflicts_with = "sequence")]
    time: Option<f64>,
    /// A folder for one file per frame
    #[arg(long, value_name = "FOLDER", conflicts_with = "output")]
    sequence: Option<PathBuf>,
    /// Replace a sequence that splat4d wrote to the folder, even a longer one
    #[arg(long, requires = "sequence")]
    force: bool,
    /// Files per second of a sequence, samples per second of tracks [default: the capture's frame rate]
    #[arg(long, value_name = "N")]
    fps: Option<f64>,
    /// First second of a sequence or of tracks
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    from: Option<f64>,
    /// Last second of a sequence or of tracks
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    to: Option<f64>,

    /// Write positions of Gaussians over time (seconds, scene units) to this .csv or .json file
    #[arg(long, value_name = "FILE", conflicts_with_all = ["output", "sequence", "time", "html"])]
    tracks: Option<PathBuf>,
    /// Track these points and their visibility instead of Gaussians
    #[arg(long, value_name = "FILE", requires = "tracks", conflicts_with_all = ["near", "every", "label"])]
    points: Option<PathBuf>,
    /// Only Gaussians with this label
    #[arg(long, value_name = "NAME")]
    label: Option<String>,
    /// Add the scene's offset: positions in the capture's world, in double precision (.ply, tracks of Gaussians)
    #[arg(long, conflicts_with_all = ["html", "points"])]
    world: bool,
    /// Only every N-th Gaussian's track
    #[arg(long, value_name = "N", requires = "tracks", conflicts_with = "near",
          value_parser = clap::value_parser!(u32).range(1..))]
    every: Option<u32>,
    /// Only tracks of the Gaussians nearest to this point at the tracks' first time
    #[arg(
        long,
        value_name = "X,Y,Z",
        requires = "tracks",
        value_delimiter = ',',
        num_args = 1,
        allow_negative_numbers = true
    )]
    near: Vec<f64>,
    /// Number of nearest Gaussians [default: 1]
    #[arg(long, value_name = "N", requires = "near", value_parser = clap::value_parser!(u32).range(1..))]
    count: Option<u32>,

    /// Write one HTML page with player and scene; it needs no network and no server. Implied by an output NAME.html
    #[arg(long, conflicts_with_all = ["time", "sequence"], requires = "output")]
    html: bool,
    /// Store the page's scene in this file, in the page's folder or below, for web servers
    #[arg(long, value_name = "FILE", requires = "output")]
    link: Option<PathBuf>,

    #[arg(short = 'm', long = "model-path", alias = "model_path", hide = true, conflicts_with = "source")]
    model: Option<PathBuf>,
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    let path = args.source.as_ref().or(args.model.as_ref()).expect("clap asks for a source");
    for (name, value) in [("--time", args.time), ("--fps", args.fps), ("--from", args.from), ("--to", args.to)] {
        if value.is_some_and(|v| !v.is_finite() || (name == "--fps" && !(0.01..=1000.0).contains(&v))) {
            return Err(Error::input(format!("{name} is out of range"))
                .remedy("Give a plain, sensible number.")
                .into());
        }
    }
    if args.sequence.is_none() && args.tracks.is_none() {
        let given = [("--fps", args.fps), ("--from", args.from), ("--to", args.to)];
        if let Some((name, _)) = given.iter().find(|(_, v)| v.is_some()) {
            return Err(Error::input(format!("{name} applies to a sequence or to tracks"))
                .remedy("Add --sequence FOLDER or --tracks FILE, or choose one time with --time.")
                .into());
        }
    }
    let named = |ending: &str| {
        args.output.as_ref().is_some_and(|o| o.extension().is_some_and(|e| e.eq_ignore_ascii_case(ending)))
    };
    if args.html || named("html") || named("htm") {
        if args.label.is_some() {
            return Err(Error::input("a page shows the whole file")
                .remedy("First write a file with that label only: splat4d edit RUN --crop 'label(NAME)' -o part.s4d.")
                .into());
        }
        let out = args.output.as_ref().expect("clap asks for an output");
        return Ok(exporting::page(path, out, args.link.as_deref(), console)?);
    }
    if args.link.is_some() {
        return Err(Error::input("--link needs a page").remedy("Add -o NAME.html.").into());
    }
    let mut source = Source::open(path)?;
    if let Some(name) = args.label.as_ref().filter(|_| args.tracks.is_none()) {
        let wanted = Some(labels::named(&source.scene.labels, name).map_err(|e| e.at(path.display()))?);
        for layer in &mut source.scene.layers {
            let of = labels::of(&layer.params);
            layer.edit(&RowEdit::prune(Space::Gaussians, of.iter().map(|l| *l == wanted)), &Rng::new(0, "export", 0));
        }
    }
    for file in args.output.iter().chain(&args.tracks) {
        source.keep(path, file, &args.points.iter().map(PathBuf::as_path).collect::<Vec<_>>())?;
    }
    let scene = &source.scene;
    not_empty(scene, path)?;
    let write = |time: f64, out: &Path| exporting::moment(scene, time, args.world, out);
    if let Some(out) = &args.tracks {
        return match &args.points {
            Some(points) => followed(&source, args, [points, out], console),
            None => tracks(scene, args, out, console),
        };
    }
    if let Some(folder) = &args.sequence {
        let (fps, times) = sequence::timestamps(scene, args.fps, [args.from, args.to])?;
        let pattern = sequence::Pattern::in_folder(folder);
        let read = sequence::Read { path, run: source.run.as_ref() };
        let owned = sequence::take(&[&pattern], times.len(), &read, "export", args.force)?;
        for (i, &time) in times.iter().enumerate() {
            write(time, &pattern.file(i))?;
            console.phase("exporting", i + 1, times.len());
        }
        owned.finished();
        console.clear();
        let (from, to) = (times[0], times[times.len() - 1]);
        console.say(&format!("{} files, {fps} per second, from {from} to {to} s", times.len()));
        console.written(folder);
        return Ok(());
    }
    let out = args.output.as_ref().expect("clap asks for an output");
    if out.extension().is_none_or(|e| !e.eq_ignore_ascii_case("ply")) && !out.starts_with("/dev") {
        return Err(Error::input("a time of the scene is written as .ply, and a page as .html")
            .at(out.display())
            .remedy("Use -o NAME.ply or -o NAME.html; `splat4d convert` writes other formats, `splat4d bake` a .s4d.")
            .into());
    }
    let time = args.time.unwrap_or(scene.clip[0]);
    let n = write(time, out)?;
    exporting::warn_of_empty(scene, time, n, console);
    console.say(&format!("{} Gaussians at {time} s", files::grouped(n)));
    console.emit(&json!({"type": "exported", "gaussians": n, "time": time}));
    console.written(out);
    Ok(())
}

/// Numbers of a file of tracks, at most: three for a Gaussian and a time. As text they are some gigabytes.
const MOST_NUMBERS: usize = 300_000_000;
/// Fainter Gaussians than this are not near anything.
const LEAST_OPACITY: f64 = 0.1;

/// Whether tracks are written as JSON. Errors: neither that nor CSV.
fn is_json(out: &Path) -> splat4d::Result<bool> {
    match out.extension().map(|e| e.to_ascii_lowercase()) {
        Some(e) if e == "json" => Ok(true),
        Some(e) if e == "csv" => Ok(false),
        _ => Err(Error::input("tracks are written as .csv or .json")
            .at(out.display())
            .remedy("Use --tracks NAME.csv or --tracks NAME.json.")),
    }
}

/// Writes where points of a file go, and who sees them.
fn followed(source: &Source, args: &Args, [points, out]: [&PathBuf; 2], console: &Console) -> anyhow::Result<()> {
    let (scene, json) = (&source.scene, is_json(out)?);
    let (_, times) = sequence::timestamps(scene, args.fps, [args.from, args.to])?;
    let views = source.views()?;
    let asked =
        point_queries::read(&files::read_text(points)?, &views, scene.clip).map_err(|e| e.at(points.display()))?;
    if asked.len().saturating_mul(times.len()).saturating_mul(3) > MOST_NUMBERS {
        return Err(Error::input(format!("{} points at {} times are too many", asked.len(), times.len()))
            .remedy("Give fewer points, or fewer times with --fps, --from or --to.")
            .into());
    }
    let answer = QueryResult::of(scene, asked, &views, &times, &mut |done, of| console.phase("following", done, of));
    console.clear();
    if answer.missing() > 0 {
        console.warn(&format!(
            "{} of {} points are not on any Gaussian: they are left out",
            answer.missing(),
            answer.len()
        ));
    }
    files::write(out, if json { answer.to_json() } else { answer.to_csv() }.as_bytes())?;
    console.say(&format!("{} points at {} times", files::grouped(answer.len()), times.len()));
    console.emit(&json!({
        "type": "exported", "points": answer.len(), "moments": times.len(), "missing": answer.missing(),
    }));
    console.written(out);
    Ok(())
}

/// Writes where Gaussians are over time.
fn tracks(scene: &Scene<f32>, args: &Args, out: &Path, console: &Console) -> anyhow::Result<()> {
    let json = is_json(out)?;
    let (_, times) = sequence::timestamps(scene, args.fps, [args.from, args.to])?;
    let mut members = match args.near[..] {
        [] => every(scene, args.every.unwrap_or(1) as usize),
        [x, y, z] if [x, y, z].iter().all(|v| v.is_finite()) => {
            let count = args.count.unwrap_or(1) as usize;
            nearest(scene, Time(times[0]), &[[x, y, z]], count, LEAST_OPACITY).remove(0)
        }
        _ => {
            return Err(Error::input("--near is not a point")
                .remedy("Give three numbers in scene units, for instance --near 0.3,1.2,-0.5")
                .into());
        }
    };
    if let Some(name) = &args.label {
        let wanted = Some(labels::named(&scene.labels, name)?);
        let of: Vec<Vec<Option<usize>>> = scene.layers.iter().map(|l| labels::of(&l.params)).collect();
        members.retain(|m| of[m.layer][m.row as usize] == wanted);
    }
    if members.len().saturating_mul(times.len()).saturating_mul(3) > MOST_NUMBERS {
        return Err(Error::input(format!("{} tracks of {} times are too many", members.len(), times.len()))
            .remedy("Select fewer with --every N, --near X,Y,Z, --fps, --from or --to.")
            .into());
    }
    if members.is_empty() {
        console.warn(&format!("no Gaussian is active at {} s: the file has no tracks", times[0]));
    }
    let followed = Tracks::follow(scene, &members, &times);
    let offset = if args.world { scene.offset } else { [0.0; 3] };
    let text = if json { followed.to_json(scene, offset) } else { followed.to_csv(scene, offset) };
    files::write(out, text.as_bytes())?;
    console.say(&format!("{} tracks of {} times", files::grouped(members.len()), times.len()));
    console.emit(&json!({"type": "exported", "tracks": members.len(), "moments": times.len()}));
    console.written(out);
    Ok(())
}
