//! `bench`: how long every stage takes on pinned scenes, and how far that is from what this machine could do.

#[cfg(feature = "gpu")]
mod gpu;
mod growth;
#[cfg(feature = "gpu")]
mod other_programs;
mod playback;
mod roofline;
mod rows;
mod scenes;
mod stages;
mod training;

use growth::Axis;
use roofline::Roofline;
use rows::Row;
use scenes::{Name, Pinned, Places};
use splat4d::render::Simd;
use splat4d::{Error, ErrorKind, Result};
use splat4d_cli::console::Console;
use splat4d_workflow::files;
use splat4d_workflow::paths::parse_size;
use stages::Way;
use std::path::PathBuf;
use std::sync::Arc;

/// Rounds over the views of a scene; the best time of each view counts.
const ROUNDS: usize = 5;
/// Rounds of whole training steps on S, each of which takes a second.
const FEW_ROUNDS: usize = 2;
/// Gaussians from which a scene is large.
const LARGE: usize = 200_000;
/// Threads by default: what a second core gains is one of the figures.
const THREADS: [usize; 2] = [1, 2];

const EXAMPLES: &str = "\
Examples:
  studies bench                                     all scenes, one and two threads
  studies bench --scene T --scene U --threads 1
  studies bench --scene S --playbot FOLDER          the folder of the robot's SOG files
  studies bench --simd scalar --json                an array of rows for machines
  studies bench --save today.json
  studies bench --against today.json                ratios to an earlier result
  studies bench --growth all --plots docs/images    steps against Gaussians, pixels, frames
  studies bench --device gpu --save gpu.json        every stage of a GPU, scenes A, B and C
  studies bench --device gpu --sweep --save sweep.json    each kernel constant at each value
  studies bench --device gpu --beside others        the same training in other programs
  studies bench --playback runs/a runs/a-small      frames per second of runs and files

Times are means over eight views of the best of several rounds. `lower bound` is the time of a stage's compulsory work \
at the measured rates of arithmetic and memory. Playback renders from 24 of the first scene's cameras over its clip, \
end to end; the best of five rounds counts. Measure on an idle machine: docs/benchmarks.md.";

/// Measure how fast this machine renders and trains
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Scene to measure, repeatable [default: T, U and S; on a GPU A, B and C]
    #[arg(long = "scene", value_name = "NAME", value_enum, ignore_case = true)]
    scenes: Vec<Name>,
    /// Device to measure: the CPU, or any GPU by its own clock, with the lower bound of each stage
    #[arg(long, value_enum, default_value = "cpu", conflicts_with_all = ["growth", "playback", "simd"])]
    device: Measured,
    /// Measure a GPU with each kernel constant at each of its values
    #[arg(long)]
    sweep: bool,
    /// Train static scenes for a comparison with other programs: write their input into this folder, and compare with
    /// their results in it if losses agree
    #[arg(long, value_name = "FOLDER", conflicts_with = "sweep")]
    beside: Option<PathBuf>,
    /// Folder with the SOG files of scene S
    #[arg(long, value_name = "FOLDER")]
    playbot: Option<PathBuf>,
    /// Scene of T and U: a run, or a file that contains its cameras [default: examples/knight.s4d]
    #[arg(long, value_name = "FILE")]
    file: Option<PathBuf>,
    /// SIMD level, repeatable [default: the best of this machine]
    #[arg(long, value_name = "LEVEL", value_enum)]
    simd: Vec<Level>,
    /// Rounds; the best counts
    #[arg(long, value_name = "N", default_value_t = ROUNDS, value_parser = rounds)]
    rounds: usize,
    /// Measure how a training step grows, repeatable
    #[arg(long, value_name = "AXIS", value_enum, conflicts_with = "scenes")]
    growth: Vec<Axis>,
    /// Folder for plots of the growth
    #[arg(long, value_name = "FOLDER", requires = "growth")]
    plots: Option<PathBuf>,
    /// Measure how these runs, scenes or .s4d files play, alternately
    #[arg(long, value_name = "FILE|RUN", num_args = 1.., conflicts_with_all = ["scenes", "growth", "simd", "rounds",
        "against"])]
    playback: Vec<PathBuf>,
    /// Image size of --playback [default: 800x800]
    #[arg(long, value_name = "WxH", value_parser = parse_size, requires = "playback")]
    size: Option<[usize; 2]>,
    /// Print a Markdown table
    #[arg(long)]
    markdown: bool,
    /// Write the rows as JSON for a later --against
    #[arg(long, value_name = "FILE")]
    save: Option<PathBuf>,
    /// Print the ratio to an earlier result
    #[arg(long, value_name = "FILE")]
    against: Option<PathBuf>,
}

