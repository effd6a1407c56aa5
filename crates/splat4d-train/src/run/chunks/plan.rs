//! Boundaries of chunks: evenly spaced, moved to times of least motion.

use super::{FRAMES, WHOLE};
use crate::capture::{Capture, ImageStore};
use crate::event::Event;
use crate::recipe::Recipe;
use crate::run::open::plan;
use crate::{Error, Result};
use splat4d::scene::Planes;
use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

/// Share of a chunk's frames by which a cut is moved, at most.
const MOVED: f64 = 0.1;
/// Cameras that are examined for it.
const LOOKED_AT: usize = 2;

/// The chunks of a capture. Frames are counted as the capture counts them.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct ChunkPlan {
    /// The splat4d that made it.
    pub version: String,
    /// Fingerprint of the recipe.
    pub recipe: String,
    /// Fingerprint of the capture.
    pub capture: String,
    /// First frame of the capture, and the one after its last.
    pub take: [usize; 2],
    /// Frames that neighbours share.
    pub overlap: usize,
    /// Cuts between chunks, in the middle of an overlap.
    pub cuts: Vec<usize>,
}

impl ChunkPlan {
    /// The plan with even cuts; `None`: the take is learnt at once. Errors: an overlap that does not fit.
    pub(crate) fn even(capture: &Capture, recipe: &Recipe) -> Result<Option<Self>> {
        let settings = recipe.chunks;
        if capture.train.is_empty() {
            return Ok(None);
        }
        let first = recipe.capture.first_frame.max(capture.take.frames.start);
        let most = if recipe.capture.max_frames == 0 { usize::MAX } else { recipe.capture.max_frames };
        let end = recipe.capture.first_frame.saturating_add(most).min(capture.take.frames.end);
        let (take, count) = ([first, end], end.saturating_sub(first));
        let fixed = capture.cameras.iter().filter(|c| c.fixed).count() > 1;
        // `auto` has not chosen yet.
        let moves = || recipe.program().map_or(true, |p| p.capabilities(&plan(capture, recipe)).moves);
        let length = match settings.frames {
            0 if count > WHOLE && fixed && moves() && super::check(recipe).is_ok() => FRAMES,
            0 => return Ok(None),
            n => n,
        };
        if count <= length {
            return Ok(None);
        }
        let chunks = count.div_ceil(length);
        let shortest = count / chunks - 2 * (MOVED * length as f64) as usize;
        if settings.overlap < 2 || !settings.overlap.is_multiple_of(2) || 2 * settings.overlap > shortest {
            return Err(Error::input(format!(
                "an overlap of {} frames between chunks of about {}",
                settings.overlap,
                count / chunks
            ))
            .remedy(format!("Give an even --overlap from 2 to {}, or longer chunks", (shortest / 2) & !1)));
        }
        let cuts = (1..chunks).map(|k| first + count * k / chunks).collect();
        Ok(Some(Self { take, overlap: settings.overlap, cuts, ..Self::default() }))
    }

    /// The plan with its cuts where least moves, as a few of the fixed cameras see it.
    /// `open` lists some frames of the capture.
    pub(super) fn at_rest(
        mut self,
        open: &dyn Fn(Range<usize>) -> Result<Capture>,
        listen: &mut dyn FnMut(&Event),
    ) -> Result<Self> {
        let (half, chunks) = (self.overlap / 2, self.cuts.len() + 1);
        let reach = (MOVED * ((self.take[1] - self.take[0]) / chunks) as f64) as usize;
        for k in 0..self.cuts.len() {
            listen(&Event::Phase { name: "searching for chunk boundaries".into(), done: k, total: self.cuts.len() });
            let cut = self.cuts[k];
            let first = cut - reach - half;
            let mut change = vec![0.0; 2 * (reach + half)];
            let capture = Arc::new(open(first..first + change.len())?);
            let mut seen: BTreeMap<usize, BTreeMap<usize, usize>> = BTreeMap::new();
            for &i in capture.train.iter().filter(|&&i| capture.cameras[capture.frames[i].camera].fixed) {
                seen.entry(capture.frames[i].camera).or_default().insert(capture.frames[i].index, i);
            }
            let cameras: Vec<BTreeMap<usize, usize>> = seen.into_values().collect();
            let step = cameras.len().div_ceil(LOOKED_AT).max(1);
            let store = Arc::new(ImageStore::new(capture.clone(), 0));
            for camera in cameras.iter().step_by(step) {
                let mut before: Option<Planes<f32>> = None;
                for (j, change) in change.iter_mut().enumerate() {
                    let Some(&i) = camera.get(&(first + j)) else { continue };
                    let mut now = Planes::default();
                    store.load(i)?.color_into(&mut now);
                    if let Some(before) = &before {
                        let sum: f64 = before.data.iter().zip(&now.data).map(|(a, b)| f64::from((a - b).abs())).sum();
                        *change += sum / now.data.len().max(1) as f64;
                    }
                    before = Some(now);
                }
            }
            // The first frame of a window has nothing before it.
            let within = |at: usize| change[at - first - half + 1..at - first + half].iter().sum::<f64>();
            let places = (cut - reach..=cut + reach).filter(|at| at - first + half <= change.len());
            let quiet =
                places.min_by(|&a, &b| within(a).total_cmp(&within(b)).then(a.abs_diff(cut).cmp(&b.abs_diff(cut))));
            self.cuts[k] = quiet.unwrap_or(cut);
        }
        Ok(self)
    }

    /// Number of chunks.
    pub fn len(&self) -> usize {
        self.cuts.len() + 1
    }

    /// Never: a capture has one chunk at least.
    pub fn is_empty(&self) -> bool {
        false
    }

    /// The frames of a chunk, those that it shares included. Panics: there is no such chunk.
    pub fn frames(&self, chunk: usize) -> Range<usize> {
        let half = self.overlap / 2;
        let from = if chunk == 0 { self.take[0] } else { self.cuts[chunk - 1] - half };
        let to = if chunk == self.cuts.len() { self.take[1] } else { self.cuts[chunk] + half };
        from..to
    }

    /// The frames that a cut's neighbours share.
    pub(crate) fn shared(&self, cut: usize) -> Range<usize> {
        self.cuts[cut] - self.overlap / 2..self.cuts[cut] + self.overlap / 2
    }

    /// Errors: a plan that is none, from a file.
    pub(super) fn check(&self) -> Result<()> {
        let ends = std::iter::once(&self.take[0]).chain(&self.cuts).chain(std::iter::once(&self.take[1]));
        let ends: Vec<usize> = ends.copied().collect();
        let sound = self.overlap >= 2 && !self.cuts.is_empty() && ends.windows(2).all(|w| w[0] + self.overlap <= w[1]);
        if sound { Ok(()) } else { Err(Error::input("its chunks do not follow each other").remedy("Train again")) }
    }

    /// Errors: a plan for another recipe, capture or version.
    pub(super) fn check_same(&self, other: &Self) -> Result<()> {
        let differs = [
            ("version of splat4d", &self.version, &other.version),
            ("recipe", &self.recipe, &other.recipe),
            ("capture", &self.capture, &other.capture),
        ];
        match differs.into_iter().find(|(_, a, b)| a != b) {
            None => Ok(()),
            Some((what, ..)) => Err(Error::input(format!("holds a run of another {what}"))
                .remedy("Give all workers the same command and version, or choose another folder with -o")),
        }
    }
}
