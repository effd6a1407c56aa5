//! COLMAP's three files, binary and text. Counts are compared with the file's length before anything is reserved.

use crate::text;
use splat4d::scene::{Intrinsics, Lens};
use splat4d::{Error, ErrorKind, Result};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use super::json::read_bytes;
use super::{panorama, rig};

/// A camera's intrinsics.
#[derive(Clone, Debug)]
pub(super) struct Optics {
    /// Focal lengths and principal point.
    pub intrinsics: Intrinsics,
    /// Distortion.
    pub lens: Lens,
    /// Pixels across.
    pub width: usize,
    /// Pixels down.
    pub height: usize,
}

/// A registered image.
#[derive(Clone, Debug)]
pub(super) struct Registered {
    /// Rotation world to camera as a quaternion wxyz.
    pub quat: [f64; 4],
    /// Translation world to camera.
    pub translation: [f64; 3],
    /// Key of its [`Optics`].
    pub camera: u32,
    /// Path below `images/`.
    pub name: String,
}

/// A triangulated point.
#[derive(Clone, Copy, Debug)]
pub(super) struct Point {
    /// World position.
    pub position: [f64; 3],
    /// sRGB, 0 to 255.
    pub color: [u8; 3],
    /// Mean reprojection error, pixels.
    pub error: f64,
}

/// The models of COLMAP's `sensor/models.h`: name and number of parameters, by id.
const MODELS: [(&str, usize); 18] = [
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    ("SIMPLE_DIVISION", 4),
    ("DIVISION", 5),
    ("SIMPLE_FISHEYE", 3),
    ("FISHEYE", 4),
    ("EUCM", 6),
    ("EQUIRECTANGULAR", 2),
];

/// Least bytes of one entry in a binary file: camera (id, model, size, 2 parameters), image (id, pose, camera, empty
/// name, count), point (id, position, colour, error, track length).
const LEAST: [usize; 3] = [4 + 4 + 16 + 16, 4 + 56 + 4 + 1 + 8, 8 + 24 + 3 + 8 + 8];
/// Longest image name.
const MAX_NAME: usize = 4096;

fn truncated() -> Error {
    Error::input("the file is truncated")
}

/// Little-endian reader that cannot run over the end.
struct Cursor<'a>(&'a [u8]);

impl<'a> Cursor<'a> {
    fn take(&mut self, n: usize) -> Result<&'a [u8]> {
        let (head, tail) = self.0.split_at_checked(n).ok_or_else(truncated)?;
        self.0 = tail;
        Ok(head)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N]> {
        self.take(N)?.try_into().map_err(|_| truncated())
    }

    fn u32(&mut self) -> Result<u32> {
        Ok(u32::from_le_bytes(self.array()?))
    }

    fn u64(&mut self) -> Result<u64> {
        Ok(u64::from_le_bytes(self.array()?))
    }

    fn f64s<const N: usize>(&mut self) -> Result<[f64; N]> {
        let mut out = [0.0; N];
        for slot in &mut out {
            *slot = f64::from_le_bytes(self.array()?);
        }
        Ok(out)
    }

    /// Passes over `count` records of `size` bytes.
    fn skip(&mut self, count: u64, size: usize) -> Result<()> {
        let bytes = usize::try_from(count).ok().and_then(|n| n.checked_mul(size)).ok_or_else(truncated)?;
        self.take(bytes).map(|_| ())
    }

    /// The number of entries at the start, checked against what the file can hold.
    fn count(&mut self, least: usize) -> Result<u64> {
        let count = self.u64()?;
        let most = (self.0.len() / least) as u64;
        if count > most {
            let what = format!("the header claims {count} entries, but the file can hold {most}: it is truncated");
            return Err(Error::input(what));
        }
        Ok(count)
    }
}

/// A model that COLMAP has got since.
fn unknown_model(name: &str) -> Error {
    Error::new(ErrorKind::Unsupported, format!("the camera model {name:.40} is not known"))
        .remedy("Undistort with `colmap image_undistorter`, or reconstruct with OPENCV or OPENCV_FISHEYE.")
}

