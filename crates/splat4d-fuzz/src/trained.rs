//! Inputs of training and evaluation: checkpoints with the state of the optimiser, LPIPS weights, true tracks.

use crate::Reader;
use crate::captures;
use crate::formats::moving;
use serde_json::{Map, json};
use splat4d::format::{npy, safetensors::SafeTensors};
use splat4d::layers::Scene;
use splat4d_train::capture::Capture;
use splat4d_train::eval::Lpips;
use splat4d_train::recipe::Recipe;
use splat4d_train::run::probe::Probe;
use splat4d_workflow::ground_truth::{points, tracks};
use std::cell::{OnceCell, RefCell};
use std::path::Path;
use std::sync::Arc;
use tempfile::TempDir;

pub(crate) const READERS: &[Reader] = &[
    Reader { name: "checkpoint", seeds: checkpoints, read: |b| drop(probed(0, b)) },
    Reader { name: "checkpoint_moving", seeds: moving_checkpoints, read: |b| drop(probed(1, b)) },
    Reader { name: "lpips_weights", seeds: lpips_headers, read: |b| lpips(b, |file| drop(check_lpips(file))) },
    Reader { name: "true_tracks", seeds: true_tracks, read: |b| truth(tracks::FILE, b) },
    Reader { name: "true_visibility", seeds: visibility, read: |b| truth(points::VISIBLE, b) },
];

/// Settings of a run that remembers as much as runs can, of a scene without motion and of one with.
const RUNS: [&[&str]; 2] = [
    &["motion=still", "exposure=true", "refine.poses=true", "refine.focal=true"],
    &["motion=spacetime", "exposure=true", "loss.rigid=0.1", "refine.poses=true", "refine.times=true"],
];
/// Gaussians of these runs.
const GAUSSIANS: usize = 12;

thread_local! {
    static PROBES: [OnceCell<RefCell<Probe>>; 2] = const { [const { OnceCell::new() }; 2] };
    static CAPTURE: OnceCell<(TempDir, Capture, Scene<f32>)> = const { OnceCell::new() };
    static WEIGHTS: RefCell<Vec<u8>> = const { RefCell::new(Vec::new()) };
}

fn with_probe<R>(number: usize, f: impl FnOnce(&mut Probe) -> R) -> R {
    let made = || {
        let mut recipe = Recipe::default();
        let count = GAUSSIANS.to_string();
        let few =
            ["iterations=50".into(), format!("num_pts={count}"), format!("max_cap={count}"), "sh_degree=1".into()];
        for setting in few.iter().map(String::as_str).chain(RUNS[number].iter().copied()) {
            recipe.set(setting).unwrap_or_else(|e| panic!("{setting}: {e}"));
        }
        let (_folder, capture) = captures::rig();
        RefCell::new(Probe::new(Arc::new(capture), &recipe).unwrap_or_else(|e| panic!("{e}")))
    };
    PROBES.with(|probes| f(&mut probes[number].get_or_init(made).borrow_mut()))
}

fn probed(number: usize, bytes: &[u8]) -> splat4d::Result<()> {
    with_probe(number, |probe| probe.resume(bytes))
}

fn checkpoints() -> Vec<Vec<u8>> {
    seeds(0)
}

fn moving_checkpoints() -> Vec<Vec<u8>> {
    seeds(1)
}

/// A checkpoint as written, and one whose checksums no reader finds: almost every change would stop at these.
fn seeds(number: usize) -> Vec<Vec<u8>> {
    let bytes = with_probe(number, |probe| probe.checkpoint()).unwrap_or_else(|e| panic!("{e}"));
    let mut open = bytes.clone();
    let key = b"splat4d-crc32";
    let at = open.windows(key.len()).position(|w| w == key).expect("it has checksums");
    open[at] = b'x';
    vec![open, bytes]
}

/// Shapes of AlexNet's tensors, as in `docs/metrics.md`.
fn alexnet() -> Vec<(String, Vec<usize>)> {
    let convolutions: [(usize, [usize; 4]); 5] = [
        (0, [64, 3, 11, 11]),
        (3, [192, 64, 5, 5]),
        (6, [384, 192, 3, 3]),
        (8, [256, 384, 3, 3]),
        (10, [256, 256, 3, 3]),
    ];
    let conv = |(i, shape): (usize, [usize; 4])| {
        [(format!("features.{i}.weight"), shape.to_vec()), (format!("features.{i}.bias"), vec![shape[0]])]
    };
    let taps = [64, 192, 384, 256, 256].into_iter().enumerate();
    let taps = taps.map(|(l, channels)| (format!("lin{l}.model.1.weight"), vec![1, channels, 1, 1]));
    convolutions.into_iter().flat_map(conv).chain(taps).collect()
}

