//! Points that a user clicked in the images of several cameras: their file, and the rig that they determine.
//!
//! Cameras at right angles share no features, but a person recognises the same corner in all of them. Six to eight such
//! points are enough for the poses of a rig (`solve.rs`); an event that all cameras show synchronises them. Without
//! clicks, keypoints of people in all cameras (`keypoints.rs`) calibrate and synchronise them (`people/`).

mod keypoints;
mod people;
mod solve;

pub(crate) use keypoints::{Frames, read_keypoints};
pub(crate) use people::calibrate;
pub(crate) use solve::{Camera, Point, Sight, Solution, plane, solve};

use crate::{Error, ErrorKind, Result};
use serde::{Deserialize, Serialize};
use splat4d::math::median;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// The version of the file.
const VERSION: u32 = 1;
/// Largest file, bytes: a thousand points in twenty cameras are 2 MB.
const LARGEST: u64 = 8 << 20;
/// Points of a floor, at least: three span a plane.
pub(crate) const FLOOR: usize = 3;

/// The file: what was clicked, in pixels of images of a stated size and seconds of the cameras' own clocks.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Clicks {
    version: u32,
    /// Pixels across and down of each camera's images in which points were clicked.
    pub cameras: BTreeMap<String, [usize; 2]>,
    /// Second of one event on the clocks of the cameras that show it.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub event: BTreeMap<String, f64>,
    /// The points.
    pub points: Vec<ClickedPoint>,
    /// Static points on the floor, by name.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub floor: Vec<String>,
    /// A known length.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub length: Option<Length>,
}

/// A point, or the position of a moving one at a time.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct ClickedPoint {
    /// Its name; positions of a moving point share it.
    pub name: String,
    /// Second on the clock of all cameras at which a moving point was clicked; none: the point is static.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub moment: Option<f64>,
    /// Where cameras show it.
    pub clicks: Vec<Click>,
}

/// A click.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Click {
    pub camera: String,
    /// Column and row, pixels; the first pixel's centre is at 0.5.
    pub x: f64,
    pub y: f64,
    /// Second of the frame on the camera's own clock.
    pub time: f64,
}

/// The distance of two static points.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Length {
    pub points: [String; 2],
    pub metres: f64,
}

/// Reads a file of clicked points of cameras with these names, or a folder of keypoints. Errors: those of `import --points`
/// and `--keypoints`.
pub fn check_clicks(path: &Path, names: &[&str]) -> Result<()> {
    match path.is_dir() {
        true => read_keypoints(path, names).map(drop),
        false => Clicks::read(path, names).map(drop),
    }
}

impl Clicks {
    /// The file of a path. Errors: unreadable, not this format, of another version, nonsense in it.
    pub(crate) fn read(path: &Path, names: &[&str]) -> Result<Self> {
        let place = |e: Error| e.at(path.display());
        let size = std::fs::metadata(path).map_err(|e| place(Error::io("the points cannot be read", e)))?.len();
        if size > LARGEST {
            return Err(place(
                Error::input(format!(
                    "invalid points: the file has {} MB, at most {} are read",
                    size >> 20,
                    LARGEST >> 20
                ))
                .remedy("Give the file that the page of --assist saved."),
            ));
        }
        let text = splat4d_train::files::read_text(path)?;
        let found: Self = serde_json::from_str(&text).map_err(|e| {
            place(Error::input(format!("invalid points: {e}")).remedy("Give the file that the page of --assist saved."))
        })?;
        found.check(names).map_err(place)?;
        Ok(found)
    }

    /// The same of a page.
    pub(crate) fn of(value: serde_json::Value, names: &[&str]) -> Result<Self> {
        let found: Self = serde_json::from_value(value).map_err(|e| Error::input(format!("invalid points: {e}")))?;
        found.check(names)?;
        Ok(found)
    }

    pub(crate) fn json(&self) -> String {
        serde_json::to_string_pretty(self).expect("clicks are plain data") + "\n"
    }

    /// None yet, in images of these sizes.
    pub(crate) fn none(cameras: BTreeMap<String, [usize; 2]>) -> Self {
        Self { version: VERSION, cameras, ..Self::default() }
    }

