//! Compares runs and results of other programs, and checks whether their scores are comparable.

use crate::files::grouped;
use crate::playable;
use crate::run_folder::{Metrics, Run, ViewScore, newest, view_scores};
use serde_json::Value;
use splat4d::{Error, Result};
use std::path::{Path, PathBuf};

/// Scores of held-out views that are compared: key, digits, whether more is better. The names of other programs are
/// those of 3DGS' `results.json`, whatever their case.
pub const SCORES: [(&str, usize, bool); 9] = [
    ("PSNR", 2, true),
    ("PSNR-dynamic", 2, true),
    ("PSNR-foreground", 2, true),
    ("SSIM", 4, true),
    ("LPIPS", 4, false),
    ("LPIPS-vgg", 4, false),
    ("LPIPS-alex", 4, false),
    ("LPIPS-squeeze", 4, false),
    ("flicker", 3, false),
];

/// Columns of the table that are words, not numbers.
pub const WORDS: [&str; 2] = ["run", "motion"];

/// One row of the comparison.
#[derive(Clone, Debug, Default)]
pub struct Entry {
    pub name: String,
    /// Scores, in the order of [`SCORES`].
    pub scores: Vec<Option<f64>>,
    pub motion: Option<String>,
    pub steps: Option<usize>,
    pub gaussians: Option<usize>,
    pub seconds: Option<f64>,
    pub bytes: Option<u64>,
    /// Identity of the measurement, where the results contain it: different ones cannot be compared.
    pub capture: Option<String>,
    pub views: Vec<ViewScore>,
    /// Folder of `gt` and `renders`, where it is kept.
    pub pictures: Option<PathBuf>,
    pub metrics: Vec<Metrics>,
}

impl Entry {
    /// A run, a folder with `results.json`, or such a file.
    ///
    /// Errors: nothing of that kind; a file that is not JSON; no score that is known.
    pub fn open(path: &Path) -> Result<Self> {
        if Run::is(path) {
            let run = Run::open(path)?;
            return Self::of_run(&run).ok_or_else(|| {
                if !Run::is_finished(path) {
                    return Run::unfinished(path, "this run is unfinished and was not measured");
                }
                Error::input("this run was not measured yet")
                    .at(path.display())
                    .remedy(format!("Measure it with: splat4d eval {}", splat4d_train::path_text::in_command(path)))
            });
        }
        let file = if path.is_dir() { path.join("results.json") } else { path.to_owned() };
        if !file.is_file() {
            return Err(Error::input("there is neither a run nor a results.json")
                .at(path.display())
                .remedy("Give folders that `splat4d train` wrote, or results.json files of other programs"));
        }
        Self::of_file(&file).map_err(|e| e.at(file.display()))
    }

    fn of_run(run: &Run) -> Option<Self> {
        let results = run.results.as_ref()?;
        // A compression writes the file by itself and records no size of a baked one.
        let file = || run.path.join(playable::FILE).metadata().ok().map(|file| file.len());
        let bytes = run.number("playback_bytes").map(|b| b as u64).or_else(file);
        Some(Self {
            // Runs of one capture differ in their folders.
            name: folder_name(&run.path).unwrap_or_else(|| run.name()),
            scores: scores(results),
            motion: run.recipe_text("run.motion"),
            steps: run.iteration(),
            gaussians: run.number("gaussians").map(|n| n as usize),
            seconds: run.number("seconds"),
            bytes,
            capture: run.info["capture_fingerprint"].as_str().map(str::to_owned),
            views: run.views.clone(),
            pictures: run.pictures(),
            metrics: run.metrics.clone(),
        })
    }

