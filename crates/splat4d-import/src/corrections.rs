//! `import.toml`: what was found of every camera, to be corrected by hand and run again.

use crate::sync::graph::Offset;
use serde::{Deserialize, Serialize};
use splat4d::scene::{Intrinsics, Lens};
use splat4d::{Error, ErrorKind, Result};
use splat4d_train::run::checkpoint::write_atomically;
use std::path::Path;

/// The file's name in the capture's folder.
pub const FILE: &str = "import.toml";
/// The version of the file.
const VERSION: u32 = 1;
/// The text above.
const HEAD: &str =
    "# What `import` found for every camera. Correct it and run the same command again: `import` continues
# from here.
#
#   offset        seconds added to the camera's clock: an event at t on its clock is at t + offset
#   keep_offset   true: keep this offset instead of measuring it again
#   rate          drift of the camera's clock, seconds a second
#   lens          pixels of the stored images, OpenCV's distortion
#   keep_lens     true: keep this lens
#   use           false: leave the camera out
#
# `sigma`, `by` \
                    and `checked` describe the accuracy of the offset and are not read.

";

/// The file.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Corrections {
    version: u32,
    /// A table per camera.
    #[serde(default, rename = "camera")]
    pub cameras: Vec<Camera>,
}

/// Known values of a camera.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Camera {
    /// Its name, by which it is found again.
    pub name: String,
    /// Whether it is part of the capture.
    #[serde(rename = "use", default = "yes")]
    pub wanted: bool,
    /// Seconds that are added to its clock, if they are known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub offset: Option<f64>,
    /// Whether the offset is the user's.
    #[serde(default)]
    pub keep_offset: bool,
    /// Drift of its clock, seconds a second.
    #[serde(default)]
    pub rate: f64,
    /// Standard deviation of the offset, seconds: to read.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sigma: Option<f64>,
    /// Source of the offset, for readers.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub by: Vec<String>,
    /// Whether other evidence would have contradicted a wrong offset: to read.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub checked: Option<bool>,
    /// Whether the lens is the user's.
    #[serde(default)]
    pub keep_lens: bool,
    /// Its lens, if it is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lens: Option<Intrinsic>,
}

/// Focal lengths, principal point and distortion in pixels of the stored images.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Intrinsic {
    /// Pixels.
    pub fx: f64,
    /// Pixels; as `fx` where it is left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fy: Option<f64>,
    /// Pixels; the first pixel's centre is at 0.5.
    pub cx: f64,
    /// Pixels.
    pub cy: f64,
    /// k1 to k6, of fisheyes k1 to k4; those left out are 0.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub k: Vec<f64>,
    /// p1 and p2.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub p: Vec<f64>,
    /// Whether it is a fisheye (Kannala and Brandt).
    #[serde(default)]
    pub fisheye: bool,
}

fn yes() -> bool {
    true
}

impl Camera {
    /// One of which nothing is known yet.
    pub(crate) fn new(name: impl Into<String>) -> Self {
        Self {
            name: name.into(),
            wanted: true,
            offset: None,
            keep_offset: false,
            rate: 0.0,
            sigma: None,
            by: Vec::new(),
            checked: None,
            keep_lens: false,
            lens: None,
        }
    }

    /// Notes an offset that was found; the user's stays.
    pub(crate) fn found_offset(&mut self, offset: &Offset) {
        if self.keep_offset {
            return;
        }
        (self.offset, self.rate) = (Some(offset.seconds), offset.rate);
        (self.sigma, self.checked) = (Some(offset.sigma), Some(offset.checked));
        self.by = offset.kinds.iter().map(|k| k.name().to_owned()).collect();
    }

    /// Notes a lens that was found; the user's stays.
    pub(crate) fn found_lens(&mut self, intrinsics: &Intrinsics, lens: &Lens) {
        if self.keep_lens {
            return;
        }
        // Zeros at the end carry no information.
        let short = |values: &[f64]| values[..values.iter().rposition(|v| *v != 0.0).map_or(0, |i| i + 1)].to_vec();
        let (k, p, fisheye) = match lens {
            Lens::Brown { k, p, .. } => (short(k), short(p), false),
            Lens::Fisheye { k } => (short(k), Vec::new(), true),
            Lens::Pinhole => (Vec::new(), Vec::new(), false),
            // Only a calibration has others, which is in its own file.
            _ => return,
        };
        let Intrinsics { fx, fy, cx, cy } = *intrinsics;
        self.lens = Some(Intrinsic { fx, fy: (fx != fy).then_some(fy), cx, cy, k, p, fisheye });
    }

