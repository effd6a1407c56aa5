//! The playback file of a long capture: parts are appended as they are finished, so that its present part plays; at the
//! end it is written again as any other file.

use crate::baking::{self, Baking, Outline, bake_like, poster};
use crate::deadline::Deadline;
use crate::events::Listener;
use crate::files::{self, cannot_read, human_bytes};
use crate::playable::FILE;
use crate::run_folder::Run;
use crate::sound;
use crate::source::Source;
use splat4d::format::playback::{Growing, HEADER_BYTES, Index, Meta, finish};
use splat4d::layers::Scene;
use splat4d::{Error, Result};
use splat4d_train::output::{note, write_atomically_with};
use splat4d_train::run::chunks::{ChunkPlan, Chunked, Part};
use std::fs::File;
use std::io::Read;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

/// Bytes 8 and 9 of a file that grows: its major version (docs/format.md, "Files that grow").
const GROWS: [u8; 2] = [2, 0];
/// Name of the file that is made of the parts of a capture whose file is finished already.
const AGAIN: &str = ".scene.again.s4d";

/// Appends all parts that are finished and not in the file yet. Nothing happens to a file that is finished.
pub fn append(
    run: &Path,
    chunked: &Chunked,
    deadline: &Deadline,
    stop: &AtomicBool,
    console: &dyn Listener,
) -> Result<()> {
    let _turn = chunked.turn(stop)?;
    let path = run.join(FILE);
    if path.is_file() && !grows(&path)? {
        return Ok(());
    }
    append_to(&path, run, chunked, false, deadline, console).map(|_| ())
}

/// Appends what is missing and finishes the file. Returns its length, bytes.
pub fn complete(
    run: &Path,
    chunked: &Chunked,
    deadline: &Deadline,
    stop: &AtomicBool,
    console: &dyn Listener,
) -> Result<u64> {
    let _turn = chunked.turn(stop)?;
    let path = run.join(FILE);
    // Of a capture that was joined before, chunks may have been trained again.
    let again = path.is_file() && !grows(&path)?;
    let growing = if again { run.join(AGAIN) } else { path.clone() };
    let done = complete_from(&growing, &path, run, chunked, deadline, console);
    if again {
        let _ = std::fs::remove_file(&growing);
    }
    done
}

fn complete_from(
    growing: &Path,
    path: &Path,
    run: &Path,
    chunked: &Chunked,
    deadline: &Deadline,
    console: &dyn Listener,
) -> Result<u64> {
    let meta = append_to(growing, run, chunked, true, deadline, console)?;
    let first = opened(run, chunked.some(0..1)?)?;
    let poster = poster(&first.scene, &first.stage(&first.views()?), first.antialias());
    let sound = first.run.as_ref().map_or(Ok(None), sound::of_run).unwrap_or_else(|e| {
        console.warn(&format!("the sound is left out: {e}"));
        None
    });
    let mut source = files::open(growing)?;
    let mut length = 0;
    write_atomically_with(path, &mut |out| {
        length = finish(&mut source, meta.clone(), (poster.as_deref(), sound.as_ref()), out)?;
        Ok(())
    })?;
    console.written(path);
    Ok(length)
}

/// Whether a playback file is one that grows, or one that cannot be played.
fn grows(path: &Path) -> Result<bool> {
    let mut header = Vec::new();
    let file = files::open(path)?;
    file.take(HEADER_BYTES as u64).read_to_end(&mut header).map_err(|e| cannot_read(path, e))?;
    Ok(Index::place(&header).is_err() || header[8..10] == GROWS)
}

