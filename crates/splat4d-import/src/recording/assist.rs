//! Manual alignment: images of the cameras for a page in which a user clicks points, and the rig that these give.

use super::given;
use super::report::Report;
use super::world::Origin;
use super::{Material, Request, material};
use crate::clicks::{self, Clicks, Solution, plane};
use crate::sfm::known::Straight;
use crate::sfm::lens::Known;
use crate::sync::graph;
use crate::write::Pictures;
use crate::{Error, Result};
use serde_json::{Value, json};
use splat4d::math::Se3;
use splat4d::math::se3::{add, mat_vec, norm, scale, sub, transpose};
use splat4d::scene::{Intrinsics, Lens as SceneLens};
use splat4d_train::capture::{Distortion, Rgb8};
use splat4d_train::encode;
use splat4d_train::event::Progress;
use splat4d_train::run::checkpoint::write_atomically;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

/// The points of the page, from the capture's folder on.
const FILE: &str = "import/points.json";
/// Those that were there before others were given.
const OLD: &str = "import/points.old.json";
/// Median distance of clicks from their points above which a rig is refused, of the larger side: 10 px of 1920. Errors
/// of clicks are a fifth of it, wrong corners ten times as large.
const MOST_ERROR: f64 = 0.005;
/// Positions along the ray of a click at which its epipolar line is computed, and the nearest, of the rig's unit.
const STEPS: usize = 32;
const NEAREST: f64 = 0.05;
/// Quality of images of captures in PNG.
const QUALITY: u8 = 95;

/// The points of a file, for these of all cameras.
///
/// Errors: those of reading; options that contradict clicked points.
pub(super) fn read(file: &Path, request: &Request, names: &[String], here: &[&str]) -> Result<Clicks> {
    let place = |e: Error| e.at(file.display());
    let all: Vec<&str> = names.iter().map(String::as_str).collect();
    let mut clicks = Clicks::read(file, &all)?;
    clicks.keep(here);
    let other = [(request.apart.is_some(), "--apart"), (request.board.is_some(), "--board")];
    if let Some((_, option)) = other.iter().find(|(given, _)| *given && clicks.length.is_some()) {
        return Err(place(
            Error::input(format!("the scale is given in two ways: {option} and the length of the clicked points"))
                .remedy("Give one of them."),
        ));
    }
    let missing = clicks::FLOOR.saturating_sub(clicks.floor.len());
    if !clicks.floor.is_empty() && missing > 0 {
        return Err(place(
            Error::input(format!(
                "invalid floor: expected {} points at least, found {}",
                clicks::FLOOR,
                clicks.floor.len()
            ))
            .remedy("Click more points of the floor, or none."),
        ));
    }
    Ok(clicks)
}

/// Given values of cameras by their clicked points.
pub(super) struct Placed {
    /// Offsets by an event or by moving points.
    pub offsets: Vec<Option<f64>>,
    pub origin: Origin,
}

/// Finds the rig of clicked points, and puts lenses and poses among the known ones.
///
/// Errors: clicks in images of another shape; cameras without a pose; clicks that contradict each other; calibrated
/// positions.
pub(super) fn placed(
    clicks: &Clicks,
    pictures: &[Pictures],
    known: &mut [Option<Known>],
    clock: &graph::Solution,
    kept: &[bool],
    report: &mut Report,
) -> Result<Placed> {
    given::without_poses(known, "clicked points", "--points")?;
    let rig = Rig::new(clicks, pictures, known, clock, kept)?;
    let found = rig.solve();
    let missing: Vec<String> = found
        .cameras
        .iter()
        .zip(pictures)
        .filter_map(|(c, p)| c.as_ref().err().map(|why| format!("{}: {why}", p.name)))
        .collect();
    if !missing.is_empty() {
        return Err(Error::input(format!("the clicked points give no pose to {}", missing.join("; ")))
            .remedy("Click more points with --assist, or leave these cameras out (use = false in import.toml)."));
    }
    let (error, side) = (found.error.unwrap_or(0.0), rig.side());
    if error > MOST_ERROR * side {
        let (name, off) = rig.worst(&found);
        return Err(Error::input(format!(
            "the clicked points contradict each other: half of the clicks are more than {error:.0} px from their points, \
             {name} is {off:.0} px off"
        ))
        .remedy("Correct the points with the largest distances in the page of --assist."));
    }
    if found.ambiguous {
        report.guesses.push(
            "Another arrangement of the cameras fits the clicked points about as well: check the result, or click more \
             points at different depths."
                .into(),
        );
    }
    let by = rig.metres(&found);
    for (c, own) in known.iter_mut().enumerate() {
        let (pose, lens) = found.cameras[c].as_ref().expect("all have a pose");
        let pose = Se3 { rotation: pose.rotation, translation: scale(pose.translation, by.unwrap_or(1.0)) };
        given::place(own, pose, *lens, pictures[c].size);
    }
    let count: usize = clicks.points.iter().map(|p| p.clicks.len()).sum();
    report.guesses.push(format!(
        "Poses and focal lengths are those of {} clicked points: {count} clicks, {error:.1} px off at the median.",
        clicks.points.len()
    ));
    if by.is_some() {
        report.guesses.push("The unit of length is the metre, by the clicked length.".into());
    }
    let floor = rig.floor(&found).map(|(up, middle)| (up, scale(middle, by.unwrap_or(1.0))));
    Ok(Placed { offsets: rig.offsets(&found), origin: Origin::Clicked { floor, metres: by.is_some() } })
}

