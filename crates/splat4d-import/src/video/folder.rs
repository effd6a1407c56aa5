//! Folders of images, and image sequences: numbers in names are the clock.

use super::{Color, Frame, Info, Range, Reader, Rgb8, Selection, Source, Transfer, fingerprint_of_file, fnv1a, stem};
use splat4d::{Error, Result};
use splat4d_train::encode::resample;
use std::cmp::Ordering;
use std::path::{Path, PathBuf};

/// Endings of images.
pub(crate) const ENDINGS: [&str; 4] = ["jpg", "jpeg", "png", "webp"];
/// Frames per second that anything was ever filmed at, and slower time lapses.
const RATES: std::ops::RangeInclusive<f64> = 1e-6..=1e5;

/// The images of a folder, in the order of the numbers in their names.
pub(crate) struct Folder {
    info: Info,
    /// Files and their times.
    files: Vec<(PathBuf, f64)>,
}

impl Folder {
    /// Lists the folder; reads the first image for its size. Images are `1/fps` seconds apart, and further where
    /// numbers are missing.
    ///
    /// Errors: no images, a frame rate that is none, a damaged first image.
    pub(crate) fn open(path: &Path, fps: f64) -> Result<Self> {
        if !RATES.contains(&fps) {
            return Err(Error::input(format!("invalid frame rate {fps}"))
                .at(path.display())
                .remedy("30, for example."));
        }
        let entries =
            std::fs::read_dir(path).map_err(|e| Error::io("the folder cannot be read", e).at(path.display()))?;
        let is_picture = |p: &PathBuf| {
            let ending = p.extension().map(|e| e.to_string_lossy().to_ascii_lowercase());
            let hidden = p.file_name().is_some_and(|n| n.to_string_lossy().starts_with('.'));
            !hidden && ending.is_some_and(|e| ENDINGS.contains(&e.as_str()))
        };
        let mut files: Vec<PathBuf> = entries.filter_map(|e| e.ok().map(|e| e.path())).filter(is_picture).collect();
        files.sort_by(|a, b| natural(&name(a), &name(b)).then_with(|| a.cmp(b)));
        let Some(first) = files.first() else {
            return Err(Error::input("there are no images in it")
                .at(path.display())
                .remedy("Give a video, or a folder of .jpg, .png or .webp files."));
        };
        let picture = Rgb8::read(first)?;
        let steps = steps(&files.iter().map(|f| name(f)).collect::<Vec<_>>());
        let size = [picture.width, picture.height];
        let times: Vec<f64> = steps.iter().map(|s| s / fps).collect();
        let gaps = steps.windows(2).filter(|w| w[1] - w[0] > 1.5).count();
        let warnings = match steps.windows(2).position(|w| w[1] - w[0] > 1.5) {
            None => Vec::new(),
            Some(first) => vec![format!(
                "numbers are missing in the names of its images, in {gaps} places, first after {}: their times are \
                 kept",
                name(&files[first])
            )],
        };
        let info = Info {
            name: stem(path),
            size,
            stored: size,
            rotation: 0,
            nominal_rate: Some(fps),
            average_rate: Some(fps),
            time_base: None,
            duration: times.last().map(|t| t + 1.0 / fps),
            frames: Some(files.len()),
            codec: first.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default(),
            pixels: "rgb24".into(),
            interlaced: false,
            color: Color { matrix: None, tagged: true, range: Range::Full, transfer: Transfer::Standard },
            sound: false,
            warnings,
            alpha: Rgb8::read_alpha(first)?.1.is_some(),
        };
        Ok(Self { info, files: files.into_iter().zip(times).collect() })
    }
}

impl Source for Folder {
    fn info(&self) -> &Info {
        &self.info
    }

    fn frames(&self, selection: &Selection) -> Result<Box<dyn Reader + '_>> {
        selection.check_for(self.info())?;
        let times = self.files.iter().map(|f| f.1).collect();
        Ok(Box::new(Pictures { folder: self, selection: selection.clone(), next: 0, counted: 0, times }))
    }

    fn sound(&self) -> Result<Option<Vec<f32>>> {
        Ok(None)
    }

    fn fingerprint(&self) -> Result<String> {
        let mut bytes = Vec::new();
        for (file, time) in &self.files {
            bytes.extend_from_slice(name(file).as_bytes());
            bytes.extend_from_slice(&time.to_bits().to_le_bytes());
            bytes.extend_from_slice(&fingerprint_of_file(file)?.to_le_bytes());
        }
        Ok(format!("{:016x}", fnv1a(&bytes)))
    }
}