/// The device that is measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Measured {
    /// The CPU
    Cpu,
    /// A GPU, including software drivers
    Gpu,
}

fn rounds(text: &str) -> std::result::Result<usize, String> {
    text.parse().ok().filter(|n| (1..=1000).contains(n)).ok_or_else(|| "expected a number from 1 to 1000".into())
}

/// Instruction levels as the command line names them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Level {
    /// The baseline of this architecture
    Scalar,
    /// AVX2 with fused multiply-add
    Avx2,
    /// AVX-512
    Avx512,
}

impl Level {
    fn simd(self) -> Result<Simd> {
        let (wanted, best) = match self {
            Self::Scalar => (Simd::Scalar, Simd::detect()),
            Self::Avx2 => (Simd::Avx2, Simd::detect()),
            Self::Avx512 => (Simd::Avx512, Simd::detect()),
        };
        if wanted > best {
            let what = format!("this machine does not have the instructions `{}`", stages::simd_name(wanted));
            let remedy = format!("Its best level is {}.", stages::simd_name(best));
            return Err(Error::new(ErrorKind::Unsupported, what).remedy(remedy));
        }
        Ok(wanted)
    }
}

pub(crate) fn run(args: &Args, threads: Option<u16>, console: &Console) -> anyhow::Result<()> {
    if !args.playback.is_empty() {
        return play(args, console);
    }
    // Impossible settings are reported before any work.
    if (args.sweep || args.beside.is_some()) && args.device != Measured::Gpu {
        let error = Error::new(ErrorKind::BadInput, "--sweep and --beside need a GPU");
        return Err(error.remedy("Add --device gpu.").into());
    }
    let earlier = args.against.as_deref().map(rows::read).transpose()?;
    let levels: Vec<Simd> = match &args.simd[..] {
        [] => vec![Simd::detect()],
        levels => levels.iter().map(|l| l.simd()).collect::<Result<_>>()?,
    };
    let threads = match threads {
        Some(n) => vec![usize::from(n)],
        None => {
            THREADS.into_iter().filter(|n| *n <= std::thread::available_parallelism().map_or(1, usize::from)).collect()
        }
    };
    let places = Places { playbot: args.playbot.clone(), file: args.file.clone() };
    let names = match &args.scenes[..] {
        _ if !args.growth.is_empty() => vec![Name::T],
        #[cfg(feature = "gpu")]
        [] if args.device == Measured::Gpu => Name::OF_GPU.to_vec(),
        [] => Name::ALL.to_vec(),
        names => names.to_vec(),
    };
    let mut scenes = Vec::new();
    for name in names {
        match Pinned::open(name, &places)? {
            Ok(pinned) => scenes.push(pinned),
            Err(skipped) => console.aside(&skipped.0),
        }
    }
    let mut rows = if args.device == Measured::Gpu {
        let way = Way { threads: threads[threads.len() - 1], simd: levels[0], rounds: args.rounds };
        on_gpu(&scenes, way, args, console)?
    } else if args.growth.is_empty() {
        measure(&scenes, &levels, &threads, args.rounds, console)?
    } else {
        grow(&scenes, args, &levels, &threads, console)?
    };
    if let Some(path) = &args.save {
        files::write(path, rows::json(&rows).as_bytes())?;
        console.aside(&format!("wrote {}", path.display()));
    }
    if let Some(earlier) = earlier
        && rows::compare(&mut rows, &earlier) == 0
        && !rows.is_empty()
    {
        console.aside("the earlier result has no row with the same scene, stage, threads and instructions");
    }
    console.clear();
    match (console.json(), args.markdown) {
        (true, _) => console.result(&rows::json(&rows)),
        (_, true) => console.result(rows::markdown(&rows).trim_end()),
        _ if rows.is_empty() => {}
        _ => console.result(rows::table(&rows).trim_end()),
    }
    Ok(())
}

/// Measures a GPU, with the most threads next to it.
#[cfg(feature = "gpu")]
fn on_gpu(scenes: &[Pinned], way: Way, args: &Args, console: &Console) -> anyhow::Result<Vec<Row>> {
    let pool = pool(way.threads)?;
    let defaults = splat4d::gpu::Tuning::default();
    let tunings = if args.sweep { splat4d::gpu::Tuning::sweep() } else { vec![defaults] };
    Ok(match &args.beside {
        Some(folder) => gpu::other_programs(scenes, folder, way, &pool, &|text| console.aside(text))?,
        None => gpu::measure(scenes, way, &tunings, &pool, &|text| console.note(text))?,
    })
}

