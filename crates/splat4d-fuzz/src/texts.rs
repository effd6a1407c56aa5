//! Inputs next to scenes and captures: recipes, edits, paths, points, actions, calibrations, requests of a page,
//! videos.

use crate::Reader;
use splat4d::Error;
use splat4d::edit::{Edits, Expr};
use splat4d_dynamics::actions::Actions;
use splat4d_import::calibration;
use splat4d_import::check_clicks;
use splat4d_import::corrections::{self, Corrections};
use splat4d_import::generated;
use splat4d_import::predicted;
use splat4d_import::video::{self, Selection};
use splat4d_train::recipe::Recipe;
use splat4d_workflow::texts::{self, Page};
use std::cell::RefCell;
use std::path::Path;
use tempfile::{NamedTempFile, TempDir};

pub(crate) const READERS: &[Reader] = &[
    Reader { name: "recipe", seeds: recipes, read: |b| drop(Recipe::from_toml(&text(b))) },
    Reader { name: "setting", seeds: settings, read: |b| drop(Recipe::default().set(&text(b))) },
    Reader { name: "edits", seeds: edits, read: |b| drop(toml::from_str::<Edits>(&text(b)).map(|e| e.check("fuzz"))) },
    Reader { name: "selection", seeds: selections, read: |b| drop(Expr::parse(&text(b))) },
    Reader { name: "camera", seeds: cameras, read: |b| drop(texts::camera(&text(b))) },
    Reader { name: "camera_path", seeds: paths, read: |b| drop(texts::path(&text(b))) },
    Reader { name: "points", seeds: points, read: |b| drop(texts::points(&text(b))) },
    Reader { name: "actions", seeds: actions, read: |b| drop(Actions::parse(&text(b))) },
    Reader { name: "calibration", seeds: calibrations, read: calibration },
    Reader { name: "calibration_rig", seeds: rigs, read: calibration },
    Reader { name: "clicks", seeds: || seeds(&[CLICKS]), read: clicks },
    Reader { name: "compress_toml", seeds: || seeds(&[ORDER]), read: |b| drop(texts::compress_order(&text(b))) },
    Reader { name: "corrections", seeds: || seeds(&[CORRECTIONS]), read: corrections },
    Reader { name: "keypoints", seeds: || seeds(&[KEYPOINTS, COCO]), read: keypoints },
    Reader { name: "model_toml", seeds: models, read: |b| drop(texts::model(&text(b))) },
    Reader { name: "rig_cameras", seeds: || seeds(&[RIG]), read: |b| drop(generated::check_cameras(b)) },
    Reader { name: "predicted_npz", seeds: predictions, read: |b| drop(predicted::check_archive(b)) },
    Reader { name: "edit_request", seeds: requests, read: edit_request },
    Reader { name: "video_avi", seeds: films, read: film },
];

const RIG: &str = r#"{"camera_model": "OPENCV", "cameras": [{"camera_id": 0, "K": [[60, 0, 32], [0, 60, 24], [0, 0, 1]],
    "camera_to_world": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -3], [0, 0, 0, 1]], "image_width": 64, "image_height": 48,
    "video": "videos/dense/00.mp4"}]}"#;

fn predictions() -> Vec<Vec<u8>> {
    let (pose, lens) =
        ([1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 3.0], [5.0, 0.0, 1.0, 0.0, 5.0, 1.0, 0.0, 0.0, 1.0]);
    let (pixels, depth) = ([0.5; 12], [2.0; 4]);
    let mut bytes = Vec::new();
    let arrays: [(&str, &[usize], &[f32]); 4] = [
        ("images", &[1, 3, 2, 2], &pixels),
        ("extrinsic", &[1, 3, 4], &pose),
        ("intrinsic", &[1, 3, 3], &lens),
        ("depth", &[1, 2, 2, 1], &depth),
    ];
    splat4d::format::npy::write_archive(&arrays, &mut bytes).expect("memory takes it");
    vec![bytes]
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

fn seeds(texts: &[&str]) -> Vec<Vec<u8>> {
    texts.iter().map(|t| t.as_bytes().to_vec()).collect()
}

fn recipes() -> Vec<Vec<u8>> {
    seeds(&[
        "iterations = 300\nstrategy = \"mcmc\"\n[loss]\nmoving = 2.0\n",
        "[run]\nmotion = \"control\"\niterations = 7\n",
    ])
}

fn models() -> Vec<Vec<u8>> {
    splat4d_workflow::models::PUBLISHED.iter().map(|(_, text)| text.as_bytes().to_vec()).collect()
}

fn settings() -> Vec<Vec<u8>> {
    seeds(&["iterations=300", "strategy=mcmc", "hold_out=\"camera=0,10\"", "refine.poses=true", "init=\"points.ply\""])
}

fn edits() -> Vec<Vec<u8>> {
    seeds(&[
        "[[edit]]\ndo = \"delete\"\nselect = \"sphere(0,0,3, 0.5) and not layer(a)\"\n",
        "title = \"x\"\n[[edit]]\ndo = \"move\"\nselect = \"all\"\nby = [1, 2, 3]\n[[edit]]\ndo = \"crop\"\nselect = \"box(-1,-1,0, 1,1,2)\"\n",
    ])
}

fn selections() -> Vec<Vec<u8>> {
    seeds(&[
        "all",
        "not (box(-1,-1,0, 1,1,2) or sphere(0,0,3, 0.5)) and size(0.5,99)",
        "at(0.5, like(0.1,0.4,1.2, 0.9)) or ever(mask(\"m a.png\", cam1))",
    ])
}

fn cameras() -> Vec<Vec<u8>> {
    seeds(&[
        r#"{"width": 40, "height": 30, "fx": 30, "fy": 30, "cx": 20, "cy": 15, "position": [0, 1, 4], "look_at": [0, 1, 0],
        "background": [1, 1, 1]}"#,
    ])
}

