//! `results.json` and `per_view.json`.

use serde_json::{Map, Value};
use splat4d::{Error, Result};
use std::collections::BTreeMap;
use std::fs;
use std::io::Write;
use std::path::Path;

/// A number, or why there is none.
#[derive(Clone, Debug, PartialEq)]
pub enum Score {
    /// The number.
    Value(f64),
    /// The reason, for the reader.
    Undefined(String),
}

impl Score {
    /// The number if it is there and finite, else the reason.
    pub fn or(value: Option<f64>, reason: impl Into<String>) -> Self {
        match value {
            Some(v) if v.is_finite() => Score::Value(v),
            Some(v) if v == f64::INFINITY => Score::Undefined("infinite: the images are equal there".into()),
            Some(_) => Score::Undefined("not a number: the render holds NaN".into()),
            None => Score::Undefined(reason.into()),
        }
    }

    fn json(&self) -> Value {
        match self {
            Score::Value(v) => Value::from(*v),
            Score::Undefined(_) => Value::Null,
        }
    }
}

/// The scores of one image.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// File name, `00000.png`.
    pub name: String,
    /// By metric.
    pub scores: BTreeMap<String, Score>,
}

impl View {
    /// A view without scores.
    pub fn new(name: &str) -> Self {
        Self { name: name.into(), scores: BTreeMap::new() }
    }

    /// Sets one score.
    pub fn set(&mut self, metric: &str, score: Score) {
        self.scores.insert(metric.into(), score);
    }
}

/// The images of some cameras.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Split {
    /// In the order of the images' names.
    pub views: Vec<View>,
    /// Scores of the split as a whole, such as `flicker`.
    pub whole: BTreeMap<String, Score>,
}

impl Split {
    /// The mean of every metric over the views in which it is defined, and the scores of the whole, with notes: why a
    /// metric is not defined, or over how many views its mean runs.
    pub fn means(&self) -> (BTreeMap<String, Score>, BTreeMap<String, String>) {
        let (mut sums, mut notes) = (BTreeMap::<&str, (f64, usize, Option<&str>)>::new(), BTreeMap::new());
        for (metric, score) in self.views.iter().flat_map(|v| &v.scores) {
            let entry = sums.entry(metric).or_default();
            match score {
                Score::Value(v) => {
                    entry.0 += v;
                    entry.1 += 1;
                }
                Score::Undefined(reason) => entry.2 = entry.2.or(Some(reason)),
            }
        }
        let mut out = BTreeMap::new();
        for (metric, (sum, count, reason)) in sums {
            if count == 0 {
                out.insert(metric.to_string(), Score::Undefined(reason.unwrap_or_default().into()));
            } else {
                out.insert(metric.to_string(), Score::Value(sum / count as f64));
            }
            if let (Some(reason), true) = (reason, count > 0) {
                notes.insert(metric.into(), format!("mean of {count} of {} views; others: {reason}", self.views.len()));
            }
        }
        out.extend(self.whole.iter().map(|(k, v)| (k.clone(), v.clone())));
        for (metric, score) in &out {
            if let Score::Undefined(reason) = score {
                notes.insert(metric.clone(), reason.clone());
            }
        }
        (out, notes)
    }

    fn results_json(&self) -> Value {
        let (means, notes) = self.means();
        let mut out: Map<String, Value> = means.iter().map(|(k, v)| (k.clone(), v.json())).collect();
        add_notes(&mut out, notes.into_iter().map(|(k, v)| (k, Value::from(v))).collect());
        Value::Object(out)
    }

    fn per_view_json(&self) -> Value {
        let (mut out, mut notes) = (Map::new(), Map::new());
        let put = |to: &mut Map<String, Value>, metric: &str, view: &str, value: Value| {
            let entry = to.entry(metric).or_insert_with(|| Value::Object(Map::new()));
            entry.as_object_mut().expect("every metric's entry is an object").insert(view.into(), value);
        };
        for view in &self.views {
            for (metric, score) in &view.scores {
                put(&mut out, metric, &view.name, score.json());
                if let Score::Undefined(reason) = score {
                    put(&mut notes, metric, &view.name, Value::from(reason.as_str()));
                }
            }
        }
        add_notes(&mut out, notes);
        Value::Object(out)
    }
}

fn add_notes(to: &mut Map<String, Value>, notes: Map<String, Value>) {
    if !notes.is_empty() {
        to.insert("notes".into(), Value::Object(notes));
    }
}

/// An evaluation after some steps of training.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Report {
    /// Steps of training; the method is called `ours_{iteration}`, as 3DGS does.
    pub iteration: u64,
    /// Held-out cameras.
    pub test: Split,
    /// Training cameras, written apart under `train`; `None` where they were not evaluated.
    pub train: Option<Split>,
}

impl Report {
    /// The method's name in the files.
    pub fn method(&self) -> String {
        format!("ours_{}", self.iteration)
    }

    /// `results.json`: `{"ours_7000": {"SSIM": …, "PSNR": …, "notes": {…}}, "train": {"ours_7000": {…}}}`.
    ///
    /// A metric that is not defined is null, and `notes` says why.
    pub fn results(&self) -> Value {
        self.nested(Split::results_json)
    }

