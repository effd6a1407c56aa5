//! Options of a capture next to its path.

use super::convention::Poses;
use super::shutter::{self, Shutter};
use super::vignetting;
use crate::settings::{Value, choices, settings};
use splat4d::{Error, Result};
use std::collections::BTreeMap;
use std::ops::Range;
use std::str::FromStr;
use std::sync::Arc;

/// A lens: size, orientation and intrinsics of its images, in hundredths of a pixel.
pub(super) type Lens100 = Vec<i64>;

/// Image areas that the lenses of a capture recorded, as far as examined.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Lenses(pub(super) BTreeMap<Lens100, Option<Arc<Vec<u8>>>>);

/// Which frames are kept from training and used to measure.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum HoldOut {
    /// All frames of these cameras, by name, else by position in the capture's list of cameras.
    Cameras(Vec<String>),
    /// Every n-th image (0, n, 2n, ...) in the capture's order (camera by camera, in time). n ≥ 2.
    Every(usize),
    /// Train on everything.
    None,
}

impl FromStr for HoldOut {
    type Err = Error;

    /// Reads `camera=0,10`, `every=8` or `none`.
    fn from_str(text: &str) -> Result<Self> {
        const REMEDY: &str = "Write camera=NAME[,NAME...], every=N (N at least 2), or none.";
        let bad = |what: String| Error::input(what).at("hold-out").remedy(REMEDY);
        match text.trim().split_once('=').map(|(key, value)| (key.trim(), value.trim())) {
            None if text.trim().eq_ignore_ascii_case("none") => Ok(Self::None),
            Some(("camera" | "cameras", list)) => {
                let names: Vec<String> = list.split(',').map(|n| n.trim().to_string()).collect();
                if names.iter().any(String::is_empty) {
                    return Err(bad(format!("\"{text}\" names an empty camera")));
                }
                Ok(Self::Cameras(names))
            }
            Some(("every", n)) => match n.parse() {
                Ok(n) if n >= 2 => Ok(Self::Every(n)),
                _ => Err(bad(format!("invalid every={n}: expected a whole number of at least 2"))),
            },
            _ => Err(bad(format!("\"{text}\" is not understood"))),
        }
    }
}

impl std::fmt::Display for HoldOut {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Cameras(names) => write!(f, "camera={}", names.join(",")),
            Self::Every(n) => write!(f, "every={n}"),
            Self::None => write!(f, "none"),
        }
    }
}

/// Empty: the data set's own convention.
impl Value for Option<HoldOut> {
    fn to_toml(&self) -> toml::Value {
        toml::Value::String(self.as_ref().map_or_else(String::new, HoldOut::to_string))
    }

    fn from_toml(value: &toml::Value) -> std::result::Result<Self, String> {
        match value.as_str() {
            Some("") => Ok(None),
            Some(rule) => rule.parse().map(Some).map_err(|e: Error| e.to_string()),
            None => Err("a rule such as \"camera=0,10\", \"every=8\" or \"none\"".into()),
        }
    }
}

/// Default of `capture.near`: a camera that is mounted in a wall is behind the wall's own splats, and haze in front of
/// places where no training camera is costs nothing. PanopticSports basketball, four minutes, held-out cameras: 27.1 dB
/// with 0.05 (Kerbl et al. 2023 render nothing nearer than 0.2 units, about that share), 28.1 with this.
const NEAR: f64 = 0.2;

choices! {
    /// Interpretation of images without times.
    pub enum Sequence {
        /// By their names: a film where they are numbered like its frames, else photos.
        Auto = "auto",
        /// Photos of one time.
        Photos = "photos",
        /// The frames of a film, or of one for each camera of a rig.
        Video = "video",
    }
}

choices! {
    /// Pixels (stored or upright) that poses describe if images have an EXIF orientation.
    pub enum Exif {
        /// By the layout, else by the images' sizes.
        Auto = "auto",
        /// The pixels as stored; the orientation is not applied.
        Stored = "stored",
        /// The upright image; the orientation is applied.
        Upright = "upright",
    }
}

choices! {
    /// Treatment of black borders of images.
    pub enum Borders {
        /// They are found, and neither trained nor scored.
        Auto = "auto",
        /// They are content like any other.
        Keep = "keep",
    }
}

choices! {
    /// Unit of a capture's times.
    pub enum Times {
        /// As their range, steps and the images' names show.
        Auto = "auto",
        /// Seconds.
        Seconds = "seconds",
        /// Parts of the capture, from 0 to 1.
        Fractions = "fractions",
        /// Frame numbers.
        Frames = "frames",
    }
}

choices! {
    /// Treatment of images without a pose of their own, whose camera has another image with one.
    pub enum Unregistered {
        /// They share that pose where names show a fixed rig (`cam00/0001.png`), else they are left out.
        Auto = "auto",
        /// They share the pose: cameras are fixed.
        Share = "share",
        /// They are left out.
        Leave = "leave",
    }
}

choices! {
    /// Source of optical flow.
    pub enum FlowSource {
        /// The capture's files; where it brings none there is none.
        Files = "files",
        /// The capture's files, and where it brings none, followed from image to image by this program.
        Own = "own",
    }
}

