//! The size of the world, and what is up in it, by tags of known size.

use super::poses::Solved;
use super::stored::Stored;
use crate::board::{self, Board, Lies, Tag};
use crate::sfm::known::pixel_unit;
use crate::sfm::lens::Known;
use crate::sfm::pictures::Pictures as _;
use crate::{Error, Result};
use rayon::prelude::*;
use splat4d::math::median;
use splat4d::math::se3::{add, cross, dot, norm, normalize, scale, sub};
use splat4d::scene::Camera;
use splat4d_train::event::Progress;
use splat4d_train::vision::raster::grey;
use splat4d_train::vision::triangulate::{PixelObservation, angle_at, triangulate};

/// Times at which fixed cameras search for tags, and frames in which a moving one does.
const MOMENTS: usize = 12;
/// A frame farther from a time than so much of an interval does not show it.
const NEAR: f64 = 0.5;
/// Degrees between two cameras that see a corner, at least: as for the triangulation of points.
const ANGLE: f64 = 1.5;
/// Pixels of 1920 that a corner may be off its place.
const OFF: f64 = 3.0;
/// Of the side, by which a tag's four sides may differ from their mean.
const UNEQUAL: f64 = 0.1;
/// Of the median, by which the median tag's side may differ.
const UNLIKE: f64 = 0.03;
/// Directions farther than this from the mean are left out (cosine of 10 degrees).
const ASKEW: f64 = 0.985;

/// Results from tags.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct TagWorld {
    /// Metres of the unit that lengths had.
    pub scale: f64,
    /// Upwards, and the middle of the tag with the lowest number, metres.
    pub frame: Option<([f64; 3], [f64; 3])>,
    /// How many tags were measured, how often, and how far the median one is off, of its side.
    pub tags: usize,
    pub times: usize,
    pub spread: f64,
}

impl TagWorld {
    pub(super) fn about(&self) -> String {
        let many = |n: usize, one: &str| if n == 1 { format!("1 {one}") } else { format!("{n} {one}s") };
        format!(
            "The unit of length is the metre: {} measured {}, which agree to {:.1} %.",
            many(self.tags, "tag"),
            many(self.times, "time"),
            100.0 * self.spread
        )
    }
}

/// A tag in a camera's image.
struct TagView {
    camera: Camera,
    tag: Tag,
    /// Pixels that a corner may be off.
    tolerance: f64,
}

/// A tag in the world.
struct Placed {
    id: usize,
    corners: [[f64; 3]; 4],
}

/// Searches for a board's tags, and measures them.
///
/// Errors: images that cannot be read; no tags, or none that two cameras see; tags that contradict each other.
pub(super) fn measured(
    board: &Board,
    stored: &Stored<'_>,
    solved: &Solved,
    progress: &mut Progress<'_>,
) -> Result<TagWorld> {
    let clock = stored.on(&solved.offsets);
    // Each sample: a camera, a frame, and its time.
    let looks = if solved.moving { walked(&clock, solved) } else { stood(&clock, solved) };
    let mut seen: Vec<(usize, TagView)> = Vec::new();
    const AT_ONCE: usize = 8;
    for (k, some) in looks.chunks(AT_ONCE).enumerate() {
        progress.phase("searching for tags", k * AT_ONCE, looks.len());
        let found: Vec<Vec<(usize, TagView)>> =
            some.par_iter().map(|look| look.tags(board, &clock, solved)).collect::<Result<_>>()?;
        seen.extend(found.into_iter().flatten());
    }
    let sightings = seen.len();
    let placed = placed(&seen);
    of(board, &placed, solved.up).map_err(|e| match sightings {
        0 => Error::input(format!("no tag of {} was found in {} images", board.family.name, looks.len()))
            .remedy(
                "Is it this family, is each of its bits at least two pixels wide, and is there white around every tag? Without \
                 --board the unit is a guess.",
            ),
        _ if placed.is_empty() => {
            Error::input(format!("tags are seen {sightings} times, but none by two cameras at once where they would place it"))
                .remedy("Put the board where neighbouring cameras see it, and let it rest for a second.")
        }
        _ => e,
    })
}

