//! Poses of fixed cameras by the COLMAP program, where it is installed: one image per camera, of the static background.

use super::stored::Stored;
use crate::calibration::{self, Calibration};
use crate::{Error, ErrorKind, Result};
use splat4d_train::encode::{self, Pixels};
use splat4d_train::event::Progress;
use splat4d_train::run::checkpoint::write_atomically;
use std::fs::File;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

const PROGRAM: &str = "colmap";
/// How to install what is missing.
const INSTALL: &str = "Install it (apt install colmap, brew install colmap, or from colmap.github.io), or leave --colmap out: \
                       poses are found without it.";
/// Interval between checks whether the program is done.
const POLL: Duration = Duration::from_millis(100);
/// Characters of the program's last words that are repeated.
const LAST_WORDS: usize = 400;

/// A step of the program, and its arguments; options of several names have a help text decide.
struct Step {
    name: &'static str,
    /// The text that begins an option in old and in new versions; 3.13 took names of the matcher for those of its kind.
    renamed: [(&'static str, &'static str); 2],
    options: &'static [(&'static str, &'static str)],
}

/// Options that worked best on the bundled capture and a hall (methods of wide baselines: affine shapes, domain sizes).
const STEPS: [Step; 3] = [
    Step {
        name: "feature_extractor",
        renamed: [("--SiftExtraction.use_gpu", "--FeatureExtraction.use_gpu"), ("", "")],
        options: &[
            ("--ImageReader.camera_model", "OPENCV"),
            ("--ImageReader.single_camera_per_image", "1"),
            ("--SiftExtraction.use_gpu", "0"),
            ("--SiftExtraction.estimate_affine_shape", "1"),
            ("--SiftExtraction.domain_size_pooling", "1"),
            ("--SiftExtraction.max_num_features", "16384"),
        ],
    },
    Step {
        name: "exhaustive_matcher",
        renamed: [
            ("--SiftMatching.use_gpu", "--FeatureMatching.use_gpu"),
            ("--SiftMatching.guided_matching", "--FeatureMatching.guided_matching"),
        ],
        options: &[("--SiftMatching.use_gpu", "0"), ("--SiftMatching.guided_matching", "1")],
    },
    Step {
        name: "mapper",
        renamed: [("", ""), ("", "")],
        options: &[
            ("--Mapper.ba_refine_principal_point", "0"),
            ("--Mapper.init_min_tri_angle", "4"),
            ("--Mapper.min_num_matches", "10"),
        ],
    },
];

/// Lenses and positions of all cameras. The work is in `import/colmap` of the capture's folder, and is not done again
/// where images and masks are the same.
///
/// Errors: no program; it fails; cameras that it could not place; of kind `Interrupted` if `stop` requests it.
pub(super) fn calibrate(
    stored: &Stored<'_>,
    progress: &mut Progress<'_>,
    stop: &dyn Fn() -> bool,
) -> Result<Calibration> {
    let work = stored.folder.join("import/colmap");
    let (note, made_of) = (work.join("made_of.txt"), stored.fingerprint());
    if splat4d_train::files::read_text(&note).ok().as_deref() != Some(&made_of) {
        let helps = helps()?;
        prepare(stored, &work, progress)?;
        for (k, (step, help)) in STEPS.iter().zip(&helps).enumerate() {
            progress.phase("COLMAP", k, STEPS.len());
            run(step, help, &work, !stored.masks.is_empty(), stop)?;
        }
        write_atomically(&note, made_of.as_bytes())?;
    }
    let found = calibration::read(&work.join("sparse")).map_err(|e| {
        e.at("COLMAP")
            .remedy("It found no two images of one scene: leave --colmap out, or place cameras closer together.")
    })?;
    let lost: Vec<&str> = (stored.pictures.iter().map(|p| p.name.as_str()))
        .filter(|name| !found.cameras.iter().any(|c| c.names[0] == *name))
        .collect();
    if !lost.is_empty() {
        return Err(Error::input(format!("COLMAP could not place these cameras: {}", lost.join(", ")))
            .remedy("Leave them out (use = false in import.toml), or leave --colmap out."));
    }
    Ok(found)
}

