//! The same run makes the same bits as ever: short runs of every motion model, their checkpoints, what compression makes of
//! them and their playback files against a table of hashes, a line for each named tensor.
//!
//! A change of behaviour on purpose records the table again (`UPDATE_GOLDEN=1 cargo test -p splat4d-train --test
//! same_bits`) and states in its commit why. SIMD levels round differently, so that each has lines of its own: the machine's
//! own level a line a tensor, the levels below it one line a run, of models without networks (whose matrix products choose
//! their instructions themselves). Runs for which a level has no line are passed over. Loss values, clocks and metadata
//! are not part of the table.

use splat4d::bake::{Options, bake};
use splat4d::format::playback::{self, Draft, Meta, WriteConfig};
use splat4d::format::safetensors::SafeTensors;
use splat4d::format::scene;
use splat4d::layers::Scene;
use splat4d::simd::Simd;
use splat4d_train::compress::{Compression, Job, Level, compress};
use splat4d_train::recipe::Recipe;
use splat4d_train::run::open_capture;
use splat4d_train::run::{TrainOptions, train};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

const TABLE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/same_bits.txt");
/// Images are this wide and high: two bins of the renderer, the last one not full.
const SIZE: u32 = 40;
const CAMERAS: usize = 4;
const FRAMES: usize = 5;
/// Settings of every run: short, and with all that edits rows well within it.
const COMMON: &str = "iterations=36 num_pts=96 max_cap=150 init=random densification_interval=6 densify_from_iter=6 \
    densify_until_iter=30 densify_grad_threshold=1e-5 checkpoint_interval=1000";

/// Runs by name: what they set next to [`COMMON`].
const RUNS: [(&str, &str); 26] = [
    ("still", "motion=still sh_degree=2 sh_degree_interval=7 opacity_reset_interval=8"),
    ("still-mcmc", "motion=still strategy=mcmc batch_size=2 antialias=true"),
    ("spacetime", "motion=spacetime motion_order=3 rotation_rate=true lambda_velocity=0.1 lambda_opacity_life=0.01"),
    ("spacetime-mcmc", "motion=spacetime strategy=mcmc life=interval exposure_lr=0.01"),
    ("spacetime-features", "motion=spacetime features=full head_lr=0.01 life=gauss-one detach=true"),
    (
        "spacetime-upkeep",
        "motion=spacetime retime_clones=true guided_from=0.3 guided_times=2 guided_share=0.1 relocate_interval=5 \
         relocate_from_iter=7 relocate_share=0.1 prune_interval=11 prune_ratio=0.1 crowding=merge crowding_interval=9 \
         crowding_distance=2 min_opacity=0.05",
    ),
    ("two-layers", "motion=spacetime static_split=0.2 static_split_from=0.5 batch_size=2"),
    (
        "picture-terms",
        "motion=spacetime lambda_mask=0.1 lambda_tv=0.01 lambda_depth_tv=0.01 lambda_depth_normal=0.05 \
         lambda_frequency=0.01 lambda_mask_entropy=0.01 lambda_opacity_entropy=0.01 lambda_flow=0.1",
    ),
    (
        "motion-terms",
        "motion=deform-mlp deform_trunk=small deform_width=16 lambda_rigid=0.1 lambda_rot=0.1 lambda_iso=0.1 \
         lambda_arap=0.1 lambda_elastic=0.1 lambda_jerk=0.1 lambda_velocity=0.1",
    ),
    ("deform-hash", "motion=deform-mlp deform_trunk=hash deform_width=16 deform_time_noise=0.1"),
    ("deform-mlp", "motion=deform-mlp deform_trunk=mlp deform_time_net=true deform_rigid=true"),
    (
        "hexplane",
        "motion=hexplane plane_channels=16 plane_resolution=8 net_width=16 coarse_iterations=6 unlock_interval=10 \
         plane_variation_weight=1e-4 half_size_until=0.3",
    ),
    (
        "hexplane-all-heads",
        "motion=hexplane plane_channels=16 plane_resolution=8 no_do=false no_dshs=false sh_degree=2",
    ),
    ("tracked", "motion=tracked track_feature_lr=0.002 exposure_lr=0.01 floor_height=0.1 seg=3"),
    ("native4d", "motion=native4d sh_harmonics=2 lambda_opacity_life=0.01"),
    ("native4d-mcmc", "motion=native4d strategy=mcmc batch_size=2"),
    (
        "control",
        "motion=control control_nodes=16 control_adapt_interval=8 control_max_nodes=24 control_grad_threshold=1e-6 \
         lambda_node_arap=0.1 lambda_node_elastic=0.1 lambda_node_acceleration=0.1 control_mask=true \
         control_bind_interval=7",
    ),
    (
        "control-low-rank",
        "motion=control control_nodes=16 control_trajectory=low-rank control_bases=4 lambda_sparse=0.01",
    ),
    ("control-network", "motion=control control_nodes=16 control_trajectory=network control_width=16 control_layers=2"),
    ("control-slerp", "motion=control control_nodes=16 control_trajectory=slerp control_keys=3"),
    ("ssm", "motion=ssm control_nodes=16 ssm_ticks=8 ssm_width=8 ssm_states=4 ssm_warm_up=0.2"),
    ("ssm-frames", "motion=ssm control_nodes=16 ssm_ticks=8 ssm_width=8 ssm_equivariance=frames ssm_mode=causal"),
    ("ssm-vector", "motion=ssm control_nodes=16 ssm_ticks=8 ssm_width=8 ssm_equivariance=vector ssm_output=twist"),
    ("filtered-spacetime", "motion=spacetime filter=geodesic filter_keep=true filter_history=2 transport=wasserstein"),
    ("filtered-hexplane", "motion=hexplane plane_channels=16 plane_resolution=8 filter=literal filter_start=0.4"),
    ("filtered-control", "motion=control control_nodes=16 filter=geodesic filter_keep=true transport=linear"),
];

