//! [`OutputFolder`]: the folder that a command writes, from its first check to the last file.

use super::cannot_write;
use super::list::{self, List};
use super::owner::{Owner, in_use};
use super::place::{Input, check_inputs, check_no_capture};
use super::temporary::is_temporary;
use super::{STATE, legacy, write_atomically};
use crate::path_text::in_command;
use crate::{Error, Result};
use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// File in the state folder with the request of an unfinished command.
const ASKED: &str = "asked";
/// Folder in the state folder for a replaced run until the new one has begun: its files, its list, its request.
const ASIDE: &str = "aside";
/// Folder in it with the files, where they were.
const KEPT: &str = "kept";
/// The same when the new run has begun: it is being deleted.
const GONE: &str = "gone";
/// Files by which people recognise a run.
const MARKERS: [&str; 4] = ["recipe.toml", "run.json", "scene.safetensors", "checkpoints"];
/// File of a finished run.
const FINISHED: &str = "scene.safetensors";

/// Content that a folder must not have.
#[derive(Clone, Copy)]
pub enum Mixes<'a> {
    /// Anything.
    Anything,
    /// Files of a numbered sequence: those that would be taken for frames, and of them those that will be written.
    Frames {
        /// Whether a name would be taken for a frame.
        is: &'a dyn Fn(&OsStr) -> bool,
        /// Whether a frame of this name will be written.
        written: &'a dyn Fn(&OsStr) -> bool,
    },
}

/// A command's request for its folder.
#[derive(Clone, Copy)]
pub struct Request<'a> {
    /// The command, for the record of the owner.
    pub command: &'a str,
    /// Inputs.
    pub inputs: &'a [Input<'a>],
    /// All that the result depends on, as text: the same text continues an unfinished command.
    pub asked: &'a str,
    /// Whether what splat4d wrote there before is to be replaced.
    pub force: bool,
    /// Content that must be absent.
    pub mixes: Mixes<'a>,
}

/// State of a command in its folder.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FolderContent {
    /// Nothing: it begins.
    Nothing,
    /// Output of the same command that ended early.
    Unfinished,
}

/// A folder that this process owns and writes.
#[derive(Debug)]
pub struct OutputFolder {
    path: PathBuf,
    list: Arc<List>,
    /// Whether the content is kept when this is dropped.
    begun: AtomicBool,
    /// Whether it was not there before.
    made: bool,
    /// Where only a list is kept, workers on parts of it have locks of their own.
    owner: Option<Owner>,
}

/// Decision about a folder.
enum Plan {
    Begin,
    Continue,
    Replace,
}

impl OutputFolder {
    /// Takes a folder for a command, and makes it where it is not there.
    ///
    /// Errors: it equals, contains or is inside what is read or any capture; another process has it; it holds what would mix with the output
    /// and is not to be replaced, or cannot be because there is no record that splat4d wrote it; it cannot be written. Nothing
    /// is changed then.
    pub fn begin(path: &Path, request: &Request<'_>) -> Result<(Self, FolderContent)> {
        check_inputs(path, request.inputs)?;
        check_no_capture(path, request.inputs)?;
        if path.exists() && !path.is_dir() {
            return Err(Error::input("is a file").at(path.display()).remedy("Give the name of a folder."));
        }
        // In a folder that never was ours nothing is touched before it is known that it may be.
        if path.is_dir() && !path.join(STATE).exists() {
            plan(path, request)?;
        }
        let before = path.exists();
        std::fs::create_dir_all(path).map_err(|e| {
            let error = Error::environment("the folder cannot be created", e).at(path.display());
            error.remedy("Choose another place with -o: one where you may write, below a folder and not below a file")
        })?;
        let owner = Owner::of(path, request.command).inspect_err(|_| {
            if !before {
                let _ = std::fs::remove_dir(path);
            }
        })?;
        recover(path)?;
        let plan = plan(path, request)?;
        if let (Plan::Begin, Mixes::Anything) = (&plan, request.mixes) {
            // A list of files that are all deleted: later files of these names are not ours.
            let _ = std::fs::remove_file(path.join(STATE).join(list::FILE));
        }
        let list = List::keep(path)?;
        let found = if let Plan::Continue = plan { FolderContent::Unfinished } else { FolderContent::Nothing };
        let begun = AtomicBool::new(found == FolderContent::Unfinished);
        let folder = Self { path: path.to_owned(), list, begun, made: !before, owner: Some(owner) };
        if let Plan::Replace = plan {
            // Workers on parts of it have their own locks.
            for part in list::folders(path).iter().skip(1) {
                if let Some(who) = Owner::holder(part) {
                    folder.begun();
                    return Err(in_use(part, who.as_ref()));
                }
            }
            folder.set_aside(request.mixes)?;
        }
        let asked = path.join(STATE).join(ASKED);
        if let (Mixes::Anything, FolderContent::Nothing) = (request.mixes, found) {
            write_atomically(&asked, request.asked.as_bytes())?;
        }
        if let Mixes::Frames { .. } = request.mixes {
            // A sequence that was begun is overwritten, file by file.
            folder.begun.store(!path.join(STATE).join(ASIDE).exists(), Ordering::Relaxed);
        }
        Ok((folder, found))
    }

