use super::list::FILE;
use super::*;
use crate::recipe::Recipe;
use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};

fn request<'a>(asked: &'a str, force: bool) -> Request<'a> {
    Request { command: "train", inputs: &[], asked, force, mixes: Mixes::Anything }
}

/// All files below a folder with their contents, the state apart.
fn tree(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let (mut out, mut todo) = (BTreeMap::new(), vec![folder.to_owned()]);
    while let Some(dir) = todo.pop() {
        for path in std::fs::read_dir(dir).into_iter().flatten().flatten().map(|e| e.path()) {
            if path.is_dir() && path.file_name() != Some(OsStr::new(STATE)) {
                todo.push(path);
            } else if path.is_file() {
                out.insert(path.strip_prefix(folder).unwrap().to_owned(), std::fs::read(&path).unwrap());
            }
        }
    }
    out
}

fn write_all(folder: &Path, files: &[(&str, &str)]) {
    for (name, text) in files {
        write_atomically(&folder.join(name), text.as_bytes()).unwrap();
    }
}

/// A run as this version writes it.
fn run(folder: &Path, text: &str) {
    let (out, found) = OutputFolder::begin(folder, &request("first", false)).unwrap();
    assert_eq!(found, FolderContent::Nothing);
    write_all(
        folder,
        &[("recipe.toml", text), ("checkpoints/00000000.safetensors", text), ("test/ours_1/gt/0.png", text)],
    );
    out.finished();
}

#[test]
fn force_replaces_files_of_splat4d_and_keeps_user_files() {
    let work = tempfile::tempdir().unwrap();
    let folder = work.path().join("run");
    run(&folder, "old");
    // Of the user: at the top, among ours, and under names that a run may write.
    let mine =
        [("notes.txt", "mine"), ("test/ours_1/gt/best.png", "mine"), ("results.json", "mine"), ("train/0.png", "mine")];
    for (name, text) in mine {
        let path = folder.join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, text).unwrap();
    }
    let error = OutputFolder::begin(&folder, &request("second", false)).unwrap_err().to_string();
    assert!(error.contains("holds an unfinished run") && error.contains("--force"), "{error}");
    let before = tree(&folder);
    let users: Vec<PathBuf> = mine.iter().map(|m| PathBuf::from(m.0)).collect();
    let only_users = || {
        tree(&folder).into_keys().collect::<Vec<_>>() == {
            let mut u = users.clone();
            u.sort();
            u
        }
    };

    // A command that fails before it began restores everything.
    let (out, _) = OutputFolder::begin(&folder, &request("second", true)).unwrap();
    assert!(only_users(), "{:?}", tree(&folder).keys());
    write_all(&folder, &[("recipe.toml", "new"), ("cameras.json", "new")]);
    drop(out);
    assert_eq!(tree(&folder), before);

    // So does one that was killed before it began, at the next start.
    let (out, _) = OutputFolder::begin(&folder, &request("second", true)).unwrap();
    write_all(&folder, &[("recipe.toml", "new"), ("cameras.json", "new")]);
    let killed = work.path().join("killed");
    copy(&folder, &killed);
    drop(out);
    drop(OutputFolder::amend(&killed, "eval").unwrap());
    assert_eq!(tree(&killed), before);
    // And what was killed while it was put back.
    std::fs::create_dir_all(killed.join(STATE).join("aside/kept")).unwrap();
    std::fs::rename(killed.join("recipe.toml"), killed.join(STATE).join("aside/kept/recipe.toml")).unwrap();
    drop(OutputFolder::amend(&killed, "eval").unwrap());
    assert_eq!(tree(&killed), before);

    // Output that has begun stays, and the replaced one is deleted.
    let (out, _) = OutputFolder::begin(&folder, &request("second", true)).unwrap();
    write_all(&folder, &[("recipe.toml", "new")]);
    out.begun();
    out.finished();
    let after = tree(&folder);
    assert_eq!(after[Path::new("recipe.toml")], b"new");
    assert!(users.iter().all(|u| after.contains_key(u)) && after.len() == mine.len() + 1, "{:?}", after.keys());
    assert!(!folder.join(STATE).join("aside").exists() && !folder.join(STATE).join("gone").exists());
}

fn copy(from: &Path, to: &Path) {
    for entry in std::fs::read_dir(from).unwrap().flatten() {
        let target = to.join(entry.file_name());
        if entry.path().is_dir() {
            copy(&entry.path(), &target);
        } else {
            std::fs::create_dir_all(to).unwrap();
            std::fs::copy(entry.path(), target).unwrap();
        }
    }
}