fn lens_of(name: &str, terms: [&[f64]; 3]) -> Lens {
    Lens::of_terms(name, terms).expect("the models are those of the list")
}

fn optics(id: u32, model: usize, size: [u64; 2], p: &[f64]) -> Result<Optics> {
    let named = |e: Error| e.at(format!("camera {id}"));
    let (name, _) = MODELS[model];
    let brown = |k: [f64; 6], p: [f64; 2]| Lens::Brown { k, p, s: [0.0; 4] };
    let single = |lens: Lens| (Intrinsics { fx: p[0], fy: p[0], cx: p[1], cy: p[2] }, lens);
    let double = |lens: Lens| (Intrinsics { fx: p[0], fy: p[1], cx: p[2], cy: p[3] }, lens);
    let (intrinsics, lens) = match name {
        "SIMPLE_PINHOLE" => single(Lens::Pinhole),
        "PINHOLE" => double(Lens::Pinhole),
        "SIMPLE_RADIAL" => single(brown([p[3], 0.0, 0.0, 0.0, 0.0, 0.0], [0.0; 2])),
        "RADIAL" => single(brown([p[3], p[4], 0.0, 0.0, 0.0, 0.0], [0.0; 2])),
        "OPENCV" => double(brown([p[4], p[5], 0.0, 0.0, 0.0, 0.0], [p[6], p[7]])),
        "FULL_OPENCV" => double(brown([p[4], p[5], p[8], p[9], p[10], p[11]], [p[6], p[7]])),
        "OPENCV_FISHEYE" => double(Lens::Fisheye { k: [p[4], p[5], p[6], p[7]] }),
        "SIMPLE_RADIAL_FISHEYE" => single(Lens::Fisheye { k: [p[3], 0.0, 0.0, 0.0] }),
        "RADIAL_FISHEYE" => single(Lens::Fisheye { k: [p[3], p[4], 0.0, 0.0] }),
        "FOV" => double(lens_of("fov", [&p[4..5], &[], &[]])),
        "THIN_PRISM_FISHEYE" => {
            double(lens_of("thin_prism_fisheye", [&[p[4], p[5], p[8], p[9]], &p[6..8], &p[10..12]]))
        }
        "RAD_TAN_THIN_PRISM_FISHEYE" => {
            double(lens_of("rad_tan_thin_prism_fisheye", [&p[4..10], &p[10..12], &p[12..16]]))
        }
        "SIMPLE_DIVISION" => single(Lens::Division { k: p[3] }),
        "DIVISION" => double(Lens::Division { k: p[4] }),
        "SIMPLE_FISHEYE" => single(Lens::Fisheye { k: [0.0; 4] }),
        "FISHEYE" => double(Lens::Fisheye { k: [0.0; 4] }),
        "EUCM" => double(Lens::Eucm { alpha: p[4], beta: p[5] }),
        "EQUIRECTANGULAR" => {
            let size = size.map(|v| usize::try_from(v).unwrap_or(usize::MAX));
            panorama::whole(size)
        }
        other => return Err(named(unknown_model(other))),
    };
    if p.iter().any(|v| !v.is_finite()) {
        return Err(named(Error::input("a parameter is NaN or infinite").remedy("Reconstruct that camera again.")));
    }
    // A lens without any terms is a pinhole, which needs no resampling.
    let lens = match lens {
        Lens::Brown { k, p, .. } if k == [0.0; 6] && p == [0.0; 2] => Lens::Pinhole,
        lens => lens,
    };
    let side = |v: u64| usize::try_from(v).unwrap_or(usize::MAX);
    let (width, height) = (side(size[0]), side(size[1]));
    super::pose::check_intrinsics(&intrinsics, width, height).map_err(named)?;
    Ok(Optics { intrinsics, lens, width, height })
}

/// Reads the cameras in `used` from `cameras.bin` or `cameras.txt`. Others may be of any model, and broken.
pub(super) fn cameras(folder: &Path, used: &BTreeSet<u32>) -> Result<BTreeMap<u32, Optics>> {
    let used = |id: u32| used.contains(&id);
    load(folder, "cameras", |bytes| cameras_bin(bytes, used), |text| cameras_txt(text, used))
}

