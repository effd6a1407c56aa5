//! `export`: a scene at one or several times as 3DGS .ply files or as triangle meshes, the whole scene as one page with
//! its player, or positions of Gaussians or of requested points as JSON or CSV.

use crate::console::Console;
use clap::ArgGroup;
use clap::builder::PossibleValuesParser;
use serde_json::json;
use splat4d::Error;
use splat4d_workflow::converting::{self, Conversion};
use splat4d_workflow::exporting::{self, Frames, PlyOptions, TrackOptions};
use splat4d_workflow::files;
use splat4d_workflow::meshing::{self, MeshOptions};
use splat4d_workflow::programs::{PROGRAMS, Program};
use std::path::{Path, PathBuf};

const EXAMPLES: &str = "\
Examples:
  splat4d export runs/knight -o now.ply --time 0.5         one time; every 3DGS viewer opens it
  splat4d export runs/knight --sequence frames/            frame_00000.ply ...; for SuperSplat
  splat4d export runs/knight --sequence frames/ --fps 10 --from 0.2 --to 0.8
  splat4d export runs/knight --sequence frames/ --for unreal            z up, cm, left-handed
  splat4d export runs/knight --html -o knight.html         player and scene in one page
  splat4d export runs/knight --html -o index.html --link knight.s4d    for a web server
  splat4d export runs/knight --tracks tracks.csv           positions at every frame; .json too
  splat4d export runs/knight --tracks tracks.json --every 50
  splat4d export runs/knight --tracks flow.npz             scene flow: positions and velocities
  splat4d export runs/knight --sequence frames/ --velocities
  splat4d export runs/knight --tracks hand.csv --near 0.3,1.2,-0.5 --count 20
  splat4d export runs/knight --tracks paths.csv --points asked.csv    given points
  splat4d export runs/knight -o knight.ply --time 0.5 --label knight
  splat4d export runs/knight --mesh knight.glb --time 0.5              triangles; .obj and .ply too
  splat4d export runs/knight --mesh meshes/ --fps 10 --watertight      frame_00000.glb ...
  splat4d export runs/knight --mesh walls.%04d.obj --collision --voxel 0.05    for physics

A file of points has a header and one line per point, either a camera's pixel at a time or a position at a time:
  camera,x,y,time          time,x,y,z           time,x,y,z,camera
  cam03,151.5,88,0.2       0,0.31,1.2,-0.5      0,0.31,1.2,-0.5,cam03
Pixels are those of the camera's image, the first one's centre at 0.5; times are seconds. `visible` is 1 where the \
camera sees the point, and empty without a camera.";

/// Write a scene as 3DGS .ply files, as triangle meshes, as an HTML page, or as tracks of its Gaussians
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, group(ArgGroup::new("replaceable").args(["sequence", "mesh"])))]
pub(crate) struct Args {
    /// The run, scene file or .ply; for a page also a playback file
    #[arg(value_name = "RUN|FILE", required_unless_present = "model")]
    source: Option<PathBuf>,
    /// The file of one time, or the page
    #[arg(short, long, value_name = "OUT", required_unless_present_any = ["sequence", "tracks", "mesh"])]
    output: Option<PathBuf>,
    /// The time, seconds of the scene [default: the clip's start]
    #[arg(long, value_name = "T", allow_negative_numbers = true, conflicts_with = "sequence")]
    time: Option<f64>,
    /// A folder for one file per frame
    #[arg(long, value_name = "FOLDER", conflicts_with = "output")]
    sequence: Option<PathBuf>,
    /// Replace a sequence that splat4d wrote to the folder, even a longer one, or the file of --mesh
    #[arg(long, requires = "replaceable")]
    force: bool,
    /// Files per second of a sequence or of meshes, samples per second of tracks [default: the capture's frame rate]
    #[arg(long, value_name = "N")]
    fps: Option<f64>,
    /// First second of a sequence, of meshes or of tracks
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    from: Option<f64>,
    /// Last second of a sequence, of meshes or of tracks
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    to: Option<f64>,

    /// Write positions of Gaussians over time (seconds, scene units) to this .csv or .json file, or with velocities to this
    /// .npz
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
    /// Add velocities to every Gaussian of a .ply: vx, vy, vz, scene units per second
    #[arg(long, conflicts_with_all = ["html", "tracks", "program"])]
    velocities: bool,
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

    /// Write triangle meshes: NAME.glb, .obj or .ply at one time, or NAME.%05d.glb or a folder for one per frame
    #[arg(long, value_name = "OUT", conflicts_with_all = ["output", "sequence", "tracks", "html", "program", "world"])]
    mesh: Option<PathBuf>,
    /// Side of a voxel, scene units: the size of the smallest triangles [default: 0.02]
    #[arg(long, value_name = "SIZE", requires = "mesh", allow_negative_numbers = true)]
    voxel: Option<f64>,
    /// Close the surface: gaps that no camera saw are closed up to 10 voxels, wider ones bound a shell
    #[arg(long, requires = "mesh")]
    watertight: bool,
    /// A mesh for physics: closed, with a filled floor, without colours and normals
    #[arg(long, requires = "mesh")]
    collision: bool,

    /// Write one HTML page with player and scene; it needs no network and no server. Implied by an output NAME.html
    #[arg(long, conflicts_with_all = ["time", "sequence"], requires = "output")]
    html: bool,
    /// Store the page's scene in this file, in the page's folder or below, for web servers
    #[arg(long, value_name = "FILE", requires = "output")]
    link: Option<PathBuf>,

