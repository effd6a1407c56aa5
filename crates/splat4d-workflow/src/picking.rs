//! Shapes drawn over an image, as text of selections.

use serde::Deserialize;
use splat4d::device;
use splat4d::edit::Surface;
use splat4d::layers::{Evaluation, Scene};
use splat4d::math::{quat, se3};
use splat4d::play::Player;
use splat4d::render::{Image, RenderConfig, Shot};
use splat4d::scene::splats::SPLAT_OPACITY;
use splat4d::scene::{Camera, Intrinsics, Time};
use splat4d::{Error, Result};

/// Fainter ones are not reported, and have no depth.
const FAINT: f32 = 0.1;
/// Below this a pixel shows nothing.
const SEEN: f32 = 0.5;
/// Share of the nearest visible depth by which a selection reaches towards the camera.
const MARGIN: f64 = 0.05;
/// Distance of similar colours, 0 to 1.
const ALIKE: f64 = 0.12;
/// Farther than this nothing is searched for, scene units.
const ENDLESS: f64 = 1e6;
/// Most corners that a page may draw.
const CORNERS: usize = 256;
/// Share of a drawn shape's narrower side by which a selection without *Through* reaches behind the first visible
/// surface: half of it holds an object about as deep as it is wide, drawn around with some room, and nothing that is
/// behind.
const BEHIND_SURFACE: f64 = 0.5;
/// Most cells along a side of the stored depth map: its text stays below 5 kB.
const MOST_CELLS: usize = 24;
/// Least side of a cell, pixels of the image in which depths are looked up.
const CELL: f64 = 2.0;

/// The shape drawn on the image.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum Shape {
    Box,
    Sphere,
    Lasso,
    Color,
}

/// Renders a scene at a time, with depths where they are requested.
pub(crate) fn draw(scene: &Scene<f32>, camera: &Camera, t: f64, depth: bool, image: &mut Image<f32>) -> Result<()> {
    let mut player = Player::of_scene(scene);
    let splats = player.at(Time(t.clamp(scene.clip[0], scene.clip[1])))?;
    let shot = Shot { depth, ..Shot::new(&splats, camera, scene.background) };
    device::cpu(RenderConfig::default()).render(&shot, image)
}

/// A number as people write it: five digits that count.
pub(crate) fn number(x: f64) -> String {
    format!("{x:.4e}").parse::<f64>().map_or_else(|_| x.to_string(), |x| (x + 0.0).to_string())
}

fn numbers(of: &[f64]) -> String {
    of.iter().map(|x| number(*x)).collect::<Vec<_>>().join(",")
}

/// Opaque enough Gaussians at t for which `which` holds, and where they are.
pub(crate) fn there(scene: &Scene<f32>, t: f64, which: impl Fn(usize, usize) -> bool) -> Vec<[f64; 3]> {
    let mut seen = Evaluation::default();
    scene.at(Time(t.clamp(scene.clip[0], scene.clip[1])), &mut seen);
    let mut out = Vec::new();
    for (layer, tape) in seen.tapes().enumerate() {
        for j in 0..tape.out().rows() {
            if tape.out().get(j, SPLAT_OPACITY) >= FAINT && which(layer, tape.rows().id(j)) {
                out.push(tape.out().read::<3>(j, 0).map(f64::from));
            }
        }
    }
    out
}

/// The shape drawn on the image.
pub(crate) struct Drawn<'a> {
    pub shape: Shape,
    pub corners: &'a [[f64; 2]],
    /// Whether all that is behind is meant as well.
    pub through: bool,
}

