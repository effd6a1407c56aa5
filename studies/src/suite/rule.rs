//! The rule that a recipe must keep on every capture: more steps do not cost quality, and training views do not get
//! worse during the run.

use super::FolderContent;
use serde::{Deserialize, Serialize};

/// Times as many steps as the shorter run.
pub(crate) const MORE: usize = 4;
/// Largest loss of the longer run on held-out views, dB: about what two seeds differ by.
const LOSS: f64 = 0.1;
/// Largest loss of training views during the run, dB.
const FALL: f64 = 1.0;

/// Training views after this many steps.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Probe {
    pub step: usize,
    /// Mean over the same views every time, dB.
    pub psnr: f64,
}

/// The largest loss of training views during the run.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Fall {
    pub db: f64,
    pub from: usize,
    pub to: usize,
}

/// The largest fall from one probe to a later one. Falls across `change` (the step at which images change their
/// resolution) do not count: before it, training views are of half the size.
pub(crate) fn largest_fall(probes: &[Probe], change: usize) -> Option<Fall> {
    let (coarse, fine) = probes.split_at(probes.partition_point(|p| p.step <= change));
    let mut worst: Option<Fall> = None;
    for part in [coarse, fine] {
        let Some(mut best) = part.first() else { continue };
        for probe in part {
            let db = best.psnr - probe.psnr;
            if worst.is_none_or(|w| db > w.db) {
                worst = Some(Fall { db, from: best.step, to: probe.step });
            }
            if probe.psnr > best.psnr {
                best = probe;
            }
        }
    }
    worst
}

/// Violations of a capture's runs, a sentence each.
pub(crate) fn broken(short: &FolderContent, long: &FolderContent) -> Vec<String> {
    let mut out = Vec::new();
    if let (Some(before), Some(after)) = (short.psnr, long.psnr)
        && after < before - LOSS
    {
        out.push(format!(
            "{}: {} steps reach {before:.2} dB, {} steps {after:.2} dB: {:.2} dB less",
            short.capture,
            short.steps,
            long.steps,
            before - after
        ));
    }
    for found in [short, long] {
        if let Some(fall) = found.fall.filter(|f| f.db > FALL) {
            out.push(format!(
                "{}, {} steps: training views fall by {:.2} dB from step {} to step {}",
                found.capture, found.steps, fall.db, fall.from, fall.to
            ));
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn probes(psnr: &[f64]) -> Vec<Probe> {
        psnr.iter().enumerate().map(|(i, &psnr)| Probe { step: 10 * (i + 1), psnr }).collect()
    }

    #[test]
    fn the_largest_fall_is_found_and_a_change_of_resolution_is_none() {
        let dip = probes(&[20.0, 25.0, 24.5, 22.0, 27.0, 26.9]);
        for change in [0, 10, 60] {
            assert_eq!(largest_fall(&dip, change), Some(Fall { db: 3.0, from: 20, to: 40 }), "{change}");
        }
        assert_eq!(largest_fall(&[], 10), None);
        // From 22 to 27 and on to 26.9: what the images' change cost does not count.
        let fall = largest_fall(&dip, 20).unwrap();
        assert!((fall.db - 2.5).abs() < 1e-12 && fall.from == 30);
        let fall = largest_fall(&dip, 30).unwrap();
        assert_eq!((fall.from, fall.to), (20, 30));
        assert_eq!(largest_fall(&probes(&[20.0, 21.0, 22.0, 23.0]), 20).unwrap().db, 0.0);
    }

    #[test]
    fn a_broken_rule_is_reported() {
        let found = |steps: usize, psnr: f64, db: f64| FolderContent {
            capture: "knight".into(),
            steps,
            psnr: Some(psnr),
            fall: Some(Fall { db, from: 40, to: 80 }),
            ..FolderContent::default()
        };
        assert!(broken(&found(100, 30.0, 0.9), &found(400, 29.95, 1.0)).is_empty());
        let less = broken(&found(100, 30.0, 0.0), &found(400, 29.5, 0.0));
        assert!(less.len() == 1 && less[0].contains("0.50 dB less"), "{less:?}");
        let falls = broken(&found(100, 30.0, 1.2), &found(400, 31.0, 4.0));
        assert!(falls.len() == 2 && falls[1].contains("400 steps: training views fall by 4.00 dB"), "{falls:?}");
        let refused = FolderContent { capture: "knight".into(), ..FolderContent::default() };
        assert!(broken(&refused, &refused).is_empty());
    }
}