/// The name of a line of all tensors of a run together.
const ALL: &str = "all";

/// Runs that are compressed as well.
const COMPRESSED: [&str; 3] = ["spacetime", "two-layers", "control"];

/// FNV-1a, 64 bits.
fn hash(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, |h, b| (h ^ u64::from(*b)).wrapping_mul(0x0100_0000_01b3))
}

/// Four cameras around a ball that moves and pulses, in whole numbers only: the same images on every machine.
fn write_capture(folder: &Path) {
    for camera in 0..CAMERAS {
        for sub in ["images", "masks", "flow"] {
            std::fs::create_dir_all(folder.join(format!("{sub}/{camera}"))).unwrap();
        }
        for frame in 0..FRAMES {
            let (cx, cy) = (12 + 4 * frame as i64, 16 + 2 * camera as i64);
            let inside = |x: u32, y: u32| {
                let (dx, dy) = (i64::from(x) - cx, i64::from(y) - cy);
                dx * dx + dy * dy < 60 + 15 * frame as i64
            };
            let color = |x: u32, y: u32| match inside(x, y) {
                true => [200, (90 + 25 * frame) as u8, (40 + 3 * x) as u8],
                false => {
                    [(3 * y + 20) as u8, (5 * ((x / 4 + y / 4) % 8) + 60) as u8, (2 * x + 30 * camera as u32) as u8]
                }
            };
            let name = |sub: &str| folder.join(format!("{sub}/{camera}/{frame:02}.png"));
            image::RgbImage::from_fn(SIZE, SIZE, |x, y| image::Rgb(color(x, y))).save(name("images")).unwrap();
            let mask = |x, y| image::Luma([if inside(x, y) { 255 } else { 0 }]);
            image::GrayImage::from_fn(SIZE, SIZE, mask).save(name("masks")).unwrap();
            let flow = |x, y| match inside(x, y) {
                true => image::Rgb([32768 + 4 * 64, 32768, 1]),
                false => image::Rgb([32768, 32768, u16::from((x + y) % 2 == 0)]),
            };
            image::ImageBuffer::<image::Rgb<u16>, Vec<u16>>::from_fn(SIZE, SIZE, flow).save(name("flow")).unwrap();
        }
    }
    // A quarter turn about the vertical axis from camera to camera, three units away.
    let turns = [[1, 0, 0, 1], [0, 1, -1, 0], [-1, 0, 0, -1], [0, -1, 1, 0]];
    let cameras: Vec<serde_json::Value> = (0..CAMERAS)
        .map(|c| {
            let [xx, xz, zx, zz] = turns[c];
            serde_json::json!({
                "name": format!("cam{c}"), "width": SIZE, "height": SIZE, "fx": 44, "fy": 44, "cx": 20, "cy": 20,
                "world_to_camera": [[xx, 0, xz, 0], [0, 1, 0, 0], [zx, 0, zz, 3], [0, 0, 0, 1]],
                "images": format!("images/{c}/%02d.png"), "flow": format!("flow/{c}/%02d.png"),
                "masks": format!("masks/{c}/%02d.png"),
            })
        })
        .collect();
    let text = serde_json::json!({ "version": 1, "fps": 10, "cameras": cameras, "up": [0, -1, 0] }).to_string();
    std::fs::write(folder.join("capture.json"), text).unwrap();
}

fn recipe(changes: &str) -> Recipe {
    let mut recipe = Recipe::default();
    for assignment in COMMON.split_whitespace().chain(changes.split_whitespace()) {
        recipe.set(assignment).unwrap_or_else(|e| panic!("{assignment}: {e}"));
    }
    recipe
}

/// Hashes of the tensors of a scene or checkpoint file, but for what losses remember: that has no name of its own.
fn add_tensors(bytes: &[u8], prefix: &str, lines: &mut BTreeMap<String, u64>) {
    for tensor in SafeTensors::read(bytes).unwrap().tensors().filter(|t| !t.name().starts_with("memory")) {
        let shape = format!("{:?}", tensor.shape());
        lines.insert(format!("{prefix}{}", tensor.name()), hash(&[shape.as_bytes(), tensor.bytes()].concat()));
    }
}