    /// The offset that the user gives.
    pub fn given_offset(&self) -> Option<f64> {
        self.offset.filter(|_| self.keep_offset)
    }

    /// The lens that the user gives.
    pub(crate) fn given_lens(&self) -> Option<(Intrinsics, Lens)> {
        self.lens.as_ref().filter(|_| self.keep_lens).map(Intrinsic::lens)
    }

    fn check(&self) -> Result<()> {
        let number = |key: &str, value: f64| {
            if value.is_finite() {
                return Ok(());
            }
            Err(Error::input(format!("{key} is {value}")).remedy("Give a finite number, or take the line out."))
        };
        number("offset", self.offset.unwrap_or(0.0))?;
        number("rate", self.rate)?;
        if self.keep_offset && self.offset.is_none() {
            return Err(Error::input("keep_offset is true, but there is no offset").remedy("Write offset = 0.0 or so."));
        }
        let Some(lens) = &self.lens else {
            return if self.keep_lens {
                Err(Error::input("keep_lens is true, but there is no lens").remedy("Write a table [camera.lens]."))
            } else {
                Ok(())
            };
        };
        for (key, value) in [("fx", lens.fx), ("fy", lens.fy.unwrap_or(lens.fx)), ("cx", lens.cx), ("cy", lens.cy)] {
            number(key, value)?;
            if key.starts_with('f') && value <= 0.0 {
                return Err(
                    Error::input(format!("{key} is {value}")).remedy("Focal lengths must be above zero, in pixels.")
                );
            }
        }
        lens.k.iter().chain(&lens.p).try_for_each(|&v| number("the distortion", v))?;
        if lens.k.len() > if lens.fisheye { 4 } else { 6 } || lens.p.len() > 2 || lens.fisheye && !lens.p.is_empty() {
            return Err(Error::input("the distortion has too many numbers")
                .remedy("k1 to k6 and p1, p2; of fisheyes k1 to k4 and no p."));
        }
        Ok(())
    }
}

impl Intrinsic {
    fn lens(&self) -> (Intrinsics, Lens) {
        let k = |i: usize| self.k.get(i).copied().unwrap_or(0.0);
        let p = |i: usize| self.p.get(i).copied().unwrap_or(0.0);
        let lens = if self.fisheye {
            Lens::Fisheye { k: std::array::from_fn(k) }
        } else if self.k.is_empty() && self.p.is_empty() {
            Lens::Pinhole
        } else {
            Lens::Brown { k: std::array::from_fn(k), p: [p(0), p(1)], s: [0.0; 4] }
        };
        (Intrinsics { fx: self.fx, fy: self.fy.unwrap_or(self.fx), cx: self.cx, cy: self.cy }, lens)
    }
}

impl Corrections {
    /// The file in a capture's folder; that of cameras of which nothing is known where there is none. Cameras that it
    /// does not name are added, in the order of `names`.
    ///
    /// Errors: no TOML, unknown keys, numbers that are none, cameras that there are not.
    pub fn read(folder: &Path, names: &[String]) -> Result<Self> {
        let path = folder.join(FILE);
        let mut found = match path.exists() {
            true => Self::parse(&splat4d_train::files::read_text(&path)?).map_err(|e| e.at(path.display()))?,
            false => Self::default(),
        };
        if let Some(unknown) = found.cameras.iter().find(|c| !names.contains(&c.name)) {
            return Err(Error::input(format!("there is no camera \"{:.80}\"", unknown.name))
                .at(path.display())
                .remedy(format!("Take it out, or write one of these: {}.", names.join(", "))));
        }
        let mut take = |name: &String| {
            let place = found.cameras.iter().position(|c| c.name == *name);
            place.map_or_else(|| Camera::new(name), |i| found.cameras.remove(i))
        };
        let cameras = names.iter().map(&mut take).collect();
        Ok(Self { version: VERSION, cameras })
    }

