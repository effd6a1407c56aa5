//! The verbs that write, each on something tiny.

use super::process::Program;
use super::sample;
use crate::files::tree;
use anyhow::{Result, ensure};
use std::collections::BTreeMap;
use std::ffi::OsString;
use std::path::{Path, PathBuf};

/// Options of a run that takes a second.
const TINY: &str =
    "--set=iterations=24 --set=num_pts=120 --set=max_cap=150 --set=sh_degree=1 --set=checkpoint_interval=6 --seed=3";
/// Frames of the capture, and of the long one, which is learnt in chunks.
const FRAMES: usize = 4;
const LONG: usize = 20;

/// A verb, its options, and what it needs.
pub(super) struct Verb {
    pub(super) name: &'static str,
    /// Whether the user keeps a file of their own in its folder.
    pub(super) users_file: bool,
    pub(super) prepare: fn(&Setup, &Path) -> Result<()>,
    pub(super) words: fn(&Setup, &Path) -> Vec<OsString>,
}

/// Shared inputs of all trials.
pub(super) struct Setup {
    pub(super) program: Program,
    capture: PathBuf,
    long: PathBuf,
    run: PathBuf,
    observed: PathBuf,
    older: PathBuf,
}

impl Setup {
    pub(super) fn new(program: Program, work: &Path) -> Result<Self> {
        let at = |name: &str| work.join("given").join(name);
        let setup = Self {
            program,
            capture: at("capture"),
            long: at("long"),
            run: at("run"),
            observed: at("observed"),
            older: at("older"),
        };
        sample::write(&setup.capture, FRAMES)?;
        sample::write(&setup.long, LONG)?;
        let train = |capture: &Path, run: &Path, more: &str| -> Result<()> {
            let words = words(&format!("train {{}} -o {{}} --no-eval {TINY} {more}"), &[capture, run]);
            let ended = setup.program.run(&words, work, None)?;
            ensure!(ended.code == Some(0), "a run to begin with: {}", ended.said);
            Ok(())
        };
        train(&setup.capture, &setup.run, "")?;
        train(&setup.capture, &setup.older, "--set=iterations=12 --set=checkpoint_interval=3")?;
        train(
            &setup.long,
            &setup.observed,
            "--observe=0.8 --motion=spacetime --set=life=infinite --set=velocity_lr_init=0.1",
        )?;
        Ok(setup)
    }

    /// Everything that verbs read: it must never change.
    pub(super) fn inputs(&self) -> Result<BTreeMap<PathBuf, Vec<u8>>> {
        let mut all = BTreeMap::new();
        for folder in [&self.capture, &self.long, &self.run, &self.observed] {
            all.extend(tree(folder)?.into_iter().map(|(path, bytes)| (folder.join(path), bytes)));
        }
        Ok(all)
    }
}

/// Words of a text; `{}` are replaced by these paths in order.
fn words(text: &str, paths: &[&Path]) -> Vec<OsString> {
    let mut paths = paths.iter();
    let word = |w: &str| match w {
        "{}" => paths.next().expect("a path for every place").as_os_str().to_owned(),
        w => OsString::from(w),
    };
    text.split_whitespace().map(word).collect()
}

fn nothing(_: &Setup, _: &Path) -> Result<()> {
    Ok(())
}

fn copied(from: &Path, to: &Path) -> Result<()> {
    for (path, bytes) in tree(from)? {
        let target = to.join(path);
        std::fs::create_dir_all(target.parent().expect("it lies below"))?;
        std::fs::write(target, bytes)?;
    }
    Ok(())
}

pub(super) const VERBS: [Verb; 14] = [
    Verb {
        name: "train",
        users_file: false,
        prepare: nothing,
        words: |s, at| words(&format!("train {{}} -o {{}} {TINY}"), &[&s.capture, &at.join("out")]),
    },
    Verb {
        name: "train --force",
        users_file: true,
        prepare: |s, at| copied(&s.older, &at.join("out")),
        words: |s, at| words(&format!("train {{}} -o {{}} --force --no-eval {TINY}"), &[&s.capture, &at.join("out")]),
    },
    Verb {
        name: "train in chunks",
        users_file: false,
        prepare: nothing,
        words: |s, at| {
            let text = format!("train {{}} -o {{}} --no-eval --chunk-frames 10 --overlap 4 --motion spacetime {TINY}");
            words(&text, &[&s.long, &at.join("out")])
        },
    },
    Verb {
        name: "compress",
        users_file: false,
        prepare: nothing,
        words: |s, at| words("compress {} -o {} --no-eval --level 1 --fine-tune 12", &[&s.run, &at.join("out")]),
    },
    Verb {
        name: "eval",
        users_file: true,
        prepare: |s, at| copied(&s.run, &at.join("out")),
        words: |_, at| words("eval {} --no-film", &[&at.join("out")]),
    },
    Verb {
        name: "label",
        users_file: true,
        prepare: |s, at| copied(&s.run, &at.join("out")),
        words: |_, at| words("label {} --rounds 2", &[&at.join("out")]),
    },
    Verb {
        name: "predict",
        users_file: true,
        prepare: |s, at| copied(&s.observed, &at.join("out")),
        words: |_, at| words("predict {} --model velocity --nodes 4 --no-film", &[&at.join("out")]),
    },
    Verb {
        name: "export",
        users_file: true,
        prepare: nothing,
        words: |s, at| words("export {} --sequence {} --fps 200", &[&s.run, &at.join("out")]),
    },
    Verb {
        name: "export --force",
        users_file: true,
        prepare: |s, at| {
            let longer = words("export {} --sequence {} --fps 300", &[&s.run, &at.join("out")]);
            s.program.run(&longer, at, None).map(|_| ())
        },
        words: |s, at| words("export {} --sequence {} --fps 200 --force", &[&s.run, &at.join("out")]),
    },
    Verb {
        name: "convert",
        users_file: true,
        prepare: nothing,
        words: |s, at| words("convert {} {} --frames --fps 200", &[&s.run, &at.join("out/f_%04d.spz")]),
    },
    Verb {
        name: "render",
        users_file: true,
        prepare: nothing,
        words: |s, at| {
            words("render {} --path test --device cpu -o {} --raw {}", &[&s.run, &at.join("out"), &at.join("out")])
        },
    },
    Verb {
        name: "edit",
        users_file: false,
        prepare: nothing,
        words: |s, at| words("edit {} --delete box(-9,-9,-9,0,9,9) -o {}", &[&s.run, &at.join("out.safetensors")]),
    },
    Verb {
        name: "bake",
        users_file: false,
        prepare: nothing,
        words: |s, at| words("bake {} -o {}", &[&s.run, &at.join("out.splat4d")]),
    },
    Verb {
        name: "import",
        users_file: true,
        prepare: nothing,
        words: |s, at| {
            let text = "import {} -o {} --calibration {} --synchronous --no-audio --no-doctor";
            words(text, &[&s.long.join("images"), &at.join("out"), &s.long.join("capture.json")])
        },
    },
];
