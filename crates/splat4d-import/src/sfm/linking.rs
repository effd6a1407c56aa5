//! Pairs of images whose features do not match, matched by what the user brings.
//!
//! Descriptors of local features match up to about 30 degrees between cameras. A learned matcher reaches farther, and takes
//! seconds per pair, so it runs on the pairs alone that features left open. Its matches are verified like others.

use super::CameraFrame;
use super::learned::Learned;
use super::pictures::{self, CameraView, Feature, Pictures};
use super::tracks::{Link, Pairing, verified};
use crate::{Error, ErrorKind, Result};
use splat4d::math::Rng;
use splat4d_train::capture::Rgb8;
use splat4d_train::event::Progress;
use splat4d_train::vision::features::NUMBERS;
use std::collections::BTreeMap;
use std::collections::btree_map::Entry;

/// How sure a learned match is next to others (a ratio of distances, as of [`Link::matches`]): as features that barely match.
const SURE: f32 = 0.8;
/// Up to this many images are in memory at once.
const KEPT: usize = 50;

/// Images behind views.
pub(super) struct Views<'a> {
    pub pictures: &'a dyn Pictures,
    pub who: &'a [CameraFrame],
    /// As of [`pictures::FeatureOptions`].
    pub pixels: usize,
    pub seed: u64,
}

impl Views<'_> {
    /// What a view is matched by: the static background of a fixed camera, the frame of a moving one.
    fn image(&self, view: usize) -> Result<Rgb8> {
        let planes = match self.who[view] {
            (camera, Some(frame)) => pictures::load(self.pictures, camera, frame, self.pixels)?.0,
            (camera, None) => pictures::median(self.pictures, camera, self.pixels)?.0,
        };
        let (bytes, count) = (pictures::bytes(&planes), planes.pixels());
        let data = (0..3 * count).map(|k| bytes[k % 3 * count + k / 3]).collect();
        Ok(Rgb8 { width: planes.width, height: planes.height, data })
    }

    /// Whether positions in a view count: all but where its mask is black.
    fn mask(&self, view: usize, size: [usize; 2]) -> Result<impl Fn([f64; 2]) -> bool + use<>> {
        let (camera, frame) = self.who[view];
        let frame = frame.unwrap_or_else(|| self.pictures.frames(camera) / 2);
        let mask = pictures::mask(self.pictures, camera, frame, size)?;
        Ok(move |[x, y]: [f64; 2]| {
            let inside = x >= 0.0 && y >= 0.0 && x < size[0] as f64 && y < size[1] as f64;
            inside && mask.as_ref().is_none_or(|m| m.counts(x as usize, y as usize))
        })
    }
}

/// Features of a view that a matcher found, by their positions in the image.
#[derive(Default)]
struct Own(BTreeMap<[u64; 2], Option<usize>>);

impl Own {
    /// The number of the feature at a position, which is added; `None`: it does not count.
    fn number(&mut self, at: [f64; 2], view: &mut CameraView, new: impl Fn() -> Option<Feature>) -> Option<usize> {
        *self.0.entry(at.map(f64::to_bits)).or_insert_with(|| {
            let feature = new()?;
            view.features.push(feature);
            view.learned += 1;
            Some(view.features.len() - 1)
        })
    }
}

/// Adds verified matches of the pairs that have none, and their features to views. Errors: images that cannot be read;
/// those of the matcher; `stop` requested it.
pub(super) fn link(
    learned: &Learned,
    views: &Views<'_>,
    sights: &mut [CameraView],
    pairing: Pairing,
    links: &mut Vec<Link>,
    progress: &mut Progress<'_>,
    stop: &dyn Fn() -> bool,
) -> Result<()> {
    let open: Vec<[usize; 2]> =
        pairing.pairs(sights.len()).into_iter().filter(|pair| links.iter().all(|l| l.sights != *pair)).collect();
    let mut images: BTreeMap<usize, Rgb8> = BTreeMap::new();
    let mut own: Vec<Own> = sights.iter().map(|_| Own::default()).collect();
    for (done, &[a, b]) in open.iter().enumerate() {
        progress.phase("matching by the network", done, open.len());
        if stop() {
            return Err(Error::new(ErrorKind::Interrupted, "stopped").remedy("Run the same command again to continue."));
        }
        images.retain(|view, _| sights.len() <= KEPT || *view == a);
        for view in [a, b] {
            if let Entry::Vacant(entry) = images.entry(view) {
                entry.insert(views.image(view)?);
            }
        }
        let pair = [&images[&a], &images[&b]];
        let matches = learned.of([a, b].map(|v| views.who[v]), pair)?;
        let counts = [views.mask(a, sights[a].size)?, views.mask(b, sights[b].size)?];
        let straight = [a, b].map(|view| {
            let known = views.pictures.known(views.who[view].0);
            known.map(|known| known.straight(sights[view].size, sights[view].factor))
        });
        let mut number = |k: usize, at: [f64; 2]| {
            let view = [a, b][k];
            own[view].number(at, &mut sights[view], || {
                let first = 3 * (at[1] as usize * pair[k].width + at[0] as usize);
                let color = std::array::from_fn(|c| pair[k].data[first + c]);
                let mut new = Feature { pixel: at, velocity: [0.0; 2], moment: 0, descriptor: [0; NUMBERS], color };
                straight[k].as_ref().is_none_or(|s| s.feature(&mut new)).then_some(new)
            })
        };
        let numbers: Vec<([usize; 2], f32)> = matches
            .iter()
            .filter(|both| counts[0](both[0]) && counts[1](both[1]))
            .filter_map(|both| Some(([number(0, both[0])?, number(1, both[1])?], SURE)))
            .collect();
        let rng = Rng::new(views.seed, "learned views", (a * sights.len() + b) as u64);
        links.extend(verified(sights, [a, b], numbers, rng));
    }
    links.sort_by_key(|l| l.sights);
    Ok(())
}
