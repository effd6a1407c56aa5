//! The present results of a study. It is written after every cell, so that nothing is measured twice.

use crate::cells::Cell;
use serde::{Deserialize, Serialize};
use splat4d::{Error, Result};
use splat4d_workflow::files;
use splat4d_workflow::measure::Side;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// The form of the file; another is refused.
const VERSION: u32 = 1;

/// All runs of a study.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Study {
    version: u32,
    pub runs: Vec<Findings>,
}

/// Results of the study on one run.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Findings {
    pub run: PathBuf,
    /// For people, and in the names of images.
    pub name: String,
    /// Of the scene file, hexadecimal: cells of another scene do not count.
    pub scene: String,
    pub cells: Vec<FolderContent>,
}

/// One measured cell.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct FolderContent {
    pub key: String,
    pub words: String,
    pub side: Side,
    /// Frames a second end to end, over those of the source measured alternately with it.
    pub speed: f64,
    /// The same of the blend stage alone.
    pub raster_speed: f64,
    /// Time that making and measuring it took, seconds.
    pub seconds: f64,
}

impl Study {
    pub(crate) fn of(runs: Vec<Findings>) -> Self {
        Self { version: VERSION, runs }
    }

    /// Reads the file; an empty study where there is none yet.
    ///
    /// Errors: a file that is none of ours, or of another version.
    pub(crate) fn open(path: &Path) -> Result<Self> {
        if !path.is_file() {
            return Ok(Self::of(Vec::new()));
        }
        let remedy = "Move it away, or choose another folder with -o.";
        let study: Self = serde_json::from_str(&files::read_text(path)?).map_err(|e| {
            Error::input(format!("it is no study as splat4d writes it: {e}")).at(path.display()).remedy(remedy)
        })?;
        if study.version != VERSION {
            let what = format!("it is a study of version {}, not {VERSION}", study.version);
            return Err(Error::input(what).at(path.display()).remedy(remedy));
        }
        Ok(study)
    }

    pub(crate) fn save(&self, path: &Path) -> Result<()> {
        let text = serde_json::to_string_pretty(self).expect("a study is plain data");
        files::write(path, text.as_bytes())
    }

    /// The findings on a run; those on an earlier state of it are forgotten.
    pub(crate) fn on(&mut self, run: &Path, name: &str, scene: &str) -> &mut Findings {
        self.runs.retain(|f| f.run != run || f.scene == scene);
        if let Some(i) = self.runs.iter().position(|f| f.run == run) {
            return &mut self.runs[i];
        }
        let fresh = Findings { run: run.into(), name: name.into(), scene: scene.into(), cells: Vec::new() };
        self.runs.push(fresh);
        self.runs.last_mut().expect("one was pushed")
    }
}

impl Findings {
    pub(crate) fn of(&self, cell: &Cell) -> Option<&FolderContent> {
        let key = cell.key();
        self.cells.iter().find(|f| f.key == key)
    }
}

/// A cell that someone made and measured.
pub(crate) struct Judged {
    pub side: Side,
    pub speed: f64,
    pub raster_speed: f64,
}

/// Makes and measures every cell that is missing. `make`: None where it was stopped. `keep` is called with every new
/// cell, with the present results. Returns whether all are complete.
pub(crate) fn fill(
    findings: &mut Findings,
    cells: &[Cell],
    make: &mut dyn FnMut(&Cell) -> anyhow::Result<Option<Judged>>,
    mut progress: impl FnMut(&Cell, Place),
    mut keep: impl FnMut(&Findings, &FolderContent) -> Result<()>,
) -> anyhow::Result<bool> {
    let missing: Vec<&Cell> = cells.iter().filter(|c| findings.of(c).is_none()).collect();
    let (started, mut spent) = (Instant::now(), 0.0);
    for (i, cell) in missing.iter().enumerate() {
        let ahead: f64 = missing[i..].iter().map(|c| c.cost()).sum();
        let left = (spent > 0.0).then(|| started.elapsed().as_secs_f64() * ahead / spent);
        progress(cell, Place { number: cells.len() - missing.len() + i + 1, of: cells.len(), left });
        let clock = Instant::now();
        let Some(Judged { side, speed, raster_speed }) = make(cell)? else { return Ok(false) };
        spent += cell.cost();
        let seconds = clock.elapsed().as_secs_f64();
        findings.cells.push(FolderContent { key: cell.key(), words: cell.words(), side, speed, raster_speed, seconds });
        keep(findings, findings.cells.last().expect("one was pushed"))?;
    }
    Ok(true)
}

/// How far a study is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Place {
    pub number: usize,
    pub of: usize,
    /// Seconds, estimated from the finished cells; None before the first.
    pub left: Option<f64>,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cells::Grid;

    fn judged(cell: &Cell) -> Judged {
        Judged { side: Side { psnr: Some(30.0 - cell.prune), ..Side::default() }, speed: 1.0, raster_speed: 1.0 }
    }

    #[test]
    fn a_stopped_study_continues() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("e03.json");
        let cells = Grid::quick(5).cells();
        let mut study = Study::open(&file).unwrap();
        let mut made = 0;
        let (mut places, mut copy) = (Vec::new(), study.clone());
        let done = fill(
            study.on(Path::new("run"), "knight", "aa"),
            &cells,
            &mut |cell| {
                made += 1;
                Ok((made <= 3).then(|| judged(cell)))
            },
            |_, place| places.push(place),
            |findings, found| {
                assert_eq!(findings.cells.last(), Some(found));
                copy.runs = vec![findings.clone()];
                copy.save(&file)
            },
        );
        assert!(!done.unwrap() && made == 4);
        assert_eq!(places[0], Place { number: 1, of: cells.len(), left: None });
        assert!(places[1].left.is_some_and(|s| s >= 0.0));

        let mut again = Study::open(&file).unwrap();
        assert_eq!(again.runs, study.runs);
        let mut keys = Vec::new();
        let mut make = |cell: &Cell| {
            keys.push(cell.key());
            Ok(Some(judged(cell)))
        };
        assert!(fill(again.on(Path::new("run"), "knight", "aa"), &cells, &mut make, |_, _| (), |_, _| Ok(())).unwrap());
        assert_eq!(keys, cells[3..].iter().map(Cell::key).collect::<Vec<_>>(), "what is there is not made again");
        assert!(cells.iter().all(|c| again.runs[0].of(c).is_some()));
        assert!(again.on(Path::new("run"), "knight", "bb").cells.is_empty(), "another scene begins anew");
        assert_eq!(again.runs.len(), 1);
    }

    #[test]
    fn foreign_files_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("e03.json");
        for text in ["", "[]", "{\"runs\": []}", "{\"version\": 9, \"runs\": []}"] {
            std::fs::write(&file, text).unwrap();
            let message = Study::open(&file).unwrap_err().to_string();
            assert!(message.contains("e03.json") && message.contains("-o"), "{message}");
        }
    }
}