/// Where the old run cannot be moved away as a whole, all of it stays.
#[cfg(target_os = "linux")]
#[test]
fn a_run_that_cannot_be_set_aside_stays() {
    let work = tempfile::tempdir().unwrap();
    let folder = work.path().join("run");
    run(&folder, "old");
    // A path that is just short enough where it is, and too long in `.splat4d/aside`.
    const PATH_MAX: usize = 4096;
    let mut deep = folder.clone();
    while deep.as_os_str().len() + 120 < PATH_MAX {
        deep.push("z".repeat(100));
    }
    deep.push("f".repeat(PATH_MAX - 6 - deep.as_os_str().len()));
    std::fs::create_dir_all(deep.parent().unwrap()).unwrap();
    std::fs::write(&deep, "old").unwrap();
    let list = folder.join(STATE).join(FILE);
    let line = deep.strip_prefix(&folder).unwrap().display().to_string();
    std::fs::write(&list, std::fs::read_to_string(&list).unwrap() + &line + "\n").unwrap();
    let before = tree(&folder);
    assert_eq!(before.len(), 4);
    assert!(OutputFolder::begin(&folder, &request("second", true)).is_err());
    assert_eq!(tree(&folder), before);
}

#[test]
fn force_is_refused_where_there_is_no_run() {
    let work = tempfile::tempdir().unwrap();
    let folder = work.path().join("blender");
    // What a Blender capture and a run have in common; markers that are none of ours.
    let files =
        ["transforms_train.json", "train/r_0.png", "test/r_0.png", "renders/a.png", "results.json", "recipe.toml"];
    for name in files {
        std::fs::create_dir_all(folder.join(name).parent().unwrap()).unwrap();
        std::fs::write(folder.join(name), "[cake]\neggs = 3\n").unwrap();
    }
    std::fs::write(folder.join("run.json"), "{\"speed\": 3}").unwrap();
    let before = tree(&folder);
    for force in [false, true] {
        assert!(OutputFolder::begin(&folder, &request("x", force)).is_err());
        assert_eq!(tree(&folder), before);
        assert!(!folder.join(STATE).exists(), "not even a lock is left");
    }
    // Where it is the capture itself, a marker does not help.
    std::fs::write(folder.join("recipe.toml"), Recipe::default().to_toml()).unwrap();
    let input = [Input::new(&folder, "the capture")];
    let error = OutputFolder::begin(&folder, &Request { inputs: &input, ..request("x", true) }).unwrap_err();
    assert!(error.to_string().contains("is the capture"), "{error}");
}

#[test]
fn without_a_file_list_only_known_names_are_removed() {
    let work = tempfile::tempdir().unwrap();
    let folder = work.path();
    let recipe = Recipe::default().to_toml();
    let ours = [
        "scene.safetensors",
        "checkpoints/00000020.safetensors",
        "test/ours_20/renders/00001.png",
        "val-white/ours_20/gt/00001.png",
        "predict/predict.json",
    ];
    let users = [
        "train/r_0.png",
        "test/r_1.png",
        "renders/film.mp4",
        "checkpoints/best.safetensors",
        "points.ply",
        "a.txt",
        "test/ours_20/renders/best.png",
    ];
    for name in ours.iter().chain(&users) {
        std::fs::create_dir_all(folder.join(name).parent().unwrap()).unwrap();
        std::fs::write(folder.join(name), "x").unwrap();
    }
    std::fs::write(folder.join("recipe.toml"), &recipe).unwrap();
    let (out, _) = OutputFolder::begin(folder, &request("x", true)).unwrap();
    out.begun();
    out.finished();
    let mut left: Vec<PathBuf> = users.iter().map(PathBuf::from).collect();
    left.sort();
    assert_eq!(tree(folder).into_keys().collect::<Vec<_>>(), left);
}

#[test]
fn a_file_list_with_foreign_paths_removes_nothing_outside() {
    let work = tempfile::tempdir().unwrap();
    let (folder, other) = (work.path().join("run"), work.path().join("other"));
    std::fs::create_dir_all(&other).unwrap();
    std::fs::write(other.join("00000000.safetensors"), "mine").unwrap();
    run(&folder, "old");
    #[cfg(unix)]
    {
        std::fs::remove_dir_all(folder.join("checkpoints")).unwrap();
        std::os::unix::fs::symlink(&other, folder.join("checkpoints")).unwrap();
    }
    let list = folder.join(STATE).join(FILE);
    let text = std::fs::read_to_string(&list).unwrap();
    std::fs::write(&list, text + "../other/00000000.safetensors\n").unwrap();
    let (out, _) = OutputFolder::begin(&folder, &request("x", true)).unwrap();
    out.begun();
    out.finished();
    assert!(other.join("00000000.safetensors").is_file());
}

