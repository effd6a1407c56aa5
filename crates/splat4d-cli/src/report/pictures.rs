//! Pictures inside the page: held-out views beside their truth and error, as small JPEGs in data URIs.

use crate::files::base64;
use image::RgbImage;
use image::codecs::jpeg::JpegEncoder;
use image::imageops::{FilterType, resize};
use std::path::{Path, PathBuf};

/// Width of a picture in the page, pixels: three stand side by side on a wide screen.
const WIDTH: u32 = 420;
/// JPEG quality: no artefact that could be taken for one of the scene's.
const QUALITY: u8 = 90;
/// Largest film that is put inside the page, bytes; a larger one is linked.
const FILM_BYTES: u64 = 6 << 20;

/// A JPEG data URI of a picture file, reduced; `None` where it cannot be read.
pub(super) fn inline(path: &Path) -> Option<String> {
    let picture = image::open(path).ok()?.to_rgb8();
    let (w, h) = picture.dimensions();
    let picture: RgbImage = if w > WIDTH {
        let height = ((u64::from(h) * u64::from(WIDTH)) / u64::from(w)).max(1) as u32;
        resize(&picture, WIDTH, height, FilterType::Triangle)
    } else {
        picture
    };
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, QUALITY).encode_image(&picture).ok()?;
    Some(format!("data:image/jpeg;base64,{}", base64(&bytes)))
}

/// The orbit film: inside the page if small, else linked beside it.
pub(super) fn film(run: &Path) -> Option<String> {
    let (path, video) = orbit(run)?;
    let small = path.metadata().ok()?.len() <= FILM_BYTES;
    let name = path.file_name()?.to_string_lossy().into_owned();
    let source = if small {
        let kind = if video { "video/mp4" } else { "image/png" };
        format!("data:{kind};base64,{}", base64(&std::fs::read(&path).ok()?))
    } else {
        name
    };
    Some(if video {
        format!(r#"<video controls loop muted autoplay playsinline src="{source}"></video>"#)
    } else {
        format!(r#"<img class="film" alt="The scene, seen from a camera that moves around it" src="{source}">"#)
    })
}

fn orbit(run: &Path) -> Option<(PathBuf, bool)> {
    [("orbit.mp4", true), ("orbit.png", false)]
        .into_iter()
        .map(|(name, video)| (run.join(name), video))
        .find(|(path, _)| path.is_file())
}

/// `count` indices spread evenly over 0..n, the first and last among them.
pub(super) fn spread(n: usize, count: usize) -> Vec<usize> {
    match n.min(count) {
        0 => Vec::new(),
        1 => vec![0],
        m => (0..m).map(|i| i * (n - 1) / (m - 1)).collect(),
    }
}