#[cfg(not(feature = "gpu"))]
fn on_gpu(_: &[Pinned], _: Way, _: &Args, _: &Console) -> anyhow::Result<Vec<Row>> {
    let error = Error::new(ErrorKind::Unsupported, "this splat4d was built without the feature `gpu`");
    Err(error.remedy("Build it with its default features.").into())
}

/// Measures how files play.
fn play(args: &Args, console: &Console) -> anyhow::Result<()> {
    let rows = playback::measure(&args.playback, args.size.unwrap_or(splat4d_workflow::measure::SIZE), console)?;
    if let Some(path) = &args.save {
        files::write(path, playback::json(&rows).as_bytes())?;
        console.aside(&format!("wrote {}", path.display()));
    }
    console.result(&match (console.json(), args.markdown) {
        (true, _) => playback::json(&rows),
        (_, true) => playback::markdown(&rows),
        _ => playback::table(&rows),
    });
    Ok(())
}

/// Measures growth with size, on the most threads, and plots it.
fn grow(
    scenes: &[Pinned],
    args: &Args,
    levels: &[Simd],
    threads: &[usize],
    console: &Console,
) -> anyhow::Result<Vec<Row>> {
    let most = threads.iter().copied().max().unwrap_or(1);
    let pool = pool(most)?;
    let mut rows = Vec::new();
    for pinned in scenes {
        for &simd in levels {
            let way = Way { threads: most, simd, rounds: args.rounds.min(FEW_ROUNDS) };
            rows.extend(growth::measure(pinned, &args.growth, way, &pool, &|text| console.note(text))?);
        }
    }
    if let Some(folder) = &args.plots {
        files::make_folder(folder)?;
        for (name, svg) in growth::plots(&rows) {
            let path = folder.join(name);
            files::write(&path, svg.as_bytes())?;
            console.note(&format!("wrote {}", path.display()));
        }
    }
    Ok(rows)
}

fn measure(
    scenes: &[Pinned],
    levels: &[Simd],
    threads: &[usize],
    rounds: usize,
    console: &Console,
) -> anyhow::Result<Vec<Row>> {
    let mut rows = Vec::new();
    // Without a scene there is nothing to compare the rooflines with.
    for &simd in levels.iter().filter(|_| !scenes.is_empty()) {
        let ways: Vec<Way> = threads.iter().map(|&threads| Way { threads, simd, rounds }).collect();
        let pools = ways.iter().map(|w| pool(w.threads)).collect::<anyhow::Result<Vec<_>>>()?;
        let rooflines: Vec<Roofline> = pools.iter().map(|p| Roofline::measure(p, simd)).collect();
        for (way, c) in ways.iter().zip(&rooflines) {
            console.note(&format!(
                "{}, {} thread(s): at best {:.2} G pairs/s and {:.1} GB/s",
                stages::simd_name(simd),
                way.threads,
                c.pairs * 1e-9,
                c.bytes * 1e-9
            ));
        }
        for pinned in scenes {
            let held = Arc::new(training::Held::of(pinned, ways[0]));
            for ((way, pool), roofline) in ways.iter().zip(&pools).zip(&rooflines) {
                console.note(&format!("scene {}, {} thread(s) ...", pinned.name, way.threads));
                let large = pinned.scene.len() >= LARGE;
                let steps = Way { rounds: if large { rounds.min(FEW_ROUNDS) } else { rounds }, ..*way };
                let mut drawn = pool.install(|| stages::measure(pinned, *way, roofline))?;
                let mut trained = pool.install(|| training::measure(pinned, &held, steps, roofline))?;
                fill_in_step(&mut drawn, &mut trained);
                rows.append(&mut drawn);
                rows.append(&mut trained);
            }
        }
    }
    Ok(rows)
}

/// A step's floor is that of its parts together.
fn fill_in_step(drawn: &mut [Row], trained: &mut [Row]) {
    let floor = |r: &Row| r.ceiling_share.map_or(0.0, |share| share * r.ms);
    let renderer: f64 = drawn.iter().filter(|r| r.stage == "forward+backward").map(floor).sum();
    let parts: f64 = trained.iter().map(floor).sum();
    for step in trained.iter_mut().filter(|r| r.stage == "step" && r.ms > 0.0) {
        step.ceiling_share = Some((renderer + parts) / step.ms);
    }
}

fn pool(threads: usize) -> anyhow::Result<rayon::ThreadPool> {
    rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .map_err(|e| anyhow::anyhow!("{threads} threads could not be started ({e}). Ask for fewer."))
}
