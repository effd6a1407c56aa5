//! Files of output folders: one of a valid run's files is replaced by the bytes, and the run is opened. Runs may be
//! from other machines.

use crate::Reader;
use serde_json::json;
use splat4d::format::safetensors::{self, Tensor};
use splat4d_train::output::{self, Owner};
use splat4d_train::recipe::Recipe;
use splat4d_train::run::chunks::Chunked;
use splat4d_train::run::corrected;
use splat4d_train::run::follow::{self, Following};
use splat4d_workflow::run_folder::{Run, RunRequest};
use std::cell::OnceCell;
use std::collections::BTreeMap;
use std::path::Path;
use tempfile::TempDir;

pub(crate) const READERS: &[Reader] = &[
    Reader { name: "run_json", seeds: || vec![run_json().into()], read: |b| open("run.json", b) },
    Reader { name: "metrics_csv", seeds: || vec![METRICS.into()], read: |b| open("metrics.csv", b) },
    Reader { name: "results_json", seeds: || vec![RESULTS.into()], read: |b| open("results.json", b) },
    Reader { name: "per_view_json", seeds: || vec![PER_VIEW.into()], read: |b| open("per_view.json", b) },
    Reader { name: "cameras_json", seeds: || vec![CAMERAS.into()], read: |b| open("cameras.json", b) },
    Reader { name: "chunk_plan", seeds: || vec![PLAN.into()], read: |b| open("chunks/plan.json", b) },
    Reader { name: "follow_plan", seeds: || vec![FOLLOW.into()], read: follow_plan },
    Reader { name: "follow_frame", seeds: || vec![frame()], read: |b| drop(follow::check_frame(b)) },
    Reader { name: "compress_json", seeds: || vec![COMPRESS.into()], read: |b| open("compress.json", b) },
    Reader { name: "geometry_json", seeds: || vec![GEOMETRY.into()], read: |b| open("geometry.json", b) },
    Reader { name: "refined_json", seeds: || vec![REFINED.into()], read: |b| open("refined.json", b) },
    Reader { name: "owner_json", seeds: || vec![OWNER.into()], read: |b| open(".splat4d/owner.json", b) },
    Reader { name: "output_files", seeds: || vec![FILES.into()], read: |b| open(".splat4d/files", b) },
    Reader { name: "output_asked", seeds: || vec![asked().into()], read: |b| open(".splat4d/asked", b) },
];

const METRICS: &str =
    "iteration,loss,psnr,gaussians,stage,seconds,render_ms\n10,0.5,20.5,100,\"deform-mlp, still\",1.5,0.25\n";
const RESULTS: &str = r#"{"ours_10": {"PSNR": 20.5, "SSIM": 0.9}, "still": {"PSNR": 18.0}}"#;
const PER_VIEW: &str =
    r#"{"ours_10": {"PSNR": {"00000.png": 20.5}, "camera": {"00000.png": "a"}, "time": {"00000.png": 0.5}}}"#;
const CAMERAS: &str = r#"[{"id": 0, "img_name": "a", "width": 8, "height": 6, "position": [0, 0, -4],
    "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "fx": 8, "fy": 8, "cx": 4, "cy": 3, "near": 0.1, "time": 0.5, "split": "test"}]"#;
const PLAN: &str = r#"{"version": "0.1.0", "recipe": "0011223344556677", "capture": "8899", "take": [0, 120], "overlap": 16, "cuts": [60]}"#;
const FOLLOW: &str = r#"{"version": "0.1.0", "capture": "/nowhere", "recipe": "0011223344556677"}"#;
const FILES: &str = "run.json\ntest/ours_10/\ntest/ours_10/renders/00000.png\nü%0a.json\n";

const COMPRESS: &str = r#"{"bytes": 1000, "before": {"PSNR": 20.5}, "after": {"PSNR": 20.0}, "tiers": []}"#;
const REFINED: &str =
    r#"{"cameras": [{"camera": "a", "frame": null, "twist": [0, 0, 0, 0, 0, 0.1], "offset": 0.01, "focal": 0.02}]}"#;
const GEOMETRY: &str = r#"{"measured": 0.5, "error": 0.01, "worst": "a", "worst_error": 0.02, "cameras": [{"camera": "a", "frames": 4, "measured": 0.5, "error": null, "ratio": 1.0}]}"#;
const OWNER: &str = r#"{"command": "train", "process": 7, "host": "h", "since": "2026-11-27T00:00:00Z", "machine": "m", "beat": "0000000001"}"#;