/// Clicks in pixels of the stored images, and what is known of their cameras.
struct Rig<'a> {
    clicks: &'a Clicks,
    names: Vec<&'a str>,
    cameras: Vec<clicks::Camera>,
    points: Vec<clicks::Point>,
    /// Lenses that were given.
    known: Vec<Option<Known>>,
    /// Pixels of stored images for one of the images in which points were clicked.
    factors: Vec<[f64; 2]>,
}

impl<'a> Rig<'a> {
    fn new(
        clicks: &'a Clicks,
        pictures: &'a [Pictures],
        known: &[Option<Known>],
        clock: &graph::Solution,
        kept: &[bool],
    ) -> Result<Self> {
        let names: Vec<&str> = pictures.iter().map(|p| p.name.as_str()).collect();
        let mut factors = Vec::with_capacity(pictures.len());
        for p in pictures {
            let size = clicks.cameras.get(&p.name).copied().unwrap_or(p.size);
            let remedy = "Import with the same --crop, or click the points again with --assist.";
            factors.push(given::factors("points were clicked", size, p, remedy)?);
        }
        let straight: Vec<Option<Straight>> =
            known.iter().zip(pictures).map(|(k, p)| k.map(|k| k.straight(p.size, 1.0))).collect();
        let before = |c: usize| clock.offsets[c].as_ref().map(|o| o.seconds);
        let fixed: Vec<Option<f64>> = (0..names.len()).map(|c| before(c).filter(|_| kept[c])).collect();
        let marked = clicks.offsets(&names, &fixed);
        let cameras = (0..names.len())
            .map(|c| clicks::Camera {
                size: pictures[c].size,
                focal: straight[c].as_ref().map(Straight::focal),
                interval: pictures[c].clock.interval,
                offset: marked[c].or(before(c)),
                keep_offset: kept[c],
            })
            .collect();
        let moving: Vec<&str> = clicks.points.iter().filter(|p| p.moment.is_some()).map(|p| p.name.as_str()).collect();
        let point = |p: &clicks::ClickedPoint| {
            let sight = |click: &clicks::Click| {
                let camera = names.iter().position(|n| *n == click.camera)?;
                let pixel = [click.x * factors[camera][0], click.y * factors[camera][1]];
                let pixel = match &straight[camera] {
                    Some(s) => s.pixel(pixel)?,
                    None => pixel,
                };
                Some(clicks::Sight { camera, pixel, time: click.time })
            };
            let track = p.moment.and_then(|_| moving.iter().position(|n| *n == p.name));
            clicks::Point { track, sights: p.clicks.iter().filter_map(sight).collect() }
        };
        let points = clicks.points.iter().map(point).collect();
        Ok(Self { clicks, names, cameras, points, known: known.to_vec(), factors })
    }

    fn solve(&self) -> Solution {
        clicks::solve(&self.cameras, &self.points)
    }