struct Pictures<'a> {
    folder: &'a Folder,
    selection: Selection,
    next: usize,
    /// Images read of the chosen part.
    counted: usize,
    times: Vec<f64>,
}

impl Reader for Pictures<'_> {
    fn next(&mut self, frame: &mut Frame) -> Result<bool> {
        while let Some((path, time)) = self.folder.files.get(self.next) {
            let number = self.next;
            self.next += 1;
            if !self.selection.holds(*time) {
                continue;
            }
            self.counted += 1;
            if !(self.counted - 1).is_multiple_of(self.selection.every) {
                continue;
            }
            let (picture, alpha) = Rgb8::read_alpha(path)?;
            let [width, height] = self.folder.info.size;
            if [picture.width, picture.height] != [width, height] {
                let what =
                    format!("the image is {}x{}, those before it are {width}x{height}", picture.width, picture.height);
                return Err(Error::input(what)
                    .at(path.display())
                    .remedy("Give each camera a folder of its own, with images of one size."));
            }
            let alpha = alpha.map_or_else(Vec::new, |a| scaled_plane(a, [width, height], &self.selection));
            *frame = Frame { number, time: *time, picture: scaled(picture, &self.selection), alpha };
            return Ok(true);
        }
        if self.counted == 0 {
            return Err(Error::input("no image is in the chosen time range").remedy("Choose another part."));
        }
        Ok(false)
    }

    fn times(&self) -> &[f64] {
        &self.times[..self.next]
    }

    fn warnings(&self) -> &[String] {
        &self.folder.info.warnings
    }
}

/// An image in the requested size.
pub(super) fn scaled(picture: Rgb8, selection: &Selection) -> Rgb8 {
    let [width, height] = selection.scaled([picture.width, picture.height]);
    let picture = match selection.crop {
        Some(crop) => {
            let data = crop.of(&picture.data, picture.width, 3);
            Rgb8 { width: crop.width, height: crop.height, data }
        }
        None => picture,
    };
    if [width, height] == [picture.width, picture.height] {
        return picture;
    }
    // The same kind of curve as ffmpeg's; both widen it where images get smaller.
    let data = resample(&picture.data, 3, [picture.width, picture.height], [width, height]);
    Rgb8 { width, height, data }
}

/// An alpha channel in the requested size.
fn scaled_plane(alpha: Vec<u8>, size: [usize; 2], selection: &Selection) -> Vec<u8> {
    let [width, height] = selection.scaled(size);
    let (alpha, size) = match selection.crop {
        Some(crop) => (crop.of(&alpha, size[0], 1), [crop.width, crop.height]),
        None => (alpha, size),
    };
    if [width, height] == size {
        return alpha;
    }
    resample(&alpha, 1, size, [width, height])
}

fn name(path: &Path) -> String {
    path.file_stem().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default()
}

/// Order of names in which numbers count as such: frame2 before frame10.
fn natural(a: &str, b: &str) -> Ordering {
    let (mut a, mut b) = (a, b);
    loop {
        let digits = |s: &str| s.bytes().take_while(u8::is_ascii_digit).count();
        let (n, m) = (digits(a), digits(b));
        if n > 0 && m > 0 {
            let (x, y) = (a[..n].trim_start_matches('0'), b[..m].trim_start_matches('0'));
            let order = x.len().cmp(&y.len()).then_with(|| x.cmp(y));
            if order != Ordering::Equal {
                return order;
            }
            (a, b) = (&a[n..], &b[m..]);
            continue;
        }
        let (mut left, mut right) = (a.chars(), b.chars());
        match (left.next(), right.next()) {
            (Some(x), Some(y)) if x == y => (a, b) = (left.as_str(), right.as_str()),
            (x, y) => return x.cmp(&y),
        }
    }
}

