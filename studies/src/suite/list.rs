//! The captures of the suite: a declared list (`studies/suite.toml`, or a file of the user's), found, rendered or
//! copied before they are trained on.

use crate::made;
use serde::Deserialize;
use splat4d::{Error, Result};
use splat4d_train::capture::HoldOut;
use splat4d_workflow::files;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// The list that is measured by default.
const DEFAULT: &str = include_str!("../../suite.toml");
/// The folder that `bundled` paths begin in.
const REPOSITORY: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/..");

/// How thoroughly the suite measures.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum Tier {
    /// Small images and few steps: all captures in some ten minutes
    Quick,
    /// For the record: larger images, more steps, and the playback files
    Full,
}

/// One number a tier.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct ByTier {
    quick: usize,
    full: usize,
}

impl ByTier {
    pub(crate) fn at(self, tier: Tier) -> usize {
        match tier {
            Tier::Quick => self.quick,
            Tier::Full => self.full,
        }
    }
}

/// Settings of a tier.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct TierSettings {
    steps: usize,
}

/// An entry of the list.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Entry {
    pub name: String,
    /// A folder in one of the user's.
    data: Option<PathBuf>,
    /// A folder of the repository.
    bundled: Option<PathBuf>,
    /// The name of a synthetic capture.
    made: Option<String>,
    /// Whether its initial cloud is used.
    #[serde(default = "yes")]
    points: bool,
    /// Held-out views; none: the capture's own.
    pub hold_out: Option<String>,
    /// Factor by which images are reduced.
    #[serde(default = "whole")]
    pub downscale: ByTier,
    /// Further settings of the recipe that the capture needs.
    #[serde(default)]
    pub set: Vec<String>,
}

fn yes() -> bool {
    true
}

fn whole() -> ByTier {
    ByTier { quick: 1, full: 1 }
}

/// The list.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct List {
    quick: TierSettings,
    full: TierSettings,
    #[serde(rename = "capture")]
    pub captures: Vec<Entry>,
}

impl List {
    /// Reads the list of a file, or the one that belongs to the program.
    pub(crate) fn open(file: Option<&Path>) -> Result<Self> {
        let Some(path) = file else {
            return Ok(Self::parse(DEFAULT).expect("the suite's own list is valid, as its test checks"));
        };
        Self::parse(&files::read_text(path)?).map_err(|e| e.at(path.display()))
    }

    fn parse(text: &str) -> Result<Self> {
        let list: Self = toml::from_str(text).map_err(|e| {
            Error::input(format!("it is no list of captures: {}", e.to_string().trim_end()))
                .remedy("studies/suite.toml shows how one is written.")
        })?;
        let mut names = BTreeSet::new();
        for entry in &list.captures {
            entry.check().map_err(|e| e.at(format!("capture {}", entry.name)))?;
            if !names.insert(entry.name.as_str()) {
                return Err(Error::input(format!("two captures are called `{}`", entry.name)).remedy("Rename one."));
            }
        }
        for (tier, settings) in [("quick", list.quick), ("full", list.full)] {
            if settings.steps == 0 {
                return Err(Error::input(format!("[{tier}] trains for no steps")).remedy("Give at least 1."));
            }
        }
        Ok(list)
    }

    pub(crate) fn steps(&self, tier: Tier) -> usize {
        match tier {
            Tier::Quick => self.quick.steps,
            Tier::Full => self.full.steps,
        }
    }

    /// The entries that are requested, in the list's order. Errors: a name that is not in it.
    pub(crate) fn only(&self, names: &[String]) -> Result<Vec<&Entry>> {
        if let Some(unknown) = names.iter().find(|n| !self.captures.iter().any(|e| e.name == **n)) {
            let all: Vec<&str> = self.captures.iter().map(|e| e.name.as_str()).collect();
            return Err(Error::input(format!("the list has no capture `{unknown}`"))
                .at("--only")
                .remedy(format!("Use some of: {}", all.join(", "))));
        }
        Ok(self.captures.iter().filter(|e| names.is_empty() || names.contains(&e.name)).collect())
    }
}

