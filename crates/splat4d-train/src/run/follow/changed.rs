//! Where the images of a new frame disagree with the scene, and which Gaussians these pixels show.
//!
//! Images are compared by tiles, and a tile disagrees where its error is larger than it was before: what the scene never
//! showed well is no change. A Gaussian's share is Σ w over pixels of such tiles by Σ w over all pixels of all views,
//! w = αT its weight in a pixel, so that the background behind a moving object is left alone where cameras still see it
//! unchanged.

use crate::Result;
use crate::blended::Blended;
use crate::capture::Capture;
use crate::capture::frames::{Frames, Picture};
use crate::run::dataset::Dataset;
use crate::run::metrics::psnr;
use crate::train_state::Exposure;
use crate::vision::view::View;
use splat4d::layers::{Evaluation, Scene};
use splat4d::scene::{Planes, Table};

/// Side of a tile, pixels: some Gaussians' size.
const TILE: usize = 8;
/// Pixels of weight that a Gaussian needs in all views together: below it no image shows it.
const SEEN: f32 = 0.05;
/// By how much a tile's least error may rise from frame to frame, as a factor and added to it: light changes slowly, and
/// errors that stay must not make a tile change forever.
const RISE: (f32, f32) = (1.1, 1e-3);

/// A pixel shows something that is not in the scene where colours differ by more than the first number (mean of the
/// channels, in [0, 1]), blurred by a radius of the second, pixels: edges that are off by a pixel do not. 0.1 and 1 pixel
/// gained as much where the bundled crate appears, and added more points again in the frame after it
/// (studies/records/2026-11-28-follow.md).
const NEW_HERE: (f32, f64) = (0.2, 2.0);

/// Mean absolute errors of the tiles of all views, one after the other.
pub(super) type TileErrors = Vec<f32>;

/// A view's errors: those of its tiles, and the mean squared one of its pixels.
struct Compared {
    tiles: Vec<f32>,
    /// Tiles in a row.
    across: usize,
    mse: f64,
}

impl Compared {
    /// The tiles whose error rose by more than `rise` over that in `before`, where this view's begin at `first`, and their
    /// neighbours; none: it is no tile.
    fn changed(&self, before: &TileErrors, first: &mut usize, rise: f32) -> Option<Vec<bool>> {
        let known = before.get(*first..*first + self.tiles.len());
        *first += self.tiles.len();
        let own: Vec<bool> =
            (0..self.tiles.len()).map(|t| self.tiles[t] > known.map_or(0.0, |known| known[t]) + rise).collect();
        own.contains(&true).then(|| dilated(&own, self.across))
    }
}

/// Renders views of one frame and compares them with its images.
pub(super) struct Comparison<'a> {
    pub(super) scene: &'a Scene<f32>,
    pub(super) capture: &'a Capture,
    /// The images to compare with, and their numbers in the capture.
    pub(super) frames: &'a Dataset,
    pub(super) numbers: &'a [usize],
    pub(super) exposure: Option<&'a Exposure>,
}