#[test]
fn a_partial_output_is_continued_by_the_same_command_only() {
    let work = tempfile::tempdir().unwrap();
    let folder = work.path().join("run");
    let begin = |asked: &str| OutputFolder::begin(&folder, &request(asked, false));
    // As a kill leaves it: nothing but the lock, then a file and another.
    let (out, _) = begin("one").unwrap();
    write_all(&folder, &[("recipe.toml", "")]);
    out.begun();
    drop(out);
    let error = begin("two").unwrap_err().to_string();
    assert!(error.contains("unfinished run") && error.contains("--resume"), "{error}");
    let (out, found) = begin("one").unwrap();
    assert_eq!(found, FolderContent::Unfinished);
    out.clear().unwrap();
    assert!(tree(&folder).is_empty() && OutputFolder::unfinished_request(&folder).as_deref() == Some("one"));
    write_all(&folder, &[("recipe.toml", "")]);
    // While it runs no other process does anything.
    assert!(begin("one").unwrap_err().to_string().contains("in use by"));
    assert!(OutputFolder::amend(&folder, "eval").unwrap_err().to_string().contains("in use by"));
    out.finished();
    assert!(begin("one").unwrap_err().to_string().contains("run already"), "what is done is not done again");
    // What fails before it begins leaves no folder.
    let fresh = work.path().join("fresh");
    let (out, _) = OutputFolder::begin(&fresh, &request("x", false)).unwrap();
    write_all(&fresh, &[("recipe.toml", ""), ("a/b/c.txt", "")]);
    out.abandon();
    assert!(!fresh.exists());
}

#[test]
fn a_sequence_removes_leftover_frames_of_an_older_one() {
    let work = tempfile::tempdir().unwrap();
    let folder = work.path().join("frames");
    let is = |n: &OsStr| n.to_string_lossy().starts_with("frame_");
    let written = |count: usize| move |n: &OsStr| (0..count).any(|i| n.to_string_lossy() == format!("frame_{i}.ply"));
    let export = |count: usize, force: bool, fails: bool| -> Result<()> {
        let written = written(count);
        let mixes = Mixes::Frames { is: &is, written: &written };
        let (out, _) = OutputFolder::begin(&folder, &Request { mixes, ..request("", force) })?;
        for i in 0..count {
            let text = format!("{count}");
            write_atomically(&folder.join(format!("frame_{i}.ply")), text.as_bytes())?;
            if fails {
                return Ok(());
            }
        }
        out.finished();
        Ok(())
    };
    export(4, false, false).unwrap();
    std::fs::write(folder.join("cover.txt"), "mine").unwrap();
    let before = tree(&folder);
    let error = export(3, false, false).unwrap_err().to_string();
    assert!(error.contains("frame_3.ply") && error.contains("--force"), "{error}");
    export(3, true, true).unwrap();
    assert_eq!(tree(&folder), before, "what fails gives the older one back");
    export(3, true, false).unwrap();
    let names: Vec<_> = tree(&folder).into_keys().collect();
    assert_eq!(names, ["cover.txt", "frame_0.ply", "frame_1.ply", "frame_2.ply"].map(PathBuf::from));
    export(4, false, false).unwrap();
    // Frames that are not known to be ours are neither overwritten nor removed.
    std::fs::write(folder.join("frame_9.ply"), "mine").unwrap();
    for force in [false, true] {
        let error = export(12, force, false).unwrap_err().to_string();
        assert!(error.contains("frame_9.ply") && error.contains("no record"), "{error}");
    }
}

/// Folders come from other people, who can put a link or a pipe in place of any file that a command writes.
#[cfg(unix)]
#[test]
fn links_and_pipes_at_output_names_are_not_followed() {
    use std::os::unix::fs::symlink;
    let work = tempfile::tempdir().unwrap();
    let (folder, mine) = (work.path().join("run"), work.path().join("mine.txt"));
    run(&folder, "old");
    std::fs::write(&mine, "mine").unwrap();
    for name in ["lock", "owner.json", FILE] {
        let place = folder.join(STATE).join(name);
        let before = std::fs::read(&place).unwrap_or_default();
        let _ = std::fs::remove_file(&place);
        symlink(&mine, &place).unwrap();
        let error = OutputFolder::amend(&folder, "eval").unwrap_err().to_string();
        assert!(error.contains("not a regular file"), "{name}: {error}");
        std::fs::remove_file(&place).unwrap();
        if std::process::Command::new("mkfifo").arg(&place).status().is_ok_and(|s| s.success()) {
            assert!(OutputFolder::amend(&folder, "eval").is_err(), "{name}");
            assert_eq!(Owner::holder(&folder), None);
            std::fs::remove_file(&place).unwrap();
        }
        std::fs::write(&place, before).unwrap();
    }
    let _ = std::fs::remove_file(folder.join(STATE).join("owner.json"));
    symlink(&mine, folder.join("report.html")).unwrap();
    let staged = |path: &Path| {
        let staged = Staged::new(path).unwrap();
        std::fs::write(staged.path(), "new").unwrap();
        staged.keep().unwrap();
    };
    let owned = OutputFolder::amend(&folder, "eval").unwrap();
    staged(&folder.join("report.html"));
    drop(owned);
    assert_eq!(std::fs::read(&mine).unwrap(), b"mine");
    assert_eq!(std::fs::read(folder.join("report.html")).unwrap(), b"new");
    // Elsewhere a link is the user's own.
    symlink(&mine, work.path().join("link")).unwrap();
    staged(&work.path().join("link"));
    assert_eq!(std::fs::read(&mine).unwrap(), b"new");
}
