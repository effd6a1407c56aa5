//! Captures that are written, interrupted, continued and read again.

use super::*;
use crate::sync::graph::Offset;
use crate::video::{self, Selection, Source};
use splat4d::ErrorKind;
use splat4d::math::Se3;
use splat4d::scene::{Intrinsics, Lens};
use splat4d_train::capture::{Capture, CaptureOptions, ImageStore};
use splat4d_train::event::Progress;
use std::cell::Cell;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

/// Two folders of images, of 20 and 11 frames.
fn rig() -> (tempfile::TempDir, Vec<Box<dyn Source>>) {
    let folder = tempfile::tempdir().unwrap();
    let mut sources = Vec::new();
    for (camera, frames) in [(0u32, 20), (1, 11)] {
        let place = folder.path().join(format!("cam {camera}"));
        std::fs::create_dir(&place).unwrap();
        for n in 0..frames {
            let shade = |x: u32, y: u32| image::Rgb([(x * 7 + n * 9) as u8, (y * 5 + 60 * camera) as u8, 90]);
            image::RgbImage::from_fn(32, 24, shade).save(place.join(format!("{n:04}.png"))).unwrap();
        }
        sources.push(video::open(&place, 25.0).unwrap());
    }
    (folder, sources)
}

fn clips<'a>(sources: &'a [Box<dyn Source>], selection: &Selection) -> Vec<Clip<'a>> {
    let names = camera_names(&sources.iter().map(|s| s.info().name.as_str()).collect::<Vec<_>>());
    let clip = |(name, source): (String, &'a dyn Source)| Clip { name, source, selection: selection.clone() };
    names.into_iter().zip(sources.iter().map(|s| &**s)).map(clip).collect()
}

/// All files below a folder and their bytes.
fn contents(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let (mut out, mut todo) = (BTreeMap::new(), vec![folder.to_owned()]);
    while let Some(place) = todo.pop() {
        for path in std::fs::read_dir(place).unwrap().map(|e| e.unwrap().path()) {
            if path.is_dir() {
                todo.push(path);
            } else {
                let name = path.strip_prefix(folder).unwrap().to_string_lossy().into_owned();
                out.insert(name, std::fs::read(path).unwrap());
            }
        }
    }
    out
}