    fn parse(text: &str) -> Result<Self> {
        let found: Self = toml::from_str(text).map_err(|e| {
            let what = e.to_string().trim().to_owned();
            Error::input(what).remedy("Correct it, or remove the file: it is written again.")
        })?;
        if found.version != VERSION {
            let what = format!("its version is {}, not {VERSION}", found.version);
            return Err(Error::new(ErrorKind::Unsupported, what).remedy("Remove the file: it is written again."));
        }
        for (i, camera) in found.cameras.iter().enumerate() {
            let place = |e: Error| e.at(format!("camera {:.80}", camera.name));
            camera.check().map_err(place)?;
            if found.cameras[..i].iter().any(|c| c.name == camera.name) {
                return Err(place(Error::input("it is there twice").remedy("Take one out.")));
            }
        }
        Ok(found)
    }

    /// Writes the file into a capture's folder.
    pub(crate) fn write(&self, folder: &Path) -> Result<()> {
        let body = toml::to_string(self).expect("corrections are plain data");
        write_atomically(&folder.join(FILE), format!("{HEAD}{body}").as_bytes())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sync::graph::Kind;

    fn given(file: &Corrections) -> Vec<Option<f64>> {
        file.cameras.iter().map(Camera::given_offset).collect()
    }

    fn names() -> Vec<String> {
        ["left", "right"].map(String::from).to_vec()
    }

    #[test]
    fn results_are_written_and_corrections_are_kept() {
        let folder = tempfile::tempdir().unwrap();
        let mut file = Corrections::read(folder.path(), &names()).unwrap();
        assert_eq!(given(&file), [None, None]);
        let offset = Offset { seconds: 0.25, sigma: 1e-3, rate: 2e-5, kinds: vec![Kind::Sound], checked: true };
        let intrinsics = Intrinsics { fx: 900.0, fy: 900.0, cx: 640.5, cy: 360.0 };
        let lens = Lens::Brown { k: [-0.1, 0.0, 0.0, 0.0, 0.0, 0.0], p: [0.0; 2], s: [0.0; 4] };
        for camera in &mut file.cameras {
            camera.found_offset(&offset);
            camera.found_lens(&intrinsics, &lens);
        }
        file.write(folder.path()).unwrap();
        assert_eq!(Corrections::read(folder.path(), &names()).unwrap(), file);
        // By hand.
        let path = folder.path().join(FILE);
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(text.starts_with('#') && text.contains("by = [\"sound\"]"), "{text}");
        let (head, right) = text.split_once("name = \"right\"").unwrap();
        let right = right.replacen("offset = 0.25", "offset = 0.75", 1).replacen(
            "keep_offset = false",
            "keep_offset = true",
            1,
        );
        let right = right.replacen("keep_lens = false", "keep_lens = true", 1).replacen("fx = 900.0", "fx = 950.0", 1);
        std::fs::write(&path, format!("{head}name = \"right\"{right}")).unwrap();
        let mut again = Corrections::read(folder.path(), &names()).unwrap();
        assert_eq!(given(&again), [None, Some(0.75)]);
        again.cameras[1].found_offset(&offset);
        again.cameras[1].found_lens(&intrinsics, &Lens::Pinhole);
        let (told, bent) = again.cameras[1].given_lens().unwrap();
        assert_eq!((again.cameras[1].offset, told.fx, told.fy, bent), (Some(0.75), 950.0, 950.0, lens));
        assert_eq!(again.cameras[0].given_lens(), None);
    }

    #[test]
    fn mistakes_are_explained() {
        let folder = tempfile::tempdir().unwrap();
        let camera = "version = 1\n[[camera]]\nname = \"left\"\n";
        for (text, word) in [
            ("version = 2\n".to_owned(), "version is 2"),
            (format!("{camera}offest = 1.0\n"), "offest"),
            (format!("{camera}keep_offset = true\n"), "no offset"),
            (format!("{camera}offset = nan\n"), "offset is NaN"),
            (format!("{camera}[camera.lens]\nfx = -3.0\ncx = 1.0\ncy = 1.0\n"), "fx is -3"),
            (format!("{camera}[[camera]]\nname = \"left\"\n"), "twice"),
            ("version = 1\n[[camera]]\nname = \"up\"\n".to_owned(), "left, right"),
        ] {
            std::fs::write(folder.path().join(FILE), &text).unwrap();
            let error = Corrections::read(folder.path(), &names()).unwrap_err().to_string();
            assert!(error.contains(word) && error.contains(FILE), "{error}");
        }
    }
}
