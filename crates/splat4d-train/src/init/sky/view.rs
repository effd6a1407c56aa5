//! An examined image, its cells and what is in them.

use crate::capture::frames::Frames;
use splat4d::scene::{Camera, Planes};
use std::collections::HashSet;

/// Cells along an image's longer side.
const CELLS: f64 = 32.0;
/// Samples of a cell: 3x3.
pub(super) const SAMPLES: usize = 9;
/// Foreground in the masks moves: other points represent it.
pub(in crate::init) const FOREGROUND: f32 = 0.5;

/// What an image shows in a cell.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Cell {
    /// Something that moves, or nothing that the lens filled.
    Moving,
    /// A point that is near.
    Near,
    /// No near point.
    Open,
    /// The far surroundings.
    Sky,
}

/// An examined image.
pub(super) struct View {
    pub camera: Camera,
    pub center: [f64; 3],
    pub color: Planes<f32>,
    pub grid: [usize; 2],
    pub cells: Vec<Cell>,
}

impl View {
    fn place(&self, cell: usize) -> [f64; 2] {
        [(cell % self.grid[0]) as f64, (cell / self.grid[0]) as f64]
    }

    /// The samples of a cell, pixels; the fifth is its centre.
    pub(super) fn samples(&self, cell: usize) -> [[f64; 2]; SAMPLES] {
        let [x, y] = self.place(cell);
        let size = [self.camera.width, self.camera.height].map(|n| n as f64);
        std::array::from_fn(|k| {
            let at = [x, y, (k % 3) as f64, (k / 3) as f64];
            [0, 1].map(|a| (at[a] + (at[2 + a] + 0.5) / 3.0) * size[a] / self.grid[a] as f64)
        })
    }

    pub(super) fn cell(&self, pixel: [f64; 2]) -> Option<usize> {
        cell(&self.camera, self.grid, pixel)
    }

    /// Marks the cells in which the image of another time differs by more, in the mean.
    pub(super) fn changed(&mut self, other: &Planes<f32>, limit: f32) {
        let (w, pixels) = (self.color.width, self.color.pixels());
        if (other.width, other.height) != (w, self.color.height) {
            return;
        }
        let mut sums = vec![(0.0f32, 0usize); self.cells.len()];
        for p in 0..pixels {
            let Some(k) = self.cell([(p % w) as f64 + 0.5, (p / w) as f64 + 0.5]) else { continue };
            let apart = (0..3).map(|c| (other.plane(c)[p] - self.color.plane(c)[p]).abs()).sum::<f32>() / 3.0;
            sums[k] = (sums[k].0 + apart, sums[k].1 + 1);
        }
        for (cell, (sum, count)) in self.cells.iter_mut().zip(sums) {
            if sum > limit * count as f32 {
                *cell = Cell::Moving;
            }
        }
    }

    /// The colour at a pixel position in the image, bilinear.
    pub(super) fn color(&self, pixel: [f64; 2]) -> [f32; 3] {
        let [w, h] = [self.color.width, self.color.height];
        let at = |p: f64, n: usize| {
            let x = (p - 0.5).clamp(0.0, (n - 1) as f64);
            let low = (x as usize).min(n.saturating_sub(2));
            (low, (low + 1).min(n - 1), (x - low as f64) as f32)
        };
        let ((x0, x1, a), (y0, y1, b)) = (at(pixel[0], w), at(pixel[1], h));
        std::array::from_fn(|c| {
            let row = |y: usize| self.color.get(c, y, x0) * (1.0 - a) + self.color.get(c, y, x1) * a;
            row(y0) * (1.0 - b) + row(y1) * b
        })
    }
}

pub(super) fn cell(camera: &Camera, grid: [usize; 2], pixel: [f64; 2]) -> Option<usize> {
    let size = [camera.width, camera.height];
    let [x, y] = [0, 1].map(|a| pixel[a] / size[a] as f64 * grid[a] as f64);
    let inside = x >= 0.0 && y >= 0.0 && x < grid[0] as f64 && y < grid[1] as f64;
    inside.then(|| y as usize * grid[0] + x as usize)
}

pub(super) fn grid(camera: &Camera) -> [usize; 2] {
    let side = camera.width.max(camera.height) as f64 / CELLS;
    [camera.width, camera.height].map(|n| (n as f64 / side).round().max(1.0) as usize)
}

/// A cell and those that touch it.
pub(super) fn around(cell: usize, grid: [usize; 2]) -> impl Iterator<Item = usize> {
    let along = |at: usize, n: usize| at.saturating_sub(1)..=(at + 1).min(n - 1);
    let columns = along(cell % grid[0], grid[0]);
    along(cell / grid[0], grid[1]).flat_map(move |y| columns.clone().map(move |x| y * grid[0] + x))
}

/// Whether each cell of a camera's image has a near point in it or next to it.
pub(super) fn occupied(camera: &Camera, grid: [usize; 2], near: &[[f64; 3]]) -> Vec<bool> {
    let mut out = vec![false; grid[0] * grid[1]];
    for k in near.iter().filter_map(|&x| cell(camera, grid, camera.project(x)?.0)) {
        around(k, grid).for_each(|k| out[k] = true);
    }
    out
}

/// One image of every fixed camera, and of every position of moving ones; at most `most`, evenly chosen.
pub(in crate::init) fn views(frames: &dyn Frames, most: usize) -> Vec<usize> {
    let mut places = HashSet::new();
    let new = |&i: &usize| {
        let pose = &frames.camera(i).cam_from_world;
        places.insert((pose.rotation.map(|row| row.map(f64::to_bits)), pose.translation.map(f64::to_bits)))
    };
    let all: Vec<usize> = (0..frames.len()).filter(new).collect();
    let count = all.len().min(most);
    (0..count).map(|k| all[k * all.len() / count]).collect()
}