fn store(folder: &Path, clips: &[Clip<'_>], stop_after: usize) -> splat4d::Result<Vec<Pictures>> {
    let asked = Cell::new(0);
    let stop = || {
        asked.set(asked.get() + 1);
        asked.get() > stop_after
    };
    pictures(folder, clips, Format::default(), &mut Progress(&mut |_| ()), &stop)
}

#[test]
fn an_interrupted_import_ends_in_the_same_bytes() {
    let (_folder, sources) = rig();
    let clips = clips(&sources, &Selection::default());
    let (whole, parts) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let expected = store(whole.path(), &clips, usize::MAX).unwrap();
    for stop_after in [0, 9, 25] {
        let error = store(parts.path(), &clips, stop_after).unwrap_err();
        assert_eq!(error.kind(), ErrorKind::Interrupted);
    }
    let first = parts.path().join("images/cam_0/000000.jpg");
    let before = std::fs::metadata(&first).unwrap().modified().unwrap();
    assert_eq!(store(parts.path(), &clips, usize::MAX).unwrap(), expected);
    assert_eq!(std::fs::metadata(&first).unwrap().modified().unwrap(), before, "it was not written again");
    let made = contents(parts.path());
    assert_eq!(made, contents(whole.path()));
    assert_eq!(made.len(), 20 + 11 + 2, "pictures, a note per camera, and nothing else: {:?}", made.keys());
    // Again: nothing is read any more.
    assert_eq!(store(parts.path(), &clips, 0).unwrap(), expected);
    assert_eq!((expected[0].name.as_str(), expected[0].shots.len(), expected[0].size), ("cam_0", 20, [32, 24]));
    assert_eq!(expected[1].file(3), Path::new("images/cam_1/000003.jpg"));
}

#[test]
fn derived_values_are_computed_again() {
    let (_folder, sources) = rig();
    let out = tempfile::tempdir().unwrap();
    store(out.path(), &clips(&sources, &Selection::default()), usize::MAX).unwrap();
    std::fs::write(out.path().join("images/cam_0/mine.txt"), "keep").unwrap();
    let half = Selection { every: 2, from: Some(0.1), ..Selection::default() };
    let stored = store(out.path(), &clips(&sources, &half), usize::MAX).unwrap();
    assert_eq!(stored[0].shots.iter().map(|s| s.number).collect::<Vec<_>>(), [3, 5, 7, 9, 11, 13, 15, 17, 19]);
    let names = contents(out.path());
    assert_eq!(names.keys().filter(|n| n.starts_with("images/cam_0") && n.ends_with("jpg")).count(), 9);
    assert!(names.contains_key("images/cam_0/mine.txt"), "files of others stay");
    // A lost image is restored.
    std::fs::remove_file(out.path().join("images/cam_1/000001.jpg")).unwrap();
    store(out.path(), &clips(&sources, &half), usize::MAX).unwrap();
    assert_eq!(contents(out.path()), names);
    let bad = pictures(out.path(), &[], Format::Jpeg(60), &mut Progress(&mut |_| ()), &|| false);
    assert!(bad.unwrap_err().to_string().contains("95"));
}

#[test]
fn foreign_images_are_neither_read_nor_removed() {
    let (_folder, sources) = rig();
    let clips = clips(&sources, &Selection::default());
    let out = tempfile::tempdir().unwrap();
    let theirs = out.path().join("images/cam_1/000003.jpg");
    std::fs::create_dir_all(theirs.parent().unwrap()).unwrap();
    std::fs::write(&theirs, "mine").unwrap();
    let error = store(out.path(), &clips, usize::MAX).unwrap_err().to_string();
    assert!(error.contains("000003.jpg") && error.contains("no record"), "{error}");
    assert_eq!(std::fs::read(&theirs).unwrap(), b"mine");
    std::fs::remove_file(&theirs).unwrap();
    // With a list of what is ours, a note alone is no proof.
    let owned = splat4d_train::output::OutputFolder::amend(out.path(), "import").unwrap();
    store(out.path(), &clips, usize::MAX).unwrap();
    std::fs::write(out.path().join("images/cam_1/000099.jpg"), "mine").unwrap();
    let half = self::clips(&sources, &Selection { every: 2, ..Selection::default() });
    let error = store(out.path(), &half, usize::MAX).unwrap_err().to_string();
    assert!(error.contains("000099.jpg") && theirs.is_file(), "{error}");
    drop(owned);
}

#[test]
fn alpha_of_videos_is_stored() {
    if let Err(e) = video::Tools::find() {
        assert!(std::env::var_os("REQUIRE_FFMPEG").is_none(), "{e}");
        println!("skipped: {e}");
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let half = "color=c=red:s=64x48:r=10:d=0.3,format=rgba,geq=r=200:g=60:b=30:a=255*gte(X\\,32)";
    let mut made = Vec::new();
    for (name, codec) in [
        ("prores.mov", &["prores_ks", "-profile:v", "4444", "-pix_fmt", "yuva444p10le"][..]),
        ("vp9.webm", &["libvpx-vp9", "-pix_fmt", "yuva420p", "-deadline", "realtime"]),
    ] {
        let path = folder.path().join(name);
        let mut ffmpeg = std::process::Command::new("ffmpeg");
        ffmpeg.args(["-loglevel", "error", "-nostdin", "-f", "lavfi", "-i", half, "-c:v"]).args(codec);
        // Not every ffmpeg can write both.
        if ffmpeg.arg(&path).status().unwrap().success() {
            made.push(path);
        }
    }
    assert!(!made.is_empty(), "ffmpeg writes one of the formats with alpha");
    let sources: Vec<_> = made.iter().map(|path| video::open(path, 25.0).unwrap()).collect();
    let out = tempfile::tempdir().unwrap();
    for camera in store(out.path(), &clips(&sources, &Selection::default()), usize::MAX).unwrap() {
        assert_eq!((camera.shots.len(), camera.file(2).extension().unwrap().to_str()), (3, Some("png")));
        let stored = image::open(out.path().join(camera.file(2))).unwrap().into_rgba8();
        let alpha = [8, 56].map(|x| stored.get_pixel(x, 24)[3]);
        assert!(alpha[0] < 8 && alpha[1] > 247, "{}: {alpha:?}", camera.name);
        assert!(camera.warnings.iter().any(|w| w.contains("PNG with alpha")), "{:?}", camera.warnings);
    }
}

#[test]
fn names_of_cameras_are_names_of_folders() {
    let names = camera_names(&["GX01/0042", "-rf", "é 1", "gx01_0042", "", "..", "a".repeat(90).as_str()]);
    assert_eq!(&names[..6], ["GX01_0042", "rf", "é_1", "gx01_0042_2", "camera", "__"]);
    assert_eq!(names[6].len(), 60);
}

#[test]
fn masks_are_stored_next_to_their_images() {
    let (_folder, sources) = rig();
    let out = tempfile::tempdir().unwrap();
    let half = Selection { every: 2, ..Selection::default() };
    let stored = store(out.path(), &clips(&sources, &half), usize::MAX).unwrap();
    let from = tempfile::tempdir().unwrap();
    let gray = |value: u8, width: u32, height: u32, name: &str| {
        let path = from.path().join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        image::GrayImage::from_pixel(width, height, image::Luma([value])).save(path).unwrap();
    };
    let begins = [Begin { from: None }; 2];
    let make =
        |begins: &[Begin]| masks(out.path(), from.path(), &stored, begins, &mut Progress(&mut |_| ()), &|| false);
    // One for the whole recording; one for each frame of the video, of another size.
    gray(1, 32, 24, "cam_0.png");
    (0..10).for_each(|n| gray(20 * n, 64, 48, &format!("cam_1/m{n:02}.png")));
    let why = make(&begins).unwrap_err().to_string();
    assert!(why.contains("camera cam_1") && why.contains("10 masks") && why.contains("frame 10"), "{why}");
    gray(200, 64, 48, "cam_1/m10.png");
    let found = make(&begins).unwrap();
    assert_eq!((found[0].files.len(), found[1].files.len()), (stored[0].shots.len(), stored[1].shots.len()));
    let value = |file: &Path| {
        let mask = image::open(out.path().join(file)).unwrap().to_luma8();
        assert_eq!((mask.width(), mask.height()), (32, 24));
        mask.get_pixel(5, 5).0[0]
    };
    assert_eq!(value(&found[0].files[7]), 255, "ones are white");
    let values: Vec<u8> = found[1].files.iter().map(|f| value(f)).collect();
    assert_eq!(values, [0, 40, 80, 120, 160, 200]);
    // From some second on, frames were not counted: they follow from times.
    let late: Vec<Pictures> = stored
        .iter()
        .cloned()
        .map(|mut p| {
            p.shots.iter_mut().for_each(|s| s.number = 0);
            p
        })
        .collect();
    let begins = [Begin { from: Some(0.1) }; 2];
    let again = masks(out.path(), from.path(), &late, &begins, &mut Progress(&mut |_| ()), &|| false).unwrap();
    assert_eq!(again, found);
    gray(9, 50, 24, "cam_0.png");
    assert!(make(&begins).unwrap_err().to_string().contains("50x24"));
    std::fs::remove_file(from.path().join("cam_0.png")).unwrap();
    assert!(make(&begins).unwrap_err().to_string().contains("has no masks"));
}

#[test]
fn the_written_capture_is_read_back() {
    let (_folder, sources) = rig();
    let out = tempfile::tempdir().unwrap();
    let stored = store(out.path(), &clips(&sources, &Selection::default()), usize::MAX).unwrap();
    let intrinsics = Intrinsics { fx: 40.0, fy: 41.0, cx: 16.5, cy: 12.25 };
    let lens = Lens::Brown { k: [-0.05, 0.01, 0.0, 0.0, 0.0, 0.0], p: [1e-3, 0.0], s: [0.0; 4] };
    let pose = |x: f64| Se3::look_at([x, -0.2, -4.0], [0.0; 3], [0.0, -1.0, 0.0]);
    let offset = |seconds: f64, rate: f64| Offset { seconds, sigma: 0.0, rate, kinds: Vec::new(), checked: true };
    let moving = Poses::Moving((0..11).map(|k| Some(pose(1.0 + 0.1 * f64::from(k)))).collect());
    let mut cameras = vec![
        Placed {
            pictures: stored[0].clone(),
            offset: offset(0.0, 0.0),
            intrinsics,
            lens,
            poses: Poses::Fixed(pose(0.0)),
            masks: None,
        },
        Placed {
            pictures: stored[1].clone(),
            offset: offset(-0.0125, 1e-4),
            intrinsics,
            lens,
            poses: moving,
            masks: None,
        },
    ];
    let take = Recording { up: Some([0.0, -1.0, 0.0]), hold_out: vec!["cam_1".into()], ..Recording::default() };
    capture(out.path(), &take, &cameras).unwrap();
    let read = Arc::new(Capture::open(out.path(), &CaptureOptions::default()).unwrap());
    assert_eq!((read.cameras.len(), read.frames.len(), read.fps, read.held.len()), (2, 31, 25.0, 11));
    assert!(read.cameras[0].fixed && !read.cameras[1].fixed);
    for frame in &read.frames {
        let camera = &cameras[frame.camera];
        let truth = camera.offset.global(camera.pictures.shots[frame.index].time);
        assert!((frame.time.0 - truth).abs() < 2e-6, "{} {truth}", frame.time.0);
        assert_eq!(frame.source.lens, lens);
    }
    let (found, truth) = (read.frames[20 + 4].source.cam_from_world, pose(1.4));
    let off = found.rotation.iter().flatten().zip(truth.rotation.iter().flatten()).map(|(a, b)| (a - b).abs());
    assert!(off.fold(0.0, f64::max) < 1e-12 && found.translation == truth.translation);
    // All cameras of a fixed rig train.
    let rig = [cameras[0].clone(), Placed { poses: Poses::Fixed(pose(1.0)), ..cameras[1].clone() }];
    capture(out.path(), &Recording::default(), &rig).unwrap();
    let all = Capture::open(out.path(), &CaptureOptions::default()).unwrap();
    assert_eq!((all.train.len(), all.held.len()), (all.frames.len(), 0));
    let picture = ImageStore::new(Arc::clone(&read), 0).load(2).unwrap().to_picture();
    assert_eq!((picture.color.width, picture.color.height), (32, 24));
    if let Poses::Moving(all) = &mut cameras[1].poses {
        all.pop();
    }
    assert!(capture(out.path(), &take, &cameras).unwrap_err().to_string().contains("10 poses"));
    assert!(capture(out.path(), &take, &[]).is_err());
}
