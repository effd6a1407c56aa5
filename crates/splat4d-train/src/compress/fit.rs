//! Settings with which a file stays within this many bytes.

use super::{Compression, Level, MOST_PRUNED, draft};
use crate::maintenance::importance::{Scores, prune};
use crate::{Error, Result};
use splat4d::format::playback::{WriteConfig, write};
use splat4d::layers::Scene;
use splat4d::math::Rng;
use splat4d::scene::Camera;

/// Share of the bytes that is kept free: fine-tuning changes how well codes deflate.
const MARGIN: f64 = 0.03;
/// Halvings of the share to prune: 0.98/2⁷ is less than a hundredth.
const HALVINGS: usize = 7;
/// Entries of the palette, where nothing but fewer coefficients helps.
const LEAST_PALETTE: usize = 256;

/// One size that was tried.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Trial {
    /// Share that was pruned.
    pub prune: f64,
    /// Highest degree of the spherical harmonics.
    pub sh_degree: usize,
    /// Bytes of the file without any fine-tuning.
    pub bytes: u64,
}

/// The gentlest settings whose file has at most `most` bytes: first `Level::Tuned` if `free` (the user requested
/// nothing else), then `base` without pruning, then `base` with as little pruning as possible, finally without
/// spherical harmonics.
///
/// `besides` are bytes that the file holds beyond its Gaussians (poster, cameras). Sizes are measured by writing, not
/// estimated. Errors: not even the hardest settings fit; what cannot be baked.
pub fn fit(
    scene: &Scene<f32>,
    scores: &Scores,
    base: &Compression,
    free: bool,
    cameras: &[Camera],
    [most, besides]: [u64; 2],
    progress: &mut dyn FnMut(usize, usize),
) -> Result<(Compression, Vec<Trial>)> {
    let room = ((most as f64 * (1.0 - MARGIN)) as u64).saturating_sub(besides);
    let total = 4 + 2 * HALVINGS;
    let mut trials = Vec::new();
    let mut try_out = |c: &Compression| -> Result<bool> {
        progress(trials.len(), total);
        let bytes = size(scene, scores, c, cameras)?;
        trials.push(Trial { prune: c.prune, sh_degree: c.sh_degree, bytes });
        Ok(bytes <= room)
    };
    if free {
        let tuned = Compression { quantise: base.quantise, ..Compression::level(Level::Tuned, 1) };
        if try_out(&tuned)? {
            return Ok((tuned, trials));
        }
    }
    let plain = Compression { sh_degree: 0, palette: LEAST_PALETTE, ..base.clone() };
    for hard in [base, &plain] {
        if try_out(&Compression { prune: 0.0, ..hard.clone() })? {
            return Ok((Compression { prune: 0.0, ..hard.clone() }, trials));
        }
        if !try_out(&Compression { prune: MOST_PRUNED, ..hard.clone() })? {
            continue;
        }
        let (mut low, mut high) = (0.0, MOST_PRUNED);
        for _ in 0..HALVINGS {
            let middle = 0.5 * (low + high);
            if try_out(&Compression { prune: middle, ..hard.clone() })? { high = middle } else { low = middle }
        }
        return Ok((Compression { prune: high, ..hard.clone() }, trials));
    }
    let least = trials.iter().map(|t| t.bytes).min().unwrap_or(0) + besides;
    Err(Error::input(format!("not even {:.0} % of the Gaussians fit into {most} bytes", 100.0 * (1.0 - MOST_PRUNED)))
        .remedy(format!("Give --max-mb at least {:.2}.", (least as f64 / (1.0 - MARGIN) / 1e4).ceil() / 100.0)))
}

/// Bytes of the pruned scene's file, without any fine-tuning; masks at a bit per Gaussian and key time.
fn size(scene: &Scene<f32>, scores: &Scores, c: &Compression, cameras: &[Camera]) -> Result<u64> {
    let mut pruned = scene.clone();
    for (layer, edit) in pruned.layers.iter_mut().zip(prune(scene, scores, c.prune)) {
        layer.edit(&edit, &Rng::new(0, "fit", 0));
    }
    let draft = draft(&pruned, c, cameras, &mut |_, _| {})?;
    let config = WriteConfig { depths: c.depths, palette: c.palette, ..WriteConfig::default() };
    let summary = write(&draft, &config, &mut std::io::sink())?;
    let frames = ((scene.clip[1] - scene.clip[0]) * scene.fps).round() as usize;
    let keys = frames.checked_div(c.mask_interval).map_or(0, |n| n + 2);
    Ok(summary.bytes + (summary.gaussians * keys / 8) as u64)
}
