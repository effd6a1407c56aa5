//! Where cameras see beyond the points: image cells without near points whose content fits a far distance.
//!
//! Structure from motion has no points on a clear sky, and those on a hazy horizon are at arbitrary depths. Every
//! training image is divided into cells. A cell without near points is compared with the other images at spheres of
//! growing radius around the cameras: a wall without texture fits best where it is, a sky and a far landscape fit far
//! away.

mod view;

use crate::Result;
use crate::capture::frames::{Frames, Picture};
use rayon::prelude::*;
use splat4d::math::median;
use splat4d::math::se3::{dot, norm, sub};
use splat4d::scene::Camera;
use view::{Cell, SAMPLES, View, around, cell, grid, occupied};
pub(super) use view::{FOREGROUND, views};

/// Views that are examined at most, evenly chosen.
const VIEWS: usize = 40;
/// Images are halved until their longer side has at most this many pixels: what is far has little detail there, and
/// errors of poses count less.
const LONGEST_SIDE: usize = 480;
/// Images whose longer side is shorter have too few pixels in a cell.
pub(crate) const SHORTEST_SIDE: usize = 128;
/// Points nearer than this to the cameras' centre occupy their cells, units ([`Sky::unit`]).
const NEAR: f64 = 10.0;
/// Radii that a wall would have, and those of far surroundings, units. From the last on, the parallax between cameras is
/// below a pixel of an image of 1,000 pixels.
const NEAR_RADII: [f64; 5] = [1.0, 1.5, 2.0, 3.0, 4.0];
const FAR_RADII: [f64; 8] = [10.0, 20.0, 40.0, 80.0, 160.0, 320.0, 640.0, 1280.0];
/// The largest radius whose error is within this share of the least one is taken: beyond it nothing is measured.
const AS_GOOD: f64 = 1.03;
/// Differences of colour above this are occlusion or another object, and count as this.
const LARGEST_DIFFERENCE: f64 = 0.2;
/// Two images agree in a cell up to this mean difference: noise, and automatic exposure of a hand-held camera.
const AGREES: f64 = 0.06;
/// The surroundings are far if the error there is at most this share of that at the best near radius, and not above the
/// largest. A walk outdoors has 0.75, a synthetic sky less, a room 1.5 (`studies/records/2026-11-28-far-shell.md`).
const BETTER: f64 = 0.85;
const LARGEST_ERROR: f64 = 0.12;
/// A cell with near points shows the surroundings all the same, and the points are wrong matches, if this many images at
/// least agree there, and their median difference is at most this share of that at the best near radius.
const WITNESSES: usize = 3;
const MUCH_BETTER: f64 = 0.5;
/// Other times at which images of a fixed camera are examined, and the mean difference of colour from which on a cell
/// moves.
const TIMES: usize = 2;
const CHANGED: f32 = 0.04;
/// Share of the images without near points, and comparisons, from which far surroundings are looked for.
const OPEN: f64 = 0.05;
const PAIRS: usize = 200;

/// The far surroundings as images show them.
pub(crate) struct Sky {
    views: Vec<View>,
    center: [f64; 3],
    /// Length in which distances are stated, scene units: the cameras' extent, or the distance of the nearest quarter of
    /// the points where that is more (cameras that hardly move).
    pub unit: f64,
    /// Distance of the surroundings from the cameras' centre, scene units.
    pub radius: f64,
}

/// The reasons for which surroundings are far, or not.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Evidence {
    /// Share of the images' cells without near points.
    pub open: f64,
    /// Mean difference of colour between images there, at the best near and at the best far radius.
    pub errors: [f64; 2],
    /// Comparisons.
    pub pairs: usize,
}

impl Evidence {
    /// Whether much of what cameras see has no near points, so that the decision is of interest.
    pub(crate) fn is_open(&self) -> bool {
        self.open >= OPEN
    }

    /// Whether that is far away.
    pub(crate) fn is_far(&self) -> bool {
        let [near, far] = self.errors;
        self.is_open() && self.pairs >= PAIRS && far <= BETTER * near && far <= LARGEST_ERROR
    }
}

/// What views show at a point on the sphere.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Look {
    /// Views that have it in the image; of these, those without near points there; of these, those with far ones.
    pub seen: usize,
    pub open: usize,
    pub sky: usize,
    /// Mean colour in the last ones.
    pub color: [f32; 3],
}