fn paths() -> Vec<Vec<u8>> {
    seeds(&[r#"{"fps": 30, "keys": [{"time": 0, "position": [0, 1, 4], "look_at": [0, 1, 0], "fov_y": 50},
        {"time": 1.5, "position": [2, 1, 3], "look_at": [0, 1, 0], "scene_time": 0.5}]}"#])
}

fn points() -> Vec<Vec<u8>> {
    seeds(&["name,x,y,z,time\na,0.1,0.2,0.3,0.5\nb,1,2,3,0\n", "camera,u,v,time\na,4,3,0.5\n"])
}

fn actions() -> Vec<Vec<u8>> {
    seeds(&["time,push,pull\n0,0.5,1\n0.1,0.25,-1\n", "{\"push\": [0, 1, 2]}"])
}

fn calibrations() -> Vec<Vec<u8>> {
    seeds(&[
        "%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ 8., 0., 4., 0., 8., 3., 0., 0., 1. ]\n\
         distortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 5\n   dt: d\n   data: [ 0.1, 0., 0., 0., 0. ]\n\
         image_width: 8\nimage_height: 6\n",
        "<?xml version=\"1.0\"?>\n<opencv_storage><K type_id=\"opencv-matrix\"><rows>3</rows><cols>3</cols><dt>d</dt>\
         <data>8 0 4 0 8 3 0 0 1</data></K></opencv_storage>\n",
        "[cam_0]\nname = \"a\"\nsize = [8, 6]\nmatrix = [[8, 0, 4], [0, 8, 3], [0, 0, 1]]\nrotation = [0, 0, 0]\ntranslation = [0, 0, 4]\n\
         distortions = [0, 0, 0, 0]\n",
        r#"{"cameras": [{"name": "a", "width": 8, "height": 6, "fx": 8, "fy": 8, "cx": 4, "cy": 3}]}"#,
    ])
}

thread_local! {
    static FILE: RefCell<Option<NamedTempFile>> = const { RefCell::new(None) };
}

/// Reads a calibration, which is a file.
fn calibration(bytes: &[u8]) {
    FILE.with_borrow_mut(|file| {
        let file = file.get_or_insert_with(|| NamedTempFile::new().expect("there is a place for temporary files"));
        let path: &Path = file.path();
        std::fs::write(path, bytes).expect("the disk takes a file");
        drop(calibration::read(path));
    });
}