/// Number of intervals of each image after the first: by the last numbers in the names where they ascend evenly but for
/// some that are missing, else by position.
fn steps(names: &[String]) -> Vec<f64> {
    let by_position = || (0..names.len()).map(|i| i as f64).collect();
    let number = |name: &String| {
        let end = name.rfind(|c: char| c.is_ascii_digit())? + 1;
        let begin = name[..end]
            .rfind(|c: char| !c.is_ascii_digit())
            .map_or(0, |i| i + name[i..].chars().next().map_or(1, char::len_utf8));
        // Dates and other long numbers are no frame numbers.
        name[begin..end].parse::<u32>().ok().map(f64::from)
    };
    let Some(numbers) = names.iter().map(number).collect::<Option<Vec<f64>>>() else { return by_position() };
    let gaps: Vec<f64> = numbers.windows(2).map(|w| w[1] - w[0]).collect();
    let least = gaps.iter().copied().fold(f64::INFINITY, f64::min);
    // Where most steps differ from one another, numbers carry no information about time.
    let even = gaps.iter().filter(|g| **g == least).count() * 2 >= gaps.len();
    if gaps.is_empty() || least <= 0.0 || !even || gaps.iter().any(|g| (g / least).fract() != 0.0) {
        return by_position();
    }
    numbers.iter().map(|n| (n - numbers[0]) / least).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(list: &[&str]) -> Vec<String> {
        list.iter().map(|n| (*n).to_owned()).collect()
    }

    #[test]
    fn numbers_in_names_give_frame_times() {
        assert_eq!(steps(&names(&["f0005", "f0006", "f0008", "f0009"])), [0.0, 1.0, 3.0, 4.0]);
        assert_eq!(steps(&names(&["a_010", "a_020", "a_040"])), [0.0, 1.0, 3.0]);
        assert_eq!(steps(&names(&["IMG_3", "IMG_17", "IMG_20"])), [0.0, 1.0, 2.0]);
        assert_eq!(steps(&names(&["first", "second"])), [0.0, 1.0]);
        assert_eq!(steps(&names(&["only7"])), [0.0]);
    }

    #[test]
    fn names_are_ordered_by_their_numbers() {
        let mut list = names(&["frame10", "frame9", "frame010b", "frame1"]);
        list.sort_by(|a, b| natural(a, b));
        assert_eq!(list, ["frame1", "frame9", "frame10", "frame010b"]);
    }

    #[test]
    fn a_folder_is_a_source_like_any_other() {
        let folder = tempfile::tempdir().unwrap();
        for (number, shade) in [(2, 20u8), (3, 30), (4, 40), (6, 60), (10, 100)] {
            let picture = image::RgbImage::from_pixel(40, 32, image::Rgb([shade; 3]));
            picture.save(folder.path().join(format!("f{number}.png"))).unwrap();
        }
        std::fs::write(folder.path().join("notes.txt"), "no image").unwrap();
        let source = super::super::open(folder.path(), 10.0).unwrap();
        assert_eq!((source.info().size, source.info().frames), ([40, 32], Some(5)));
        assert!(source.info().warnings[0].contains("in 2 places, first after f4:"), "{:?}", source.info().warnings);
        let mut frames = source.frames(&Selection { from: Some(0.1), size: Some(16), ..Selection::default() }).unwrap();
        let (mut frame, mut seen) = (Frame::default(), Vec::new());
        while frames.next(&mut frame).unwrap() {
            seen.push((frame.number, (frame.time * 10.0).round(), frame.picture.data[0]));
            assert_eq!([frame.picture.width, frame.picture.height], [20, 16]);
        }
        assert_eq!(seen, [(1, 1.0, 30), (2, 2.0, 40), (3, 4.0, 60), (4, 8.0, 100)]);
        assert_eq!(frames.times().len(), 5);
        assert!(source.sound().unwrap().is_none());
        let before = source.fingerprint().unwrap();
        image::RgbImage::new(40, 32).save(folder.path().join("f3.png")).unwrap();
        assert_ne!(source.fingerprint().unwrap(), before);
    }

    #[test]
    fn empty_folders_and_mixed_sizes_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        assert!(Folder::open(folder.path(), 30.0).err().unwrap().to_string().contains("no images"));
        for (number, width) in [(1, 20), (2, 24)] {
            image::RgbImage::new(width, 20).save(folder.path().join(format!("{number}.png"))).unwrap();
        }
        let source = Folder::open(folder.path(), 30.0).unwrap();
        let mut frames = source.frames(&Selection::default()).unwrap();
        let mut frame = Frame::default();
        assert!(frames.next(&mut frame).unwrap());
        assert!(frames.next(&mut frame).unwrap_err().to_string().contains("24x20"));
        assert!(Folder::open(folder.path(), 0.0).is_err());
    }
}
