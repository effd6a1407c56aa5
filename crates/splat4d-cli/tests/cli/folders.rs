//! Output folders from a user's view; their implementation is tested in `splat4d_train::output`.

use crate::sample::{Capture, splat4d};
use crate::{TINY, str};
use splat4d::format::ply;
use splat4d::scene::params::QUAT;
use splat4d::scene::{GEOMETRY, LifeKind, Params};
use splat4d_train::output::Owner;
use splat4d_train::recipe::{MotionName, Recipe};
use splat4d_workflow::run_folder::RunRequest;
use std::path::Path;

/// A file of one Gaussian.
fn write_ply(path: &Path, x: f32) {
    let mut params = Params::new(1, 1, LifeKind::Infinite.columns());
    params[GEOMETRY].write(0, 0, [x, 0.0, 4.0]);
    params[GEOMETRY].write(0, QUAT, [1.0, 0.0, 0.0, 0.0]);
    let mut bytes = Vec::new();
    ply::write(&params, &mut bytes).unwrap();
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    std::fs::write(path, bytes).unwrap();
}

fn count(folder: &Path) -> usize {
    let files = std::fs::read_dir(folder).unwrap().flatten();
    files.map(|e| if e.path().is_dir() { count(&e.path()) } else { 1 }).sum()
}

#[test]
fn force_never_removes_a_capture() {
    let work = tempfile::tempdir().unwrap();
    let capture = Capture::new(work.path()).write();
    // As in a Blender capture.
    for name in ["train", "test", "val"] {
        std::fs::create_dir_all(capture.join(name)).unwrap();
        std::fs::copy(capture.join("images/cam0/0000.png"), capture.join(name).join("r_0.png")).unwrap();
    }
    std::fs::write(capture.join("recipe.toml"), "").unwrap();
    let before = count(&capture);
    for (out, how) in [
        (capture.clone(), "is the capture"),
        (work.path().to_owned(), "contains"),
        (capture.join("run"), "lies inside"),
    ] {
        let said = splat4d(&["train", str(&capture), "-o", str(&out), "--force"]).args(&TINY).run().refused();
        assert!(said.contains(how), "{said}");
    }
    // Another folder of the user's.
    let other = work.path().join("other");
    std::fs::create_dir_all(other.join("train")).unwrap();
    std::fs::write(other.join("train/r_0.png"), "mine").unwrap();
    let said = splat4d(&["train", str(&capture), "-o", str(&other), "--force"]).args(&TINY).run().refused();
    assert!(said.contains("did not write") && said.contains("train"), "{said}");
    assert_eq!((count(&capture), count(&other)), (before, 1));
}