/// Reads `images.bin` or `images.txt`.
pub(super) fn images(folder: &Path) -> Result<Vec<Registered>> {
    load(folder, "images", images_bin, images_txt)
}

/// Reads `points3D.bin` or `points3D.txt`; an empty list where neither exists.
pub(super) fn points(folder: &Path) -> Result<Vec<Point>> {
    let there = rig::has_any(folder, &["points3D.bin", "points3D.txt"]);
    if there { load(folder, "points3D", points_bin, points_txt) } else { Ok(Vec::new()) }
}

fn load<T>(folder: &Path, stem: &str, bin: impl Fn(&[u8]) -> Result<T>, txt: impl Fn(&str) -> Result<T>) -> Result<T> {
    let at = rig::Folder::new(folder);
    let [binary, text] = ["bin", "txt"].map(|ending| at.spelled(&format!("{stem}.{ending}")));
    let path = if binary.is_file() { &binary } else { &text };
    let bytes = read_bytes(path)?;
    let read = if path == &binary { bin(&bytes) } else { text::decode(&bytes).and_then(|text| txt(&text)) };
    read.map_err(|e| e.at(path.display()).remedy("Export the reconstruction again (colmap model_converter)."))
}

fn cameras_bin(bytes: &[u8], used: impl Fn(u32) -> bool) -> Result<BTreeMap<u32, Optics>> {
    let mut cursor = Cursor(bytes);
    let mut cameras = BTreeMap::new();
    for _ in 0..cursor.count(LEAST[0])? {
        let (id, model) = (cursor.u32()?, cursor.u32()? as usize);
        let size = [cursor.u64()?, cursor.u64()?];
        let (_, count) =
            *MODELS.get(model).ok_or_else(|| unknown_model(&format!("{model}")).at(format!("camera {id}")))?;
        let parameters = (0..count).map(|_| Ok(cursor.f64s::<1>()?[0])).collect::<Result<Vec<f64>>>()?;
        if used(id) {
            cameras.insert(id, optics(id, model, size, &parameters)?);
        }
    }
    Ok(cameras)
}

fn images_bin(bytes: &[u8]) -> Result<Vec<Registered>> {
    let mut cursor = Cursor(bytes);
    let mut images = Vec::new();
    for _ in 0..cursor.count(LEAST[1])? {
        cursor.u32()?;
        let (quat, translation, camera) = (cursor.f64s()?, cursor.f64s()?, cursor.u32()?);
        let end = cursor.0.iter().take(MAX_NAME).position(|&b| b == 0).ok_or_else(truncated)?;
        let name = String::from_utf8_lossy(cursor.take(end)?).into_owned();
        cursor.take(1)?;
        let points = cursor.u64()?;
        cursor.skip(points, 24)?;
        images.push(Registered { quat, translation, camera, name });
    }
    Ok(images)
}

fn points_bin(bytes: &[u8]) -> Result<Vec<Point>> {
    let mut cursor = Cursor(bytes);
    let mut points = Vec::new();
    for _ in 0..cursor.count(LEAST[2])? {
        cursor.u64()?;
        let (position, color) = (cursor.f64s()?, cursor.array()?);
        let [error] = cursor.f64s()?;
        let track = cursor.u64()?;
        cursor.skip(track, 8)?;
        points.push(Point { position, color, error });
    }
    Ok(points)
}

/// Numbered lines that are no comments.
fn lines(text: &str) -> impl Iterator<Item = (usize, &str)> {
    text.lines().enumerate().map(|(i, l)| (i + 1, l.trim())).filter(|(_, l)| !l.starts_with('#'))
}

fn word<'a, T: std::str::FromStr>(words: &mut impl Iterator<Item = &'a str>, line: usize, what: &str) -> Result<T> {
    let text = words.next().ok_or_else(|| Error::input(format!("line {line} ends before the {what}")))?;
    text.parse().map_err(|_| Error::input(format!("line {line}: expected the {what}, found \"{text:.40}\"")))
}