struct TagImage {
    camera: usize,
    frame: usize,
    moment: usize,
}

/// Fixed cameras use shared times, because the board may be carried about.
fn stood(stored: &Stored<'_>, solved: &Solved) -> Vec<TagImage> {
    let cameras: Vec<usize> = (0..stored.cameras()).filter(|&c| solved.cameras[c].is_ok()).collect();
    let ends = |c: usize| (stored.time(c, 0), stored.time(c, stored.frames(c) - 1));
    let first = cameras.iter().map(|&c| ends(c).0).fold(f64::INFINITY, f64::min);
    let last = cameras.iter().map(|&c| ends(c).1).fold(f64::NEG_INFINITY, f64::max);
    let mut out = Vec::new();
    for moment in 0..MOMENTS {
        let at = first + (last - first) * (moment as f64 + 0.5) / MOMENTS as f64;
        for &camera in &cameras {
            let off = |k: &usize| (stored.time(camera, *k) - at).abs();
            let nearest = (0..stored.frames(camera)).min_by(|a, b| off(a).total_cmp(&off(b)));
            let interval = stored.pictures[camera].clock.interval;
            // One image is of every time.
            let near = |k: &usize| stored.frames(camera) == 1 || off(k) <= NEAR * interval;
            out.extend(nearest.filter(near).map(|frame| TagImage { camera, frame, moment }));
        }
    }
    out.dedup_by_key(|l| (l.camera, l.frame, l.moment));
    out
}

/// Moving cameras see a fixed board from all sides.
fn walked(stored: &Stored<'_>, solved: &Solved) -> Vec<TagImage> {
    let mut out = Vec::new();
    for (camera, stand) in solved.cameras.iter().enumerate() {
        let Ok(stand) = stand else { continue };
        let known: Vec<usize> = (0..stored.frames(camera)).filter(|&k| stand.poses[k].is_some()).collect();
        let count = known.len().min(4 * MOMENTS);
        out.extend((0..count).map(|k| TagImage { camera, frame: known[k * known.len() / count], moment: 0 }));
    }
    out
}

impl TagImage {
    fn tags(&self, board: &Board, stored: &Stored<'_>, solved: &Solved) -> Result<Vec<(usize, TagView)>> {
        let Ok(stand) = &solved.cameras[self.camera] else { return Ok(Vec::new()) };
        let Some(pose) = stand.poses.get(if stand.fixed { 0 } else { self.frame }).copied().flatten() else {
            return Ok(Vec::new());
        };
        let size = stored.pictures[self.camera].size;
        let known = Known { intrinsics: stand.intrinsics, lens: stand.lens, pose: Some(pose) };
        let straight = known.straight(size, 1.0);
        let camera = straight.camera(pose, size);
        let picture = grey(&stored.load(self.camera, self.frame)?);
        let tolerance = OFF * pixel_unit(size);
        let straightened = |tag: Tag| {
            let corners = tag.corners.map(|c| straight.pixel(c));
            let [Some(a), Some(b), Some(c), Some(d)] = corners else { return None };
            Some((
                self.moment,
                TagView { camera: camera.clone(), tag: Tag { corners: [a, b, c, d], ..tag }, tolerance },
            ))
        };
        Ok(board::tags(&picture, &board.family).into_iter().filter_map(straightened).collect())
    }
}

