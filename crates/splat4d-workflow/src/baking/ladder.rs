//! Rungs of a bitrate ladder: what each has and needs, and how like the whole file it is.

use super::likeness;
use crate::deadline::Deadline;
use crate::events::Listener;
use crate::files::{grouped, human_bytes};
use splat4d::format::playback::{Index, Kind, Rung, read_pages};
use splat4d::layers::Scene;
use splat4d::scene::Camera;
use splat4d::{Error, Result};
use splat4d_train::path_text::in_command;
use std::path::Path;

/// Bits of a megabit.
pub(super) const MEGA: f64 = 1e6;
/// Most rates of a ladder.
const MOST_RATES: usize = 8;

/// What a rung of a file has and needs. Counts and bytes include the rungs before it.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub(crate) struct RungReport {
    /// The rate that suffices, Mbit/s; that of the index.
    pub rate: f64,
    /// Pages with a lower tier belong to it.
    pub tiers: u16,
    /// Mbit/s of the fullest window, and their mean.
    pub most: f64,
    pub mean: f64,
    /// Gaussians in all pages, and in those of one time, averaged over the clip.
    pub gaussians: usize,
    pub at_once: f64,
    /// Bits per second for each Gaussian at once.
    pub bits_a_gaussian: f64,
    /// Stored bytes of the pages.
    pub bytes: u64,
    /// Bytes of the first image, and seconds that they take at the rung's rate.
    pub first_image_bytes: u64,
    pub first_image_seconds: f64,
    /// PSNR against the whole file, dB; none where nothing was compared, and for the last rung, which is the whole.
    pub psnr: Option<f64>,
    pub worst_psnr: Option<f64>,
}

/// Errors: rates that do not rise from above zero, or too many of them.
pub(super) fn check(rates: &[f64]) -> Result<()> {
    let sound = rates.iter().all(|r| r.is_finite() && *r > 0.0) && rates.windows(2).all(|pair| pair[0] < pair[1]);
    if sound && rates.len() <= MOST_RATES {
        return Ok(());
    }
    let list: Vec<String> = rates.iter().map(f64::to_string).collect();
    Err(Error::input(format!(
        "invalid ladder {}: expected at most {MOST_RATES} rates in Mbit/s, each above the one before it",
        list.join(",")
    ))
    .remedy("Give for example 8,20,75 (option `ladder`)"))
}

/// The rungs of a file by its index, without comparisons.
pub(crate) fn rungs(index: &Index) -> Vec<RungReport> {
    let pages: Vec<_> = index.sections.iter().filter(|e| e.kind == Kind::Page).collect();
    let start = index.meta.clip[0];
    let span = pages.iter().fold([f64::INFINITY, f64::NEG_INFINITY], |s, e| [s[0].min(e.span[0]), s[1].max(e.span[1])]);
    let seconds = (span[1] - span[0]).max(f64::MIN_POSITIVE);
    let before: u64 = pages.iter().map(|e| e.offset).min().unwrap_or(0);
    let report = |rung: &Rung| {
        let own = || pages.iter().filter(|e| e.tier < rung.tiers);
        let at_once = own().map(|e| f64::from(e.count) * (e.span[1] - e.span[0])).sum::<f64>() / seconds;
        let first = own().filter(|e| e.tier == 0 && e.span[0] <= start && start < e.span[1]);
        let first_image_bytes = before + first.map(|e| u64::from(e.stored)).sum::<u64>();
        RungReport {
            rate: rung.rate / MEGA,
            tiers: rung.tiers,
            most: rung.most / MEGA,
            mean: rung.mean / MEGA,
            gaussians: own().map(|e| e.count as usize).sum(),
            at_once,
            bits_a_gaussian: rung.mean / at_once.max(1.0),
            bytes: own().map(|e| u64::from(e.stored)).sum(),
            first_image_bytes,
            first_image_seconds: 8.0 * first_image_bytes as f64 / rung.rate,
            psnr: None,
            worst_psnr: None,
        }
    };
    index.meta.ladder.iter().map(report).collect()
}