impl Entry {
    fn check(&self) -> Result<()> {
        let sources = [self.data.is_some(), self.bundled.is_some(), self.made.is_some()];
        if sources.iter().filter(|s| **s).count() != 1 {
            return Err(Error::input("expected exactly one location")
                .remedy("Give one of data (a folder in those of --data), bundled and made."));
        }
        if let Some(name) = self.made.as_ref().filter(|n| !made::NAMES.iter().any(|m| m.0 == n.as_str())) {
            return Err(made::unknown(name));
        }
        let plain = |c: char| c.is_ascii_alphanumeric() || "-_".contains(c);
        if self.name.is_empty() || !self.name.chars().all(plain) {
            return Err(Error::input("its name becomes the name of a folder")
                .remedy("Use letters, digits, hyphens and underscores."));
        }
        if self.downscale.quick == 0 || self.downscale.full == 0 {
            return Err(Error::input("images cannot be reduced by 0").remedy("Give 1 for full size."));
        }
        self.hold_out.as_deref().map(str::parse::<HoldOut>).transpose()?;
        Ok(())
    }

    /// Whether a copy without its initial cloud is measured.
    pub(crate) fn is_bare(&self) -> bool {
        !self.points
    }

    /// The capture's folder: found in `data`, or rendered or copied below `work`. `None`: it is nowhere.
    pub(crate) fn folder(&self, data: &[PathBuf], work: &Path) -> anyhow::Result<Option<PathBuf>> {
        let origin = if let Some(folder) = &self.data {
            data.iter().map(|d| d.join(folder)).find(|p| p.is_dir())
        } else if let Some(folder) = &self.bundled {
            Some(Path::new(REPOSITORY).join(folder)).filter(|p| p.is_dir())
        } else {
            let name = self.made.as_deref().expect("one source is given, as checked");
            let folder = work.join(format!("{name}-{}", made::VERSION));
            if !folder.join("capture.json").is_file() {
                made::write(name, &folder)?;
            }
            Some(folder)
        };
        match origin {
            Some(origin) if self.is_bare() => {
                let copy = work.join(format!("bare-{}-{}", self.name, made::VERSION));
                if !copy.is_dir() {
                    // Under another name until all of it is there.
                    let part = work.join(format!("{}.part", self.name));
                    let _ = std::fs::remove_dir_all(&part);
                    copy_without_points(&origin, &part)?;
                    std::fs::rename(&part, &copy).map_err(|e| files::cannot_write(&copy, e))?;
                }
                Ok(Some(copy))
            }
            found => Ok(found),
        }
    }
}

