//! `results.json` and `per_view.json`.

use super::colour::ColourMatrix;
use serde_json::{Map, Value, json};
use std::collections::BTreeMap;

/// Prefix of our own entries, as 3DGS does; the steps follow.
pub(super) const METHOD: &str = "ours_";

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
    pub(crate) fn or(value: Option<f64>, reason: impl Into<String>) -> Self {
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
    pub(crate) fn new(name: &str) -> Self {
        Self { name: name.into(), scores: BTreeMap::new() }
    }

    /// Sets one score.
    pub(crate) fn set(&mut self, metric: &str, score: Score) {
        self.scores.insert(metric.into(), score);
    }
}

/// The views of one camera in a [`Split`], and what its colours have in common.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CameraScores {
    /// The camera's name in the capture.
    pub name: String,
    /// Its views, by their place in [`Split::views`].
    pub places: Vec<usize>,
    /// The affine map of colours, render to truth, with the least squared error over all these views; `None` where they
    /// determine none (grey images), and the identity is used.
    pub colour: Option<ColourMatrix>,
}

/// The images of some cameras.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Split {
    /// In the order of the images' names.
    pub views: Vec<View>,
    /// The same by camera, in the order in which they were measured.
    pub cameras: Vec<CameraScores>,
    /// Scores of the split as a whole, such as `flicker`.
    pub whole: BTreeMap<String, Score>,
}

impl Split {
    /// The mean of every metric over the views in which it is defined, and the scores of the whole, with notes: why a
    /// metric is not defined, or over how many views its mean runs.
    pub(crate) fn means(&self) -> (BTreeMap<String, Score>, BTreeMap<String, String>) {
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
        if !self.cameras.is_empty() {
            let cameras = self.cameras.iter().map(|c| (c.name.clone(), self.camera_json(c))).collect();
            out.insert("cameras".into(), Value::Object(cameras));
        }
        Value::Object(out)
    }

    /// Mean PSNR of a camera's views, plain and colour-corrected, and the matrix (null: the identity was taken).
    fn camera_json(&self, camera: &CameraScores) -> Value {
        let mean = |metric: &str| {
            let score = |place: &usize| match self.views[*place].scores.get(metric) {
                Some(Score::Value(value)) => Some(*value),
                _ => None,
            };
            let values: Vec<f64> = camera.places.iter().filter_map(score).collect();
            (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
        };
        json!({"PSNR": mean("PSNR"), "PSNR-cc": mean("PSNR-cc"), "colour": camera.colour})
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

/// Conditions of the figures next to the training steps; only equal ones compare.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize)]
pub struct Conditions {
    /// `test`, `val` or `train`.
    pub split: &'static str,
    /// Background of transparent pixels, sRGB from 0 to 1, in renders and truth; null: images have no alpha.
    pub background: Option<[f32; 3]>,
    /// Instructions of the kernels: `scalar`, `avx2`, `avx512` or `neon`. Levels round differently.
    pub simd: &'static str,
    /// The renderer.
    pub device: String,
}

/// An evaluation after some steps of training.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Report {
    /// Steps of training; the method is called `ours_{iteration}`, as 3DGS does.
    pub iteration: u64,
    /// Conditions of the figures.
    pub conditions: Conditions,
    /// The views that were requested: those held out, by default.
    pub test: Split,
    /// Training cameras, written apart under `train`; `None` where they were not evaluated.
    pub train: Option<Split>,
}

impl Report {
    /// The method's name in the files.
    pub fn method(&self) -> String {
        format!("{METHOD}{}", self.iteration)
    }

    /// `results.json`:
    /// `{"ours_7000": {"SSIM": …, "PSNR": …, "notes": {…}, "cameras": {…}}, "train": {"ours_7000": {…}}}`.
    ///
    /// `cameras` holds for every camera `{"PSNR": …, "PSNR-cc": …, "colour": [[m, m, m, offset] × 3]}`. A metric that
    /// is not defined is null, and `notes` states why.
    pub fn results(&self) -> Value {
        self.nested(Split::results_json)
    }

    /// `per_view.json`: `{"ours_7000": {"PSNR": {"00000.png": …}, "notes": {…}}, "train": {…}}`.
    pub(crate) fn per_view(&self) -> Value {
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
        Report {
            iteration: 7000,
            conditions: Conditions::default(),
            test: Split { views, whole, ..Split::default() },
            train: Some(train),
        }
    }

    #[test]
    fn results_have_the_keys_of_3dgs() {
        let results = report().results();
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
        let per_view = report().per_view();
        assert!((number(&per_view["ours_7000"]["PSNR"]["00001.png"]) - 40.0).abs() < 1e-3);
        assert!(per_view["ours_7000"]["PSNR-dynamic"]["00001.png"].is_null());
        assert!(per_view["ours_7000"]["notes"]["PSNR-dynamic"]["00001.png"].is_string());
    }
}