/// Options that each step supports. Errors: the program is not there.
fn helps() -> Result<Vec<String>> {
    let help = |step: &Step| {
        let out = Command::new(PROGRAM).args([step.name, "--help"]).stdin(Stdio::null()).output();
        let out = out.map_err(|e| Error::environment("the program colmap cannot be started", e).remedy(INSTALL))?;
        Ok(String::from_utf8_lossy(&[out.stdout, out.stderr].concat()).into_owned())
    };
    STEPS.iter().map(help).collect()
}

/// Writes what the program works on: of each camera its median, where people vanish, and its mask.
fn prepare(stored: &Stored<'_>, work: &Path, progress: &mut Progress<'_>) -> Result<()> {
    let fail = |e| Error::environment("the folder cannot be created again", e).at(work.display());
    if work.exists() {
        std::fs::remove_dir_all(work).map_err(fail)?;
    }
    std::fs::create_dir_all(work.join("sparse")).map_err(fail)?;
    for (c, p) in stored.pictures.iter().enumerate() {
        progress.phase("images for COLMAP", c, stored.pictures.len());
        let still = stored.median(c, |picture| picture)?;
        let bytes = encode::png(Pixels::Eight(&still.data), [still.width, still.height], 3);
        write_atomically(&work.join("images").join(format!("{}.png", p.name)), &bytes)?;
        if let Some(masks) = stored.masks.get(c) {
            let from = stored.folder.join(&masks.files[p.shots.len() / 2]);
            let mask = splat4d_train::files::read(&from)?;
            write_atomically(&work.join("masks").join(format!("{}.png.png", p.name)), &mask)?;
        }
    }
    Ok(())
}

fn run(step: &Step, help: &str, work: &Path, masks: bool, stop: &dyn Fn() -> bool) -> Result<()> {
    let log = work.join(format!("{}.txt", step.name));
    let file = File::create(&log).map_err(|e| Error::environment("the log cannot be written", e).at(log.display()))?;
    let copy = file.try_clone().map_err(|e| Error::environment("the log cannot be written", e).at(log.display()))?;
    let mut command = Command::new(PROGRAM);
    command.arg(step.name).arg("--database_path").arg(work.join("database.db"));
    if step.name != "exhaustive_matcher" {
        command.arg("--image_path").arg(work.join("images"));
    }
    if step.name == "mapper" {
        command.arg("--output_path").arg(work.join("sparse"));
    }
    if step.name == "feature_extractor" && masks {
        command.arg("--ImageReader.mask_path").arg(work.join("masks"));
    }
    for (option, value) in step.options {
        let new = step.renamed.iter().find(|(old, new)| old == option && help.contains(new)).map(|r| r.1);
        command.args([new.unwrap_or(option), value]);
    }
    let mut child = command
        .stdin(Stdio::null())
        .stdout(file)
        .stderr(copy)
        .spawn()
        .map_err(|e| Error::environment("the program colmap cannot be started", e).remedy(INSTALL))?;
    let status = loop {
        if let Some(status) = child.try_wait().map_err(|e| Error::environment("the program colmap was lost", e))? {
            break status;
        }
        if stop() {
            drop(child.kill());
            drop(child.wait());
            return Err(Error::new(ErrorKind::Interrupted, "stopped while COLMAP was at work")
                .remedy("Run the same command again to continue."));
        }
        std::thread::sleep(POLL);
    };
    if status.success() { Ok(()) } else { Err(failed(step, &log, status)) }
}

fn failed(step: &Step, log: &Path, status: std::process::ExitStatus) -> Error {
    let words = std::fs::read(log).map(|b| String::from_utf8_lossy(&b).into_owned()).unwrap_or_default();
    let words = words.trim();
    let from = words.char_indices().rev().nth(LAST_WORDS).map_or(0, |(k, _)| k);
    Error::input(format!("colmap {} ended with {status}: {}", step.name, words[from..].trim()))
        .at(log.display())
        .remedy("Leave --colmap out: poses are found without it.")
}
