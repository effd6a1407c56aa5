//! Texts that people and programs give: recipes, edits, paths, points, actions, calibrations.

use crate::Reader;
use splat4d::edit::{Edits, Expr};
use splat4d_cli::texts;
use splat4d_dynamics::actions::Actions;
use splat4d_import::calibration;
use splat4d_train::recipe::Recipe;
use std::cell::RefCell;
use std::path::Path;
use tempfile::NamedTempFile;

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
];

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
