//! Closed surfaces: whether each voxel that no camera saw is inside or outside.
//!
//! Outside is what can be reached from the border of the grid through voxels that are free or unseen. Unseen gaps that are
//! narrower than [`GAP`] are closed: the way from the border keeps half of it away from surfaces, and then continues for
//! that distance (a morphological closing). What cameras saw to be free stays outside.

use super::fusion::{BAND, Grid, SIDE};
use rayon::prelude::*;
use splat4d::{Error, Result};

/// Unseen gaps of fewer voxels are closed.
const GAP: usize = 10;
/// Voxels between the blocks and the border, so that the way around everything is open.
const ROOM: usize = GAP;
/// Most voxels of the box, one byte each.
const MOST_VOXELS: usize = 600_000_000;
/// Share of the largest horizontal layer that makes a layer the floor, if it is the lowest such one.
const FLOOR_SHARE: usize = 2;

const UNSEEN: u8 = 0;
const SOLID: u8 = 1;
const FREE: u8 = 2;
const OUTSIDE: u8 = 3;

/// All voxels of the box around the blocks.
struct Dense {
    /// First voxel of the box.
    low: [i32; 3],
    size: [usize; 3],
    /// x fastest.
    state: Vec<u8>,
}

impl Dense {
    fn of(grid: &Grid) -> Result<Self> {
        let side = |k: usize, high: bool| {
            let all = grid.keys.iter().map(|key| key[k]);
            if high { all.max().unwrap_or(0) + 1 } else { all.min().unwrap_or(0) }
        };
        let low: [i32; 3] = std::array::from_fn(|k| side(k, false) * SIDE as i32 - ROOM as i32);
        let size: [usize; 3] = std::array::from_fn(|k| (side(k, true) - side(k, false)) as usize * SIDE + 2 * ROOM);
        let count = size.iter().fold(1usize, |n, s| n.saturating_mul(*s));
        if count > MOST_VOXELS {
            let larger = grid.voxel * (count as f64 / MOST_VOXELS as f64).cbrt() * 1.05;
            return Err(Error::input(format!(
                "a closed surface with voxels of {} scene units needs a grid of {} x {} x {} of them, more than {MOST_VOXELS}",
                grid.voxel, size[0], size[1], size[2]
            ))
            .remedy(format!("Use option `voxel` {larger:.3} or more, or first cut out a part with `splat4d edit`.")));
        }
        let mut out = Self { low, size, state: vec![UNSEEN; count] };
        for (key, block) in grid.keys.iter().zip(&grid.blocks) {
            for (v, distance) in block.distance.iter().enumerate() {
                let at = [v % SIDE, v / SIDE % SIDE, v / (SIDE * SIDE)];
                let i = out.index(std::array::from_fn(|k| (key[k] * SIDE as i32 - low[k]) as usize + at[k]));
                out.state[i] = if distance.is_nan() {
                    UNSEEN
                } else if *distance < 0.0 {
                    SOLID
                } else {
                    FREE
                };
            }
        }
        Ok(out)
    }

    fn index(&self, [x, y, z]: [usize; 3]) -> usize {
        x + self.size[0] * (y + self.size[1] * z)
    }

    fn strides(&self) -> [usize; 3] {
        [1, self.size[0], self.size[0] * self.size[1]]
    }