fn newest_checkpoint(run: &Path) -> Vec<u8> {
    let mut all: Vec<_> = std::fs::read_dir(run.join("checkpoints")).unwrap().map(|e| e.unwrap().path()).collect();
    all.sort();
    std::fs::read(all.last().unwrap()).unwrap()
}

/// The scene as a playback file that was written and read back.
fn add_playback(scene: &Scene<f32>, lines: &mut BTreeMap<String, u64>) {
    let baked = bake(scene, &Options::default(), &mut |_, _| {}).unwrap();
    let meta = Meta { clip: baked.clip, fps: scene.fps, up: scene.up, sh_degree: baked.sh_degree, ..Meta::default() };
    let draft = Draft { meta, nodes: baked.nodes, poster: None };
    let (mut file, mut decoded) = (Vec::new(), Vec::new());
    playback::write(&draft, &WriteConfig::default(), &mut file).unwrap();
    scene::write(&playback::read(&file).unwrap(), &mut decoded).unwrap();
    add_tensors(&decoded, "playback/", lines);
}

/// One run: name of a tensor, hash.
fn lines_of(name: &str, changes: &str, capture: &Path, folder: &Path) -> BTreeMap<String, u64> {
    let (recipe, run, go) = (recipe(changes), folder.join(name), AtomicBool::new(false));
    let capture = Arc::new(open_capture(capture, &recipe).unwrap());
    let options = TrainOptions::default();
    train(capture.clone(), recipe.clone(), &run, &options, &go, &mut |_| {}).unwrap_or_else(|e| panic!("{name}: {e}"));
    let mut lines = BTreeMap::new();
    add_tensors(&newest_checkpoint(&run), "", &mut lines);
    let source = scene::read(&std::fs::read(run.join("scene.safetensors")).unwrap()).unwrap();
    if source.without_head("").is_ok() {
        add_playback(&source, &mut lines);
    }
    if COMPRESSED.contains(&name) {
        let settings = Compression::level(Level::Pruned, 30);
        let job = Job { source: &source, capture, recipe: &recipe, settings: &settings, run: None };
        let small = folder.join(format!("{name}-small"));
        compress(&job, &small, &options, &go, &mut |_| {}).unwrap();
        add_tensors(&newest_checkpoint(&small), "compressed/", &mut lines);
        add_tensors(&std::fs::read(small.join("scene.safetensors")).unwrap(), "compressed/shown/", &mut lines);
    }
    lines
}

/// Runs with networks.
fn has_network(changes: &str) -> bool {
    ["deform", "hexplane", "network", "ssm", "features=full"].iter().any(|word| changes.contains(word))
}

#[test]
fn runs_make_the_bits_that_they_always_made() {
    let folder = tempfile::tempdir().unwrap();
    let capture = folder.path().join("capture");
    write_capture(&capture);
    let update = std::env::var_os("UPDATE_GOLDEN").is_some();
    let text = std::fs::read_to_string(TABLE).unwrap_or_default();
    let table: BTreeSet<&str> = text.lines().collect();
    let machine = Simd::detect();
    let mut found: BTreeSet<String> = BTreeSet::new();
    for level in [Simd::Scalar, Simd::Avx2, Simd::Avx512].into_iter().filter(|l| *l <= machine) {
        Simd::limit(level);
        let word = format!("{level:?}").to_lowercase();
        for (name, changes) in RUNS.iter().filter(|r| level == machine || !has_network(r.1)) {
            let begin = format!("{word} {name} ");
            let whole = format!("{begin}{ALL} ");
            let known = |begin: &str| table.range(begin..).next().is_some_and(|l| l.starts_with(begin));
            if !update && !known(&begin) {
                eprintln!("no lines for {begin}in same_bits.txt: passed over");
                continue;
            }
            let lines = lines_of(name, changes, &capture, &folder.path().join(&word));
            if !has_network(changes) {
                let text: String = lines.iter().map(|(tensor, hash)| format!("{tensor} {hash:016x}\n")).collect();
                found.insert(format!("{whole}{:016x}", hash(text.as_bytes())));
            }
            // A level that was recorded as another machine's lesser one has one line a run.
            if update && level == machine
                || table.range(begin.as_str()..).take_while(|l| l.starts_with(&begin)).count() > 1
            {
                found.extend(lines.iter().map(|(tensor, hash)| format!("{begin}{tensor} {hash:016x}")));
            }
        }
    }
    if update {
        let names: BTreeSet<String> =
            found.iter().map(|l| l.split(' ').take(2).collect::<Vec<_>>().join(" ") + " ").collect();
        let others = table.iter().filter(|l| !names.iter().any(|n| l.starts_with(n))).map(|l| (*l).to_owned());
        let all: BTreeSet<String> = others.chain(found.iter().cloned()).collect();
        std::fs::write(TABLE, all.into_iter().collect::<Vec<_>>().join("\n") + "\n").unwrap();
        return;
    }
    let changed: Vec<&String> = found.iter().filter(|l| !table.contains(l.as_str())).collect();
    assert!(!found.is_empty(), "no level of this machine is in same_bits.txt");
    assert!(
        changed.is_empty(),
        "{} of {} lines differ from same_bits.txt, now: {changed:#?}",
        changed.len(),
        found.len()
    );
}