impl Look {
    /// Whether it belongs to the far surroundings.
    pub(crate) fn is_sky(&self) -> bool {
        self.sky > 0 && 2 * self.sky >= self.open
    }
}

impl Sky {
    /// Reads images and finds cells without near points; the radius is not known yet. `center`, `extent`: of the
    /// cameras. Errors: an image cannot be read.
    pub(crate) fn open(frames: &dyn Frames, points: &[[f64; 3]], center: [f64; 3], extent: f64) -> Result<Self> {
        let mut distances: Vec<f64> = points.iter().map(|&x| norm(sub(x, center))).collect();
        distances.sort_by(f64::total_cmp);
        let unit = distances.get(distances.len() / 4).map_or(extent, |d| d.max(extent));
        let near: Vec<[f64; 3]> = points.iter().copied().filter(|&x| norm(sub(x, center)) < NEAR * unit).collect();
        let chosen = views(frames, VIEWS);
        let mut views = Vec::new();
        let mut picture = Picture::default();
        for i in chosen {
            frames.load(i, &mut picture)?;
            let mut camera = frames.camera(i).clone();
            while camera.width.max(camera.height) > LONGEST_SIDE {
                picture.halve();
                camera = camera.downscaled(2);
            }
            let grid = grid(&camera);
            let busy = occupied(&camera, grid, &near);
            let mut cells: Vec<Cell> = busy.into_iter().map(|b| if b { Cell::Near } else { Cell::Open }).collect();
            let [w, h] = [camera.width, camera.height];
            let moves = |p: usize| picture.mask.as_ref().is_some_and(|m| m.data[p] > FOREGROUND);
            let empty = |p: usize| picture.weight.as_ref().is_some_and(|m| m.data[p] == 0.0);
            for p in (0..w * h).filter(|&p| moves(p) || empty(p)) {
                if let Some(k) = cell(&camera, grid, [(p % w) as f64 + 0.5, (p / w) as f64 + 0.5]) {
                    cells[k] = Cell::Moving;
                }
            }
            let center = camera.center();
            views.push(View { camera, center, color: picture.color.clone(), grid, cells });
            let view = views.last_mut().expect("just added");
            for other in later(frames, i) {
                frames.load(other, &mut picture)?;
                while picture.color.width.max(picture.color.height) > LONGEST_SIDE {
                    picture.halve();
                }
                view.changed(&picture.color, CHANGED);
            }
        }
        Ok(Self { views, center, unit, radius: 0.0 })
    }

    /// The point of a sphere around the centre that a camera sees at a pixel position; `None`: it is outside of it.
    fn beyond(&self, camera: &Camera, eye: [f64; 3], pixel: [f64; 2], radius: f64) -> Option<[f64; 3]> {
        let ray = sub(camera.unproject(pixel, 1.0), eye);
        let from = sub(eye, self.center);
        // |from + s ray| = radius
        let (a, b, c) = (dot(ray, ray), dot(ray, from), dot(from, from) - radius * radius);
        let s = (-b + (b * b - a * c).sqrt()) / a;
        (c < 0.0).then(|| std::array::from_fn(|k| eye[k] + s * ray[k]))
    }

    /// Mean difference of colour between a view's cell and every other image that shows the same of a sphere in cells that
    /// `counts` holds for.
    fn differences(
        &self,
        (view, cell): (usize, usize),
        radius: f64,
        counts: impl Fn(Cell) -> bool,
        mut found: impl FnMut(f64),
    ) {
        let own = &self.views[view];
        let samples = own.samples(cell);
        let mut there = [[0.0; 3]; SAMPLES];
        for (x, &pixel) in there.iter_mut().zip(&samples) {
            let Some(at) = self.beyond(&own.camera, own.center, pixel, radius) else { return };
            *x = at;
        }
        let colors = samples.map(|pixel| own.color(pixel));
        for other in self.views.iter().enumerate().filter(|(k, _)| *k != view).map(|(_, v)| v) {
            let pixels = there.map(|x| other.camera.project(x).map(|(pixel, _)| pixel));
            let cells = pixels.map(|p| p.and_then(|p| other.cell(p)));
            let counting = |k: &Option<usize>| k.is_some_and(|k| counts(other.cells[k]));
            if !cells.iter().all(counting) {
                continue;
            }
            let apart = |k: usize| {
                let there = other.color(pixels[k].expect("it is in a cell"));
                (0..3).map(|c| f64::from((there[c] - colors[k][c]).abs())).sum::<f64>() / 3.0
            };
            found((0..SAMPLES).map(apart).sum::<f64>() / SAMPLES as f64);
        }
    }