/// Copies a capture (by links to the same files where the disk allows it), but for its cloud: `.ply` files, and what
/// `capture.json` states of them.
fn copy_without_points(from: &Path, to: &Path) -> Result<()> {
    files::make_folder(to)?;
    let mut entries: Vec<PathBuf> = std::fs::read_dir(from)
        .and_then(|d| d.map(|e| e.map(|e| e.path())).collect())
        .map_err(|e| files::cannot_read(from, e))?;
    entries.sort();
    for entry in entries {
        let name = entry.file_name().expect("an entry of a folder has a name");
        let target = to.join(name);
        if entry.is_dir() {
            copy_without_points(&entry, &target)?;
        } else if name == "capture.json" {
            let bad = |e: serde_json::Error| Error::input(format!("it is not JSON: {e}")).at(entry.display());
            let mut value: serde_json::Value = serde_json::from_str(&files::read_text(&entry)?).map_err(bad)?;
            if let Some(map) = value.as_object_mut() {
                map.remove("points");
            }
            files::write(&target, value.to_string().as_bytes())?;
        } else if entry.extension().is_none_or(|e| e != "ply") {
            let linked = std::fs::hard_link(&entry, &target).or_else(|_| std::fs::copy(&entry, &target).map(|_| ()));
            linked.map_err(|e| files::cannot_write(&target, e))?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_suite_s_own_list_is_sound() {
        let list = List::parse(DEFAULT).unwrap();
        assert!(list.captures.len() > 20 && list.steps(Tier::Quick) < list.steps(Tier::Full));
        for (name, _) in made::NAMES {
            assert!(list.captures.iter().any(|e| e.made.as_deref() == Some(name)), "{name} is not measured");
        }
        assert_eq!(list.only(&["mage".into(), "knight".into()]).unwrap().len(), 2);
        let unknown = list.only(&["knigth".into()]).unwrap_err().to_string();
        assert!(unknown.contains("knigth") && unknown.contains("knight-no-points"), "{unknown}");
    }

    #[test]
    fn a_list_that_cannot_be_measured_is_explained() {
        let head = "[quick]\nsteps = 1\n[full]\nsteps = 2\n[[capture]]\n";
        let parse = |entry: &str| List::parse(&format!("{head}{entry}"));
        assert!(parse("name = \"a\"\ndata = \"a\"").is_ok());
        for (entry, expected) in [
            ("name = \"a\"", "exactly one location"),
            ("name = \"a\"\ndata = \"a\"\nmade = \"enters\"", "exactly one location"),
            ("name = \"a\"\nmade = \"leaves\"", "enters"),
            ("name = \"a\"\ndata = \"a\"\nhold_out = \"every=1\"", "every=N"),
            ("name = \"a\"\ndata = \"a\"\ndownscale = { quick = 0, full = 1 }", "reduced by 0"),
            ("name = \"a\"\ndata = \"a\"\ndownscale = 2", "downscale"),
            ("name = \"../a\"\ndata = \"a\"", "hyphens"),
            ("name = \"a\"\ndata = \"a\"\n[[capture]]\nname = \"a\"\ndata = \"b\"", "two captures"),
            ("name = \"a\"\ndata = \"a\"\nsteps = 5", "steps"),
        ] {
            let message = parse(entry).unwrap_err().to_string();
            assert!(message.contains(expected), "{entry}: {message}");
        }
        let none = List::parse("[quick]\nsteps = 0\n[full]\nsteps = 2\n[[capture]]\nname = \"a\"\ndata = \"a\"");
        assert!(none.unwrap_err().to_string().contains("no steps"));
    }

    #[test]
    fn a_copy_has_everything_but_its_points() {
        let home = tempfile::tempdir().unwrap();
        let take = home.path().join("take");
        std::fs::create_dir_all(take.join("images")).unwrap();
        std::fs::write(take.join("images/0.png"), "picture").unwrap();
        std::fs::write(take.join("points.ply"), "ply").unwrap();
        std::fs::write(take.join("capture.json"), "{\"version\": 1, \"points\": \"points.ply\"}").unwrap();
        let list = List::parse(
            "[quick]\nsteps = 1\n[full]\nsteps = 2\n[[capture]]\nname = \"a\"\ndata = \"take\"\npoints = false\n\
             [[capture]]\nname = \"b\"\ndata = \"elsewhere\"",
        )
        .unwrap();
        let work = home.path().join("work");
        let data = [home.path().join("empty"), home.path().to_owned()];
        let copy = list.captures[0].folder(&data, &work).unwrap().unwrap();
        assert_eq!(std::fs::read_to_string(copy.join("images/0.png")).unwrap(), "picture");
        assert!(!copy.join("points.ply").exists());
        assert_eq!(std::fs::read_to_string(copy.join("capture.json")).unwrap(), "{\"version\":1}");
        assert!(take.join("points.ply").exists(), "the take itself stays as it is");
        assert_eq!(list.captures[0].folder(&data, &work).unwrap(), Some(copy), "it is made once");
        assert_eq!(list.captures[1].folder(&data, &work).unwrap(), None);
    }
}