/// Calibrations of rigs in the other dialects: EasyMocap, Qualisys, `transforms.json`, `capture.json`.
fn rigs() -> Vec<Vec<u8>> {
    let matrix = |name: &str, rows: usize, cols: usize, data: &str| {
        format!("{name}: !!opencv-matrix\n  rows: {rows}\n  cols: {cols}\n  dt: d\n  data: [{data}]\n")
    };
    let easymocap = [
        "%YAML:1.0\n---\nnames:\n  - \"1\"\n".to_owned(),
        matrix("K_1", 3, 3, "8, 0, 4, 0, 8, 3, 0, 0, 1"),
        matrix("dist_1", 1, 5, "0.1, 0, 0, 0, 0"),
        matrix("Rot_1", 3, 3, "1, 0, 0, 0, 1, 0, 0, 0, 1"),
        matrix("T_1", 3, 1, "0, 0, 4"),
    ]
    .concat();
    seeds(&[
        &easymocap,
        "<?xml version=\"1.0\"?>\n<calibration created=\"x\"><cameras><camera serial=\"1\" active=\"1\" model=\"a\">\
         <fov_video left=\"0\" top=\"0\" right=\"8\" bottom=\"6\"/><transform x=\"1\" y=\"2\" z=\"3\" r11=\"1\" r12=\"0\" r13=\"0\" \
         r21=\"0\" r22=\"1\" r23=\"0\" r31=\"0\" r32=\"0\" r33=\"1\"/><intrinsic focallength=\"8\" focalLengthU=\"512\" focalLengthV=\"512\" \
         centerPointU=\"256\" centerPointV=\"192\" skew=\"0\" radialDistortion1=\"0.1\" radialDistortion2=\"0\" \
         radialDistortion3=\"0\" tangentalDistortion1=\"0\" tangentalDistortion2=\"0\"/></camera></cameras></calibration>\n",
        r#"{"fl_x": 8, "fl_y": 8, "cx": 4, "cy": 3, "w": 8, "h": 6, "frames": [{"file_path": "a.png",
        "transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]}]}"#,
        r#"{"version": 1, "cameras": [{"name": "a", "width": 8, "height": 6, "fx": 8, "fy": 8, "cx": 4, "cy": 3, "images": "a/%d.png",
        "world_to_camera": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]}]}"#,
    ])
}

/// `compress.toml`, as written.
const ORDER: &str = "source = \"runs/a\"\nlevel = 1\nguard = 0.1\nasked = false\nunpruned = false\nfree = true\n\n[settings]\nprune = 0.2\nrounds = 1\n";

/// `import.toml`, as written.
const CLICKS: &str = r#"{"version": 1, "cameras": {"a": [64, 48], "b": [64, 48]}, "event": {"a": 0.4, "b": 0.5},
    "points": [{"name": "corner", "clicks": [{"camera": "a", "x": 8.5, "y": 9, "time": 0.4}, {"camera": "b", "x": 3, "y": 40.25, "time": 0.5}]},
    {"name": "post", "clicks": [{"camera": "a", "x": 60, "y": 1, "time": 0.4}]}, {"name": "mat", "clicks": []},
    {"name": "hand", "moment": 0.9, "clicks": [{"camera": "b", "x": 31, "y": 7, "time": 0.9}]}],
    "floor": ["corner", "mat", "post"], "length": {"points": ["corner", "post"], "metres": 2.0}}"#;
const CORRECTIONS: &str = "version = 1\n[[camera]]\nname = \"a\"\nuse = true\noffset = 0.5\nkeep_offset = true\n[camera.lens]\nfx = 8\ncx = 4\ncy = 3\nk = [0.1]\n\n[[camera]]\nname = \"b\"\nuse = false\n";

thread_local! {
    static FOLDER: TempDir = tempfile::tempdir().expect("there is a place for temporary files");
    static PAGE: RefCell<Option<Page>> = const { RefCell::new(None) };
}

fn in_folder(name: &str, bytes: &[u8], read: impl FnOnce(&Path)) {
    FOLDER.with(|folder| {
        std::fs::write(folder.path().join(name), bytes).expect("the disk takes a file");
        read(folder.path());
    });
}

fn corrections(bytes: &[u8]) {
    in_folder(corrections::FILE, bytes, |folder| {
        if let Ok(read) = Corrections::read(folder, &["a".into(), "b".into()]) {
            read.cameras.iter().for_each(|c| assert!(c.given_offset().is_none_or(f64::is_finite)));
        }
    });
}

/// Keypoints of a frame as OpenPose writes them, and of a camera as COCO has them.
const KEYPOINTS: &str =
    r#"{"version": 1.3, "people": [{"person_id": [-1], "pose_keypoints_2d": [694.6, 531.5, 0.69, 0, 0, 0]}]}"#;
const COCO: &str = r#"{"images": [{"id": 7, "file_name": "a/000001.jpg"}],
    "annotations": [{"image_id": 7, "keypoints": [3, 4, 2, 5, 6.5, 1]}, {"image_id": 3, "keypoints": []}]}"#;

/// As the file of a frame, and as that of a camera.
fn keypoints(bytes: &[u8]) {
    in_folder("a.json", bytes, |folder| drop(check_clicks(folder, &["a"])));
    in_folder("1.json", bytes, |folder| {
        let (Some(parent), Some(name)) = (folder.parent(), folder.file_name().and_then(|n| n.to_str())) else { return };
        drop(check_clicks(parent, &[name]));
    });
}

fn clicks(bytes: &[u8]) {
    in_folder("points.json", bytes, |folder| drop(check_clicks(&folder.join("points.json"), &["a", "b"])));
}