/// The header of such a file: its ten megabytes of numbers are zeros.
fn lpips_headers() -> Vec<Vec<u8>> {
    let (mut header, mut at) = (Map::new(), 0);
    for (name, shape) in alexnet() {
        let end = at + 4 * shape.iter().product::<usize>();
        header.insert(name, json!({"dtype": "F32", "shape": shape, "data_offsets": [at, end]}));
        at = end;
    }
    vec![serde_json::Value::Object(header).to_string().into_bytes()]
}

/// Space for a header before the numbers, which are made once.
const HEADER: usize = 1 << 14;

/// Reads weights as `eval` does.
fn check_lpips(bytes: &[u8]) -> splat4d::Result<()> {
    let file = SafeTensors::read(bytes)?;
    let tensor = |name: &str| {
        let tensor = file.tensor(name).ok()?;
        Some((tensor.shape().to_vec(), tensor.as_f32().ok()?.to_vec()))
    };
    Lpips::load(tensor).map(drop)
}

/// Calls `f` with the file that begins with this header.
fn lpips(header: &[u8], f: impl FnOnce(&[u8])) {
    let length = (header.len() as u64).to_le_bytes();
    let Some(start) = HEADER.checked_sub(header.len() + length.len()) else { return };
    WEIGHTS.with_borrow_mut(|file| {
        if file.is_empty() {
            let numbers: usize = alexnet().iter().map(|(_, shape)| shape.iter().product::<usize>()).sum();
            file.resize(HEADER + 4 * numbers, 0);
        }
        file[start..start + length.len()].copy_from_slice(&length);
        file[start + length.len()..HEADER].copy_from_slice(header);
        f(&file[start..]);
    });
}

/// Frames and points of the true tracks.
const TRACKS: [usize; 3] = [2, 3, 3];

fn true_tracks() -> Vec<Vec<u8>> {
    vec![array(&TRACKS)]
}

/// Of the capture's two cameras.
fn visibility() -> Vec<Vec<u8>> {
    vec![array(&[2, TRACKS[0], TRACKS[1]])]
}

fn array(shape: &[usize]) -> Vec<u8> {
    let data: Vec<f32> = (0..shape.iter().product()).map(|i| 0.1 * (i % 5) as f32).collect();
    let mut out = Vec::new();
    npy::write_f32(shape, &data, &mut out).expect("memory takes all bytes");
    out
}

/// Compares a scene with true tracks of which one file has other bytes.
fn truth(file: &str, bytes: &[u8]) {
    CAPTURE.with(|capture| {
        let (folder, capture, scene) = capture.get_or_init(|| {
            let (folder, capture) = captures::rig();
            std::fs::create_dir_all(folder.path().join("truth")).expect("the disk takes a folder");
            (folder, capture, moving())
        });
        let put = |name: &str, bytes: &[u8]| write(folder.path(), name, bytes);
        put(tracks::FILE, &array(&TRACKS));
        put(points::VISIBLE, &visibility()[0]);
        put(file, bytes);
        drop((tracks::track_error(scene, capture), points::point_errors(scene, capture)));
    });
}

fn write(folder: &Path, name: &str, bytes: &[u8]) {
    std::fs::write(folder.join(name), bytes).expect("the disk takes a file");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seeds_are_sound() {
        for number in 0..RUNS.len() {
            for seed in seeds(number) {
                assert_eq!(probed(number, &seed).map_err(|e| e.to_string()), Ok(()));
            }
        }
        lpips(&lpips_headers()[0], |file| assert_eq!(check_lpips(file).map_err(|e| e.to_string()), Ok(())));
        // Both files are read: sound ones are, and each is missed where it is damaged.
        let compared = |file: &str, bytes: &[u8]| {
            truth(file, bytes);
            CAPTURE.with(|made| {
                let (_, capture, scene) = made.get().unwrap();
                points::point_errors(scene, capture).is_ok()
            })
        };
        assert!(compared(tracks::FILE, &true_tracks()[0]));
        assert!(!compared(tracks::FILE, b"no array") && !compared(points::VISIBLE, b"no array"));
    }
}