    /// Results of another program: `{"ours_30000": {"PSNR": …}}` as 3DGS writes them, `{"results": {"psnr": …}}` as
    /// nerfstudio, or the scores themselves.
    fn of_file(file: &Path) -> Result<Self> {
        let bytes = crate::files::read(file)?;
        let text = String::from_utf8_lossy(&bytes);
        let all = crate::camera_file::json(&text)?;
        let (steps, entry) = match newest(&all) {
            Some((steps, entry)) => (Some(steps), entry),
            None => (None, all.get("results").unwrap_or(&all)),
        };
        let scores = scores(entry);
        if scores.iter().all(Option::is_none) {
            let known: Vec<&str> = SCORES.iter().map(|s| s.0).collect();
            return Err(Error::input("holds none of the scores that are compared")
                .remedy(format!("Known are {}, in a results.json as 3DGS or nerfstudio write it", known.join(", "))));
        }
        let folder = file.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let name = match file.file_name().is_some_and(|n| n == "results.json") {
            true => folder_name(folder),
            false => file.file_stem().map(|n| n.to_string_lossy().into_owned()),
        };
        let per_view = crate::files::read(&folder.join("per_view.json")).ok();
        let per_view = per_view.and_then(|b| serde_json::from_slice::<Value>(&b).ok());
        let views = per_view.as_ref().and_then(newest).map(|(_, entry)| view_scores(entry)).unwrap_or_default();
        let pictures = steps.map(|n| folder.join("test").join(format!("ours_{n}"))).filter(|f| f.is_dir());
        Ok(Self { name: name.unwrap_or_default(), scores, steps, views, pictures, ..Self::default() })
    }

    /// A score by its place in [`SCORES`].
    pub fn score(&self, i: usize) -> Option<f64> {
        self.scores.get(i).copied().flatten()
    }
}

/// The scores of an entry of `results.json`.
fn scores(entry: &Value) -> Vec<Option<f64>> {
    let of = |key: &str| {
        let found = entry.as_object()?.iter().find(|(k, _)| k.eq_ignore_ascii_case(key))?;
        found.1.as_f64().filter(|x| x.is_finite())
    };
    SCORES.iter().map(|(key, ..)| of(key)).collect()
}

/// The name of a folder, also of `.`.
fn folder_name(folder: &Path) -> Option<String> {
    folder.canonicalize().ok()?.file_name().map(|n| n.to_string_lossy().into_owned())
}

/// Reads all, and gives two of one name a number.
pub fn open(paths: &[PathBuf]) -> Result<Vec<Entry>> {
    let mut entries: Vec<Entry> = Vec::with_capacity(paths.len());
    for path in paths {
        let mut entry = Entry::open(path)?;
        let same = entries.iter().filter(|e| e.name == entry.name || e.name.starts_with(&format!("{} (", entry.name)));
        let same = same.count();
        if same > 0 {
            entry.name = format!("{} ({})", entry.name, same + 1);
        }
        entries.push(entry);
    }
    Ok(entries)
}

/// Reasons for which the rows should not be compared.
pub fn differences(entries: &[Entry]) -> Vec<String> {
    let mut out = Vec::new();
    let Some(first) = entries.first() else { return out };
    for other in &entries[1..] {
        if let (Some(a), Some(b)) = (&first.capture, &other.capture)
            && a != b
        {
            out.push(format!("{} and {} were measured on different captures or sizes", first.name, other.name));
        }
        let (a, b) = (first.views.len(), other.views.len());
        if a != b && a > 0 && b > 0 {
            out.push(format!("{} was measured on {a} held-out views, {} on {b}", first.name, other.name));
        }
    }
    out
}

/// The place of the best row in each column of [`SCORES`] that at least two rows have; none if the rows cannot be
/// compared.
pub fn best(entries: &[Entry]) -> Vec<Option<usize>> {
    if !differences(entries).is_empty() {
        return vec![None; SCORES.len()];
    }
    let of = |(i, (_, _, more)): (usize, &(&str, usize, bool))| {
        let mut all: Vec<(usize, f64)> = (0..entries.len()).filter_map(|e| Some((e, entries[e].score(i)?))).collect();
        if all.len() < 2 {
            return None;
        }
        all.sort_by(|a, b| if *more { b.1.total_cmp(&a.1) } else { a.1.total_cmp(&b.1) });
        Some(all[0].0)
    };
    SCORES.iter().enumerate().map(of).collect()
}

/// The table as text: a head, and cells by row; columns that no row has are left out.
pub fn table(entries: &[Entry]) -> (Vec<String>, Vec<Vec<String>>) {
    table_of(entries, |n| n.to_string())
}

/// [`table`] for people: counts with separators of thousands.
pub fn table_to_read(entries: &[Entry]) -> (Vec<String>, Vec<Vec<String>>) {
    table_of(entries, grouped)
}