    /// Takes a folder to add to it, and creates it if it is missing. Errors: another process has it; it cannot be
    /// written.
    pub fn amend(path: &Path, command: &str) -> Result<Self> {
        let made = !path.exists();
        let owner = Owner::of(path, command)?;
        recover(path)?;
        let (path, list, begun) = (path.to_owned(), List::keep(path)?, AtomicBool::new(true));
        Ok(Self { path, list, begun, made, owner: Some(owner) })
    }

    /// Keeps the list of a folder on whose parts several processes work, each under a lock of its own.
    pub fn shared(path: &Path) -> Result<Self> {
        let (path, list, begun) = (path.to_owned(), List::keep(path)?, AtomicBool::new(true));
        Ok(Self { path, list, begun, made: false, owner: None })
    }

    /// The folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Request of the unfinished command in a folder.
    pub fn unfinished_request(path: &Path) -> Option<String> {
        crate::files::read_text(&path.join(STATE).join(ASKED)).ok()
    }

    /// The new output has begun: the replaced one is deleted now, and the new one is kept if the command fails.
    pub fn begun(&self) {
        if self.begun.swap(true, Ordering::Relaxed) {
            return;
        }
        let state = self.path.join(STATE);
        if std::fs::rename(state.join(ASIDE), state.join(GONE)).is_ok() {
            let _ = std::fs::remove_dir_all(state.join(GONE));
        }
    }

    /// The command is done: the same one does not continue it any more.
    pub fn finished(self) {
        self.begun();
        let _ = std::fs::remove_file(self.path.join(STATE).join(ASKED));
    }

    /// Removes every file that commands wrote into the folder, and the folders that are empty then.
    pub fn clear(&self) -> Result<()> {
        clear(&self.path, &self.list)
    }

    /// The same for a run within it, such as a baseline.
    pub fn clear_inner(&self, name: &str) -> Result<()> {
        let inner = self.path.join(name);
        let mut files: Vec<PathBuf> = self.list.files().into_iter().filter(|f| f.starts_with(name)).collect();
        if files.is_empty() && legacy::is_run(&inner) {
            files = legacy::files(&inner).iter().map(|f| Path::new(name).join(f)).collect();
        }
        files.iter().try_for_each(|f| remove(&self.path, &self.path.join(f)))
    }

    /// Gives back a folder in which nothing was begun, as it was before.
    pub fn abandon(self) {
        self.begun.store(false, Ordering::Relaxed);
    }

    /// Lets other processes work on its parts, under locks of their own; the list is kept on.
    pub fn share(mut self) -> Self {
        self.begun();
        self.owner = None;
        self
    }

    /// Removes all that states that the folder was ever ours, and the folder where nothing is in it.
    fn give_back(&self, owner: Owner) {
        let _ = std::fs::remove_file(self.path.join(STATE).join(list::FILE));
        owner.remove(&self.path);
        // Fails where the user keeps files there, as it should.
        let _ = std::fs::remove_dir(&self.path);
    }

