//! Images inside the page: held-out views next to their truth and error, as small JPEGs in data URIs.

use crate::draw::Rgb;
use crate::draw::color_rgb;
use crate::files::{self, base64};
use splat4d::scene::Planes;
use splat4d_train::capture::Rgb8;
use splat4d_train::encode;
use splat4d_train::eval::metrics::error_map;
use std::path::{Path, PathBuf};

/// Width of an image in the page, pixels: three fit side by side on a wide screen.
const WIDTH: usize = 420;
/// JPEG quality: no artefact that could be taken for one of the scene's.
const QUALITY: u8 = 90;
/// Largest film that is put inside the page, bytes; a larger one is linked.
const FILM_BYTES: u64 = 6 << 20;

/// A mean difference of the channels as large as this is the last colour of [`difference`]: compression changes less
/// than training leaves wrong.
const DIFFERENCE_FULL: f32 = 0.1;
/// The same in words.
pub(super) const DIFFERENCE_WORDS: &str = "a tenth";

/// A JPEG data URI of an image file, reduced; `None` where it cannot be read.
pub(super) fn inline(path: &Path) -> Option<String> {
    reduced(&Rgb8::read(path).ok()?)
}

/// The same of where two images differ; `None` where one cannot be read or their sizes differ.
pub(super) fn difference(a: &Path, b: &Path) -> Option<String> {
    let read = |path: &Path| {
        let Rgb8 { width, height, data } = Rgb8::read(path).ok()?;
        let unit: Vec<f32> = data.iter().map(|&v| f32::from(v) / 255.0).collect();
        Some(Planes::from_interleaved(3, height, width, &unit))
    };
    let (a, b) = (read(a)?, read(b)?);
    if (a.width, a.height) != (b.width, b.height) {
        return None;
    }
    let Rgb { width, height, data } = color_rgb(&error_map(&a, &b, DIFFERENCE_FULL));
    reduced(&Rgb8 { width, height, data })
}

/// A JPEG data URI of an image, reduced.
pub(super) fn reduced(picture: &Rgb8) -> Option<String> {
    let size = [picture.width, picture.height];
    let bytes = if picture.width > WIDTH {
        let small = [WIDTH, (picture.height * WIDTH / picture.width).max(1)];
        encode::jpeg(&encode::resample(&picture.data, 3, size, small), small, QUALITY)
    } else {
        encode::jpeg(&picture.data, size, QUALITY)
    };
    let bytes = bytes.ok()?;
    Some(format!("data:image/jpeg;base64,{}", base64(&bytes)))
}

/// The orbit film: inside the page if small, else linked next to it.
pub(super) fn film(run: &Path) -> Option<String> {
    film_file(&orbit(run)?, "The scene, from a camera on an orbit")
}

/// A film's file: inside the page if small, else linked next to it.
pub(super) fn film_file(path: &Path, alt: &str) -> Option<String> {
    let video = path.extension().is_some_and(|e| e == "mp4");
    let small = path.metadata().ok()?.len() <= FILM_BYTES;
    let name = path.file_name()?.to_string_lossy().into_owned();
    let source = if small {
        let kind = if video { "video/mp4" } else { "image/png" };
        format!("data:{kind};base64,{}", base64(&files::read(path).ok()?))
    } else {
        name
    };
    Some(if video {
        format!(r#"<video controls loop muted autoplay playsinline src="{source}"></video>"#)
    } else {
        format!(r#"<img class="film" alt="{alt}" src="{source}">"#)
    })
}

fn orbit(run: &Path) -> Option<PathBuf> {
    ["orbit.mp4", "orbit.png"].map(|name| run.join(name)).into_iter().find(|path| path.is_file())
}

/// `count` indices spread evenly over 0..n, the first and last among them.
pub(crate) fn spread(n: usize, count: usize) -> Vec<usize> {
    match n.min(count) {
        0 => Vec::new(),
        1 => vec![0],
        m => (0..m).map(|i| i * (n - 1) / (m - 1)).collect(),
    }
}