/// Tags where two cameras and more see them at one time, each time for itself.
fn placed(seen: &[(usize, TagView)]) -> Vec<Placed> {
    let mut keys: Vec<(usize, usize)> = seen.iter().map(|(m, s)| (*m, s.tag.id)).collect();
    keys.sort_unstable();
    keys.dedup();
    let of = |&(moment, id): &(usize, usize)| {
        let about: Vec<&TagView> =
            seen.iter().filter(|(m, s)| *m == moment && s.tag.id == id).map(|(_, s)| s).collect();
        let corner = |k: usize| {
            let sights: Vec<PixelObservation<'_>> =
                about.iter().map(|s| PixelObservation { camera: &s.camera, pixel: s.tag.corners[k] }).collect();
            let x = triangulate(&sights)?;
            let near = sights.iter().zip(&about).all(|(s, a)| s.error(x) <= a.tolerance);
            let centers: Vec<[f64; 3]> = sights.iter().map(|s| s.camera.center()).collect();
            let wide = |a: &[f64; 3]| centers.iter().any(|b| angle_at(x, *a, *b) >= ANGLE.to_radians());
            (near && centers.iter().any(wide)).then_some(x)
        };
        let [Some(a), Some(b), Some(c), Some(d)] = [corner(0), corner(1), corner(2), corner(3)] else { return None };
        Some(Placed { id, corners: [a, b, c, d] })
    };
    keys.iter().filter(|_| seen.len() > 1).filter_map(of).collect()
}

impl Placed {
    /// The mean side, of what is a square.
    fn side(&self) -> Option<f64> {
        let sides: [f64; 4] = std::array::from_fn(|k| norm(sub(self.corners[(k + 1) % 4], self.corners[k])));
        let mean = sides.iter().sum::<f64>() / 4.0;
        sides.iter().all(|s| (s - mean).abs() <= UNEQUAL * mean).then_some(mean)
    }

    fn middle(&self) -> [f64; 3] {
        scale(self.corners.iter().fold([0.0; 3], |s, c| add(s, *c)), 0.25)
    }

    /// Along its upper edge and down its side.
    fn edges(&self) -> [[f64; 3]; 2] {
        let [a, b, c, d] = self.corners;
        [normalize(add(sub(b, a), sub(c, d))), normalize(add(sub(d, a), sub(c, b)))]
    }

    /// Upwards, as the board is put up; `held` is what cameras hold upwards.
    fn up(&self, lies: Lies, held: [f64; 3]) -> [f64; 3] {
        let [right, down] = self.edges();
        match lies {
            // Towards those who see it.
            Lies::Floor => normalize(cross(down, right)),
            // Whichever edge is the upper one: programs print them turned.
            Lies::Wall => [right, down]
                .into_iter()
                .flat_map(|e| [e, e.map(|v| -v)])
                .max_by(|a, b| dot(*a, held).total_cmp(&dot(*b, held)))
                .expect("there are four"),
        }
    }
}