    /// Moves earlier output aside; of a sequence only its frames.
    fn set_aside(&self, mixes: Mixes<'_>) -> Result<()> {
        if self.list.files().is_empty() {
            legacy::files(&self.path).iter().try_for_each(|f| self.list.add(f))?;
        }
        let of_it = |p: &PathBuf| match mixes {
            Mixes::Anything => true,
            Mixes::Frames { is, .. } => p.parent() == Some(Path::new("")) && p.file_name().is_some_and(is),
        };
        let aside = self.path.join(STATE).join(ASIDE);
        std::fs::create_dir_all(aside.join(KEPT)).map_err(|e| cannot_write(&aside, e))?;
        for file in self.list.files().iter().filter(|p| of_it(p)) {
            let (from, to) = (self.path.join(file), aside.join(KEPT).join(file));
            if !is_own_file(&self.path, &from) {
                continue;
            }
            let moved =
                std::fs::create_dir_all(to.parent().expect("it lies below")).and_then(|()| std::fs::rename(&from, &to));
            moved.map_err(|e| cannot_write(&from, e))?;
            remove_empty(&self.path, &from);
        }
        // The list is moved last: while it is in place, everything is restored.
        let state = self.path.join(STATE);
        for name in [ASKED, list::FILE] {
            match std::fs::rename(state.join(name), aside.join(name)) {
                Err(e) if e.kind() != std::io::ErrorKind::NotFound => return Err(cannot_write(&state.join(name), e)),
                _ => {}
            }
        }
        self.list.forget();
        Ok(())
    }
}

impl Drop for OutputFolder {
    fn drop(&mut self) {
        if *self.begun.get_mut() {
            // A folder that was made for nothing.
            if let Some(owner) = self.owner.take_if(|_| self.made && self.list.files().is_empty()) {
                self.give_back(owner);
            }
            return;
        }
        let state = self.path.join(STATE);
        if state.join(ASIDE).exists() {
            // `recover` distinguishes the lists of the new and the old output.
            let _ = recover(&self.path);
            return;
        }
        let _ = clear(&self.path, &self.list);
        let _ = std::fs::remove_file(state.join(ASKED));
        // Nothing of ours is left: the lock, which is still held, is removed last.
        if let Some(owner) = self.owner.take() {
            self.give_back(owner);
        }
    }
}

/// Decides about a folder for a request. Errors: nothing can be.
fn plan(folder: &Path, request: &Request<'_>) -> Result<Plan> {
    let unreadable = |e| Error::io("cannot be read", e).at(folder.display());
    let mut there: Vec<OsString> = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(unreadable)? {
        let name = entry.map_err(unreadable)?.file_name();
        if name != STATE && !is_temporary(&name) {
            there.push(name);
        }
    }
    there.sort();
    match request.mixes {
        Mixes::Anything => plan_all(folder, request, &there),
        Mixes::Frames { is, written } => {
            let frames: Vec<&OsString> = there.iter().filter(|n| is(n)).collect();
            let listed = list::read_of(folder);
            if let Some(foreign) = frames.iter().find(|n| !listed.contains(Path::new(n))) {
                let what = format!(
                    "holds numbered files that would be taken for frames, such as {}, and there is no record that splat4d wrote \
                     them",
                    foreign.display()
                );
                return Err(Error::input(what)
                    .at(folder.display())
                    .remedy("Remove them yourself, or choose another folder"));
            }
            match frames.iter().find(|n| !written(n)) {
                None => Ok(Plan::Begin),
                Some(_) if request.force => Ok(Plan::Replace),
                Some(stale) => {
                    Err(Error::input(format!("holds files of another sequence, such as {}", stale.display()))
                        .at(folder.display())
                        .remedy("Replace what splat4d wrote there with --force, or choose another folder"))
                }
            }
        }
    }
}

