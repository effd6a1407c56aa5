//! Which reader covers each source file that opens files. A new one without an entry fails the test below.

/// Coverage of a source file.
pub(crate) enum Covered {
    /// These readers.
    By(&'static [&'static str]),
    /// Nothing of ours parses the bytes, for this reason.
    Not(&'static str),
}
use Covered::{By, Not};

/// Bytes that are only passed on.
const PASSED: Covered = Not("passed on as they are, or to a reader of the list");
/// Texts of the kernel.
const KERNEL: Covered = Not("a text of the operating system");

/// By path below `src`, whatever the crate.
pub(crate) const SOURCES: &[(&str, Covered)] = &[
    ("assets.rs", Not("files of the player's own source, in development")),
    ("calibration/mod.rs", By(&["calibration", "calibration_rig"])),
    ("camera_file.rs", By(&["camera"])),
    ("capture/colmap_files.rs", By(&["colmap_cameras", "colmap_images", "colmap_points", "colmap_images_txt"])),
    ("capture/depth.rs", By(&["depth_png", "depth_exr", "depth_npy"])),
    ("capture/evidence/copies.rs", Not("images are compared byte by byte")),
    ("capture/features.rs", By(&["features_npy"])),
    ("capture/flow.rs", By(&["flow_png", "flow_flo", "flow_npy"])),
    ("capture/geometry.rs", By(&["scan_las", "scan_pcd", "scan_e57", "scan_obj", "scan_ply"])),
    ("capture/foreign/metashape.rs", By(&["metashape_xml"])),
    ("capture/foreign/realityscan.rs", By(&["realityscan_csv"])),
    (
        "capture/json.rs",
        By(&["capture_json", "transforms_json", "priors_json", "nerfies_dataset", "polycam_json", "record3d_json"]),
    ),
    ("capture/n3dv.rs", By(&["poses_bounds", "import_note"])),
    ("capture/nerfies.rs", By(&["nerfies_points"])),
    ("capture/picture.rs", By(&["picture", "image_file", "mask_png", "labels_png"])),
    ("capture/points.rs", By(&["ply_points"])),
    ("capture/splits.rs", By(&["split_list", "nerfies_split"])),
    ("capture/stray.rs", Not("a word is looked for in the first bytes")),
    ("capture/tracks.rs", By(&["tracks_npz", "tracks_csv"])),
    ("clicks/keypoints.rs", By(&["keypoints"])),
    ("clicks/mod.rs", By(&["clicks"])),
    ("comparing.rs", By(&["results_json", "per_view_json"])),
    ("compressing.rs", By(&["compress_toml"])),
    ("corrections.rs", By(&["corrections"])),
    ("doctor/mod.rs", KERNEL),
    ("editing.rs", By(&["edits", "mask_png"])),
    ("editor.rs", By(&["edits", "edit_request"])),
    ("eval/run.rs", By(&["lpips_weights", "results_json"])),
    ("evaluating.rs", By(&["results_json"])),
    ("files.rs", PASSED),
    ("following.rs", Not("lines of its own table, which are kept as they are")),
    ("format/gltf/mod.rs", By(&["gltf", "glb"])),
    ("generated.rs", By(&["rig_cameras"])),
    ("ground_truth/points.rs", By(&["true_visibility"])),
    ("ground_truth/tracks.rs", By(&["true_tracks"])),
    ("growing.rs", By(&["playback"])),
    ("models/mod.rs", By(&["model_toml"])),
    (
        "models/network.rs",
        Not("a network, which the crate rten reads: it has no limits on time and memory, and panics are caught"),
    ),
    ("output/folder.rs", By(&["output_asked"])),
    ("output/legacy.rs", By(&["run_json"])),
    ("output/list.rs", By(&["output_files"])),
    ("output/owner.rs", By(&["owner_json"])),
    ("output/temporary.rs", KERNEL),
    ("paths/keys.rs", By(&["camera_path"])),
    ("playable.rs", By(&["playback"])),
    ("predicting/score.rs", By(&["true_tracks", "npy"])),
    ("predicted.rs", By(&["predicted_npz"])),
    (
        "priors.rs",
        Not("the list and the notes that it wrote itself, in plain data; the reader of the list is `priors_json`"),
    ),
    ("report/compress.rs", By(&["playback"])),
    ("report/pictures.rs", PASSED),
    ("inspecting/playback.rs", By(&["playback"])),
    ("run.rs", Not("forecasts that the run has written, in plain data")),
    ("run/chunks/join.rs", By(&["recipe"])),
    ("run/chunks/mod.rs", By(&["chunk_plan", "recipe"])),
    ("run/chunks/shared.rs", By(&["scene", "safetensors"])),
    ("run/corrected.rs", By(&["refined_json"])),
    ("run/flows.rs", Not("compared with a mark")),
    ("run/follow/about.rs", By(&["follow_plan"])),
    ("run/follow/mod.rs", By(&["follow_plan", "recipe"])),
    ("run/follow/record.rs", By(&["follow_frame"])),
    ("run/info.rs", By(&["run_json"])),
    ("run/memory.rs", KERNEL),
    ("run/metrics.rs", By(&["metrics_csv"])),
    ("run/points.rs", Not("compared with a mark; the points are read as any others")),
    ("run/refine.rs", By(&["recipe"])),
    ("run/session.rs", By(&["checkpoint", "checkpoint_moving"])),
    ("run/start.rs", By(&["recipe", "run_json", "scene"])),
    ("run_folder.rs", By(&["run_json", "cameras_json", "compress_json", "geometry_json", "metrics_csv"])),
    ("scene.rs", By(&["playback"])),
    ("serving.rs", PASSED),
    ("shipped.rs", By(&["poses_bounds"])),
    ("source.rs", By(&["ply", "spz", "splat", "sog_zip", "scene", "playback"])),
    ("source/bundle.rs", By(&["ply_zip", "sog_meta", "sog_levels", "research", "research_pickle"])),
    ("still_baseline.rs", By(&["results_json"])),
    ("recording/assist.rs", Not("a file of points is renamed; its reader is `clicks`")),
    ("recording/cache.rs", Not("values of an import, in plain data; what cannot be read is made again")),
    ("recording/colmap.rs", Not("a note of our own that is compared, masks that are copied and a log that is shown")),
    ("recording/soundtrack.rs", By(&["sound_mp4"])),
    ("storage/mirror.rs", Not("a list that the worker itself wrote; a damaged one is no list")),
    ("storage/s3.rs", PASSED),
    ("storage/work.rs", By(&["capture_json"])),
    ("sound.rs", By(&["sound_mp4", "capture_json", "playback"])),
    ("training.rs", By(&["scene", "capture_json"])),
    ("exporting.rs", By(&["points"])),
    ("verbs/predict.rs", By(&["actions"])),
    ("verbs/train.rs", By(&["recipe"])),
    ("video/avi.rs", By(&["video_avi"])),
    ("video/mod.rs", By(&["video_avi"])),
    ("write/pictures.rs", Not("notes of an import, in plain data; what cannot be read is written again")),
];