fn numbers<'a, const N: usize>(words: &mut impl Iterator<Item = &'a str>, line: usize, what: &str) -> Result<[f64; N]> {
    let mut out = [0.0; N];
    for slot in &mut out {
        *slot = word(words, line, what)?;
    }
    Ok(out)
}

fn cameras_txt(text: &str, used: impl Fn(u32) -> bool) -> Result<BTreeMap<u32, Optics>> {
    let mut cameras = BTreeMap::new();
    for (line, text) in lines(text).filter(|(_, l)| !l.is_empty()) {
        let mut words = text.split_ascii_whitespace();
        let id = word(&mut words, line, "camera id")?;
        if !used(id) {
            continue;
        }
        let model: String = word(&mut words, line, "camera model")?;
        let known = MODELS.iter().position(|(name, _)| *name == model);
        let model = known.ok_or_else(|| unknown_model(&model).at(format!("line {line}")))?;
        let size = [word(&mut words, line, "width")?, word(&mut words, line, "height")?];
        let parameters =
            (0..MODELS[model].1).map(|_| word(&mut words, line, "camera parameter")).collect::<Result<Vec<_>>>()?;
        cameras.insert(id, optics(id, model, size, &parameters)?);
    }
    Ok(cameras)
}

fn images_txt(text: &str) -> Result<Vec<Registered>> {
    let mut images = Vec::new();
    let mut lines = lines(text).peekable();
    while let Some((line, text)) = lines.next() {
        if text.is_empty() {
            continue;
        }
        let (words, name) = image_words(text);
        let mut words = words.into_iter();
        word::<u32>(&mut words, line, "image id")?;
        let (quat, translation) = (numbers(&mut words, line, "quaternion")?, numbers(&mut words, line, "translation")?);
        let camera = word(&mut words, line, "camera id")?;
        let name = Some(name).filter(|n| !n.is_empty());
        let name = name.ok_or_else(|| Error::input(format!("line {line} ends before the image's name")))?;
        images.push(Registered { quat, translation, camera, name: name.to_string() });
        // The image's 2D points follow on a line of their own, which may be empty. Scripts that have poses only leave
        // it out.
        lines.next_if(|(_, next)| !is_image_line(next));
    }
    Ok(images)
}

/// The first nine words of an image's line, and its name, which may hold spaces.
fn image_words(text: &str) -> (Vec<&str>, &str) {
    let (mut words, mut rest) = (Vec::with_capacity(9), text);
    while words.len() < 9 && !rest.is_empty() {
        let (word, after) = rest.split_at(rest.find(|c: char| c.is_ascii_whitespace()).unwrap_or(rest.len()));
        words.push(word);
        rest = after.trim_ascii_start();
    }
    (words, rest)
}

/// Whether a line of `images.txt` is an image's, not one of 2D points: its tenth word is a name, not a number; or its
/// words are not triples.
fn is_image_line(text: &str) -> bool {
    let words: Vec<&str> = text.split_ascii_whitespace().collect();
    let numbers = words.iter().take(9).filter(|w| w.parse::<f64>().is_ok()).count();
    let named = words.get(9).is_some_and(|name| name.parse::<f64>().is_err());
    numbers == 9 && (named || words.len() == 10)
}

