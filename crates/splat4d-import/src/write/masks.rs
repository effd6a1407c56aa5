//! Masks next to images: white where the image counts, stored in the size of the images.

use super::Pictures;
use crate::video::fnv1a;
use rayon::prelude::*;
use splat4d::{Error, ErrorKind, Result};
use splat4d_train::capture::Rgb8;
use splat4d_train::encode::{self, Pixels};
use splat4d_train::event::Progress;
use splat4d_train::run::checkpoint::write_atomically;
use std::path::{Path, PathBuf};

/// Endings of images that masks may have.
const ENDINGS: [&str; 4] = ["png", "jpg", "jpeg", "webp"];

/// The masks of a camera's stored images.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Masks {
    /// One file for each image, from the capture's folder on; all may be the same.
    pub files: Vec<PathBuf>,
    /// Changes when the masks do.
    pub fingerprint: u64,
}

/// Start of a camera's images in its video.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Begin {
    /// The second that reading began at; none: the first frame.
    pub from: Option<f64>,
}

/// Stores the masks of all cameras below `folder`, as `masks/NAME/000000.png` and so on. `from` holds for each
/// camera an image
/// `NAME.png` for the whole recording, or a folder `NAME` with one for each frame of its video, in the order of names.
///
/// Errors: a camera without masks, fewer masks than frames, masks of another shape, no space; of kind `Interrupted`
/// where `stop` requested it.
pub(crate) fn masks(
    folder: &Path,
    from: &Path,
    pictures: &[Pictures],
    begins: &[Begin],
    progress: &mut Progress<'_>,
    stop: &dyn Fn() -> bool,
) -> Result<Vec<Masks>> {
    let mut out = Vec::with_capacity(pictures.len());
    for (k, (p, begin)) in pictures.iter().zip(begins).enumerate() {
        progress.phase("masks", k, pictures.len());
        if stop() {
            return Err(Error::new(ErrorKind::Interrupted, "stopped while masks were stored")
                .remedy("Run the same command again to continue."));
        }
        out.push(camera(folder, from, p, *begin).map_err(|e| e.at(format!("camera {}", p.name)))?);
    }
    Ok(out)
}

fn camera(folder: &Path, from: &Path, pictures: &Pictures, begin: Begin) -> Result<Masks> {
    let to = Path::new("masks").join(&pictures.name);
    let single = ENDINGS.iter().map(|e| from.join(format!("{}.{e}", pictures.name))).find(|p| p.is_file());
    if let Some(mask) = single {
        let file = to.join("000000.png");
        let fingerprint = store(&mask, &folder.join(&file), pictures.size)?;
        return Ok(Masks { files: vec![file; pictures.shots.len()], fingerprint });
    }
    let own = from.join(&pictures.name);
    if !own.is_dir() {
        return Err(Error::input("it has no masks").at(from.display()).remedy(format!(
            "Add {}.png for the whole recording, or a folder {} with one for each frame: white where the image counts.",
            pictures.name, pictures.name
        )));
    }
    let all = std::fs::read_dir(&own).map_err(|e| Error::io("the folder cannot be read", e).at(own.display()))?;
    let picture = |p: &PathBuf| {
        p.extension().is_some_and(|e| ENDINGS.contains(&e.to_string_lossy().to_ascii_lowercase().as_str()))
    };
    let mut masks: Vec<PathBuf> = all.filter_map(|e| e.ok().map(|e| e.path())).filter(picture).collect();
    masks.sort();
    let numbers = numbers(pictures, begin)?;
    let last = numbers.iter().copied().max().unwrap_or(0);
    if last >= masks.len() {
        return Err(Error::input(format!("there are {} masks, but frame {last} of the video is stored", masks.len()))
            .at(own.display())
            .remedy("Give one for each frame of the video, those that are left out too."));
    }
    let one = |(k, &number): (usize, &usize)| {
        store(&masks[number], &folder.join(&to).join(format!("{k:06}.png")), pictures.size)
    };
    let prints = numbers.par_iter().enumerate().map(one).collect::<Result<Vec<u64>>>()?;
    let fingerprint = fnv1a(&prints.iter().flat_map(|p| p.to_le_bytes()).collect::<Vec<u8>>());
    Ok(Masks { files: (0..numbers.len()).map(|k| to.join(format!("{k:06}.png"))).collect(), fingerprint })
}

/// The numbers of stored images among all frames of the video.
fn numbers(pictures: &Pictures, begin: Begin) -> Result<Vec<usize>> {
    let Some(from) = begin.from.filter(|f| *f > 0.0) else {
        return Ok(pictures.shots.iter().map(|s| s.number).collect());
    };
    // Frames before the part that was read were not counted.
    if pictures.clock.variable || pictures.clock.interval <= 0.0 {
        return Err(Error::input(format!(
            "its frame rate varies, and it is read from {from:.2} s on: which mask is which frame's is not known"
        ))
        .remedy("Give one mask for the whole recording, or cut the video and its masks beforehand."));
    }
    Ok(pictures.shots.iter().map(|s| (s.time / pictures.clock.interval).round() as usize).collect())
}

/// Stores a mask in a size, black and white, and returns what changes with it; a file that is there is of another run
/// and is written again.
fn store(from: &Path, to: &Path, [width, height]: [usize; 2]) -> Result<u64> {
    let mask = Rgb8::read(from)?;
    let off = (mask.width * height).abs_diff(mask.height * width);
    // Sides are whole pixels.
    if off > mask.width.max(mask.height).max(width).max(height) {
        return Err(Error::input(format!(
            "the mask has {}x{} pixels, its image {width}x{height}",
            mask.width, mask.height
        ))
        .at(from.display())
        .remedy("Masks must show the same part as images, in any size."));
    }
    // Masks of zeros and ones are meant to be black and white.
    let most = mask.data.iter().copied().max().unwrap_or(0);
    let gain = if most == 1 { 255 } else { 1 };
    let value =
        |x: usize, y: usize| mask.data[3 * (y * mask.height / height * mask.width + x * mask.width / width)] * gain;
    let data: Vec<u8> = (0..width * height).map(|p| value(p % width, p / width)).collect();
    let bytes = encode::png(Pixels::Eight(&data), [width, height], 1);
    write_atomically(to, &bytes)?;
    Ok(fnv1a(&bytes))
}