/// How source files open files.
const OPENS: [&str; 8] = [
    "files::read(",
    "files::read_with(",
    "files::open(",
    "fs::read(",
    "fs::read_to_string(",
    "File::open(",
    "read_bytes(",
    "read_text",
];

#[cfg(test)]
mod tests {
    use super::*;
    use crate::readers;
    use std::collections::BTreeSet;
    use std::path::Path;

    /// Source files below a folder, tests aside.
    fn sources(folder: &Path, out: &mut Vec<std::path::PathBuf>) {
        for entry in std::fs::read_dir(folder).unwrap().flatten() {
            let (path, name) = (entry.path(), entry.file_name().into_string().unwrap());
            match path.is_dir() {
                true if name != "tests" => sources(&path, out),
                false if name.ends_with(".rs") && name != "tests.rs" => out.push(path),
                _ => {}
            }
        }
    }

    #[test]
    fn every_file_that_opens_files_has_a_reader() {
        let crates = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
        let mut found = BTreeSet::new();
        for entry in std::fs::read_dir(crates).unwrap().flatten().filter(|e| e.file_name() != "splat4d-fuzz") {
            let root = entry.path().join("src");
            let mut files = Vec::new();
            if root.is_dir() {
                sources(&root, &mut files);
            }
            for file in files {
                let text = std::fs::read_to_string(&file).unwrap();
                let code = text.split("#[cfg(test)]\nmod tests {").next().unwrap_or_default();
                let code = code.lines().filter(|l| !l.trim_start().starts_with("//"));
                if code.into_iter().any(|l| OPENS.iter().any(|open| l.contains(open))) {
                    found.insert(file.strip_prefix(&root).unwrap().to_str().unwrap().replace('\\', "/"));
                }
            }
        }
        let listed: BTreeSet<String> = SOURCES.iter().map(|(path, _)| (*path).to_owned()).collect();
        let missing: Vec<_> = found.difference(&listed).collect();
        assert!(missing.is_empty(), "these open files: add them to SOURCES, with a fuzz target: {missing:?}");
        let gone: Vec<_> = listed.difference(&found).collect();
        assert!(gone.is_empty(), "these open no file: remove them from SOURCES: {gone:?}");
        let names: BTreeSet<&str> = readers().map(|r| r.name).collect();
        for (path, covered) in SOURCES {
            match covered {
                By(list) => assert!(list.iter().all(|n| names.contains(n)), "{path}: there is no such reader"),
                Not(why) => assert!(!why.is_empty(), "{path}"),
            }
        }
    }
}