    /// Axes, unit and file names of this program, the same Gaussians in every file of a sequence
    #[arg(long = "for", value_name = "PROGRAM", value_parser = PossibleValuesParser::new(PROGRAMS.map(|p| p.name)),
          conflicts_with_all = ["tracks", "html", "label", "link"])]
    program: Option<String>,

    #[arg(short = 'm', long = "model-path", alias = "model_path", hide = true, conflicts_with = "source")]
    model: Option<PathBuf>,
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    let path = args.source.as_ref().or(args.model.as_ref()).expect("clap requires a source");
    for (name, value) in [("--time", args.time), ("--fps", args.fps), ("--from", args.from), ("--to", args.to)] {
        if value.is_some_and(|v| !v.is_finite() || (name == "--fps" && !(0.01..=1000.0).contains(&v))) {
            return Err(Error::input(format!("invalid {name}"))
                .remedy("Give a finite number; frames per second from 0.01 to 1000.")
                .into());
        }
    }
    if args.sequence.is_none() && args.tracks.is_none() && args.mesh.is_none() {
        let given = [("--fps", args.fps), ("--from", args.from), ("--to", args.to)];
        if let Some((name, _)) = given.iter().find(|(_, v)| v.is_some()) {
            return Err(Error::input(format!("{name} applies to a sequence, to meshes or to tracks"))
                .remedy("Add --sequence FOLDER, --mesh FOLDER or --tracks FILE, or choose one time with --time.")
                .into());
        }
    }
    let named = |ending: &str| {
        args.output.as_ref().is_some_and(|o| o.extension().is_some_and(|e| e.eq_ignore_ascii_case(ending)))
    };
    if args.html || named("html") || named("htm") {
        if args.program.is_some() {
            return Err(Error::input("--for applies to .ply files")
                .remedy("Use -o NAME.ply or --sequence FOLDER.")
                .into());
        }
        if args.label.is_some() {
            return Err(Error::input("a page shows the whole file")
                .remedy("First write a file with that label only: splat4d edit RUN --crop 'label(NAME)' -o part.s4d.")
                .into());
        }
        let out = args.output.as_ref().expect("clap requires an output");
        return Ok(exporting::page(path, out, args.link.as_deref(), console)?);
    }
    if args.link.is_some() {
        return Err(Error::input("--link needs a page").remedy("Add -o NAME.html.").into());
    }
    let mut source = exporting::open(path, args.label.as_deref().filter(|_| args.tracks.is_none()))?;
    if let Some(out) = &args.mesh {
        let frames = Frames { fps: args.fps, from: args.from, to: args.to };
        let options = MeshOptions {
            voxel: args.voxel.unwrap_or(meshing::VOXEL),
            watertight: args.watertight,
            collision: args.collision,
            time: args.time,
            frames,
            force: args.force,
        };
        meshing::write(path, &source, out, &options, console)?;
        return Ok(());
    }
    let outputs: Vec<&Path> = args.output.iter().chain(&args.tracks).map(PathBuf::as_path).collect();
    source.keep_all(path, &outputs, &args.points.iter().map(PathBuf::as_path).collect::<Vec<_>>())?;
    if args.tracks.is_none() && args.program.is_none() {
        exporting::fold(&mut source, console)?;
    }
    let scene = &source.scene;
    let frames = Frames { fps: args.fps, from: args.from, to: args.to };
    if let Some(out) = &args.tracks {
        match &args.points {
            Some(points) => exporting::points(&source, points, &frames, out, console)?,
            None => exporting::tracks(scene, &tracks(args, frames)?, out, console)?,
        }
        return Ok(());
    }
    let program = args.program.as_deref().and_then(Program::of);
    let conversion = |output: &Path| Conversion {
        force: args.force,
        fps: args.fps,
        from: args.from,
        to: args.to,
        world: args.world,
        program,
        ..Conversion::new(path, output)
    };
    if let (Some(program), Some(folder)) = (program, &args.sequence) {
        let named = folder.join(program.frame);
        return Ok(converting::run(&Conversion { frames: true, ..conversion(&named) }, console)?);
    }
    let options = PlyOptions { world: args.world, velocities: args.velocities };
    if let Some(folder) = &args.sequence {
        exporting::frames(path, &source, folder, &frames, (options, args.force), console)?;
        return Ok(());
    }
    let out = args.output.as_ref().expect("clap requires an output");
    if out.extension().is_none_or(|e| !e.eq_ignore_ascii_case("ply")) && !files::is_stream(out) {
        return Err(Error::input("a time of the scene is written as .ply, and a page as .html")
            .at(out.display())
            .remedy("Use -o NAME.ply or -o NAME.html; `splat4d convert` writes other formats, `splat4d bake` a .s4d.")
            .into());
    }
    let time = args.time.unwrap_or(scene.clip[0]);
    if program.is_some() {
        return Ok(converting::run(&Conversion { time: Some(time), ..conversion(out) }, console)?);
    }
    let n = exporting::moment(scene, time, options, out)?;
    exporting::warn_of_empty(scene, time, n, console);
    console.print_line(&format!("{} Gaussians at {time} s", files::grouped(n)));
    console.emit(&json!({"type": "exported", "gaussians": n, "time": time}));
    console.written(out);
    Ok(())
}

fn tracks(args: &Args, frames: Frames) -> anyhow::Result<TrackOptions> {
    let near = match args.near[..] {
        [] => None,
        [x, y, z] => Some(([x, y, z], args.count.unwrap_or(1) as usize)),
        _ => {
            return Err(Error::input("--near is not a point")
                .remedy("Give three numbers in scene units, for instance --near 0.3,1.2,-0.5")
                .into());
        }
    };
    let every = args.every.unwrap_or(1) as usize;
    Ok(TrackOptions { frames, every, near, label: args.label.clone(), world: args.world })
}