/// The file of a frame of two Gaussians, one of them new.
fn frame() -> Vec<u8> {
    let (geometry, sh) = ([0.0f32; 22], [0.0f32; 6]);
    let tensors = [
        Tensor::u32("active", &[1], &[0]),
        Tensor::u32("origin", &[2], &[0, u32::MAX]),
        Tensor::f32("geometry", &[2, 11], &geometry),
        Tensor::f32("sh", &[2, 3], &sh),
        Tensor::f32("errors", &[1], &[0.5]),
        Tensor::f32("exposure", &[0], &[]),
    ];
    let facts = json!({"version": 1, "frame": 0, "facts": null}).to_string();
    let mut bytes = Vec::new();
    safetensors::write(&tensors, &BTreeMap::from([("splat4d-follow".to_owned(), facts)]), &mut bytes)
        .expect("memory takes it");
    bytes
}

fn run_json() -> String {
    json!({"version": "0.1.0", "capture": "/nowhere", "capture_name": "a", "iteration": 10, "iterations": 10, "seconds": 1.5,
        "finished": true, "gaussians": 100, "warnings": ["a"], "notes": [{"what": "b", "remedy": "c"}]})
    .to_string()
}

fn asked() -> String {
    let asked = RunRequest::new(Path::new("/nowhere"), &Recipe::default(), Some(1.0), false);
    serde_json::to_string(&asked).expect("it is plain data")
}

thread_local! {
    static FOLDER: OnceCell<TempDir> = const { OnceCell::new() };
}

/// Opens the run in which one file has other bytes, and puts that back.
fn open(file: &str, bytes: &[u8]) {
    with_file(file, bytes, |run| {
        if let Ok(run) = Run::open(run) {
            drop((run.name(), run.iteration(), run.scene_file(), run.views()));
        }
        drop((corrected::read(run), Owner::holder(run)));
        drop((Chunked::open(run).map(|c| c.parts()), RunRequest::unbegun(run), output::written(run)));
    });
}

/// Nothing else reads that file.
fn follow_plan(bytes: &[u8]) {
    with_file("frames/follow.json", bytes, |run| drop(Following::request(run)));
}

fn with_file(file: &str, bytes: &[u8], read: impl FnOnce(&Path)) {
    FOLDER.with(|folder| {
        let run = folder.get_or_init(made).path();
        let path = run.join(file);
        std::fs::write(&path, bytes).expect("the disk takes a file");
        read(run);
        std::fs::remove_file(path).expect("it is there");
    });
}

fn made() -> TempDir {
    let folder = tempfile::tempdir().expect("there is a place for temporary files");
    for inner in ["chunks", "frames", ".splat4d"] {
        std::fs::create_dir(folder.path().join(inner)).expect("it is new");
    }
    // Short: it is parsed for every input, and the reader `recipe` has inputs of its own.
    for recipe in ["recipe.toml", "frames/recipe.toml"] {
        std::fs::write(folder.path().join(recipe), "[run]\niterations = 10\n").expect("the disk takes a file");
    }
    folder
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seeds_are_sound() {
        let folder = made();
        let at = folder.path();
        for (file, text) in [
            ("run.json", run_json()),
            ("metrics.csv", METRICS.into()),
            ("results.json", RESULTS.into()),
            ("per_view.json", PER_VIEW.into()),
            ("cameras.json", CAMERAS.into()),
            ("chunks/plan.json", PLAN.into()),
            ("frames/follow.json", FOLLOW.into()),
            (".splat4d/files", FILES.into()),
            (".splat4d/asked", asked()),
        ] {
            std::fs::write(at.join(file), text).unwrap();
        }
        let run = Run::open(at).unwrap();
        assert_eq!((run.metrics.len(), run.views.len(), run.views().unwrap().len()), (1, 1, 1));
        assert_eq!((run.name().as_str(), output::written(at).len()), ("a", 4));
        assert_eq!(Following::request(at).unwrap().0, Path::new("/nowhere"));
        follow::check_frame(&frame()).unwrap();
        assert!(RunRequest::unbegun(at).is_some());
        assert!(Chunked::open(at).err().unwrap().to_string().contains("recipe"), "its fingerprint is another");
    }
}