#[test]
fn a_folder_in_use_is_refused_and_read() {
    let work = tempfile::tempdir().unwrap();
    let capture = Capture::new(work.path()).write();
    let run = work.path().join("run");
    std::fs::create_dir(&run).unwrap();
    let owner = Owner::of(&run, "train").unwrap();
    let told = format!("in use by `splat4d train`, process {}", std::process::id());
    for force in [&["--quiet"][..], &["--force"]] {
        let said = splat4d(&["train", str(&capture), "-o", str(&run)]).args(&TINY).args(force).run().failed();
        assert!(said.contains(&told) && said.contains("since 20"), "{said}");
    }
    // It is a run already, though it has no files yet.
    let said = splat4d(&["info", str(&run)]).run().ok();
    assert!(said.contains("owner            `splat4d train`, process") && said.contains("splat4d status"), "{said}");
    assert!(splat4d(&["status", str(&run)]).run().ok().contains("step 0, `splat4d train`, process"));
    for words in [&["view", "--no-open"][..], &["render", "-o", "x.png"]] {
        let said = splat4d(&[words[0], str(&run)]).args(&words[1..]).run_in(work.path()).refused();
        assert!(said.contains("no checkpoint yet; `splat4d train`") && said.contains("splat4d status"), "{said}");
    }
    // One file in it is as much a write as a whole run.
    let file = work.path().join("a.ply");
    write_ply(&file, 0.0);
    let said = splat4d(&["convert", str(&file), str(&run.join("scene.safetensors"))]).run().failed();
    assert!(said.contains(&told) && !run.join("scene.safetensors").exists(), "{said}");
    drop(owner);
    // What a kill right after the start leaves: `--resume` begins again, as the command requested it.
    splat4d(&["train", str(&capture), "-o", str(&run), "--no-eval"]).args(&TINY).run().ok();
    let wanted = std::fs::read(run.join("scene.safetensors")).unwrap();
    assert!(!run.join(".splat4d/asked").exists(), "what is done is not continued");
    std::fs::remove_dir_all(run.join("checkpoints")).unwrap();
    std::fs::remove_file(run.join("scene.safetensors")).unwrap();
    let capture = capture.canonicalize().unwrap();
    let recipe = Recipe::default().with(|r| r.run.motion = MotionName::AUTO);
    let recipe = TINY.iter().filter_map(|s| s.strip_prefix("--set=")).chain(["seed=3"]).fold(recipe, |mut r, s| {
        r.set(s).unwrap();
        r
    });
    let asked = serde_json::to_string(&RunRequest::new(&capture, &recipe, None, false)).unwrap();
    std::fs::write(run.join(".splat4d/asked"), asked).unwrap();
    splat4d(&["train", "--resume", str(&run), "--no-eval"]).run().ok();
    assert!(std::fs::read(run.join("scene.safetensors")).unwrap() == wanted);
    // Its own files and its capture's are no outputs of other commands.
    write_ply(&capture.join("points.ply"), 0.0);
    let (scene, points) = (run.join("scene.safetensors"), capture.join("points.ply"));
    for words in [
        &["edit", str(&run), "--crop", "all", "-o", str(&scene)][..],
        &["convert", str(&file), str(&scene)],
        &["export", str(&run), "-o", str(&points)],
        &["export", str(&run), "--html", "-o", str(&run.join("scene.s4d"))],
    ] {
        splat4d(words).run().refused();
    }
    assert!(std::fs::read(&scene).unwrap() == wanted);
    // A pipe in place of one of its files is no reason to wait.
    let info = run.join("run.json");
    std::fs::remove_file(&info).unwrap();
    if std::process::Command::new("mkfifo").arg(&info).status().is_ok_and(|s| s.success()) {
        let said = splat4d(&["eval", str(&run), "--no-film"]).run().refused();
        assert!(said.contains("run.json") && said.contains("regular file"), "{said}");
    }
}

#[test]
fn no_output_replaces_an_input() {
    let work = tempfile::tempdir().unwrap();
    let at = |name: &str| work.path().join(name);
    write_ply(&at("a.ply"), 0.0);
    write_ply(&at("frames/1.ply"), 0.0);
    let before = std::fs::read(at("a.ply")).unwrap();
    let (ply, page) = (at("a.ply"), at("a.html"));
    for words in [
        &["convert", str(&ply), str(&at("frames/../a.ply"))][..],
        &["convert", str(&at("frames")), str(&at("frames/1.ply"))],
        &["bake", str(&ply), "-o", str(&at("a.s4d")), "--report", str(&ply)],
        &["edit", str(&ply), "--crop", "all", "-o", str(&ply)],
        &["edit", str(&ply), "--crop", "all", "--save", str(&ply), "-o", str(&at("b.ply"))],
        &["bake", str(&ply), "-o", str(&at("a.s4d")), "--report", str(&at("frames/../a.s4d"))],
        &["export", str(&ply), "-o", str(&page), "--link", str(&ply)],
        &["export", str(&ply), "-o", str(&ply)],
    ] {
        splat4d(words).run().refused();
        assert!(std::fs::read(&ply).unwrap() == before && !at("a.s4d").exists(), "{words:?}");
    }
    // The extension states the format, and a file may be replaced that is not read.
    splat4d(&["export", str(&ply), "-o", str(&page)]).run().ok();
    assert!(std::fs::read(&page).unwrap().starts_with(b"<!doctype html>"), "a page");
    splat4d(&["convert", str(&ply), str(&at("frames/1.ply"))]).run().ok();
    // A scene that an edit merges is read too.
    let (list, other) = (at("list.toml"), at("other.s4d"));
    splat4d(&["bake", str(&ply), "-o", str(&other)]).run().ok();
    let before = std::fs::read(&other).unwrap();
    let merge = "version = 1\n[[edit]]\ndo = \"merge\"\nscene = \"other.s4d\"\nname = \"second\"\nat = 0.0\n";
    std::fs::write(&list, merge).unwrap();
    let said = splat4d(&["edit", str(&ply), str(&list), "-o", str(&other)]).run().refused();
    assert!(said.contains("the output is what is read") && std::fs::read(&other).unwrap() == before, "{said}");
    splat4d(&["edit", str(&ply), str(&list), "-o", str(&at("merged.s4d"))]).run().ok();
    // Images that the capture holds by a link are as much its own.
    #[cfg(unix)]
    {
        let capture = Capture::new(&at("linked")).write();
        std::fs::rename(capture.join("images"), at("images")).unwrap();
        std::os::unix::fs::symlink(at("images"), capture.join("images")).unwrap();
        for output in ["images", "images/new"] {
            let said = splat4d(&["train", str(&capture), "-o", str(&at(output))]).args(&TINY).run().refused();
            assert!(said.contains("a folder of the capture's images"), "{said}");
        }
    }
}