impl Drawn<'_> {
    /// The selection in words. Errors: too few corners, nothing is seen there.
    pub(crate) fn words(&self, scene: &Scene<f32>, camera: &Camera, t: f64) -> Result<String> {
        let least = match self.shape {
            Shape::Color => 1,
            Shape::Lasso => 3,
            Shape::Box | Shape::Sphere => 2,
        };
        let sound = self.corners.iter().flatten().all(|x| x.is_finite());
        if !(least..=CORNERS).contains(&self.corners.len()) || !sound {
            return Err(Error::input("the outline has too few or too many corners").remedy("Draw it again"));
        }
        let mut image = Image::default();
        draw(scene, camera, t, true, &mut image)?;
        let k = &camera.intrinsics;
        let world = camera.cam_from_world.inverse();
        let depth = |i: usize| f64::from(image.depth.data[i] / image.alpha.data[i]);
        let shows = |i: usize| image.alpha.data[i] >= SEEN;
        let nothing = || Error::input("nothing is visible there").remedy("Draw over something visible");
        // The pixel of a corner, within the image.
        let pixel = |[u, v]: [f64; 2]| {
            let column = (k.fx * u + k.cx).clamp(0.0, (camera.width - 1) as f64) as usize;
            let row = (k.fy * v + k.cy).clamp(0.0, (camera.height - 1) as f64) as usize;
            row * camera.width + column
        };
        let [first, last] = [self.corners[0], self.corners[self.corners.len() - 1]];
        match self.shape {
            Shape::Color => {
                let i = pixel(first);
                let alpha = image.alpha.data[i];
                if !shows(i) {
                    return Err(nothing());
                }
                let behind = scene.background;
                let own = |c: usize| (image.color.plane(c)[i] - (1.0 - alpha) * behind[c]) / alpha;
                let rgb = [0, 1, 2].map(|c| (1e3 * f64::from(own(c).clamp(0.0, 1.0))).round() / 1e3);
                Ok(format!("color({}, {ALIKE})", numbers(&rgb)))
            }
            Shape::Sphere => {
                let i = pixel(first);
                if !shows(i) {
                    return Err(nothing());
                }
                let z = depth(i);
                let center = world.apply([first[0] * z, first[1] * z, z]);
                let radius = z * (last[0] - first[0]).hypot(last[1] - first[1]);
                Ok(format!("sphere({}, {})", numbers(&center), number(radius)))
            }
            Shape::Box | Shape::Lasso => {
                let polygon = match self.shape {
                    Shape::Box => vec![first, [last[0], first[1]], last, [first[0], last[1]]],
                    _ => self.corners.to_vec(),
                };
                let center = |i: usize| {
                    let (row, column) = (i / camera.width, i % camera.width);
                    [(column as f64 + 0.5 - k.cx) / k.fx, (row as f64 + 0.5 - k.cy) / k.fy]
                };
                let inside_shape = |i: usize| splat4d::edit::within(&polygon, center(i));
                let mut seen: Vec<(usize, f64)> = (0..camera.width * camera.height)
                    .filter(|&i| shows(i) && inside_shape(i))
                    .map(|i| (i, depth(i)))
                    .collect();
                if seen.is_empty() {
                    return Err(nothing());
                }
                seen.sort_by(|a, b| a.1.total_cmp(&b.1));
                let near = seen[seen.len() / 50].1;
                let side = |k: usize| {
                    let of = |pick: fn(f64, f64) -> f64| polygon.iter().map(|c| c[k]).reduce(pick).unwrap_or(0.0);
                    [of(f64::min), of(f64::max)]
                };
                let (eye, turn) = (world.translation, quat::from_rotation(&world.rotation));
                let (wide, tall) = (side(0), side(1));
                let surface = (!self.through).then(|| {
                    let narrow = (wide[1] - wide[0]).min(tall[1] - tall[0]);
                    let seen: Vec<([f64; 2], f64)> = seen.iter().map(|&(i, z)| (center(i), z)).collect();
                    first_surface(eye, turn, [wide, tall], k, narrow, &seen)
                });
                let visible = surface.as_ref().map_or(String::new(), |s| format!(" and {}", visible_words(s)));
                // In front of the surface nothing hides: a margin takes what reaches towards the camera.
                let range = if self.through { [0.0, ENDLESS] } else { [near * (1.0 - MARGIN), ENDLESS] };
                if self.shape == Shape::Lasso {
                    let corners: Vec<f64> = polygon.iter().flatten().copied().collect();
                    return Ok(format!(
                        "lasso({}, {}, {}, {}){visible}",
                        numbers(&eye),
                        numbers(&turn),
                        numbers(&range),
                        numbers(&corners)
                    ));
                }
                let inside = |x: &[f64; 3]| {
                    let p = camera.cam_from_world.apply(*x);
                    let point = [p[0] / p[2], p[1] / p[2]];
                    let shown = |s: &Surface| s.cell(point).is_some_and(|cell| p[2] <= s.depths[cell]);
                    p[2] > range[0]
                        && p[2] <= range[1]
                        && splat4d::edit::within(&polygon, point)
                        && surface.as_ref().is_none_or(shown)
                };
                let all: Vec<[f64; 3]> = there(scene, t, |_, _| true).into_iter().filter(inside).collect();
                if all.is_empty() {
                    return Err(nothing());
                }
                let edge = |k: usize, pick: fn(f64, f64) -> f64| all.iter().map(|x| x[k]).reduce(pick).unwrap_or(0.0);
                let low: [f64; 3] = std::array::from_fn(|k| edge(k, f64::min));
                let high: [f64; 3] = std::array::from_fn(|k| edge(k, f64::max));
                let room: [f64; 3] = std::array::from_fn(|k| 0.01 * (high[k] - low[k]) + 1e-6);
                let (low, high) = (se3::sub(low, room), se3::add(high, room));
                Ok(format!("box({}, {}){visible}", numbers(&low), numbers(&high)))
            }
        }
    }
}

/// The first visible surface within a shape, as a coarse depth map.
///
/// `sides` are the shape's ranges of x/z and y/z; `k` the intrinsics of the image; `narrow` the shape's narrower side,
/// x/z; `seen` the image points that show something, with their depths. A cell takes the nearest depth in it, so that
/// nothing behind an outline is selected.
fn first_surface(
    eye: [f64; 3],
    turn: [f64; 4],
    sides: [[f64; 2]; 2],
    k: &Intrinsics,
    narrow: f64,
    seen: &[([f64; 2], f64)],
) -> Surface {
    let cells = |[from, to]: [f64; 2], focal: f64| (((to - from) * focal / CELL).ceil() as usize).clamp(1, MOST_CELLS);
    let (columns, rows) = (cells(sides[0], k.fx), cells(sides[1], k.fy));
    let corners = [[sides[0][0], sides[1][0]], [sides[0][1], sides[1][1]]];
    let mut surface = Surface { eye, turn, corners, columns, depths: vec![0.0; rows * columns] };
    for &(point, z) in seen {
        if let Some(cell) = surface.cell(point) {
            let depth = &mut surface.depths[cell];
            *depth = if *depth == 0.0 { z } else { depth.min(z) };
        }
    }
    surface.depths.iter_mut().for_each(|z| *z *= 1.0 + BEHIND_SURFACE * narrow);
    surface
}

/// The selection in words.
fn visible_words(s: &Surface) -> String {
    let corners = s.corners.concat();
    let [eye, turn, corners, depths] = [&s.eye[..], &s.turn, &corners, &s.depths].map(numbers);
    format!("visible({eye}, {turn}, {corners}, {}, {depths})", s.columns)
}
