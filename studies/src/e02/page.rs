//! Results of the ablation, as a table and a curve.

use super::cells::Variant;
use super::{FolderContent, Study};
use crate::tables::{number, table};
use splat4d_workflow::report::chart::{self, Series};

type Get = fn(&FolderContent) -> Option<f64>;

/// Mean over the seeds, and the spread of its ends where there are several.
fn over(found: &[&FolderContent], get: Get) -> Option<(f64, Option<f64>)> {
    let values: Vec<f64> = found.iter().filter_map(|f| get(f)).collect();
    let mean = (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)?;
    let [low, high] = [f64::min, f64::max].map(|f| values.iter().copied().reduce(f).unwrap_or(mean));
    Some((mean, (values.len() > 1).then_some(0.5 * (high - low))))
}

fn cell(value: Option<(f64, Option<f64>)>, digits: usize) -> String {
    match value {
        Some((mean, Some(spread))) => format!("{mean:.digits$} ± {spread:.digits$}"),
        other => number(other.map(|v| v.0), digits),
    }
}

/// How much less than the motion alone, in per cent.
fn saved(value: Option<(f64, Option<f64>)>, base: Option<(f64, Option<f64>)>) -> Option<f64> {
    let (value, base) = (value?.0, base?.0);
    (base > 0.0).then(|| 100.0 * (1.0 - value / base))
}

/// The page.
pub(crate) fn markdown(study: &Study, variants: &[Variant], motion: &str) -> String {
    let mut out = format!(
        "# The temporal filter around `{motion}`\n\n{} steps, means over {} seed(s), ± half the spread. PSNR is that of \
         the held-out views, `moving` is that of dynamic regions; flicker in 1/255; flow: end-point error in pixels, over all \
         pixels and where the truth moves. Minutes are those of training, on this machine.\n",
        study.steps, study.seeds
    );
    let head = [
        "variant",
        "PSNR",
        "moving",
        "SSIM",
        "flicker",
        "flow",
        "flow, moving",
        "flicker less, %",
        "flow less, %",
        "minutes",
    ];
    let base = variants.first().map(|v| study.of(v)).unwrap_or_default();
    let line = |v: &Variant| {
        let found = study.of(v);
        let of = |get: Get, digits| cell(over(&found, get), digits);
        let less = |get: Get| number(saved(over(&found, get), over(&base, get)), 1);
        vec![
            v.name.to_owned(),
            of(|f| f.psnr, 2),
            of(|f| f.psnr_dynamic, 2),
            of(|f| f.ssim, 4),
            of(|f| f.flicker, 3),
            of(|f| f.flow.map(|e| e.all), 3),
            of(|f| f.flow.and_then(|e| e.moving), 3),
            less(|f| f.flicker),
            less(|f| f.flow.map(|e| e.all)),
            of(|f| Some(f.minutes), 2),
        ]
    };
    table(&mut out, "Ablation", &head, variants.iter().map(line).collect());
    out
}

/// Every variant's flicker, flow error and loss of quality against the motion alone, by row of the table.
pub(crate) fn plot(study: &Study, variants: &[Variant]) -> Option<String> {
    let base = study.of(variants.first()?);
    let curve = |name: &str, get: Get| {
        let point = |(i, v): (usize, &Variant)| {
            let value = over(&study.of(v), get)?.0;
            let base = over(&base, get).filter(|b| b.0 > 0.0)?.0;
            Some(((i + 1) as f64, 100.0 * value / base))
        };
        Series { name: name.into(), points: variants.iter().enumerate().filter_map(point).collect() }
    };
    let all = [
        curve("flicker", |f| f.flicker),
        curve("flow error", |f| f.flow.map(|e| e.all)),
        curve("minutes", |f| Some(f.minutes)),
    ];
    chart::file(&all, "row of the table", "% of the motion alone")
}

#[cfg(test)]
mod tests {
    use super::super::cells::variants;
    use super::super::flow::FlowError;
    use super::*;

    #[test]
    fn the_page_compares_with_the_motion_alone() {
        let all = variants(false);
        let mut study = Study { steps: 100, seeds: 2, ..Study::default() };
        let empty = markdown(&study, &all, "hexplane");
        assert!(!empty.contains("NaN") && plot(&study, &all).is_none());
        for (i, v) in all.iter().enumerate() {
            for seed in 0..2 {
                study.cells.push(FolderContent {
                    key: v.key.into(),
                    seed,
                    psnr: Some(25.0 + seed as f64),
                    flicker: Some(2.0 - 0.1 * i as f64),
                    flow: Some(FlowError { all: 1.0, moving: Some(4.0) }),
                    minutes: 1.0,
                    ..FolderContent::default()
                });
            }
        }
        let page = markdown(&study, &all, "hexplane");
        assert!(page.contains("25.50 ± 0.50") && page.contains("| 5.0 |"), "{page}");
        let rows: Vec<usize> = page.lines().filter(|l| l.starts_with('|')).map(|l| l.matches('|').count()).collect();
        assert!(rows.len() == all.len() + 2 && rows.windows(2).all(|w| w[0] == w[1]), "{page}");
        assert!(plot(&study, &all).is_some_and(|svg| svg.contains("flicker") && !svg.contains("NaN")));
    }
}