/// A capture whose images, points and a mask are elsewhere: they are as safe as those in its folder.
#[test]
fn no_output_replaces_external_files_of_a_capture() {
    let work = tempfile::tempdir().unwrap();
    let at = |name: &str| work.path().join(name);
    let mut sample = Capture::new(&at("sets"));
    sample.black_masks = true;
    let capture = sample.write();
    let (images, masks, points) = (at("photos"), at("cut"), at("sets/points.ply"));
    std::fs::rename(capture.join("images"), &images).unwrap();
    std::fs::rename(capture.join("masks"), &masks).unwrap();
    // All is foreground: a capture without any could not be opened.
    for camera in std::fs::read_dir(&masks).unwrap() {
        for mask in std::fs::read_dir(camera.unwrap().path()).unwrap() {
            let path = mask.unwrap().path();
            let (width, height) = image::image_dimensions(&path).unwrap();
            image::GrayImage::from_pixel(width, height, image::Luma([255])).save(&path).unwrap();
        }
    }
    write_ply(&points, 0.0);
    let text = std::fs::read_to_string(capture.join("capture.json")).unwrap();
    let absolute = format!("\"{}/cam", masks.display());
    let text = text.replace("\"images/", "\"../../photos/").replace("\"masks/cam", &absolute);
    let text = text.replacen("\"fps\"", "\"points\":\"../points.ply\",\"fps\"", 1);
    std::fs::write(capture.join("capture.json"), text).unwrap();
    std::fs::write(capture.join("x.npy"), "mine").unwrap();
    std::fs::write(capture.join("x.s4d"), "mine").unwrap();
    #[cfg(unix)]
    {
        std::fs::create_dir(at("pool")).unwrap();
        std::fs::rename(images.join("cam0/0000.png"), at("pool/0.png")).unwrap();
        std::os::unix::fs::symlink(at("pool/0.png"), images.join("cam0/0000.png")).unwrap();
    }
    // A run of it that is as good as trained.
    let run = at("run");
    std::fs::create_dir(&run).unwrap();
    write_ply(&at("a.ply"), 0.0);
    splat4d(&["convert", str(&at("a.ply")), str(&run.join("scene.safetensors"))]).run().ok();
    std::fs::write(run.join("recipe.toml"), Recipe::default().to_toml()).unwrap();
    let info = serde_json::json!({"version": "0", "capture": str(&capture.canonicalize().unwrap())});
    std::fs::write(run.join("run.json"), info.to_string()).unwrap();
    let camera = at("camera.json");
    let lens = r#"{"width": 8, "height": 6, "fx": 8, "fy": 8, "cx": 4, "cy": 3,
        "world_to_camera": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]}"#;
    std::fs::write(&camera, lens).unwrap();
    let refused = |file: &Path| {
        let said = splat4d(&["render", str(&run), "--camera", str(&camera), "-o", str(file)]).run().refused();
        assert!(said.contains("is a file of a folder of the capture's images"), "{said}");
    };
    refused(&images.join("cam1/0000.png"));
    refused(&masks.join("cam1/0000.png"));
    #[cfg(unix)]
    refused(&at("pool/0.png"));
    let [inside, around, new] = [images.join("cam1/new"), images.clone(), at("photos/cam2/frames")];
    for (words, how) in [
        (&["train", str(&capture), "-o", str(&inside)][..], "lies inside a folder of the capture's images"),
        (&["train", str(&capture), "--force", "-o", str(&around)], "contains a folder of the capture's images"),
        (&["train", str(&capture), "--force", "-o", str(&at("sets"))], "contains the capture"),
        (&["info", str(&capture), "--doctor", "-o", str(&inside)], "lies inside a folder of the capture's images"),
        (&["export", str(&run), "--sequence", str(&new)], "lies inside a folder of the capture's images"),
        (&["render", str(&run), "--path", "orbit", "-o", str(&new)], "lies inside a folder of the capture's images"),
        (&["compress", str(&run), "-o", str(&new)], "lies inside a folder of the capture's images"),
        (&["export", str(&run), "-o", str(&points)], "is a file of the capture"),
        (
            &["export", str(&run), "-o", str(&at("p.html")), "--link", str(&capture.join("x.s4d"))],
            "a file of the capture",
        ),
        (&["render", str(&run), "--camera", str(&camera), "--raw", str(&capture.join("x"))], "a file of the capture"),
    ] {
        let said = splat4d(words).run().refused();
        assert!(said.contains(how), "{words:?}: {said}");
    }
    // A capture that can no longer be opened keeps what the run recorded.
    std::fs::write(capture.join("capture.json"), "{").unwrap();
    let info = serde_json::json!({"version": "0", "capture": str(&capture), "capture_elsewhere": [str(&images), str(&points)]});
    std::fs::write(run.join("run.json"), info.to_string()).unwrap();
    refused(&images.join("cam1/0000.png"));
    let said = splat4d(&["export", str(&run), "--sequence", str(&new)]).run().refused();
    assert!(said.contains("lies inside a folder of the capture's images"), "{said}");
    let said = splat4d(&["export", str(&run), "-o", str(&points)]).run().refused();
    assert!(said.contains("is a file of the capture"), "{said}");
    // The frames that are read are those that would be written.
    let frames = at("frames");
    splat4d(&["convert", str(&at("a.ply")), str(&frames), "--frames"]).run().ok();
    for read in ["frames/frame_00000.ply", "frames/frame_%05d.ply"] {
        let said = splat4d(&["convert", str(&at(read)), str(&frames), "--frames"]).run().refused();
        assert!(said.contains("what is read"), "{said}");
    }
}