impl Comparison<'_> {
    /// Renders one view, with two columns of ones if their gradients are needed.
    fn view(&self, i: usize, work: &mut Blended, picture: &mut Picture) -> Result<Compared> {
        self.frames.load(i, picture)?;
        work.draw(self.scene, self.capture, self.numbers[i], ones);
        if let Some(exposure) = self.exposure {
            let frame = &self.capture.frames[self.numbers[i]];
            exposure.respond(frame.camera, frame.time, &mut work.image.color);
        }
        Ok(compare(&work.image.color, &picture.color, picture.weight.as_ref()))
    }

    /// Errors of all tiles, and the mean PSNR of the views, dB; none: there is no view.
    pub(super) fn errors(&self) -> Result<(TileErrors, Option<f64>)> {
        let (mut work, mut picture) = (Blended::default(), Picture::default());
        let (mut tiles, mut sum) = (Vec::new(), 0.0);
        for i in 0..self.frames.len() {
            let view = self.view(i, &mut work, &mut picture)?;
            tiles.extend(view.tiles);
            sum += psnr(view.mse);
        }
        let count = self.frames.len();
        Ok((tiles, (count > 0).then(|| sum / count as f64)))
    }

    /// Mean squared error of at most `most` views, evenly chosen.
    pub(super) fn error(&self, most: usize) -> Result<f64> {
        let (mut work, mut picture, mut sum) = (Blended::default(), Picture::default(), 0.0);
        let count = self.frames.len().min(most);
        for k in 0..count {
            sum += self.view(k * self.frames.len() / count, &mut work, &mut picture)?.mse;
        }
        Ok(sum / count.max(1) as f64)
    }

    /// Rows of the first layer whose share of tiles that disagree is at least `share`. `before`: errors before the
    /// frame; a tile disagrees where they rise by more than `rise`.
    pub(super) fn rows(&self, before: &TileErrors, rise: f32, share: f32) -> Result<Vec<u32>> {
        let (mut work, mut picture) = (Blended::default(), Picture::default());
        let mut sums = vec![[0.0f32; 2]; self.scene.layers[0].params.len()];
        let mut first = 0;
        for i in 0..self.frames.len() {
            let view = self.view(i, &mut work, &mut picture)?;
            let Some(changed) = view.changed(before, &mut first, rise) else {
                // Its pixels count as unchanged.
                self.add(&mut work, i, &|_, _| 0.0, &mut sums);
                continue;
            };
            let at = |x: usize, y: usize| f32::from(u8::from(changed[y / TILE * view.across + x / TILE]));
            self.add(&mut work, i, &at, &mut sums);
        }
        let active = |(_, [changed, all]): &(usize, &[f32; 2])| *all > SEEN && *changed >= share * all;
        Ok(sums.iter().enumerate().filter(active).map(|(row, _)| row as u32).collect())
    }

    /// The images, with those pixels to search in that show something new: unlike the scene, in tiles that disagree (as in
    /// [`rows`](Self::rows)).
    pub(super) fn new_here(&self, before: &TileErrors, rise: f32) -> Result<Vec<View>> {
        let (mut work, mut picture) = (Blended::default(), Picture::default());
        let (mut first, mut out) = (0, Vec::new());
        for i in 0..self.frames.len() {
            let view = self.view(i, &mut work, &mut picture)?;
            let changed = view.changed(before, &mut first, rise);
            let (camera, width) = (&self.capture.frames[self.numbers[i]].view, picture.color.width);
            let wanted = (0..picture.color.pixels()).map(|p| {
                let filled = picture.weight.as_ref().is_none_or(|w| w.data[p] == 1.0);
                filled && changed.as_ref().is_some_and(|c| c[p / width / TILE * view.across + p % width / TILE])
            });
            let mut shown = View::new(camera.clone(), &picture.color, wanted.collect());
            shown.keep_unlike(&View::new(camera.clone(), &work.image.color, Vec::new()).colors, NEW_HERE.0, NEW_HERE.1);
            out.push(shown);
        }
        Ok(out)
    }

    /// Adds each row's weight in pixels, times `changed` and as it is.
    fn add(&self, work: &mut Blended, i: usize, changed: &dyn Fn(usize, usize) -> f32, sums: &mut [[f32; 2]]) {
        let (height, width) = (work.image.color.height, work.image.color.width);
        let mut d = Planes::new(2, height, width);
        for y in 0..height {
            for x in 0..width {
                d.plane_mut(0)[y * width + x] = changed(x, y);
            }
        }
        d.plane_mut(1).fill(1.0);
        work.back(self.scene, self.capture, self.numbers[i], &d, |[layer, row], splat, d, _| {
            if layer == 0 {
                let [changed, all] = d.read::<2>(splat, 0);
                sums[row][0] += changed;
                sums[row][1] += all;
            }
        });
    }
}

/// What later frames are compared with: the present errors, which may rise only slowly.
pub(super) fn settled(before: &TileErrors, now: TileErrors) -> TileErrors {
    if before.len() != now.len() {
        return now;
    }
    before.iter().zip(now).map(|(b, n)| n.min(RISE.0 * b + RISE.1)).collect()
}

/// Two columns of ones for every splat.
fn ones(seen: &Evaluation<f32>) -> Table<f32> {
    let rows = seen.tapes().map(|tape| tape.out().rows()).sum();
    let mut table = Table::new(&[("changed", 1), ("seen", 1)], rows);
    table.fill(1.0);
    table
}

/// The tiles and their neighbours.
fn dilated(tiles: &[bool], across: usize) -> Vec<bool> {
    let down = tiles.len() / across;
    let near = |at: usize, n: usize| at.saturating_sub(1)..=(at + 1).min(n - 1);
    let any = |t: usize| near(t / across, down).any(|y| near(t % across, across).any(|x| tiles[y * across + x]));
    (0..tiles.len()).map(any).collect()
}

/// Compares two images, where the lens recorded something.
fn compare(drawn: &Planes<f32>, truth: &Planes<f32>, weight: Option<&Planes<f32>>) -> Compared {
    let (width, height) = (truth.width, truth.height);
    let across = width.div_ceil(TILE);
    let mut sums = vec![[0.0f64; 2]; across * height.div_ceil(TILE)];
    let (mut squares, mut pixels) = (0.0, 0.0);
    for y in 0..height {
        for x in 0..width {
            let p = y * width + x;
            let w = weight.map_or(1.0, |w| f64::from(w.data[p]));
            let off: [f64; 3] = std::array::from_fn(|c| f64::from(drawn.plane(c)[p] - truth.plane(c)[p]));
            let [sum, count] = &mut sums[y / TILE * across + x / TILE];
            *sum += w * off.iter().map(|d| d.abs()).sum::<f64>() / 3.0;
            *count += w;
            squares += w * off.iter().map(|d| d * d).sum::<f64>() / 3.0;
            pixels += w;
        }
    }
    let tiles = sums.iter().map(|[sum, count]| if *count > 0.0 { (sum / count) as f32 } else { 0.0 }).collect();
    Compared { tiles, across, mse: squares / f64::max(pixels, 1.0) }
}