    /// `per_view.json`: `{"ours_7000": {"PSNR": {"00000.png": …}, "notes": {…}}, "train": {…}}`.
    pub fn per_view(&self) -> Value {
        self.nested(Split::per_view_json)
    }

    fn nested(&self, json: impl Fn(&Split) -> Value) -> Value {
        let mut out = Map::new();
        out.insert(self.method(), json(&self.test));
        if let Some(train) = &self.train {
            let mut inner = Map::new();
            inner.insert(self.method(), json(train));
            out.insert("train".into(), Value::Object(inner));
        }
        Value::Object(out)
    }

    /// Writes `results.json` and `per_view.json` into `folder`, each whole or not at all.
    ///
    /// Errors: the folder cannot be written to, or the disk is full.
    pub fn write(&self, folder: &Path) -> Result<()> {
        write_json(&folder.join("results.json"), &self.results())?;
        write_json(&folder.join("per_view.json"), &self.per_view())
    }
}

/// Writes to a temporary name in the same folder, then renames.
fn write_json(path: &Path, value: &Value) -> Result<()> {
    let temporary = path.with_extension(format!("json.{}.tmp", std::process::id()));
    let text = format!("{value:#}\n");
    let written = fs::File::create(&temporary)
        .and_then(|mut file| file.write_all(text.as_bytes()).and_then(|()| file.sync_all()))
        .and_then(|()| fs::rename(&temporary, path));
    written.map_err(|e| {
        // The file may never have come into being; the first error is the one to tell.
        let _ = fs::remove_file(&temporary);
        Error::io("the evaluation cannot be written", e)
            .at(path.display())
            .remedy("Check that the folder exists, may be written to and has room")
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::eval::{ViewContext, score_view};
    use splat4d::scene::Planes;

    fn flat(value: f32, side: usize) -> Planes<f32> {
        Planes { channels: 3, height: side, width: side, data: vec![value; 3 * side * side] }
    }

    fn report() -> Report {
        let region: Vec<bool> = (0..64).map(|p| p < 8).collect();
        let none = [false; 64];
        let context = ViewContext { foreground: Some(&region), dynamic: Some(&region), lpips: None };
        let still = ViewContext { dynamic: Some(&none), ..context };
        let views = vec![
            score_view("00000.png", &flat(0.6, 8), &flat(0.5, 8), &context),
            score_view("00001.png", &flat(0.51, 8), &flat(0.5, 8), &still),
        ];
        let whole = [("flicker".to_string(), Score::Value(1.5))].into();
        let train = Split {
            views: vec![score_view("00000.png", &flat(0.5, 200), &flat(0.5, 200), &ViewContext::default())],
            ..Split::default()
        };
        Report { iteration: 7000, test: Split { views, whole }, train: Some(train) }
    }

    #[test]
    fn files_have_the_keys_that_3dgs_users_know() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        report().write(folder.path()).expect("the folder can be written to");
        let read = |name: &str| -> Value {
            let text = fs::read_to_string(folder.path().join(name)).expect("it was written");
            serde_json::from_str(&text).expect("it is JSON")
        };
        let results = read("results.json");
        let ours = &results["ours_7000"];
        let number = |v: &Value| v.as_f64().expect("a number");
        assert!((number(&ours["PSNR"]) - 30.0).abs() < 1e-3, "the mean of 20 and 40 dB, not the dB of the mean");
        assert!((number(&ours["PSNR-dynamic"]) - 20.0).abs() < 1e-3);
        assert!(ours["notes"]["PSNR-dynamic"].as_str().is_some_and(|n| n.contains("1 of 2") && n.contains("moves")));
        assert_eq!(number(&ours["flicker"]), 1.5);
        assert!((number(&ours["D-SSIM"]) - (1.0 - number(&ours["SSIM"])) / 2.0).abs() < 1e-12);
        assert!(ours["MS-SSIM"].is_null() && ours["notes"]["MS-SSIM"].as_str().is_some_and(|n| n.contains("176")));
        assert!(ours.as_object().is_some_and(|o| !o.keys().any(|k| k.starts_with("LPIPS"))), "not computed, not shown");
        let train = &results["train"]["ours_7000"];
        assert!(train["PSNR"].is_null() && train["notes"]["PSNR"].as_str().is_some_and(|n| n.contains("equal")));
        assert!(train["notes"]["PSNR-dynamic"].as_str().is_some_and(|n| n.contains("not fixed")));
        assert!((number(&train["MS-SSIM"]) - 1.0).abs() < 1e-9 && train.get("PSNR-foreground").is_none());
        let per_view = read("per_view.json");
        assert!((number(&per_view["ours_7000"]["PSNR"]["00001.png"]) - 40.0).abs() < 1e-3);
        assert!(per_view["ours_7000"]["PSNR-dynamic"]["00001.png"].is_null());
        assert!(per_view["ours_7000"]["notes"]["PSNR-dynamic"]["00001.png"].is_string());
        let left: Vec<_> = fs::read_dir(folder.path()).expect("it is there").collect();
        assert_eq!(left.len(), 2, "no temporary file may stay behind");
    }

    #[test]
    fn an_unwritable_folder_is_an_error_with_a_place() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let error = report().write(&folder.path().join("missing")).expect_err("there is no such folder");
        assert!(error.to_string().contains("results.json"), "{error}");
    }
}