/// A capture that the command does not read is as safe as one that it reads.
#[test]
fn no_folder_is_written_into_any_capture() {
    let work = tempfile::tempdir().unwrap();
    let at = |name: &str| work.path().join(name);
    let capture = Capture::new(&at("sets")).write();
    // Another program's: COLMAP's text with photos, and videos with their poses.
    let others =
        ["colmap/cameras.txt", "colmap/images.txt", "colmap/images/a.jpg", "n3dv/poses_bounds.npy", "n3dv/cam00.mp4"];
    for name in others {
        std::fs::create_dir_all(at(name).parent().unwrap()).unwrap();
        std::fs::write(at(name), name).unwrap();
    }
    let before = count(work.path());
    write_ply(&at("a.ply"), 0.0);
    let (file, own) = (at("a.ply"), Capture::new(&at("own")).write());
    let refused = |words: &[&str], out: &Path, how: &str| {
        let said = splat4d(words).paths(&[out]).run().refused();
        assert!(said.contains(how) && said.contains("the capture") && said.contains("-o"), "{words:?}: {said}");
    };
    for (out, how) in [
        (capture.clone(), "is the capture"),
        (capture.join("images/cam0"), "lies inside the capture"),
        (capture.join("new"), "lies inside the capture"),
        (at("colmap"), "is the capture"),
        (at("colmap/images"), "lies inside the capture"),
        (at("n3dv/frames"), "lies inside the capture"),
        (at("sets"), "contains the capture"),
        (work.path().to_owned(), "contains the capture"),
    ] {
        refused(&["convert", "--force", "--frames", str(&file)], &out, how);
        refused(&["export", str(&file), "--force", "--sequence"], &out, how);
        refused(&["render", str(&file), "--force", "--path", "orbit", "-o"], &out, how);
        refused(&[&["train", str(&own), "--force"][..], &TINY[..], &["-o"][..]].concat(), &out, how);
        if out != work.path() {
            // That folder contains the scene, too.
            refused(&["eval", str(&file), "--capture", str(&own), "--force", "-o"], &out, how);
        }
        refused(&["info", str(&own), "--doctor", "-o"], &out, how);
    }
    refused(&["import", str(&at("n3dv/cam00.mp4")), "-o"], &capture.join("take"), "lies inside the capture");
    assert_eq!((count(&at("sets")) + others.len(), count(&at("n3dv"))), (before, 2));
    // The folder of captures holds runs too, and a file is no folder.
    let run = at("runs/own");
    splat4d(&["train", str(&own), "--no-eval", "-o", str(&run)]).args(&TINY).run().ok();
    refused(&["compress", "--force", str(&run), "-o"], &capture.join("small"), "lies inside the capture");
    splat4d(&["convert", str(&file), str(&capture.join("initial.ply"))]).run().ok();
}

