//! [`Emphasis`]: larger weights for pixels of dynamic regions. These are a small part of most images and the hardest,
//! because a static Gaussian is trained by every frame and a moving one only by those of its lifespan.
//!
//! Source: the importance of DyNeRF (Li et al. 2022) by the distance from the temporal median, which draws rays there
//! and weighs pixels here: w = 1 + k·⅓ Σ_c ψ(I_c − median_c), ψ(x) = x²/(x² + γ²).

use crate::Result;
use crate::capture::frames::{Frames, Picture};
use crate::vision::view::{self, Rigs};
use rayon::prelude::*;
use splat4d::scene::Planes;
use splat4d::simd::{Pass, Simd, dispatch_pass};
use std::collections::BTreeMap;

/// γ: at this distance from the median a channel counts half (K-Planes' setting of DyNeRF's for all frames).
const GAMMA: f32 = 0.02;
/// Rows of pixels of a task: for fewer, scheduling would cost more than the work.
const ROWS: usize = 16;

/// Weights of pixels by how much they differ from the static background; none where cameras move, or have few images.
pub(crate) struct Emphasis {
    /// k: how much more than others a pixel weighs that shows nothing but what moves.
    strength: f32,
    /// By camera: its temporal median, channel by channel at the size that images are examined in, as bytes.
    still: BTreeMap<usize, [Vec<u8>; 3]>,
    /// Scratch: Σ ψ/3 by pixel at that size.
    moves: Planes<f32>,
}

impl Emphasis {
    /// Computes the static background. `None`: nothing is emphasised. Errors: an image cannot be read.
    pub(crate) fn new(frames: &dyn Frames, strength: f64) -> Result<Option<Self>> {
        if strength <= 0.0 {
            return Ok(None);
        }
        let rigs = Rigs::all(frames);
        if !rigs.have_medians() {
            return Ok(None);
        }
        let Rigs::Fixed(cameras) = &rigs else { return Ok(None) };
        let ids = cameras.iter().map(|frames_of| frames.rig(frames_of[0]));
        let planes = |colors: &[[u8; 3]]| [0, 1, 2].map(|c| colors.iter().map(|pixel| pixel[c]).collect());
        let still = ids.zip(rigs.still(frames)?).map(|(id, view)| (id, planes(&view.colors))).collect();
        Ok(Some(Self { strength: strength as f32, still, moves: Planes::default() }))
    }

    /// Multiplies the weights of a whole image of camera `rig`, which is not yet halved.
    pub(super) fn apply(&mut self, rig: usize, picture: &mut Picture) {
        let Some(still) = self.still.get(&rig) else { return };
        let (width, height) = (picture.color.width, picture.color.height);
        let halvings = view::halvings(width, height);
        let mut small;
        let color = match halvings {
            0 => &picture.color,
            _ => {
                small = picture.color.clone();
                (0..halvings).for_each(|_| small.halve());
                &small
            }
        };
        self.moves.reset(1, color.height, color.width);
        assert_eq!(still[0].len(), color.pixels(), "images of one camera have one size");
        // Rows in parallel: in series this was a twentieth of a step on two cores, and a quarter next to a graphics
        // card.
        let simd = Simd::detect();
        self.moves.data.par_chunks_mut(color.width).with_min_len(ROWS).enumerate().for_each(|(y, row)| {
            let of_row = y * color.width..(y + 1) * color.width;
            let color = [0, 1, 2].map(|c| &color.plane(c)[of_row.clone()]);
            let still = still.each_ref().map(|plane| &plane[of_row.clone()]);
            dispatch_pass(simd, &Moves { color, still }, &mut (), row);
        });
        let weight = picture.weight.get_or_insert_with(|| {
            let mut all = Planes::new(1, height, width);
            all.data.fill(1.0);
            all
        });
        let (moves, strength) = (&self.moves.data, self.strength);
        weight.data.par_chunks_mut(width).with_min_len(ROWS).enumerate().for_each(|(y, row)| {
            // An odd last row or column is left out where images are halved: it is like the one before.
            let from = (y >> halvings).min(color.height - 1) * color.width;
            let moves = &moves[from..from + color.width];
            if halvings == 0 {
                row.iter_mut().zip(moves).for_each(|(w, m)| *w *= 1.0 + strength * m);
            } else {
                let at = |x: usize| (x >> halvings).min(moves.len() - 1);
                row.iter_mut().enumerate().for_each(|(x, w)| *w *= 1.0 + strength * moves[at(x)]);
            }
        });
    }
}