fn points_txt(text: &str) -> Result<Vec<Point>> {
    let mut points = Vec::new();
    for (line, text) in lines(text).filter(|(_, l)| !l.is_empty()) {
        let mut words = text.split_ascii_whitespace();
        word::<u64>(&mut words, line, "point id")?;
        let position = numbers(&mut words, line, "position")?;
        let color = numbers::<3>(&mut words, line, "colour")?.map(|v| v.clamp(0.0, 255.0) as u8);
        let [error] = numbers(&mut words, line, "reprojection error")?;
        points.push(Point { position, color, error });
    }
    Ok(points)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_common_model_is_read() {
        let text = "1 SIMPLE_PINHOLE 8 6 5 4 3\n2 PINHOLE 8 6 5 6 4 3\n3 SIMPLE_RADIAL 8 6 5 4 3 .1\n\
                    4 RADIAL 8 6 5 4 3 .1 .2\n5 OPENCV 8 6 5 6 4 3 .1 .2 .3 .4\n\
                    6 OPENCV_FISHEYE 8 6 5 6 4 3 .1 .2 .3 .4\n\
                    7 FULL_OPENCV 8 6 5 6 4 3 .1 .2 .3 .4 .5 .6 .7 .8\n8 SIMPLE_RADIAL_FISHEYE 8 6 5 4 3 .1\n\
                    9 RADIAL_FISHEYE 8 6 5 4 3 .1 .2\n";
        let cameras = cameras_txt(text, |_| true).unwrap();
        let brown = |k, p| Lens::Brown { k, p, s: [0.0; 4] };
        let lenses = [
            Lens::Pinhole,
            Lens::Pinhole,
            brown([0.1, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0; 2]),
            brown([0.1, 0.2, 0.0, 0.0, 0.0, 0.0], [0.0; 2]),
            brown([0.1, 0.2, 0.0, 0.0, 0.0, 0.0], [0.3, 0.4]),
            Lens::Fisheye { k: [0.1, 0.2, 0.3, 0.4] },
            brown([0.1, 0.2, 0.5, 0.6, 0.7, 0.8], [0.3, 0.4]),
            Lens::Fisheye { k: [0.1, 0.0, 0.0, 0.0] },
            Lens::Fisheye { k: [0.1, 0.2, 0.0, 0.0] },
        ];
        for (camera, lens) in cameras.values().zip(lenses) {
            assert_eq!(camera.lens, lens);
            let k = camera.intrinsics;
            assert!(k.fx == 5.0 && (k.fy == 5.0 || k.fy == 6.0) && k.cx == 4.0 && k.cy == 3.0, "{k:?}");
        }
        assert_eq!(cameras.len(), 9);
        let text = "1 FOV 8 6 5 6 4 3 .9\n2 THIN_PRISM_FISHEYE 8 6 5 6 4 3 .1 .2 .3 .4 .5 .6 .7 .8\n\
                    3 RAD_TAN_THIN_PRISM_FISHEYE 8 6 5 6 4 3 .1 .2 .3 .4 .5 .6 .7 .8 .9 1 1.1 1.2\n\
                    4 SIMPLE_DIVISION 8 6 5 4 3 -.1\n5 DIVISION 8 6 5 6 4 3 -.1\n6 SIMPLE_FISHEYE 8 6 5 4 3\n\
                    7 FISHEYE 8 6 5 6 4 3\n8 EUCM 8 6 5 6 4 3 .6 1.1\n9 FOV 8 6 5 6 4 3 0\n";
        let lenses = [
            Lens::Fov { omega: 0.9 },
            Lens::ThinPrismFisheye { k: [0.1, 0.2, 0.5, 0.6], p: [0.3, 0.4], s: [0.7, 0.8] },
            Lens::RadTanThinPrismFisheye { k: [0.1, 0.2, 0.3, 0.4, 0.5, 0.6], p: [0.7, 0.8], s: [0.9, 1.0, 1.1, 1.2] },
            Lens::Division { k: -0.1 },
            Lens::Division { k: -0.1 },
            Lens::Fisheye { k: [0.0; 4] },
            Lens::Fisheye { k: [0.0; 4] },
            Lens::Eucm { alpha: 0.6, beta: 1.1 },
            Lens::Pinhole,
        ];
        assert_eq!(cameras_txt(text, |_| true).unwrap().values().map(|c| c.lens).collect::<Vec<_>>(), lenses);
        let panorama = cameras_txt("1 EQUIRECTANGULAR 80 40 80 40\n", |_| true).unwrap().remove(&1).unwrap();
        assert!(matches!(panorama.lens, Lens::Equirectangular { size: [80, 40], .. }));
        for error in [
            cameras_txt("1 NEWER 8 6 5\n", |_| true),
            cameras_bin(&[&1u64.to_le_bytes()[..], &[1, 0, 0, 0, 18], &[0; 43]].concat(), |_| true),
        ] {
            let error = error.unwrap_err().to_string();
            assert!(error.contains("is not known") && error.contains("image_undistorter"), "{error}");
        }
    }
}