    /// Cells of all views for which the rule holds: view and cell.
    fn cells(&self, rule: impl Fn(Cell) -> bool) -> Vec<(usize, usize)> {
        let of = |(v, view): (usize, &View)| (0..view.cells.len()).map(move |k| (v, k)).collect::<Vec<_>>();
        let all = self.views.iter().enumerate().flat_map(of);
        all.filter(|&(v, k)| rule(self.views[v].cells[k])).collect()
    }

    /// Marks cells whose near points are wrong: there the images agree at a radius (scene units) and nowhere near.
    fn clear(&mut self, radius: f64) {
        let seen = |c: Cell| c != Cell::Moving;
        let middle = |at: (usize, usize), radius: f64| {
            let mut all = Vec::new();
            self.differences(at, radius, seen, |d| all.push(d));
            let enough = all.len() >= WITNESSES;
            median(&mut all).filter(|_| enough)
        };
        let wrong = |at: &(usize, usize)| {
            let Some(far) = middle(*at, radius).filter(|far| *far <= AGREES) else { return false };
            let near = NEAR_RADII.iter().filter_map(|r| middle(*at, r * self.unit));
            far <= MUCH_BETTER * near.fold(LARGEST_DIFFERENCE, f64::min)
        };
        let near = self.cells(|c| c == Cell::Near);
        let wrong: Vec<bool> = near.par_iter().map(wrong).collect();
        let mut right: Vec<Vec<bool>> = self.views.iter().map(|v| vec![false; v.cells.len()]).collect();
        near.iter().zip(&wrong).filter(|(_, wrong)| !**wrong).for_each(|((v, k), _)| right[*v][*k] = true);
        for ((v, k), _) in near.into_iter().zip(wrong).filter(|(_, wrong)| *wrong) {
            let view = &mut self.views[v];
            // Next to something near, the outline may be in the cell.
            if !around(k, view.grid).any(|k| right[v][k]) {
                view.cells[k] = Cell::Open;
            }
        }
    }

    /// Finds the radius at which images agree best, and the cells that show what is there.
    pub(crate) fn fit(&mut self) -> Evidence {
        let open = self.cells(is_open);
        let cells: usize = self.views.iter().map(|v| v.cells.len()).sum();
        let error = |radius: f64| -> (f64, usize) {
            // Sums of a cell in order, and cells in order: the same with any number of threads.
            let of = |&(v, k): &(usize, usize)| {
                let mut sum = (0.0, 0);
                self.differences((v, k), radius * self.unit, is_open, |d| {
                    sum = (sum.0 + d.min(LARGEST_DIFFERENCE), sum.1 + 1)
                });
                sum
            };
            let sums: Vec<(f64, usize)> = open.par_iter().map(of).collect();
            let (sum, pairs) = sums.into_iter().fold((0.0, 0), |a, b| (a.0 + b.0, a.1 + b.1));
            (if pairs > 0 { sum / pairs as f64 } else { LARGEST_DIFFERENCE }, pairs)
        };
        let best = |errors: &[(f64, usize)]| errors.iter().map(|e| e.0).fold(LARGEST_DIFFERENCE, f64::min);
        let (near, far) = (NEAR_RADII.map(error), FAR_RADII.map(error));
        let errors = [best(&near), best(&far)];
        let last = (0..far.len()).rev().find(|&k| far[k].0 <= AS_GOOD * errors[1]).unwrap_or(far.len() - 1);
        let evidence = Evidence { open: open.len() as f64 / cells.max(1) as f64, errors, pairs: far[last].1 };
        self.mark(FAR_RADII[last] * self.unit);
        evidence
    }