fn plan_all(folder: &Path, request: &Request<'_>, there: &[OsString]) -> Result<Plan> {
    let is_run = MARKERS.iter().any(|m| folder.join(m).exists());
    if request.force {
        return match there {
            [] => Ok(Plan::Begin),
            _ if !list::read_of(folder).is_empty() || legacy::is_run(folder) => Ok(Plan::Replace),
            [first, ..] => {
                let what = format!(
                    "holds files that splat4d did not write, such as {}, and no recipe.toml or run.json of a run",
                    first.display()
                );
                Err(Error::input(what)
                    .at(folder.display())
                    .remedy("--force replaces runs alone: choose another folder with -o"))
            }
        };
    }
    if OutputFolder::unfinished_request(folder).is_some_and(|asked| asked == request.asked) {
        return Ok(Plan::Continue);
    }
    if there.is_empty() {
        return Ok(Plan::Begin);
    }
    let error = if is_run {
        let what = if folder.join(FINISHED).is_file() { "a finished run" } else { "an unfinished run" };
        Error::input(format!("holds {what} already")).remedy(format!(
            "Continue it with --resume {}, replace it with --force, or choose another folder with -o.",
            in_command(folder)
        ))
    } else {
        Error::input("is not empty and is not a run").remedy("Choose another folder with -o.")
    };
    Err(error.at(folder.display()))
}

/// Removes the files of a folder's list, and the list.
fn clear(folder: &Path, list: &List) -> Result<()> {
    for file in list.files() {
        remove(folder, &folder.join(file))?;
    }
    let path = folder.join(STATE).join(list::FILE);
    match std::fs::remove_file(&path) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => return Err(cannot_write(&path, e)),
        _ => {}
    }
    list.forget();
    Ok(())
}

/// Removes a file of ours, and the folders that are empty then.
fn remove(folder: &Path, path: &Path) -> Result<()> {
    if !is_own_file(folder, path) {
        return Ok(());
    }
    std::fs::remove_file(path).map_err(|e| cannot_write(path, e))?;
    remove_empty(folder, path);
    Ok(())
}

/// Ends what a kill interrupted: deletes what was replaced, or, where the new output had not begun, removes that and
/// puts back what was to be replaced. May itself be interrupted and called again.
fn recover(folder: &Path) -> Result<()> {
    let state = folder.join(STATE);
    let (aside, gone) = (state.join(ASIDE), state.join(GONE));
    if gone.exists() {
        std::fs::remove_dir_all(&gone).map_err(|e| cannot_write(&gone, e))?;
    }
    if !aside.exists() {
        return Ok(());
    }
    let old_list = aside.join(list::FILE);
    if old_list.exists() {
        // The list in its place, if there is one, is the new output's.
        if state.join(list::FILE).exists() {
            clear(folder, List::keep(folder)?.as_ref())?;
        }
        let _ = std::fs::remove_file(state.join(ASKED));
    }
    put_back(&aside.join(KEPT), folder)?;
    for name in [ASKED, list::FILE] {
        let from = aside.join(name);
        if from.exists() {
            std::fs::rename(&from, state.join(name)).map_err(|e| cannot_write(&from, e))?;
        }
    }
    std::fs::remove_dir_all(&aside).map_err(|e| cannot_write(&aside, e))
}

/// Moves all files below `from` to the same places below `to`.
fn put_back(from: &Path, to: &Path) -> Result<()> {
    for entry in std::fs::read_dir(from).into_iter().flatten().flatten() {
        let (path, target) = (entry.path(), to.join(entry.file_name()));
        let failed = |e| cannot_write(&target, e);
        if entry.file_type().is_ok_and(|t| t.is_dir()) {
            std::fs::create_dir_all(&target).map_err(failed)?;
            put_back(&path, &target)?;
        } else if std::fs::symlink_metadata(&target).is_err() {
            // What the user put there meanwhile stays.
            std::fs::rename(&path, &target).map_err(failed)?;
        }
    }
    Ok(())
}

/// Whether a listed path is a file, or a link itself, really below the folder: a folder that was replaced by a link
/// leads elsewhere.
fn is_own_file(folder: &Path, path: &Path) -> bool {
    let file = std::fs::symlink_metadata(path).is_ok_and(|m| !m.is_dir());
    let real = |p: &Path| p.canonicalize().ok();
    file && path.parent().and_then(real).zip(real(folder)).is_some_and(|(parent, root)| parent.starts_with(root))
}

/// Removes the folders above a removed file, up to the output folder, that are empty now.
fn remove_empty(folder: &Path, file: &Path) {
    let above = file.ancestors().skip(1).take_while(|p| *p != folder);
    for parent in above {
        if std::fs::remove_dir(parent).is_err() {
            return;
        }
    }
}