/// Appends what is missing, in time; `thorough`: and checks that its parts match the existing chunks.
fn append_to(
    path: &Path,
    run: &Path,
    chunked: &Chunked,
    thorough: bool,
    deadline: &Deadline,
    console: &dyn Listener,
) -> Result<Meta> {
    let done: Vec<Part> = chunked.parts().into_iter().filter(|p| chunked.is_done(*p)).collect();
    let place = |e: std::io::Error| Error::io("the playback file cannot be opened", e).at(path.display());
    let known = File::options().read(true).write(true).open(path).ok().and_then(|file| Growing::open(file).ok());
    let in_it = |meta: &Meta, part: &Part| meta.parts.iter().find(|p| p.starts_with(&format!("{part} "))).cloned();
    // Parts that were trained again since, or a file that does not hold together: all of it is made again.
    let mut growing = None;
    if let Some(file) = known {
        let mut same = true;
        for (part, print) in done.iter().filter_map(|p| Some((p, in_it(&file.index().meta, p)?))) {
            same &= !thorough || chunked.print(*part)? == print;
        }
        growing = Some(file).filter(|_| same);
    }
    let mut meta = growing.as_ref().map(|g| g.index().meta.clone());
    for (number, part) in done.iter().enumerate() {
        if meta.as_ref().is_some_and(|m| in_it(m, part).is_some()) {
            continue;
        }
        let print = chunked.print(*part)?;
        console.phase(&format!("the playback file, chunk {part}"), 0, 0);
        let shell = chunked.shell()?;
        let whole = shell.clip;
        let scene = match part {
            Part::Shared => Scene { layers: chunked.still()?.into_iter().collect(), ..shell },
            Part::Chunk(c) => chunked.alone(*c)?,
        };
        let last = if *part == Part::Shared { whole[0] } else { scene.clip[1] };
        let source = opened(run, scene)?;
        let title = source.run.as_ref().map(Run::name).unwrap_or_default();
        let deadline = deadline.part(1.0 / (done.len() - number) as f64);
        let baking = Baking { poster: false, deadline, ..Baking::default() };
        let (bytes, theirs) = if source.scene.is_empty() {
            (None, Meta::default())
        } else {
            let bytes = bake_like(&source, &title, &baking, console)?.packed.bytes;
            let index = Index::parse(&bytes, None)?;
            (Some(bytes), index.meta)
        };
        let mut next = meta.take().unwrap_or_else(|| Meta {
            clip: [whole[0]; 2],
            sh_degree: 0,
            bounds: None,
            gaussians: 0,
            ..described(&source, &title)
        });
        next.clip[1] = next.clip[1].max(last);
        next.sh_degree = next.sh_degree.max(theirs.sh_degree);
        next.bounds = union(next.bounds, theirs.bounds);
        next.parts.push(print);
        next.missing = missing(chunked.plan(), &next);
        let file = match growing.as_mut() {
            Some(file) => file,
            None => {
                note(path)?;
                let file =
                    File::options().read(true).write(true).create(true).truncate(true).open(path).map_err(place)?;
                growing.insert(Growing::begin(file, next.clone())?)
            }
        };
        if let Some(bytes) = bytes {
            file.append(&bytes, next.clone(), &mut |f| f.sync_data()).map_err(|e| e.at(path.display()))?;
            console.detail(&format!("{}: chunk {part}, {} more", path.display(), human_bytes(bytes.len() as u64)));
        }
        meta = Some(next);
    }
    console.clear();
    meta.ok_or_else(|| {
        Error::input("no chunk is finished").at(run.display()).remedy("Train option `chunk` shared first")
    })
}

/// A scene of the run.
fn opened(run: &Path, scene: Scene<f32>) -> Result<Source> {
    Ok(Source { run: Some(Run::open(run)?), ..Source::own(scene) })
}

pub(crate) fn union(a: Option<[[f64; 3]; 2]>, b: Option<[[f64; 3]; 2]>) -> Option<[[f64; 3]; 2]> {
    let (Some([a0, a1]), Some([b0, b1])) = (a, b) else { return a.or(b) };
    Some([std::array::from_fn(|k| a0[k].min(b0[k])), std::array::from_fn(|k| a1[k].max(b1[k]))])
}