fn table_of(entries: &[Entry], written: fn(usize) -> String) -> (Vec<String>, Vec<Vec<String>>) {
    let number = |n: Option<usize>| n.map(written).unwrap_or_default();
    let mut columns: Vec<(String, Vec<String>)> = vec![
        (WORDS[0].into(), entries.iter().map(|e| e.name.clone()).collect()),
        (WORDS[1].into(), entries.iter().map(|e| e.motion.clone().unwrap_or_default()).collect()),
        ("steps".into(), entries.iter().map(|e| number(e.steps)).collect()),
        ("Gaussians".into(), entries.iter().map(|e| number(e.gaussians)).collect()),
        ("seconds".into(), entries.iter().map(|e| number(e.seconds.map(|s| s.round() as usize))).collect()),
        ("file bytes".into(), entries.iter().map(|e| number(e.bytes.map(|b| b as usize))).collect()),
    ];
    for (i, (name, digits, _)) in SCORES.iter().enumerate() {
        let cell = |e: &Entry| e.score(i).map(|x| format!("{x:.digits$}")).unwrap_or_default();
        columns.push(((*name).to_owned(), entries.iter().map(cell).collect()));
    }
    columns.retain(|(_, cells)| cells.iter().any(|c| !c.is_empty()));
    let rows = (0..entries.len()).map(|row| columns.iter().map(|(_, cells)| cells[row].clone()).collect());
    (columns.iter().map(|(name, _)| name.clone()).collect(), rows.collect())
}

/// The place of a column's score in [`SCORES`]; `None`: it is not a score.
pub fn score_of(column: &str) -> Option<usize> {
    SCORES.iter().position(|(name, ..)| *name == column)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn written(folder: &Path, name: &str, text: &str) -> PathBuf {
        std::fs::create_dir_all(folder.join(name)).unwrap();
        let file = folder.join(name).join("results.json");
        std::fs::write(&file, text).unwrap();
        folder.join(name)
    }

    #[test]
    fn results_of_other_programs_are_rows() {
        let folder = tempfile::tempdir().unwrap();
        let a =
            written(folder.path(), "gs", r#"{"ours_7000": {"PSNR": 1}, "ours_30000": {"PSNR": 27.25, "SSIM": 0.8}}"#);
        let b = written(folder.path(), "ns", r#"{"method_name": "x", "results": {"psnr": 26.5, "lpips": 0.2}}"#);
        let entries = open(&[a.clone(), b, a.join("results.json")]).unwrap();
        let names: Vec<&str> = entries.iter().map(|e| e.name.as_str()).collect();
        assert_eq!(names, ["gs", "ns", "gs (2)"]);
        let (head, rows) = table(&entries);
        assert_eq!(head, ["run", "steps", "PSNR", "SSIM", "LPIPS"]);
        assert_eq!([&rows[0][1], &table_to_read(&entries).1[0][1]], ["30000", "30,000"]);
        assert_eq!(rows[0], ["gs", "30000", "27.25", "0.8000", ""]);
        assert_eq!(rows[1], ["ns", "", "26.50", "", "0.2000"]);
        assert_eq!(best(&entries)[..5], [Some(0), None, None, Some(0), None], "one row alone is not the best");
    }

    #[test]
    fn runs_that_cannot_be_compared_are_reported() {
        let views = |n| vec![ViewScore::default(); n];
        let of = |name: &str, capture: &str, n| Entry {
            name: name.into(),
            capture: Some(capture.into()),
            views: views(n),
            ..Entry::default()
        };
        assert!(differences(&[of("a", "x", 3), of("b", "x", 3)]).is_empty());
        let mut two = [of("a", "x", 3), of("b", "y", 4)];
        let found = differences(&two);
        assert_eq!(found.len(), 2, "{found:?}");
        two.iter_mut().for_each(|e| e.scores = vec![Some(30.0); SCORES.len()]);
        assert!(best(&two).iter().all(Option::is_none), "no row is the best of what cannot be compared");
        let folder = tempfile::tempdir().unwrap();
        let none = written(folder.path(), "none", r#"{"speed": 3}"#);
        assert!(Entry::open(&none).unwrap_err().to_string().contains("none of the scores"));
        assert!(Entry::open(&folder.path().join("nowhere")).is_err());
    }
}