    /// Marks the cells that show the surroundings at this distance, scene units: those in which most of the other images
    /// agree, and those without a comparison that continue them. Where nothing can be compared at all, all cells without
    /// near points.
    pub(crate) fn mark(&mut self, radius: f64) {
        self.clear(radius);
        let open = self.cells(is_open);
        let agreement = |&(v, k): &(usize, usize)| {
            let mut count = [0usize; 2];
            self.differences((v, k), radius, is_open, |d| count[usize::from(d <= AGREES)] += 1);
            count
        };
        let counts: Vec<[usize; 2]> = open.par_iter().map(agreement).collect();
        let nothing = counts.iter().all(|c| *c == [0, 0]);
        let mut unknown = Vec::new();
        for (&(v, k), [no, yes]) in open.iter().zip(counts) {
            let cell = &mut self.views[v].cells[k];
            *cell = if nothing || yes > 0 && yes >= no { Cell::Sky } else { Cell::Open };
            if yes + no == 0 {
                unknown.push((v, k));
            }
        }
        loop {
            let next_to_sky = |&(v, k): &(usize, usize)| {
                let view = &self.views[v];
                let [x, y] = [k % view.grid[0], k / view.grid[0]];
                let at = |x: usize, y: usize| view.cells[y * view.grid[0] + x] == Cell::Sky;
                let left = x > 0 && at(x - 1, y) || x + 1 < view.grid[0] && at(x + 1, y);
                left || y > 0 && at(x, y - 1) || y + 1 < view.grid[1] && at(x, y + 1)
            };
            let (grown, rest): (Vec<_>, Vec<_>) = unknown.into_iter().partition(next_to_sky);
            if grown.is_empty() {
                break;
            }
            grown.into_iter().for_each(|(v, k)| self.views[v].cells[k] = Cell::Sky);
            unknown = rest;
        }
        self.radius = radius;
    }

    /// Share of the images that shows the surroundings.
    pub(crate) fn share(&self) -> f64 {
        let all = self.views.iter().flat_map(|v| &v.cells);
        let (sky, count) = all.fold((0, 0), |(sky, n), c| (sky + usize::from(*c == Cell::Sky), n + 1));
        sky as f64 / f64::from(count.max(1))
    }

    /// The point of the sphere in a direction (unit) from its centre.
    pub(crate) fn point(&self, direction: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|k| self.center[k] + self.radius * direction[k])
    }

    /// The smallest angle that a cell of a view covers, radians.
    pub(crate) fn cell_angle(&self) -> f64 {
        let angle = |v: &View| v.camera.width as f64 / v.grid[0] as f64 / v.camera.intrinsics.fx;
        self.views.iter().map(angle).fold(f64::INFINITY, f64::min)
    }

    /// What views show at a point.
    pub(crate) fn look(&self, x: [f64; 3]) -> Look {
        let mut look = Look::default();
        let mut sum = [0.0f32; 3];
        for view in &self.views {
            let Some((pixel, _)) = view.camera.project(x) else { continue };
            let Some(cell) = view.cell(pixel) else { continue };
            look.seen += 1;
            look.open += usize::from(is_open(view.cells[cell]));
            if view.cells[cell] == Cell::Sky {
                look.sky += 1;
                let color = view.color(pixel);
                (0..3).for_each(|c| sum[c] += color[c]);
            }
        }
        look.color = sum.map(|s| s / look.sky.max(1) as f32);
        look
    }

    /// Whether a point is in front of the surroundings in most views that have it in the image: nothing supports it.
    pub(crate) fn hides(&self, x: [f64; 3]) -> bool {
        let look = self.look(x);
        look.sky > 0 && 2 * look.sky > look.seen
    }

    /// A test of pixels of any camera and their colours: whether the surroundings are there.
    pub(crate) fn of_camera<'a>(&'a self, camera: &'a Camera) -> impl Fn([f64; 2], [f32; 3]) -> bool + Sync + 'a {
        let eye = camera.center();
        move |pixel, color| {
            let Some(x) = self.beyond(camera, eye, pixel, self.radius) else { return false };
            let look = self.look(x);
            let apart = (0..3).map(|c| f64::from((color[c] - look.color[c]).abs())).sum::<f64>() / 3.0;
            look.is_sky() && apart <= AGREES
        }
    }
}

/// Whether a cell is without near points.
fn is_open(cell: Cell) -> bool {
    matches!(cell, Cell::Open | Cell::Sky)
}

/// Frames of the same camera in the same place at other times, evenly chosen.
fn later(frames: &dyn Frames, first: usize) -> Vec<usize> {
    let (rig, pose) = (frames.rig(first), &frames.camera(first).cam_from_world);
    let all: Vec<usize> = (0..frames.len())
        .filter(|&i| i != first && frames.rig(i) == rig && frames.camera(i).cam_from_world == *pose)
        .collect();
    let count = all.len().min(TIMES);
    (1..=count).map(|k| all[k * all.len() / count - 1]).collect()
}

#[cfg(test)]
pub(super) mod tests;