    /// Pixels of the largest image's larger side.
    fn side(&self) -> f64 {
        self.cameras.iter().flat_map(|c| c.size).max().unwrap_or(0) as f64
    }

    /// The click that is farthest from its point, and by how much.
    fn worst(&self, found: &Solution) -> (String, f64) {
        let mut worst = (String::new(), 0.0);
        for (p, residuals) in found.residuals.iter().enumerate() {
            for (sight, off) in self.points[p].sights.iter().zip(residuals) {
                if let Some(off) = off.filter(|o| *o > worst.1) {
                    worst = (format!("point {} in {}", self.clicks.points[p].name, self.names[sight.camera]), off);
                }
            }
        }
        worst
    }

    /// The position of a static point.
    fn place(&self, found: &Solution, name: &str) -> Option<[f64; 3]> {
        let k = self.clicks.points.iter().position(|p| p.name == name && p.moment.is_none())?;
        found.points[k]
    }

    /// Metres for one unit of the solution.
    fn metres(&self, found: &Solution) -> Option<f64> {
        let length = self.clicks.length.as_ref()?;
        let [a, b] = [0, 1].map(|k| self.place(found, &length.points[k]));
        Some(length.metres / norm(sub(a?, b?))).filter(|m| m.is_finite() && *m > 0.0)
    }

    /// Normal and centre of the floor.
    fn floor(&self, found: &Solution) -> Option<([f64; 3], [f64; 3])> {
        let points: Vec<[f64; 3]> = self.clicks.floor.iter().filter_map(|name| self.place(found, name)).collect();
        let centers: Vec<[f64; 3]> =
            found.cameras.iter().flatten().map(|(pose, _)| pose.inverse().translation).collect();
        let above = centers.iter().fold([0.0; 3], |m, c| add(m, scale(*c, 1.0 / centers.len() as f64)));
        plane(&points, above)
    }

    /// Offsets that an event or moving points give; others stay open.
    fn offsets(&self, found: &Solution) -> Vec<Option<f64>> {
        let marked = self.clicks.offsets(&self.names, &vec![None; self.names.len()]);
        let moves = |c: usize| {
            let shows = |p: &&clicks::Point| p.track.is_some() && p.sights.iter().any(|s| s.camera == c);
            self.points.iter().filter(shows).count() > 1
        };
        (0..self.names.len())
            .map(|c| {
                (marked[c].is_some() || moves(c)).then_some(found.offsets[c]).filter(|_| !self.cameras[c].keep_offset)
            })
            .collect()
    }

    /// A position in the camera's axes as a pixel of the images in which points are clicked.
    fn pixel(&self, camera: usize, found: &Solution, x: [f64; 3]) -> Option<[f64; 2]> {
        let (_, lens) = found.cameras[camera].as_ref().ok()?;
        let [u, v] = match &self.known[camera] {
            None => lens.project(x)?,
            Some(Known { intrinsics: Intrinsics { fx, fy, cx, cy }, lens, .. }) => {
                if x[2] <= 0.0 {
                    return None;
                }
                let ray = [x[0] / x[2], x[1] / x[2]];
                let [a, b] =
                    if matches!(lens, SceneLens::Pinhole) { ray } else { Distortion::new(*lens).distort(ray)? };
                [fx * a + cx, fy * b + cy]
            }
        };
        let by = self.factors[camera];
        Some([u / by[0], v / by[1]])
    }

