//! The stored images as structure from motion requests them.

use crate::sfm;
use crate::sfm::learned::Learned;
use crate::sfm::lens::Known;
use crate::sync::graph::Offset;
use crate::write::{Masks, Pictures};
use crate::{Error, Result};
use rayon::prelude::*;
use splat4d::math::median_by;
use splat4d::scene::Planes;
use splat4d_train::capture::Rgb8;
use std::path::Path;

/// All cameras' stored images, and their time offsets as far as known.
pub(super) struct Stored<'a> {
    pub folder: &'a Path,
    pub pictures: &'a [Pictures],
    pub offsets: Vec<Option<Offset>>,
    /// Lenses, and positions, that were given.
    pub known: &'a [Option<Known>],
    /// Masks of images; empty: none.
    pub masks: &'a [Masks],
    /// What matches images whose features do not.
    pub learned: Option<&'a Learned>,
}

impl<'a> Stored<'a> {
    pub(super) fn new(
        folder: &'a Path,
        pictures: &'a [Pictures],
        known: &'a [Option<Known>],
        masks: &'a [Masks],
    ) -> Self {
        Self { folder, pictures, offsets: vec![None; pictures.len()], known, masks, learned: None }
    }

    /// The same images on another clock.
    pub(super) fn on(&self, offsets: &[Option<Offset>]) -> Self {
        Self { offsets: offsets.to_vec(), ..*self }
    }

    /// With what matches images whose features do not.
    pub(super) fn matched_by(self, learned: Option<&'a Learned>) -> Self {
        Self { learned, ..self }
    }

    /// Given values of a camera.
    pub(super) fn known(&self, camera: usize) -> Option<Known> {
        self.known.get(camera).copied().flatten()
    }

    /// Whether all positions were given.
    pub(super) fn posed(&self) -> bool {
        !self.known.is_empty() && self.known.iter().all(|k| k.is_some_and(|k| k.pose.is_some()))
    }

    /// Changes with images, masks, and what was given of cameras.
    pub(super) fn fingerprint(&self) -> String {
        let prints: Vec<&str> = self.pictures.iter().map(|p| p.fingerprint.as_str()).collect();
        let masks: Vec<u64> = self.masks.iter().map(|m| m.fingerprint).collect();
        let learned = self.learned.map_or("", Learned::identity);
        format!("{prints:?} {masks:?} {:?} {learned}", self.known)
    }

    /// The static background: the median of some frames, each made into what is worked with.
    pub(super) fn median(&self, camera: usize, made: impl Fn(Rgb8) -> Rgb8 + Sync) -> Result<Rgb8> {
        /// Frames over the recording.
        const SPREAD: usize = 15;
        let count = self.pictures[camera].shots.len();
        let kept = count.min(SPREAD);
        let chosen: Vec<usize> = (0..kept).map(|k| (2 * k + 1) * count / (2 * kept)).collect();
        let all: Vec<Rgb8> = chosen.par_iter().map(|&k| Ok(made(self.rgb(camera, k)?))).collect::<Result<_>>()?;
        let mut still = all[0].clone();
        let mut values = vec![0u8; all.len()];
        for (p, v) in still.data.iter_mut().enumerate() {
            values.iter_mut().zip(&all).for_each(|(v, a)| *v = a.data[p]);
            *v = median_by(&mut values, u8::cmp).expect("there are images");
        }
        Ok(still)
    }

    pub(super) fn rgb(&self, camera: usize, frame: usize) -> Result<Rgb8> {
        Rgb8::read(&self.folder.join(self.pictures[camera].file(frame)))
    }
}

impl sfm::pictures::Pictures for Stored<'_> {
    fn cameras(&self) -> usize {
        self.pictures.len()
    }

    fn name(&self, camera: usize) -> String {
        self.pictures[camera].name.clone()
    }

    fn frames(&self, camera: usize) -> usize {
        self.pictures[camera].shots.len()
    }

    fn time(&self, camera: usize, frame: usize) -> f64 {
        let time = self.pictures[camera].shots[frame].time;
        self.offsets[camera].as_ref().map_or(time, |o| o.global(time))
    }

    fn known(&self, camera: usize) -> Option<Known> {
        Stored::known(self, camera)
    }

    fn matcher(&self) -> Option<&Learned> {
        self.learned
    }

    fn mask(&self, camera: usize, frame: usize) -> Result<Option<Planes<f32>>> {
        let Some(masks) = self.masks.get(camera) else { return Ok(None) };
        let mask = Rgb8::read(&self.folder.join(&masks.files[frame]))?;
        let mut out = Planes::new(1, mask.height, mask.width);
        out.data.iter_mut().zip(mask.data.chunks_exact(3)).for_each(|(v, p)| *v = f32::from(p[0]) / 255.0);
        Ok(Some(out))
    }

    fn load(&self, camera: usize, frame: usize) -> Result<Planes<f32>> {
        let picture = self.rgb(camera, frame)?;
        if [picture.width, picture.height] != self.pictures[camera].size {
            return Err(Error::input("a stored image is of another size than the rest")
                .at(self.folder.join(self.pictures[camera].file(frame)).display())
                .remedy("Remove the folder \"images\" and import again."));
        }
        let mut out = Planes::new(3, picture.height, picture.width);
        let count = picture.width * picture.height;
        for (i, pixel) in picture.data.chunks_exact(3).enumerate() {
            for c in 0..3 {
                out.data[c * count + i] = f32::from(pixel[c]) / 255.0;
            }
        }
        Ok(out)
    }
}
