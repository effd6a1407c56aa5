//! Anything that can be played, as a playback file: one unchanged; a run's, if it is not older than its scene; any
//! other scene baked in memory.

use crate::baking::{Baking, pack, title};
use crate::deadline::Deadline;
use crate::events::Listener;
use crate::files::{self, cannot_read};
use crate::folding::fold;
use crate::run_folder::Run;
use crate::source::{Source, not_empty};
use splat4d::Result;
use splat4d::format::playback::{self, HEADER_BYTES, Index, MAGIC, Rung};
use splat4d_serve::Content;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// Name of a run's playback file.
pub const FILE: &str = "scene.s4d";
/// Its name in runs of versions before 0.1.
const OLD_FILE: &str = "scene.splat4d";

/// Path of a run's playback file, which may be missing.
pub fn of_run(run: &Path) -> PathBuf {
    let old = run.join(OLD_FILE);
    if old.is_file() && !run.join(FILE).is_file() { old } else { run.join(FILE) }
}

/// A playback file and what people call it.
pub struct Playable {
    pub title: String,
    pub content: Content,
}

impl Playable {
    /// Opens a run or a file, baking it where it must be. Errors: no scene; a damaged playback file.
    pub fn open(path: &Path, console: &dyn Listener) -> Result<Self> {
        if let Some(file) = ready(path)? {
            let index = index(&file)?;
            let stem = || path.file_stem().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
            let title = if index.meta.title.is_empty() { stem() } else { index.meta.title };
            return Ok(Self { title, content: Content::File(file) });
        }
        let mut source = Source::open(path)?;
        not_empty(&source.scene, path)?;
        fold(&mut source, "a playback file", &Deadline::default(), console)?;
        source.warnings.lines().iter().for_each(|w| console.warn(&format!("{w}.")));
        let title = title(&source, path);
        let packed = pack(&source, &title, &Baking::default(), console)?;
        console.clear();
        let bytes = playback::with_extras(&packed.bytes, source.provenance.as_ref(), source.sound.as_ref())?;
        Ok(Self { title, content: Content::Bytes(bytes.into()) })
    }

    /// The whole file. Errors: damaged anywhere.
    pub fn bytes(&self) -> Result<Vec<u8>> {
        match &self.content {
            Content::File(path) => {
                let bytes = files::read(path)?;
                playback::read(&bytes).map_err(|e| e.at(path.display()))?;
                Ok(bytes)
            }
            Content::Bytes(bytes) => Ok(bytes.to_vec()),
            _ => Ok(Vec::new()),
        }
    }
}

/// The playback file that is there already.
fn ready(path: &Path) -> Result<Option<PathBuf>> {
    if Run::is(path) {
        let changed = |p: &Path| p.metadata().and_then(|m| m.modified()).ok();
        let baked = of_run(path);
        let scene = Run::open(path)?.scene_file().ok();
        let current = baked.is_file() && scene.is_none_or(|scene| changed(&scene) <= changed(&baked));
        return Ok(current.then_some(baked));
    }
    // A folder or pattern of files, or nothing: opening reports the error.
    if !path.is_file() {
        return Ok(None);
    }
    let mut start = Vec::new();
    let file = files::open(path)?;
    file.take(MAGIC.len() as u64).read_to_end(&mut start).map_err(|e| cannot_read(path, e))?;
    Ok((start == MAGIC).then(|| path.to_owned()))
}

/// The bitrate ladder of the playback file that is there already; empty without either.
pub(crate) fn ladder(path: &Path) -> Vec<Rung> {
    ready(path).ok().flatten().and_then(|file| index(&file).ok()).map_or_else(Vec::new, |index| index.meta.ladder)
}

/// A playback file's index; the rest is not read. A damaged file is reported here rather than in a browser.
fn index(path: &Path) -> Result<Index> {
    let fail = |e| cannot_read(path, e);
    let file = files::open(path)?;
    let mut header = Vec::new();
    (&file).take(HEADER_BYTES as u64).read_to_end(&mut header).map_err(fail)?;
    // Behind everything else in a file that grows.
    let place = Index::place(&header).map_err(|e| e.at(path.display()))?;
    (&file).seek(SeekFrom::Start(place.start)).map_err(fail)?;
    let mut index = Vec::new();
    (&file).take(place.end - place.start).read_to_end(&mut index).map_err(fail)?;
    Index::of(&header, &index).map_err(|e| e.at(path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn playback_files_are_known_by_both_extensions() {
        for (name, named) in [("a.s4d", true), ("A.S4D", true), ("a.splat4d", true), ("a.splat", false), ("s4d", false)]
        {
            assert_eq!(files::is_playback(Path::new(name)), named, "{name}");
        }
        let run = tempfile::tempdir().unwrap();
        assert_eq!(of_run(run.path()), run.path().join("scene.s4d"));
        std::fs::write(run.path().join("scene.splat4d"), b"").unwrap();
        assert_eq!(of_run(run.path()), run.path().join("scene.splat4d"), "a run of an older version");
        std::fs::write(run.path().join("scene.s4d"), b"").unwrap();
        assert_eq!(of_run(run.path()), run.path().join("scene.s4d"));
    }
}