/// Seconds before the clip's end whose chunks are not there, from cut to cut.
fn missing(plan: &ChunkPlan, meta: &Meta) -> Vec<[f64; 2]> {
    let there = |c: usize| meta.parts.iter().any(|p| p.starts_with(&format!("{c} ")));
    let second = |frame: usize| meta.clip[0] + (frame - plan.take[0]) as f64 / meta.fps;
    let border = |k: usize| match k {
        0 => plan.take[0],
        k => plan.cuts.get(k - 1).copied().unwrap_or(plan.take[1]),
    };
    let mut out: Vec<[f64; 2]> = Vec::new();
    for c in (0..plan.len()).filter(|&c| !there(c)) {
        let [from, to] = [second(border(c)), second(border(c + 1))];
        match out.last_mut() {
            Some(last) if last[1] == from => last[1] = to,
            _ => out.push([from, to]),
        }
    }
    out.retain(|span| span[0] < meta.clip[1]);
    out
}

/// The playback file of a capture that is followed while it is being filmed. Its parts are named by their frames.
pub(crate) struct Film {
    path: PathBuf,
    file: Growing<File>,
    /// Metadata of the whole; clip and box are those of what is in it.
    pub(crate) about: Meta,
}

impl Film {
    /// Continues the file, or begins it where there is none that can be continued, or one with frames from `end` on.
    pub(crate) fn open(path: &Path, about: Meta, end: usize) -> Result<Self> {
        let place = |e: std::io::Error| Error::io("the playback file cannot be opened", e).at(path.display());
        let options = || {
            let mut options = File::options();
            options.read(true).write(true);
            options
        };
        let known = options().open(path).ok().and_then(|file| Growing::open(file).ok());
        let file = match known.filter(|file| last_frame(&file.index().meta).is_none_or(|last| last <= end)) {
            Some(file) => file,
            None => {
                note(path)?;
                let file = options().create(true).truncate(true).open(path).map_err(place)?;
                Growing::begin(file, Meta { clip: [about.clip[0]; 2], gaussians: 0, ..about.clone() })?
            }
        };
        let bounds = union(about.bounds, file.index().meta.bounds);
        Ok(Self { path: path.to_owned(), file, about: Meta { bounds, ..about } })
    }

    /// Its name.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// The frame after the last one in it, from `first` on.
    pub(crate) fn frames(&self, first: usize) -> usize {
        last_frame(&self.file.index().meta).map_or(first, |last| last.max(first))
    }

    /// Appends a part. After an error the file is what it was.
    pub(crate) fn append(&mut self, part: &[u8], frames: Range<usize>, meta: Meta) -> Result<()> {
        let mut parts = self.file.index().meta.parts.clone();
        parts.push(format!("{}..{}", frames.start, frames.end));
        self.about.bounds = meta.bounds;
        let meta = Meta { parts, ..meta };
        self.file.append(part, meta, &mut |f| f.sync_data()).map_err(|e| e.at(self.path.display()))
    }

    /// Its present content as a finished file.
    pub(crate) fn finished(&self) -> Result<Vec<u8>> {
        let mut source = files::open(&self.path)?;
        let mut bytes = Vec::new();
        let meta = self.file.index().meta.clone();
        finish(&mut source, meta, (None, None), &mut bytes).map_err(|e| e.at(self.path.display()))?;
        Ok(bytes)
    }
}

/// The frame after the last one that the parts of a followed capture name.
fn last_frame(meta: &Meta) -> Option<usize> {
    meta.parts.iter().filter_map(|name| name.split_once("..")?.1.parse().ok()).max()
}

/// Metadata of the run's scene, whatever parts of it there are.
fn described(source: &Source, title: &str) -> Meta {
    let views = source.views().unwrap_or_default();
    let stage = source.stage(&views);
    let outline = Outline { clip: source.scene.clip, sh_degree: 0, bounds: None };
    let cameras = baking::distinct(&views);
    Meta { title: title.to_owned(), ..baking::meta(&source.scene, &outline, &stage, &cameras) }
}
