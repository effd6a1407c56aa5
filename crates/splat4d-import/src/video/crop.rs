//! Parts of images that are kept: a rectangle that the user gives, or what black bars leave.

use super::{EXAMINED, Frame, Selection, Source};
use crate::calibration::bars;
use splat4d::scene::Planes;
use splat4d::{Error, Result};

/// Pixels next to a bar that codecs mix with it; they are cut off too.
const MIXED: usize = 2;
/// Share of a side that bars take at most: a film that is darker was filmed with the cap on.
const MOST: f64 = 0.6;

/// A rectangle of an upright image, pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Crop {
    /// Pixels across.
    pub width: usize,
    /// Pixels down.
    pub height: usize,
    /// The first column.
    pub x: usize,
    /// The first row.
    pub y: usize,
}

impl Crop {
    /// An error unless it is in an image of this size.
    pub(super) fn check(&self, [width, height]: [usize; 2]) -> Result<()> {
        let inside = |from: usize, length: usize, most: usize| {
            length > 0 && from.checked_add(length).is_some_and(|end| end <= most)
        };
        if inside(self.x, self.width, width) && inside(self.y, self.height, height) {
            return Ok(());
        }
        let Self { width: w, height: h, x, y } = self;
        Err(Error::input(format!("the part {w}:{h}:{x}:{y} does not lie in images of {width}x{height}"))
            .remedy("Give --crop W:H:X:Y in pixels of the video, or --crop auto."))
    }

    /// The rectangle of an image with `channels` interleaved samples a pixel.
    pub(super) fn of(&self, data: &[u8], width: usize, channels: usize) -> Vec<u8> {
        let row = |y: usize| {
            let from = (y * width + self.x) * channels;
            &data[from..from + self.width * channels]
        };
        (self.y..self.y + self.height).flat_map(row).copied().collect()
    }
}

/// Which parts of images are kept.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cropping {
    /// The area inside black bars, found for every camera.
    Auto,
    /// The same rectangle of every camera.
    At(Crop),
}

/// Finds what black bars leave of a source's images; `None`: there are none. Dark content is hardly ever dark in all
/// examined frames.
///
/// Errors: those of reading.
pub(crate) fn without_bars(source: &dyn Source, selection: &Selection) -> Result<Option<Crop>> {
    let selection = Selection { size: None, crop: None, ..selection.clone() };
    let mut reader = source.frames(&selection.spread(source.info()))?;
    let (mut frame, mut grey) = (Frame::default(), Vec::new());
    while grey.len() < EXAMINED && reader.next(&mut frame)? {
        let p = &frame.picture;
        // The brightest channel: a saturated colour is content.
        let data = p.data.chunks_exact(3).map(|c| f32::from(c[0].max(c[1]).max(c[2])) / 255.0).collect();
        grey.push(Planes { channels: 1, height: p.height, width: p.width, data });
    }
    let Some(first) = grey.first() else { return Ok(None) };
    let (size, found) = ([first.width, first.height], bars(&grey).map(|v| v as usize));
    Ok(kept(size, found))
}

/// The rectangle between bars at the left, above, at the right and below.
fn kept(size: [usize; 2], bars: [usize; 4]) -> Option<Crop> {
    // Chroma is stored for pairs of pixels.
    let side = |bar: usize| if bar == 0 { 0 } else { (bar + MIXED).next_multiple_of(2) };
    let [left, above, right, below] = bars.map(side);
    let most = |cut: usize, side: usize| cut as f64 <= MOST * side as f64;
    let some = left + above + right + below > 0;
    let crop = || Crop { width: size[0] - left - right, height: size[1] - above - below, x: left, y: above };
    (some && most(left + right, size[0]) && most(above + below, size[1])).then(crop)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bars_are_cut_off_and_dark_films_are_left_alone() {
        let crop = kept([1920, 1080], [0, 131, 0, 131]).unwrap();
        assert_eq!(crop, Crop { width: 1920, height: 812, x: 0, y: 134 });
        assert_eq!(kept([1920, 1080], [0; 4]), None);
        assert_eq!(kept([1920, 1080], [0, 540, 0, 540]), None, "a dark film has no bars");
    }

    #[test]
    fn a_rectangle_inside_the_image_is_cropped_and_others_refused() {
        let crop = Crop { width: 2, height: 1, x: 1, y: 1 };
        assert!(crop.check([3, 2]).is_ok());
        assert_eq!(crop.of(&[0, 1, 2, 3, 4, 5], 3, 1), [4, 5]);
        for bad in [
            Crop { x: 2, ..crop },
            Crop { height: 2, ..crop },
            Crop { width: 0, ..crop },
            Crop { x: usize::MAX, ..crop },
        ] {
            let error = bad.check([3, 2]).unwrap_err().to_string();
            assert!(error.contains("3x2"), "{error}");
        }
    }
}