fn requests() -> Vec<Vec<u8>> {
    let view = r#""view": {"position": [0, 0, -5], "quat": [1, 0, 0, 0], "fx": 16, "fy": 16, "cx": 8, "cy": 6, "near": 0.01,
        "width": 16, "height": 12}"#;
    let step = r#"{"do": "delete", "select": "sphere(0,0,0, 0.5)"}"#;
    let with_view = |text: &str| text.replace("VIEW", view).replace("STEP", step);
    [
        r#"{"do": "open"}"#,
        r#"{"do": "show", "steps": [STEP], VIEW, "t": 0.5}"#,
        r#"{"do": "bake", "steps": [STEP]}"#,
        r#"{"do": "save", "steps": [STEP]}"#,
        r#"{"do": "select", "steps": [], "select": "box(-1,-1,-1, 1,1,1)", "t": 0}"#,
        r#"{"do": "pick", "steps": [], "shape": "box", "corners": [[0, 0], [9, 9]], VIEW, "t": 0, "through": true, "now": true}"#,
        r#"{"do": "bend", "steps": [], "select": "all", "at": 0, "t": 0.5, "nodes": 4}"#,
        r#"{"do": "pull", "number": 0, "handles": [], "pins": [], VIEW}"#,
    ]
    .map(|text| with_view(text).into_bytes())
    .into()
}

/// Requests of a page of `view --edit`.
fn edit_request(bytes: &[u8]) {
    PAGE.with_borrow_mut(|page| {
        let list = FOLDER.with(|folder| folder.path().join("edits.toml"));
        let _ = std::fs::remove_file(&list);
        let new = || Page::new(crate::formats::moving(), &list).expect("there is no list yet");
        // Each request meets a page that has just been opened.
        drop(page.insert(new()).ask(&text(bytes)));
    });
}

/// An AVI of two frames of motion JPEG at 25 a second.
fn films() -> Vec<Vec<u8>> {
    let chunk = |name: &[u8; 4], body: &[u8]| {
        let mut out = [&name[..], &(body.len() as u32).to_le_bytes(), body].concat();
        out.resize(out.len().next_multiple_of(2), 0);
        out
    };
    let mut header = vec![0; 56];
    header[..8].copy_from_slice(b"vidsMJPG");
    header[20..24].copy_from_slice(&1u32.to_le_bytes());
    header[24..28].copy_from_slice(&25u32.to_le_bytes());
    let stream = chunk(b"LIST", &[&b"strl"[..], &chunk(b"strh", &header)].concat());
    let headers = chunk(b"LIST", &[&b"hdrl"[..], &stream].concat());
    let frame = chunk(b"00dc", include_bytes!("../seeds/few.jpg"));
    let frames = chunk(b"LIST", &[&b"movi"[..], &frame, &frame].concat());
    vec![chunk(b"RIFF", &[&b"AVI "[..], &headers, &frames].concat())]
}

/// Reads a video as where there is no ffmpeg.
fn film(bytes: &[u8]) {
    in_folder("film.avi", bytes, |folder| {
        let none = Err(Error::input("there is no ffmpeg"));
        let Ok(source) = video::open_with(&folder.join("film.avi"), 1.0, none) else { return };
        let Ok(mut reader) = source.frames(&Selection::default()) else { return };
        let mut frame = video::Frame::default();
        while reader.next(&mut frame).unwrap_or(false) {}
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seeds_are_sound() {
        in_folder("points.json", CLICKS.as_bytes(), |folder| {
            check_clicks(&folder.join("points.json"), &["a", "b"]).unwrap();
        });
        in_folder(corrections::FILE, CORRECTIONS.as_bytes(), |folder| {
            let read = Corrections::read(folder, &["a".into(), "b".into()]).unwrap();
            assert_eq!(
                read.cameras.iter().map(corrections::Camera::given_offset).collect::<Vec<_>>(),
                [Some(0.5), None]
            );
        });
        for (i, rig) in rigs().iter().enumerate() {
            in_folder("rig", rig, |folder| {
                let read = calibration::read(&folder.join("rig"));
                assert!(read.is_ok(), "{i}: {:?}", read.err().map(|e| e.to_string()));
            });
        }
        in_folder("film.avi", &films()[0], |folder| {
            let none = Err(Error::input("there is no ffmpeg"));
            let film = video::open_with(&folder.join("film.avi"), 1.0, none).unwrap();
            assert_eq!(film.info().frames, Some(2));
        });
        in_folder("x", b"", |folder| {
            let page = Page::new(crate::formats::moving(), &folder.join("list.toml")).unwrap();
            for request in requests() {
                // All are understood, though not every one has something to do.
                let error = page.ask(&text(&request)).err().map(|e| e.to_string()).unwrap_or_default();
                assert!(
                    !error.contains("unknown request") && !error.contains("invalid JSON"),
                    "{}: {error}",
                    text(&request)
                );
            }
        });
    }
}