    /// Where every camera shows every point, and the epipolar lines of clicks, for a page.
    fn json(&self, found: &Solution) -> Value {
        let rounded = |v: f64| (v * 100.0).round() / 100.0;
        let shown = |p: usize, c: usize| {
            let (pose, _) = found.cameras[c].as_ref().ok()?;
            self.pixel(c, found, pose.apply(found.points[p]?)).map(|x| x.map(rounded))
        };
        let count = self.names.len();
        let line = |from: usize, to: usize, pixel: [f64; 2]| -> Option<Vec<[f64; 2]>> {
            let (pose, lens) = found.cameras[from].as_ref().ok()?;
            let (other, _) = found.cameras[to].as_ref().ok()?;
            let (center, ahead) = (pose.inverse().translation, mat_vec(&transpose(&pose.rotation), lens.ray(pixel)));
            let at = |k: usize| {
                // Even in inverse depth: even along the line.
                let x = match k {
                    0 => return self.pixel(to, found, mat_vec(&other.rotation, ahead)),
                    _ => add(center, scale(ahead, NEAREST * STEPS as f64 / k as f64)),
                };
                self.pixel(to, found, other.apply(x))
            };
            let [width, height] = self.cameras[to].size.map(|s| s as f64);
            let near = |[x, y]: &[f64; 2]| x.abs() < 4.0 * width && y.abs() < 4.0 * height;
            Some((0..=STEPS).filter_map(at).filter(near).map(|x| x.map(rounded)).collect())
        };
        let points: Vec<Value> = (0..self.points.len())
            .map(|p| {
                let mut clicks = serde_json::Map::new();
                for (sight, off) in self.points[p].sights.iter().zip(&found.residuals[p]) {
                    let c = sight.camera;
                    let off = off.map(|o| rounded(o / (0.5 * (self.factors[c][0] + self.factors[c][1]))));
                    let lines: serde_json::Map<String, Value> = (0..count)
                        .filter(|&to| to != c)
                        .filter_map(|to| Some((self.names[to].to_owned(), json!(line(c, to, sight.pixel)?))))
                        .collect();
                    clicks.insert(self.names[c].to_owned(), json!({ "off": off, "lines": lines }));
                }
                let seen: serde_json::Map<String, Value> =
                    (0..count).filter_map(|c| Some((self.names[c].to_owned(), json!(shown(p, c)?)))).collect();
                json!({ "seen": seen, "clicks": clicks })
            })
            .collect();
        let cameras: Vec<Value> = (0..count)
            .map(|c| match &found.cameras[c] {
                Ok((_, lens)) => {
                    json!({ "focal": rounded(lens.focal / self.factors[c][0]), "offset": found.offsets[c] })
                }
                Err(why) => json!({ "missing": why, "offset": found.offsets[c] }),
            })
            .collect();
        let length = self.metres(found).map(|by| by * self.spread(found));
        json!({
            "cameras": cameras, "points": points, "error": found.error.map(rounded), "spare": found.spare,
            "ambiguous": found.ambiguous, "solved": found.cameras.iter().all(Result::is_ok),
            "floor": self.floor(found).is_some(), "radius": length.map(rounded),
        })
    }

    /// Mean distance of the cameras from their middle.
    fn spread(&self, found: &Solution) -> f64 {
        let centers: Vec<[f64; 3]> =
            found.cameras.iter().flatten().map(|(pose, _)| pose.inverse().translation).collect();
        let n = centers.len().max(1) as f64;
        let middle = centers.iter().fold([0.0; 3], |m, c| add(m, scale(*c, 1.0 / n)));
        centers.iter().map(|c| norm(sub(*c, middle))).sum::<f64>() / n
    }
}

/// What a page of manual alignment shows and calls.
pub struct Desk {
    folder: PathBuf,
    pictures: Vec<Pictures>,
    known: Vec<Option<Known>>,
    clock: graph::Solution,
    kept: Vec<bool>,
    clicks: Clicks,
    /// Number of changes that were saved: a page with an older number has not seen the newest points.
    revision: Mutex<u64>,
}

impl Desk {
    /// Stores the images of the cameras, as [`super::import`] does. Points of the request's file are shown first, else
    /// those of an earlier page.
    ///
    /// Errors: those of an import until images are stored; cameras that move.
    pub fn open(request: &Request, progress: &mut Progress<'_>, stop: &dyn Fn() -> bool) -> Result<Self> {
        let folder = request.folder.clone();
        let own = folder.join(FILE);
        let file = request.points.clone().or_else(|| own.is_file().then(|| own.clone()));
        // Points of the page may be unfinished.
        let all = material(&Request { points: None, ..request.clone() }, progress, stop)?;
        let Material { corrections, kept, moving, given, clock, mut pictures, .. } = all;
        if moving {
            return Err(Error::input("manual alignment is for fixed cameras, but these cameras move")
                .remedy("Use --rig fixed if they are fixed, or leave --assist out."));
        }
        if given.as_ref().is_some_and(|g| g.posed) {
            return Err(Error::input("the calibration contains poses, so nothing is left to align")
                .remedy("Leave --assist or --calibration out."));
        }
        let known = given::known(given.as_ref(), &corrections, &folder, &mut pictures)?;
        let names: Vec<&str> = pictures.iter().map(|p| p.name.as_str()).collect();
        let clicks = match &file {
            Some(file) => {
                let every: Vec<&str> = corrections.cameras.iter().map(|c| c.name.as_str()).collect();
                let mut clicks = Clicks::read(file, &every)?;
                clicks.keep(&names);
                // Points of another file must not replace what an earlier page saved.
                if own.is_file() && std::fs::canonicalize(file).ok() != std::fs::canonicalize(&own).ok() {
                    let old = folder.join(OLD);
                    std::fs::rename(&own, &old).map_err(|e| Error::io("cannot be renamed", e).at(own.display()))?;
                    progress.warn(format!("the points of an earlier page are now in {}", old.display()));
                }
                clicks
            }
            None => Clicks::none(Default::default()),
        };
        Ok(Self { folder, pictures, known, clock, kept, clicks, revision: Mutex::new(0) })
    }