    /// Fills what no camera saw of the floor: below and between things that stand on it.
    ///
    /// The floor is the lowest layer with at least half as many upward faces as the largest one. In the columns between
    /// others with a floor, on both axes, unseen voxels at its height become solid.
    fn fill_floor(&mut self) {
        let [nx, ny, nz] = self.size;
        let layer = nx * ny;
        let mut faces = vec![0usize; nz];
        for z in 0..nz - 1 {
            let (here, above) =
                (&self.state[z * layer..(z + 1) * layer], &self.state[(z + 1) * layer..(z + 2) * layer]);
            faces[z] = here.iter().zip(above).filter(|(h, a)| **h == SOLID && **a == FREE).count();
        }
        let thick: Vec<usize> = (0..nz).map(|z| faces[z.saturating_sub(1)..(z + 2).min(nz)].iter().sum()).collect();
        let most = thick.iter().copied().max().unwrap_or(0);
        if most == 0 {
            return;
        }
        let Some(first) = (0..nz).find(|z| thick[*z] * FLOOR_SHARE >= most) else { return };
        // The peak of the lowest run of such layers.
        let floor = (first..nz)
            .take_while(|z| thick[*z] * FLOOR_SHARE >= most)
            .max_by_key(|z| (thick[*z], *z))
            .unwrap_or(first);
        let band = BAND as usize;
        let depth = floor.saturating_sub(band - 1)..floor + 1;
        let is_floor =
            |c: usize| (floor.saturating_sub(1)..(floor + 2).min(nz)).any(|z| self.state[z * layer + c] == SOLID);
        let columns: Vec<bool> = (0..layer).map(is_floor).collect();
        // First and last column with a floor of every row and of every line across.
        let mut spans = vec![[usize::MAX, 0]; nx + ny];
        for c in (0..layer).filter(|c| columns[*c]) {
            let (x, y) = (c % nx, c / nx);
            for (span, at) in [(y, x), (ny + x, y)] {
                spans[span] = [spans[span][0].min(at), spans[span][1].max(at)];
            }
        }
        for c in (0..layer).filter(|c| !columns[*c]) {
            let (x, y) = (c % nx, c / nx);
            let between = |span: usize, at: usize| spans[span][0] < at && at < spans[span][1];
            if between(y, x) && between(ny + x, y) {
                for z in depth.clone() {
                    let voxel = &mut self.state[z * layer + c];
                    *voxel = if *voxel == UNSEEN { SOLID } else { *voxel };
                }
            }
        }
    }

    /// Voxels with a solid one at most `reach` away on every axis.
    fn near_solid(&self, reach: usize) -> Vec<bool> {
        let mut near: Vec<bool> = self.state.par_iter().map(|s| *s == SOLID).collect();
        for axis in 0..3 {
            let (n, stride) = (self.size[axis], self.strides()[axis]);
            // Lines along the axis lie in slabs of this many voxels.
            let slab = stride * n;
            near.par_chunks_mut(slab).for_each(|slab| {
                let mut line = vec![false; n];
                for start in 0..stride {
                    (0..n).for_each(|i| line[i] = slab[start + i * stride]);
                    // Steps since the last one that is set, from both ends; after the turn no step is closer than it was.
                    let mut since = usize::MAX;
                    for i in (0..n).chain((0..n).rev()) {
                        since = if line[i] { 0 } else { since.saturating_add(1) };
                        if since <= reach {
                            slab[start + i * stride] = true;
                        }
                    }
                }
            });
        }
        near
    }

    /// Marks what is outside.
    fn flood(&mut self) {
        let reach = GAP / 2;
        let near = self.near_solid(reach);
        let strides = self.strides();
        let mut front: Vec<usize> = vec![0];
        // The border is unseen and as far from all blocks as a gap is wide.
        self.state[0] = OUTSIDE;
        let size = self.size;
        let neighbours = |i: usize| {
            let at = [i % size[0], i / size[0] % size[1], i / strides[2]];
            (0..3).flat_map(move |k| {
                let back = (at[k] > 0).then(|| i - strides[k]);
                let on = (at[k] + 1 < size[k]).then(|| i + strides[k]);
                [back, on].into_iter().flatten()
            })
        };
        let mut seen_free = Vec::new();
        while let Some(i) = front.pop() {
            for next in neighbours(i) {
                if self.state[next] == UNSEEN && !near[next] {
                    self.state[next] = OUTSIDE;
                    front.push(next);
                }
            }
        }
        drop(near);
        // What cameras saw to be free is outside too, wherever it is.
        for (i, state) in self.state.iter().enumerate() {
            if *state == OUTSIDE || *state == FREE {
                seen_free.push(i);
            }
        }
        let mut front = seen_free;
        for _ in 0..reach {
            let mut next_front = Vec::new();
            for i in front {
                for next in neighbours(i) {
                    if self.state[next] == UNSEEN {
                        self.state[next] = OUTSIDE;
                        next_front.push(next);
                    }
                }
            }
            front = next_front;
        }
    }