/// Results from placed tags.
fn of(board: &Board, placed: &[Placed], held: [f64; 3]) -> Result<TagWorld> {
    let contradicts = |what: String| {
        Error::input(what).remedy(
            "Give the length of one tag's dark square; if there are tags of two sizes, cover one kind; let the board rest while it is \
             filmed.",
        )
    };
    let square: Vec<(&Placed, f64)> = placed.iter().filter_map(|p| Some((p, p.side()?))).collect();
    let Some(side) = median(&mut square.iter().map(|s| s.1).collect::<Vec<_>>()) else {
        return Err(contradicts(format!("{} tags were placed, but none as a square", placed.len())));
    };
    let spread =
        median(&mut square.iter().map(|s| (s.1 / side - 1.0).abs()).collect::<Vec<_>>()).expect("there are some");
    if spread > UNLIKE {
        return Err(contradicts(format!(
            "the tags' sizes contradict each other: the median one is {:.0} % off",
            100.0 * spread
        )));
    }
    let scale = board.side / side;
    let mut ids: Vec<usize> = square.iter().map(|s| s.0.id).collect();
    ids.sort_unstable();
    ids.dedup();
    let frame = board.lies.map(|lies| {
        let ups: Vec<[f64; 3]> = square.iter().map(|s| s.0.up(lies, held)).collect();
        let mean = |all: &[[f64; 3]]| normalize(all.iter().fold([0.0; 3], |s, u| add(s, *u)));
        let about = mean(&ups);
        let near: Vec<[f64; 3]> = ups.iter().copied().filter(|u| dot(*u, about) >= ASKEW).collect();
        if 2 * near.len() <= ups.len() {
            return Err(contradicts("the tags do not agree about what is up".into()));
        }
        let middles: Vec<[f64; 3]> = square.iter().filter(|s| s.0.id == ids[0]).map(|s| s.0.middle()).collect();
        let origin = std::array::from_fn(|k| {
            scale * median(&mut middles.iter().map(|m| m[k]).collect::<Vec<_>>()).expect("the tag was placed")
        });
        Ok((mean(&near), origin))
    });
    Ok(TagWorld { scale, frame: frame.transpose()?, tags: ids.len(), times: square.len(), spread })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::board::tests::{Put, drawn};
    use splat4d::math::Se3;

    /// Two metres of the world are one unit; the floor is askew in it.
    #[test]
    fn tags_give_metres_and_up() {
        let board: Board = "36h11:0.3:floor".parse().expect("it is right");
        let unit = 2.0;
        let tilt = Se3::look_at([0.0; 3], [0.3, 1.0, 0.2], [0.1, 0.2, 1.0]).rotation;
        let world = |p: [f64; 3]| splat4d::math::se3::mat_vec(&tilt, p).map(|v| v / unit);
        let family = board.family;
        // Seen from above, x to the right and y downwards in the image: z of the plane points away.
        let put = |id: usize, x: f64, y: f64, side: f64| Put {
            family,
            id,
            corner: world([x, y, 0.0]),
            right: world([side, 0.0, 0.0]),
            down: world([0.0, -side, 0.0]),
        };
        let puts = [put(4, -0.4, 0.2, 0.3), put(9, 0.2, 0.1, 0.3)];
        let up = world([0.0, 0.0, unit]);
        let seen = |puts: &[Put]| -> Vec<(usize, TagView)> {
            let mut all = Vec::new();
            for eye in [[-1.0, -1.2, 1.6], [0.1, -1.5, 1.5], [1.1, -1.1, 1.7]] {
                let pose = Se3::look_at(world(eye), world([0.0; 3]), up);
                let camera = Camera::with_fov_y(pose, 0.7, 320, 240);
                let found = board::tags(&drawn(&camera, puts), &family);
                all.extend(found.into_iter().map(|tag| (0, TagView { camera: camera.clone(), tag, tolerance: 0.5 })));
            }
            all
        };
        let looked = seen(&puts);
        assert_eq!(looked.len(), 6);
        let found = of(&board, &placed(&looked), up).expect("tags are seen");
        assert!((found.scale / unit - 1.0).abs() < 0.005, "{found:?}");
        let (floor, origin) = found.frame.expect("it lies on the floor");
        assert!(dot(floor, up) > 0.9999, "{floor:?} for {up:?}");
        let middle = world([-0.25, 0.05, 0.0]).map(|v| v * unit);
        assert!(norm(sub(origin, middle)) < 0.005, "{origin:?} for {middle:?}");
        assert_eq!((found.tags, found.times), (2, 2));
        // Of two sizes.
        let mixed = seen(&[put(4, -0.4, 0.2, 0.3), put(9, 0.2, 0.1, 0.4)]);
        assert!(of(&board, &placed(&mixed), up).is_err() || placed(&mixed).len() < 2);
        // One camera places nothing.
        let alone: Vec<(usize, TagView)> = looked.into_iter().take(2).collect();
        assert!(placed(&alone).is_empty());
        // Against a wall, whichever edge was printed as the upper one, it is the one that cameras hold upwards.
        let hung = Placed { id: 0, corners: [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 0.0, 0.0]] };
        assert_eq!(hung.up(Lies::Wall, [0.1, -0.2, 0.9]), [0.0, 0.0, 1.0]);
    }
}
