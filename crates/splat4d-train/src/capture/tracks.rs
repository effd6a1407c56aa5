//! Point tracks on disk: where single points are in the images of a camera, frame by frame. CSV with the columns
//! `point`,
//! `frame`, `x`, `y` and, if there is one, `visible`; or `.npz` with `tracks` [frames, points, 2] and `visibility`
//! [frames, points], as trackers write them.

use super::json;
use super::lens::Distortion;
use splat4d::format::npy::Npy;
use splat4d::scene::Camera;
use splat4d::{Error, Result};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The columns that a table must have.
const COLUMNS: [&str; 4] = ["point", "frame", "x", "y"];

/// The tracks of a camera.
#[derive(Clone, Debug, PartialEq)]
pub struct Tracks {
    /// The file.
    pub path: PathBuf,
    /// Size of the images that places are pixels of.
    size: [usize; 2],
    /// By frame number, the points that are seen in it: their numbers, ascending, and places, pixels of the stored
    /// image.
    seen: BTreeMap<usize, Vec<(usize, [f32; 2])>>,
}

impl Tracks {
    /// Reads the tracks of a camera of this size, of this many frames. Errors name the file, the point and the frame.
    pub(super) fn read(path: &Path, size: [usize; 2], frames: usize) -> Result<Self> {
        let bytes = json::read_bytes(path)?;
        let npz = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("npz"));
        let rows = if npz { arrays(&bytes) } else { table(&bytes) }.map_err(|e| e.at(path.display()))?;
        let mut out = Self { path: path.to_owned(), size, seen: BTreeMap::new() };
        for (point, frame, place) in rows {
            let bad = |what: String, remedy: &str| {
                Err(Error::input(what).at(format!("{}, point {point}, frame {frame}", path.display())).remedy(remedy))
            };
            if frame >= frames {
                let what = format!("the track goes to frame {frame}, the camera has {frames}");
                return bad(what, "Frames are numbered from 0, independent of the images' names");
            }
            let inside = (0..2).all(|k| place[k] >= 0.0 && place[k] < size[k] as f32);
            if !inside {
                let what = format!(
                    "the point is visible at ({}, {}), outside of the {}x{} image",
                    place[0], place[1], size[0], size[1]
                );
                return bad(what, "Mark it as not visible there, and give pixels of the stored image, x before y");
            }
            out.seen.entry(frame).or_default().push((point, place));
        }
        for (frame, points) in &mut out.seen {
            points.sort_by_key(|p| p.0);
            if let Some(twice) = points.windows(2).find(|w| w[0].0 == w[1].0) {
                return Err(Error::input(format!("point {} is given twice in frame {frame}", twice[0].0))
                    .at(path.display())
                    .remedy("Give a point once a frame"));
            }
        }
        if out.seen.is_empty() {
            return Err(Error::input("no point is ever visible").at(path.display()).remedy("Leave the file out"));
        }
        Ok(out)
    }

    /// Whether points are seen in both of two frames.
    pub(crate) fn shares(&self, frame: usize, other: usize) -> bool {
        frame != other && self.pairs(frame, other).next().is_some()
    }

    /// Places in two frames of the points that are seen in both, pixels of the stored image.
    pub(crate) fn pairs(&self, from: usize, to: usize) -> impl Iterator<Item = [[f32; 2]; 2]> + '_ {
        let of = |frame: usize| self.seen.get(&frame).map_or(&[][..], Vec::as_slice);
        let then = of(to);
        of(from).iter().filter_map(move |(point, place)| {
            let at = then.binary_search_by_key(point, |p| p.0).ok()?;
            Some([*place, then[at].1])
        })
    }

    /// A position in the pixels of its frame's view; `None`: no ray ends there.
    pub(crate) fn in_view(&self, place: [f32; 2], source: &Camera, view: &Camera) -> Option<[f64; 2]> {
        let (a, b) = (&source.intrinsics, &view.intrinsics);
        let [x, y] =
            [0, 1].map(|k| f64::from(place[k]) * [source.width, source.height][k] as f64 / self.size[k] as f64);
        let [u, v] = Distortion::new(source.lens).undistort([(x - a.cx) / a.fx, (y - a.cy) / a.fy])?;
        Some([b.fx * u + b.cx, b.fy * v + b.cy])
    }
}

/// A point that is seen: its number, the frame, its place.
type Row = (usize, usize, [f32; 2]);

fn table(bytes: &[u8]) -> Result<Vec<Row>> {
    let remedy = "Write a header point,frame,x,y (or point,frame,x,y,visible) and a row for each point and frame";
    let text = crate::text::decode(bytes).map_err(|e| e.remedy(remedy))?;
    let mut lines = text.lines().enumerate().map(|(n, line)| (n + 1, line.trim())).filter(|(_, line)| !line.is_empty());
    let names: Vec<&str> = lines.next().map_or_else(Vec::new, |(_, line)| line.split(',').map(str::trim).collect());
    let column = |name: &str| names.iter().position(|n| *n == name);
    let Some(at) = COLUMNS.iter().map(|name| column(name)).collect::<Option<Vec<usize>>>() else {
        return Err(Error::input(format!("the first line is \"{:.60}\"", names.join(","))).remedy(remedy));
    };
    let visible = column("visible");
    let mut rows = Vec::new();
    for (number, line) in lines {
        let fields: Vec<&str> = line.split(',').map(str::trim).collect();
        let bad = |what: String| Error::input(what).at(format!("line {number}")).remedy(remedy);
        if fields.len() != names.len() {
            return Err(bad(format!("there are {} fields, not {}", fields.len(), names.len())));
        }
        match visible.map(|k| fields[k]) {
            Some("0" | "false" | "False") => continue,
            None | Some("1" | "true" | "True") => {}
            Some(other) => return Err(bad(format!("visible is \"{other:.30}\", not 0 or 1"))),
        }
        let whole = |k: usize| {
            fields[at[k]].parse::<usize>().map_err(|_| bad(format!("\"{:.30}\" is no {}", fields[at[k]], COLUMNS[k])))
        };
        let place = |k: usize| {
            let number = fields[at[k]].parse::<f32>().ok().filter(|x| x.is_finite());
            number.ok_or_else(|| bad(format!("\"{:.30}\" is no {}", fields[at[k]], COLUMNS[k])))
        };
        rows.push((whole(0)?, whole(1)?, [place(2)?, place(3)?]));
    }
    Ok(rows)
}

fn arrays(bytes: &[u8]) -> Result<Vec<Row>> {
    let tracks = Npy::read_member(bytes, "tracks")?;
    let visibility = Npy::read_member(bytes, "visibility")?;
    let [frames, points, 2] = tracks.shape[..] else {
        return Err(Error::input(format!("tracks are [frames, points, 2], not {:?}", tracks.shape))
            .remedy("numpy.savez(path, tracks=xy, visibility=seen), both with frames first"));
    };
    if visibility.shape != [frames, points] {
        return Err(Error::input(format!("visibility is {:?}, tracks {:?}", visibility.shape, tracks.shape))
            .remedy("Give [frames, points], 1 where the point is seen"));
    }
    let (places, seen) = (tracks.to_f32(), visibility.to_f32());
    let mut rows = Vec::new();
    for k in (0..frames * points).filter(|&k| seen[k] > 0.5) {
        let place = [places[2 * k], places[2 * k + 1]];
        if place.iter().any(|x| !x.is_finite()) {
            return Err(Error::input("the position of a visible point is not finite")
                .at(format!("point {}, frame {}", k % points, k / points))
                .remedy("Mark it as not visible"));
        }
        rows.push((k % points, k / points, place));
    }
    Ok(rows)
}