settings! {
    /// Options of reading a capture.
    pub struct CaptureSettings {
        /// Images are reduced by this factor (mean of k×k boxes).
        downscale: usize = 1 => at_least(1);
        /// Held-out views: empty (the data set's convention), "camera=0,10", "every=8" or "none".
        hold_out: Option<HoldOut> = None;
        /// Frames per second; 0: as the capture states.
        fps: f64 = 0.0 => any().unit("frames/s");
        /// Images without times: photos (of one time), video (frames of a video), or auto (by their names).
        sequence: Sequence = Sequence::Auto;
        /// Source of optical flow: files (of the capture) or own (computed where the capture has none, and stored with
        /// the run).
        flow: FlowSource = FlowSource::Files => any().when(On("loss.flow"));
        /// Number of frames of the capture to use; 0: all.
        max_frames: usize = 0 => any().unit("frames");
        /// Near distance of cameras, share of the extent; less if the capture's points are nearer, a quarter of it
        /// without points.
        near: f64 = NEAR => below_one().unit("extents");
        /// Share of the clip for training; later frames only score forecasts. 1: all.
        observe: f64 = 1.0 => share();
        /// Folder of images instead of the capture's, such as "images_4"; empty: the capture's.
        images: Text = Text::default();
        /// Convention of poses if it differs from the layout's: opencv or opengl (camera axes), inverse, transposed or
        /// xyzw (quaternions), joined by +; empty: the layout's.
        poses: Poses = Poses::STATED;
        /// Pixels that poses describe if images have an EXIF orientation: stored, upright, or auto (as stored for
        /// COLMAP, else by the sizes).
        exif: Exif = Exif::Auto;
        /// Black borders of images, as undistortion and letterboxing leave them: auto (found, and neither trained nor
        /// scored) or keep (they are content).
        borders: Borders = Borders::Auto;
        /// Unit of times: seconds, fractions (of the capture), frames, or auto (by their range, steps and names).
        times: Times = Times::Auto;
        /// Images without a pose whose camera has one: share (the pose), leave (out), or auto (by names).
        unregistered: Unregistered = Unregistered::Auto;
        /// Largest share of missing images; they are skipped.
        max_missing: f64 = MAX_MISSING => share();
        /// First frame of the capture to use.
        first_frame: usize = 0 => any().unit("frames");
        /// RGBA images are composited on white; false: on black.
        white_background: bool = true;
        /// Rows are rendered at their own times where cameras have a readout time.
        rolling_shutter: bool = true;
        /// Readout time of cameras that state none, from the first row to the last; negative: from the last.
        readout: f64 = 0.0 => any().unit("seconds").when(On("capture.rolling_shutter"));
        /// Renders that are averaged over the exposure of an image; 1: motion blur is not modelled.
        subframes: usize = 1 => at_least(1);
        /// Exposure time of cameras that state none.
        exposure_time: f64 = 0.0 => any().unit("seconds");
        /// Vignetting of cameras that state none, `k1,k2,k3` of light = 1 + k1 r² + k2 r⁴ + k3 r⁶, r = 1 in the corners:
        /// it is removed from images; empty: none.
        vignetting: Text = Text::default();
    }
}

/// Options of reading a capture. `CaptureOptions::default()` follows the data set's own conventions.
#[derive(Clone, Debug, PartialEq)]
pub struct CaptureOptions {
    /// Images become means of k×k boxes; 1 keeps them. Rows and columns that fill no box are cut off.
    pub downscale: usize,
    /// Held-out frames; `None` follows the data set's convention.
    pub hold_out: Option<HoldOut>,
    /// Frames per second; `None` takes what the capture states, else 30. Scales the clock of D-NeRF captures too.
    pub fps: Option<f64>,
    /// Interpretation of images without times.
    pub sequence: Sequence,
    /// The background of transparent pixels, sRGB from 0 to 1; `None` takes the capture's own, else white.
    pub background: Option<[f32; 3]>,
    /// Length in seconds of captures that count time from 0 to 1 (D-NeRF, Nerfstudio); `None`: (N − 1)/fps for N
    /// training frames.
    pub unit_time_seconds: Option<f64>,
    /// Most points of the initial cloud; larger clouds are thinned by voxel.
    pub max_points: usize,
    /// How near to a camera splats are rendered, as a share of the cameras' extent; less where the capture's points
    /// come nearer, and a quarter of it where it has none.
    pub near: f64,
    /// The folder of images below the capture's, in place of the one that the capture names.
    pub images: Option<String>,
    /// Convention of the poses if it is not that of the layout.
    pub poses: Poses,
    /// Pixels (stored or upright) that poses describe.
    pub exif: Exif,
    /// Treatment of black borders.
    pub borders: Borders,
    /// Unit of times.
    pub times: Times,
    /// Treatment of images without a pose of their own.
    pub unregistered: Unregistered,
    /// Share of the images that may be missing.
    pub max_missing: f64,
    /// Only images with these frame numbers are listed, so that memory does not grow with the capture; empty: all. What
    /// they are for (training, held out) is as in the whole capture.
    pub frames: Vec<Range<usize>>,
    /// Whether frames that are not in `frames` may be missing before the last of these, as in a capture that is still
    /// recorded; else a camera without a stated number of frames ends where an image is missing.
    pub gaps: bool,
    /// Known properties of the lenses, from another part of the capture; else images are examined.
    pub lenses: Lenses,
    /// Readout time of cameras that state none, seconds from the first row to the last; `None`: readout times are
    /// ignored.
    pub readout: Option<f64>,
    /// Exposure time of cameras that state none, seconds.
    pub exposure: f64,
    /// Renders that are averaged over an exposure; 1: motion blur is not modelled.
    pub subframes: usize,
    /// Vignetting of cameras that state none; `None`: there is none.
    pub vignetting: Option<[f64; 3]>,
}