/// Adds Σ_c ψ(I_c − median_c)/3 of a row of pixels.
struct Moves<'a> {
    color: [&'a [f32]; 3],
    still: [&'a [u8]; 3],
}

impl Pass for Moves<'_> {
    type Scratch = ();
    type Into = [f32];
    type Out = ();

    #[inline(always)]
    fn run<const FMA: bool>(&self, (): &mut (), out: &mut [f32]) {
        for (color, still) in self.color.iter().zip(&self.still) {
            for ((out, v), still) in out.iter_mut().zip(*color).zip(*still) {
                let x = v - f32::from(*still) / 255.0;
                *out += x * x / (x * x + GAMMA * GAMMA) / 3.0;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::step::tests::Made;

    #[test]
    fn weights_follow_the_distance_from_the_median_and_unfilled_pixels_have_none() {
        let frames = Made::new(3, 5, 24);
        let mut emphasis = Emphasis::new(&frames, 2.0).unwrap().expect("cameras stand still and have five moments");
        let load = |i: usize| {
            let mut picture = Picture::default();
            frames.load(i, &mut picture).unwrap();
            picture
        };
        let (rig, shown) = (1, 1 + 4 * 3);
        let others: Vec<Picture> = (0..5).map(|k| load(rig + 3 * k)).collect();
        let mut picture = load(shown);
        emphasis.apply(rig, &mut picture);
        let weight = picture.weight.take().unwrap();
        let mut moving = 0;
        for (p, w) in weight.data.iter().enumerate() {
            let psi = |c: usize| {
                let mut all: Vec<f32> = others.iter().map(|o| o.color.plane(c)[p]).collect();
                all.sort_by(f32::total_cmp);
                let far = |from: f32| f64::from(picture.color.plane(c)[p] - from);
                let psi = |x: f64| x * x / (x * x + f64::from(GAMMA).powi(2));
                psi(far(all[2]))
            };
            let expected = 1.0 + 2.0 * (0..3).map(psi).sum::<f64>() / 3.0;
            // The median is kept as bytes: half a step of 1/255 moves ψ by at most 0.064.
            assert!((f64::from(*w) - expected).abs() < 0.13, "pixel {p}: {w} {expected}");
            moving += usize::from(*w > 2.0);
        }
        assert!(moving > 10, "{moving} pixels show the ball where it was not before");
        let mut filled = Planes::new(1, weight.height, weight.width);
        filled.data[0] = 1.0;
        picture.weight = Some(filled);
        emphasis.apply(rig, &mut picture);
        let weight = picture.weight.unwrap();
        assert!(weight.data[0] >= 1.0 && weight.data[1..].iter().all(|w| *w == 0.0), "what the lens never filled");
    }

    #[test]
    fn without_fixed_cameras_or_times_all_pixel_weights_are_one() {
        assert!(Emphasis::new(&Made::new(3, 5, 4), 0.0).unwrap().is_none());
        assert!(Emphasis::new(&Made::new(3, 2, 4), 1.0).unwrap().is_none(), "two moments have no median");
    }

    /// Images that are larger than the size that is worked with: every pixel has a weight.
    #[test]
    fn weights_are_those_of_the_place_in_a_smaller_image() {
        let (width, height) = (801, 603);
        let small = [width / 2, height / 2];
        let mut emphasis = Emphasis {
            strength: 1.0,
            still: [(0, [0, 1, 2].map(|_| vec![0; small[0] * small[1]]))].into(),
            moves: Planes::default(),
        };
        let mut picture = Picture { color: Planes::new(3, height, width), ..Picture::default() };
        let bright = |x: usize, y: usize| (200..204).contains(&x) && (100..102).contains(&y);
        for c in 0..3 {
            for (p, v) in picture.color.plane_mut(c).iter_mut().enumerate() {
                *v = f32::from(bright(p % width, p / width));
            }
        }
        emphasis.apply(0, &mut picture);
        let weight = picture.weight.unwrap();
        for (p, w) in weight.data.iter().enumerate() {
            let expected = if bright(p % width, p / width) { 2.0 } else { 1.0 };
            assert!((w - expected).abs() < 1e-3, "pixel {p}: {w}");
        }
    }
}