    /// The file in which [`Desk::answer`] saves points.
    pub fn file(&self) -> PathBuf {
        self.folder.join(FILE)
    }

    /// Cameras with the times of their frames.
    pub fn about(&self) -> Value {
        let camera = |(p, o): (&Pictures, &Option<graph::Offset>)| {
            let times: Vec<f64> = p.shots.iter().map(|s| s.time).collect();
            json!({
                "name": p.name, "width": p.size[0], "height": p.size[1], "times": times,
                "offset": o.as_ref().map(|o| o.seconds),
            })
        };
        let cameras: Vec<Value> = self.pictures.iter().zip(&self.clock.offsets).map(camera).collect();
        json!({ "cameras": cameras })
    }

    /// Solves what a page clicked (`{"clicks": …, "revision": …}`), and saves it: points are never lost with the page.
    /// With `"finish": true`, errors are those that an import with these points would have. `{"load": true}` returns the
    /// newest points and their revision; a page with an older one is refused, so that it replaces nothing.
    pub fn answer(&self, asked: &Value) -> Result<Value> {
        let names: Vec<&str> = self.pictures.iter().map(|p| p.name.as_str()).collect();
        let file = self.file();
        let mut revision = self.revision.lock().unwrap_or_else(PoisonError::into_inner);
        if asked["load"] == true {
            let clicks = if file.is_file() { Clicks::read(&file, &names)? } else { self.clicks.clone() };
            return Ok(json!({ "clicks": clicks, "revision": *revision }));
        }
        if asked["revision"] != *revision {
            return Err(Error::input("the points were changed in another page").remedy("Reload this page."));
        }
        let clicks = Clicks::of(asked["clicks"].clone(), &names)?;
        let finish = asked["finish"] == true;
        if finish {
            let mut known = self.known.clone();
            placed(&clicks, &self.pictures, &mut known, &self.clock, &self.kept, &mut Report::default())?;
        }
        let rig = Rig::new(&clicks, &self.pictures, &self.known, &self.clock, &self.kept)?;
        write_atomically(&file, clicks.json().as_bytes())?;
        *revision += 1;
        let now = *revision;
        drop(revision);
        if finish {
            return Ok(json!({ "finished": true, "revision": now, "file": file.display().to_string() }));
        }
        let mut found = rig.json(&rig.solve());
        found["revision"] = json!(now);
        Ok(found)
    }

    /// The image of a camera nearest to a second of its own clock, as JPEG, and its time.
    pub fn image(&self, camera: usize, time: f64) -> Option<(Vec<u8>, f64)> {
        let p = self.pictures.get(camera)?;
        let away = |k: &usize| (p.shots[*k].time - time).abs();
        let nearest = (0..p.shots.len()).min_by(|a, b| away(a).total_cmp(&away(b)))?;
        let path = self.folder.join(p.file(nearest));
        let jpeg = if path.extension().is_some_and(|e| e == "jpg") {
            splat4d_train::files::read(&path).ok()?
        } else {
            let picture = Rgb8::read(&path).ok()?;
            encode::jpeg(&picture.data, [picture.width, picture.height], QUALITY).ok()?
        };
        Some((jpeg, p.shots[nearest].time))
    }
}