/// Share of the images that may be missing by default: a few were deleted; more is probably another folder.
const MAX_MISSING: f64 = 0.2;

/// A text of the recipe.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Text(pub String);

impl Value for Text {
    fn to_toml(&self) -> toml::Value {
        toml::Value::String(self.0.clone())
    }

    fn from_toml(value: &toml::Value) -> std::result::Result<Self, String> {
        value.as_str().map(|s| Self(s.to_owned())).ok_or_else(|| "a text".into())
    }
}

/// Most points an initial cloud keeps by default.
pub(crate) const MAX_POINTS: usize = 40_000;

impl Default for CaptureOptions {
    fn default() -> Self {
        Self {
            downscale: 1,
            hold_out: None,
            fps: None,
            sequence: Sequence::Auto,
            background: None,
            unit_time_seconds: None,
            max_points: MAX_POINTS,
            near: NEAR,
            images: None,
            poses: Poses::STATED,
            exif: Exif::Auto,
            borders: Borders::Auto,
            times: Times::Auto,
            unregistered: Unregistered::Auto,
            max_missing: MAX_MISSING,
            frames: Vec::new(),
            gaps: false,
            lenses: Lenses::default(),
            readout: Some(0.0),
            exposure: 0.0,
            subframes: 1,
            vignetting: None,
        }
    }
}

impl CaptureOptions {
    /// Whether an image with this frame number is to be listed.
    pub(super) fn lists(&self, index: usize) -> bool {
        self.frames.is_empty() || self.frames.iter().any(|f| f.contains(&index))
    }

    /// The shutter of an image whose readout and exposure are stated so.
    pub(super) fn shutter(&self, [readout, exposure]: [Option<f64>; 2]) -> Option<Shutter> {
        let readout = self.readout.map_or(0.0, |others| readout.unwrap_or(others));
        Shutter::new(readout, exposure.unwrap_or(self.exposure), self.subframes)
    }

    /// An error for values that mean nothing: downscale 0, fps ≤ 0, a background outside 0 to 1.
    pub(super) fn check(&self) -> Result<()> {
        if self.downscale == 0 {
            return Err(Error::input("downscale is 0").remedy("Give 1 (full size) or more."));
        }
        for (name, value) in [("fps", self.fps), ("length in seconds", self.unit_time_seconds)] {
            if let Some(value) = value {
                check_rate(name, value)?;
            }
        }
        if !(0.0..1.0).contains(&self.near) {
            return Err(
                Error::input(format!("near is {}", self.near)).remedy("Give a share of the extent from 0 to below 1.")
            );
        }
        shutter::checked("readout", self.readout.unwrap_or(0.0))?;
        shutter::checked("exposure_time", self.exposure)?;
        vignetting::checked(self.vignetting.unwrap_or_default())?;
        if self.background.is_some_and(|b| b.iter().any(|v| !(0.0..=1.0).contains(v))) {
            return Err(Error::input("the background is outside [0,1]").remedy("Give three numbers from 0 to 1."));
        }
        Ok(())
    }
}

/// Fastest camera that is accepted, frames per second; also the longest take in seconds that is.
const MAX_RATE: f64 = 1e6;

/// An error unless 0 < value ≤ 10⁶.
pub(super) fn check_rate(name: &str, value: f64) -> Result<()> {
    if value.is_finite() && value > 0.0 && value <= MAX_RATE {
        return Ok(());
    }
    Err(Error::input(format!("invalid {name} {value}")).remedy(format!("Give a number above 0, at most {MAX_RATE}.")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hold_out_is_read_or_explained() {
        assert_eq!("camera=0, 10".parse::<HoldOut>().unwrap(), HoldOut::Cameras(vec!["0".into(), "10".into()]));
        assert_eq!("every=8".parse::<HoldOut>().unwrap(), HoldOut::Every(8));
        assert_eq!(" none ".parse::<HoldOut>().unwrap(), HoldOut::None);
        for bad in ["", "every=1", "every=x", "camera=", "camera=a,,b", "cam=3", "8"] {
            let message = bad.parse::<HoldOut>().unwrap_err().to_string();
            assert!(message.contains("every=N"), "{bad}: {message}");
        }
    }
}