/// The same, each rung but the last compared with the whole file.
pub(super) fn report(
    bytes: &[u8],
    shots: &[(f64, Camera)],
    deadline: &Deadline,
    console: &dyn Listener,
) -> Result<Vec<RungReport>> {
    let index = Index::parse(bytes, Some(bytes.len() as u64))?;
    let mut out = rungs(&index);
    let pages = read_pages(bytes)?;
    let whole = pages.scene();
    let last = out.len().saturating_sub(1);
    for (k, rung) in out.iter_mut().enumerate().take(last) {
        let layers = pages.layers.iter().zip(&pages.tiers).filter(|(_, tier)| **tier < rung.tiers);
        let part = Scene { layers: layers.map(|(layer, _)| layer.clone()).collect(), ..pages.scene() };
        let like = likeness(&whole, &part, shots, false, &mut |done, total| {
            console.phase(&format!("comparing rung {} with the whole file", k + 1), done, total);
            deadline.left() > 0.0
        })?;
        (rung.psnr, rung.worst_psnr) = (like.map(|l| l.psnr), like.map(|l| l.worst_psnr));
    }
    Ok(out)
}

/// One line for each rung; `given` are the rates that were requested, Mbit/s.
pub(crate) fn in_words(rungs: &[RungReport]) -> Vec<String> {
    let line = |(k, r): (usize, &RungReport)| {
        let like = r.psnr.map_or(String::new(), |psnr| format!(", {psnr:.2} dB against the whole file"));
        let first = format!("first image {} ({:.2} s)", human_bytes(r.first_image_bytes), r.first_image_seconds);
        format!(
            "rung {} of {}: {:.2} Mbit/s (up to {:.2} needed), {} Gaussians, {:.0} bits per Gaussian and second, {first}{like}",
            k + 1,
            rungs.len(),
            r.rate,
            r.most,
            grouped(r.gaussians),
            r.bits_a_gaussian
        )
    };
    rungs.iter().enumerate().map(line).collect()
}

/// What became of rates that the file does not have as ordered.
pub(super) fn notes(rungs: &[RungReport], given: &[f64]) -> Vec<String> {
    let mut out = Vec::new();
    let Some(last) = rungs.last() else { return out };
    if rungs.len() < given.len() {
        let rest: Vec<String> = given[rungs.len()..].iter().map(f64::to_string).collect();
        out.push(format!(
            "the whole file needs {:.2} Mbit/s: the rates {} of option `ladder` would add nothing and are left out",
            last.most,
            rest.join(", ")
        ));
    }
    if rungs.len() > given.len() {
        out.push(format!(
            "the whole file needs {:.2} Mbit/s: what exceeds the highest rate of option `ladder` is a rung of its own",
            last.most
        ));
    }
    out
}

/// The command that gives a run of the scene of a file with these rungs a ladder again; none without rungs.
pub(crate) fn again(rungs: &[Rung], run: &Path) -> Option<String> {
    let rates: Vec<String> = rungs.iter().map(|rung| hundredths(rung.rate / MEGA)).collect();
    let mut file = run.as_os_str().to_owned();
    file.push("-ladder.s4d");
    let [run, file] = [run, Path::new(&file)].map(in_command);
    (!rates.is_empty()).then(|| format!("splat4d bake {run} -o {file} --ladder {}", rates.join(",")))
}

/// A rate with two decimals, rounded up, so that what fits into the rate fits into this.
fn hundredths(rate: f64) -> String {
    let rounded = (rate * 100.0).round();
    let rounded = if rounded / 100.0 < rate * (1.0 - f64::EPSILON) { rounded + 1.0 } else { rounded };
    (rounded / 100.0).to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_for_another_ladder_has_rates_that_suffice() {
        let rung = |rate: f64| Rung { rate, tiers: 1, ..Rung::default() };
        assert_eq!(again(&[], Path::new("a")), None);
        let command = again(&[rung(0.4e6), rung(4.1e6), rung(6.061e6)], Path::new("runs/my dance")).unwrap();
        assert_eq!(command, "splat4d bake 'runs/my dance' -o 'runs/my dance-ladder.s4d' --ladder 0.4,4.1,6.07");
    }

    #[test]
    fn rates_must_rise_from_above_zero() {
        assert!(check(&[]).is_ok() && check(&[8.0, 20.0, 75.0]).is_ok());
        for wrong in [&[0.0][..], &[-1.0], &[f64::NAN], &[8.0, 8.0], &[20.0, 8.0], &[1.0; 9]] {
            let error = check(wrong).unwrap_err().to_string();
            assert!(error.contains("invalid ladder") && error.contains("Mbit/s"), "{error}");
        }
    }
}