#[test]
fn a_sequence_keeps_its_gaps_and_removes_leftover_frames() {
    let work = tempfile::tempdir().unwrap();
    let at = |name: &str| work.path().join(name);
    for n in [1, 2, 4] {
        write_ply(&at(&format!("frames/f{n}.ply")), n as f32);
    }
    let out = at("out");
    let convert = |fps: &str, more: &[&str]| {
        splat4d(&["convert", str(&at("all.safetensors")), str(&out), "--frames", "--fps", fps]).args(more).run()
    };
    let told = splat4d(&["convert", str(&at("frames")), str(&at("all.safetensors")), "--fps", "10"]).run().told();
    assert!(told.contains("frames are missing: 3"), "{told}");
    let info = splat4d(&["info", str(&at("frames"))]).run().ok();
    assert!(info.contains("frames are missing: 3"), "{info}");
    convert("10", &[]).ok();
    assert_eq!(count(&out) - count(&out.join(".splat4d")), 4, "with the frame that is missing, of nothing");
    convert("20", &[]).ok();
    let said = convert("10", &[]).refused();
    assert!(said.contains("frame_00004.ply") && said.contains("--force"), "{said}");
    convert("10", &["--force"]).ok();
    assert_eq!(count(&out) - count(&out.join(".splat4d")), 4);
}

#[test]
fn machine_errors_exit_with_1_and_user_errors_with_2() {
    let work = tempfile::tempdir().unwrap();
    let at = |name: &str| work.path().join(name);
    write_ply(&at("a.ply"), 0.0);
    let convert = |from: &str, to: &str| splat4d(&["convert", str(&at(from)), str(&at(to))]).run();
    assert!(convert("a.ply", "nowhere/b.ply").failed().contains("nowhere"));
    assert!(convert("nowhere.ply", "b.ply").refused().contains("nowhere.ply"));
    if Path::new("/dev/full").exists() {
        let said = splat4d(&["export", str(&at("a.ply")), "-o", "/dev/full"]).run().failed();
        assert!(said.contains("disk"), "{said}");
    }
}

/// Bytes that are no UTF-8, in what is read and in what is written.
#[cfg(target_os = "linux")]
#[test]
fn names_that_are_not_text_work_everywhere() {
    use std::os::unix::ffi::OsStrExt;
    let work = tempfile::tempdir().unwrap();
    let at = |name: &[u8]| work.path().join(std::ffi::OsStr::from_bytes(name));
    let file = at(b"\xff.ply");
    write_ply(&file, 0.0);
    for (verb, out) in [("convert", &b"\xfe.spz"[..]), ("convert", b"\xfe.safetensors"), ("convert", b"\xfe.splat4d")] {
        let said = splat4d(&[verb, "--json"]).paths(&[&file, &at(out)]).run().ok();
        assert!(said.contains("written") && at(out).is_file(), "{said}");
    }
    let scene = at(b"\xfe.safetensors");
    splat4d(&["bake", "--json", "-o"]).paths(&[&at(b"b\xff.splat4d"), &scene]).run().ok();
    splat4d(&["edit", "--json", "--crop", "all", "-o"]).paths(&[&at(b"e\xff.ply"), &scene]).run().ok();
    splat4d(&["export", "--json", "--sequence"]).paths(&[&at(b"s\xff"), &scene]).run().ok();
    splat4d(&["convert", "--json", "--frames"]).paths(&[&scene, &at(b"s\xff/f\xff_%d.spz")]).run().ok();
    splat4d(&["export", "--json", "--html", "-o"]).paths(&[&at(b"p\xff.html"), &scene]).run().ok();
    splat4d(&["info", "--json"]).paths(&[&scene]).run().ok();
    // A capture and its run.
    let capture = Capture::new(&at(b"c\xff")).write();
    let run = at(b"r\xff");
    splat4d(&["train", "--no-eval", "--json", "-o"]).paths(&[&run, &capture]).args(&TINY).run().ok();
    splat4d(&["eval", "--json", "--no-film"]).paths(&[&run]).run().ok();
    splat4d(&["train", "--json", "--no-eval", "--resume"]).paths(&[&run]).run().ok();
    splat4d(&["compress", "--json", "--no-eval", "--level", "1", "--fine-tune", "4"]).paths(&[&run]).run().ok();
    splat4d(&["render", "--json", "--path", "test", "--device", "cpu", "-o"]).paths(&[&at(b"v\xff"), &run]).run().ok();
    assert!(at(b"r\xff-compressed").join("scene.s4d").is_file());
}