    fn is_inside(&self, i: usize) -> bool {
        matches!(self.state[i], SOLID | UNSEEN)
    }
}

/// Gives every voxel at a surface a sign, so that the surface is closed; `floor`: also fills the floor.
///
/// Errors: the box has more voxels than memory should hold, or needs too many blocks.
pub(super) fn close(grid: &mut Grid, floor: bool) -> Result<()> {
    if grid.keys.is_empty() {
        return Ok(());
    }
    let mut dense = Dense::of(grid)?;
    if floor {
        dense.fill_floor();
    }
    dense.flood();
    let (size, strides, low) = (dense.size, dense.strides(), dense.low);
    // Blocks of all cells that the surface crosses.
    let layer = |z: usize| {
        let mut keys = Vec::new();
        for i in z * strides[2]..(z + 1) * strides[2] {
            let at = [i % size[0], i / size[0] % size[1], z];
            if !dense.is_inside(i) || (0..3).any(|k| at[k] == 0 || at[k] + 1 == size[k]) {
                continue;
            }
            if strides.iter().all(|s| dense.is_inside(i - s) && dense.is_inside(i + s)) {
                continue;
            }
            for corner in 0..8 {
                let voxel = |k: usize| low[k] + at[k] as i32 + if corner >> k & 1 == 1 { 1 } else { -1 };
                let key: [i32; 3] = std::array::from_fn(|k| voxel(k).div_euclid(SIDE as i32));
                if keys.last() != Some(&key) {
                    keys.push(key);
                }
            }
        }
        keys.sort_unstable();
        keys.dedup();
        keys
    };
    let mut missing: Vec<[i32; 3]> = (0..size[2]).into_par_iter().flat_map_iter(layer).collect();
    missing.par_sort_unstable();
    missing.dedup();
    missing.retain(|key| grid.find(*key).is_none());
    super::fusion::check_blocks(grid.keys.len() + missing.len(), grid.voxel)?;
    grid.add(missing);
    let pairs = grid.keys.par_iter().zip(&mut grid.blocks);
    pairs.for_each(|(key, block)| {
        for (v, distance) in block.distance.iter_mut().enumerate().filter(|(_, d)| d.is_nan()) {
            let at = [v % SIDE, v / SIDE % SIDE, v / (SIDE * SIDE)];
            let place: [i32; 3] = std::array::from_fn(|k| key[k] * SIDE as i32 + at[k] as i32 - low[k]);
            let within = (0..3).all(|k| (0..size[k] as i32).contains(&place[k]));
            let inside = within && dense.is_inside(dense.index(place.map(|p| p as usize)));
            *distance = if inside { -1.0 } else { 1.0 };
        }
    });
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::meshing::fusion::Block;
    use crate::meshing::surface::extract;
    use std::collections::BTreeMap;

    /// A grid of blocks from −2 to 2 with what `known` states of each voxel.
    fn grid(known: impl Fn([i32; 3]) -> f32) -> Grid {
        let range = || -2..2i32;
        let mut keys: Vec<[i32; 3]> =
            range().flat_map(|x| range().flat_map(move |y| range().map(move |z| [x, y, z]))).collect();
        keys.sort_unstable();
        let block = |key: &[i32; 3]| {
            let mut block = Block::unseen();
            for v in 0..block.distance.len() {
                let at = [v % SIDE, v / SIDE % SIDE, v / (SIDE * SIDE)];
                block.distance[v] = known(std::array::from_fn(|k| key[k] * SIDE as i32 + at[k] as i32));
            }
            block
        };
        let blocks = keys.iter().map(block).collect();
        Grid { voxel: 0.1, keys, blocks }
    }

    /// Triangles whose edges in this direction have no counterpart in the other, and the volume that is enclosed.
    fn open_edges(grid: &Grid) -> (usize, f32) {
        let mesh = extract(grid);
        let mut edges: BTreeMap<(u32, u32), i32> = BTreeMap::new();
        let mut volume = 0.0;
        for [a, b, c] in &mesh.triangles {
            for (from, to) in [(a, b), (b, c), (c, a)] {
                *edges.entry((*from.min(to), *from.max(to))).or_default() += if from < to { 1 } else { -1 };
            }
            let [p, q, r] = [a, b, c].map(|v| mesh.positions[*v as usize]);
            volume += p[0] * (q[1] * r[2] - q[2] * r[1])
                + p[1] * (q[2] * r[0] - q[0] * r[2])
                + p[2] * (q[0] * r[1] - q[1] * r[0]);
        }
        (edges.values().filter(|n| **n != 0).count(), volume / 6.0)
    }

    fn radius(v: [i32; 3]) -> f32 {
        v.iter().map(|x| (*x as f32 + 0.3).powi(2)).sum::<f32>().sqrt()
    }

    /// A ball of 9 voxels of which `seen` is known.
    fn ball(seen: impl Fn([i32; 3]) -> bool) -> Grid {
        grid(|v| {
            let distance = (radius(v) - 9.0) / 4.0;
            if seen(v) && (-1.0..=1.0).contains(&distance) { distance } else { f32::NAN }
        })
    }

    #[test]
    fn a_ball_with_an_unseen_hole_is_closed_and_full() {
        let whole = 4.0 / 3.0 * std::f32::consts::PI * 0.9f32.powi(3);
        let mut open = ball(|v| !(v[0].abs() < 3 && v[1].abs() < 3 && v[2] < 0));
        assert!(open_edges(&open).0 > 0, "the hole is open");
        close(&mut open, false).unwrap();
        let (edges, volume) = open_edges(&open);
        assert!(edges == 0 && (volume / whole - 1.0).abs() < 0.1, "{edges} {volume} {whole}");
    }

    #[test]
    fn half_a_ball_becomes_a_closed_shell() {
        let mut half = ball(|v| v[2] >= 0);
        close(&mut half, false).unwrap();
        let (edges, volume) = open_edges(&half);
        let full = 4.0 / 3.0 * std::f32::consts::PI * 0.9f32.powi(3);
        assert!(edges == 0 && volume > 0.0 && volume < 0.5 * full, "{edges} {volume}");
    }

    #[test]
    fn the_floor_below_a_thing_is_filled() {
        // A floor at z = 0, not seen within a square of 12 voxels.
        let floor = || {
            grid(|[x, y, z]| {
                let distance = (z as f32 + 0.5) / 4.0;
                let hidden = x.abs() < 6 && y.abs() < 6;
                if !hidden && (-1.0..=1.0).contains(&distance) { distance } else { f32::NAN }
            })
        };
        let solid_below = |mut grid: Grid, fill: bool| {
            close(&mut grid, fill).unwrap();
            assert_eq!(open_edges(&grid).0, 0);
            let block = grid.find([0, 0, -1]).unwrap();
            grid.blocks[block].distance[7 * SIDE * SIDE] < 0.0
        };
        assert!(solid_below(floor(), true) && !solid_below(floor(), false));
    }

    #[test]
    fn a_gap_through_which_cameras_saw_stays() {
        let seen_through = |v: [i32; 3]| v[0].abs() < 3 && v[1].abs() < 3;
        let mut ring = grid(|v| {
            let distance = (radius(v) - 9.0) / 4.0;
            match seen_through(v) {
                true => 1.0,
                false if (-1.0..=1.0).contains(&distance) => distance,
                false => f32::NAN,
            }
        });
        close(&mut ring, true).unwrap();
        let middle = ring.find([0, 0, 0]).unwrap();
        assert!(open_edges(&ring).0 == 0 && ring.blocks[middle].distance[0] > 0.0);
    }
}