    /// Leaves out the cameras that are not among these.
    pub(crate) fn keep(&mut self, names: &[&str]) {
        let is_here = |name: &String| names.contains(&name.as_str());
        self.cameras.retain(|name, _| is_here(name));
        self.event.retain(|name, _| is_here(name));
        self.points.iter_mut().for_each(|p| p.clicks.retain(|c| is_here(&c.camera)));
    }

    /// Seconds that are added to the clocks of cameras so that all show the event at one time. `told` has priority;
    /// cameras without the event keep it.
    pub(crate) fn offsets(&self, names: &[&str], told: &[Option<f64>]) -> Vec<Option<f64>> {
        let own = |c: usize| self.event.get(names[c]).copied();
        let mut known: Vec<f64> = (0..names.len()).filter_map(|c| Some(told[c]? + own(c)?)).collect();
        let event = median(&mut known).or_else(|| (0..names.len()).find_map(own));
        let several = (0..names.len()).filter_map(own).count() > 1;
        (0..names.len()).map(|c| told[c].or_else(|| Some(event.filter(|_| several)? - own(c)?))).collect()
    }

    /// Checks names, numbers and references.
    fn check(&self, names: &[&str]) -> Result<()> {
        if self.version != VERSION {
            let what = format!("invalid version of points: expected {VERSION}, found {}", self.version);
            return Err(Error::new(ErrorKind::Unsupported, what).remedy("Click the points again with --assist."));
        }
        let camera = |name: &str| {
            if names.contains(&name) {
                return Ok(());
            }
            Err(Error::input(format!("invalid points: there is no camera \"{name:.80}\""))
                .remedy(format!("Cameras are {}.", names.join(", "))))
        };
        self.cameras.keys().chain(self.event.keys()).try_for_each(|name| camera(name))?;
        for (name, time) in &self.event {
            finite(*time, || format!("event of camera {name}"))?;
        }
        let mut known = BTreeSet::new();
        for point in &self.points {
            let place = || match point.moment {
                Some(t) => format!("point {:.80} at {t} s", point.name),
                None => format!("point {:.80}", point.name),
            };
            if let Some(t) = point.moment {
                finite(t, place)?;
            }
            if !known.insert((&point.name, point.moment.map(f64::to_bits))) {
                return Err(invalid("it is listed twice", place()).remedy("Rename or remove one of them."));
            }
            let mut seen = BTreeSet::new();
            for click in &point.clicks {
                camera(&click.camera).map_err(|e| e.at(place()))?;
                if !seen.insert(&click.camera) {
                    let what = format!("camera {} shows it twice", click.camera);
                    return Err(invalid(&what, place()).remedy("Keep one click for each camera."));
                }
                let Some([width, height]) = self.cameras.get(&click.camera) else {
                    let what = format!("the image size of camera {} is missing", click.camera);
                    return Err(invalid(&what, place()).remedy("Add it to \"cameras\": \"NAME\": [WIDTH, HEIGHT]."));
                };
                finite(click.time, place)?;
                let inside = (0.0..=*width as f64).contains(&click.x) && (0.0..=*height as f64).contains(&click.y);
                if !inside {
                    let what = format!(
                        "({}, {}) is outside of the {width}x{height} image of camera {}",
                        click.x, click.y, click.camera
                    );
                    return Err(invalid(&what, place()).remedy("Click it again."));
                }
            }
        }
        let of_length = self.length.iter().flat_map(|l| &l.points);
        for name in self.floor.iter().chain(of_length) {
            if !known.contains(&(name, None)) {
                return Err(invalid(
                    "floor and length refer to static points, and it is not one",
                    format!("point {name:.80}"),
                )
                .remedy("Correct the name, or click the point."));
            }
        }
        if let Some(Length { points: [a, b], metres }) = &self.length {
            if a == b {
                return Err(invalid("the known length is from a point to itself", format!("point {a:.80}"))
                    .remedy("Choose two points."));
            }
            if !metres.is_finite() || *metres <= 0.0 {
                return Err(Error::input(format!("invalid length: expected more than 0 m, found {metres}"))
                    .remedy("Give the distance of the two points in metres."));
            }
        }
        Ok(())
    }
}

fn invalid(what: &str, place: String) -> Error {
    Error::input(format!("invalid points: {what}")).at(place)
}

fn finite(value: f64, place: impl Fn() -> String) -> Result<()> {
    if value.is_finite() {
        return Ok(());
    }
    Err(invalid("a number is not finite", place()).remedy("Click it again."))
}

#[cfg(test)]
pub(crate) mod tests;
