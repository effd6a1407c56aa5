//! Truncated signed distances on a sparse grid, averaged over the surfaces that all cameras see (Curless and Levoy 1996),
//! in blocks of 8³ voxels (Nießner et al. 2013).

use super::depth::Map;
use rayon::prelude::*;
use splat4d::math::se3::mat_vec;
use splat4d::{Error, Result};

/// Voxels along a side of a block.
pub(super) const SIDE: usize = 8;
/// Voxels of a block.
pub(super) const VOXELS: usize = SIDE * SIDE * SIDE;
/// Voxels from a surface to where distances are cut off.
pub(super) const BAND: f64 = 4.0;
/// Most blocks, 4 KiB each.
pub(super) const MOST_BLOCKS: usize = 150_000;
/// Weight of a ray that passes a voxel, where one that meets a surface at a right angle has 1.
const FREE: f32 = 0.25;
/// Least cosine that counts between a ray and a normal.
const GRAZING: f32 = 0.1;
/// Coordinates of blocks are below this, so that three fit into 64 bits.
const MOST_COORDINATE: i32 = 1 << 20;

/// 8³ voxels, x fastest.
pub(super) struct Block {
    /// Signed distances from −1 to 1 in bands, positive outside; NaN: not seen.
    pub(super) distance: Box<[f32; VOXELS]>,
    /// sRGB, and 255 where it is known.
    pub(super) color: Box<[[u8; 4]; VOXELS]>,
}

impl Block {
    /// Nothing is seen.
    pub(super) fn unseen() -> Self {
        Self { distance: Box::new([f32::NAN; VOXELS]), color: Box::new([[0; 4]; VOXELS]) }
    }
}

/// A sparse grid of voxels. The voxel of integer coordinates v has its centre at v times the size.
pub(super) struct Grid {
    /// Length of a voxel's side.
    pub(super) voxel: f64,
    /// Coordinates of the blocks, sorted.
    pub(super) keys: Vec<[i32; 3]>,
    /// One per key.
    pub(super) blocks: Vec<Block>,
}

impl Grid {
    /// The block of these coordinates.
    pub(super) fn find(&self, key: [i32; 3]) -> Option<usize> {
        self.keys.binary_search(&key).ok()
    }

    /// Adds blocks in which nothing is seen.
    pub(super) fn add(&mut self, missing: Vec<[i32; 3]>) {
        let all = self.keys.drain(..).zip(self.blocks.drain(..));
        let mut all: Vec<_> = all.chain(missing.into_iter().map(|key| (key, Block::unseen()))).collect();
        all.sort_by_key(|(key, _)| *key);
        (self.keys, self.blocks) = all.into_iter().unzip();
    }
}

/// Refuses more blocks than memory should hold.
pub(super) fn check_blocks(count: usize, voxel: f64) -> Result<()> {
    if count <= MOST_BLOCKS {
        return Ok(());
    }
    Err(Error::input(format!(
        "voxels of {voxel} scene units need more than {MOST_BLOCKS} blocks of {SIDE} x {SIDE} x {SIDE} of them"
    ))
    .remedy(format!(
        "Use a larger option `voxel`, such as {}, or first cut out a part: splat4d edit SCENE --crop 'box(...)' -o part.s4d.",
        2.0 * voxel
    )))
}

/// Packs coordinates in their order.
fn pack(key: [i32; 3]) -> u64 {
    key.iter().fold(0, |all, k| all << 21 | (k + MOST_COORDINATE) as u64)
}

fn unpack(packed: u64) -> [i32; 3] {
    [42, 21, 0].map(|shift| (packed >> shift & 0x1f_ffff) as i32 - MOST_COORDINATE)
}

/// Blocks within a band of the surfaces of a map that are in the box.
fn touched(map: &Map, voxel: f64, [low, high]: [[f64; 3]; 2]) -> Vec<u64> {
    let (camera, world) = (&map.camera, map.camera.cam_from_world.inverse());
    let k = &camera.intrinsics;
    let block = voxel * SIDE as f64;
    let row = |y: usize| {
        let (mut found, mut last) = (Vec::new(), u64::MAX);
        for x in 0..camera.width {
            let sample = &map.samples[y * camera.width + x];
            if !sample.depth.is_finite() {
                continue;
            }
            let z = f64::from(sample.depth);
            let at = world.apply([(x as f64 + 0.5 - k.cx) / k.fx * z, (y as f64 + 0.5 - k.cy) / k.fy * z, z]);
            if (0..3).any(|i| !(low[i]..=high[i]).contains(&at[i])) {
                continue;
            }
            let normal = mat_vec(&world.rotation, sample.normal.map(|n| f64::from(n) / 127.0));
            for step in [-1.0, 0.0, 1.0] {
                let place = |i: usize| ((at[i] + step * BAND * voxel * normal[i]) / block).floor() as i32;
                let key = pack([place(0), place(1), place(2)]);
                if key != last {
                    found.push(key);
                    last = key;
                }
            }
        }
        found.sort_unstable();
        found.dedup();
        found
    };
    let mut all: Vec<u64> = (0..camera.height).into_par_iter().flat_map_iter(row).collect();
    all.par_sort_unstable();
    all.dedup();
    all
}

/// Blocks around the surfaces that maps show, found one map at a time: voxels that are too small are noticed early.
pub(super) struct Shell {
    voxel: f64,
    bounds: [[f64; 3]; 2],
    /// Packed, sorted.
    keys: Vec<u64>,
}

impl Shell {
    /// Of surfaces in a box (low and high corner). Errors: a box of more voxels than coordinates can count.
    pub(super) fn new(voxel: f64, bounds: [[f64; 3]; 2]) -> Result<Self> {
        let reach = bounds.iter().flatten().fold(0.0, |m: f64, x| m.max(x.abs())) / (voxel * SIDE as f64);
        if reach >= f64::from(MOST_COORDINATE - 2) {
            check_blocks(usize::MAX, voxel)?;
        }
        Ok(Self { voxel, bounds, keys: Vec::new() })
    }

    /// Adds the surfaces of a map. Errors: more blocks than memory should hold.
    pub(super) fn add(&mut self, map: &Map) -> Result<()> {
        self.keys.extend(touched(map, self.voxel, self.bounds));
        self.keys.par_sort_unstable();
        self.keys.dedup();
        check_blocks(self.keys.len(), self.voxel)
    }

    /// Averages the surfaces of all maps.
    pub(super) fn fuse(self, maps: &[Map]) -> Grid {
        let keys: Vec<[i32; 3]> = self.keys.into_iter().map(unpack).collect();
        let blocks = keys.par_iter().map(|key| integrate(*key, maps, self.voxel)).collect();
        Grid { voxel: self.voxel, keys, blocks }
    }
}

/// What all maps show of a block.
fn integrate(key: [i32; 3], maps: &[Map], voxel: f64) -> Block {
    let mut out = Block::unseen();
    let mut sums = [[0.0f32; 2]; VOXELS];
    let mut colors = [[0.0f32; 4]; VOXELS];
    let corner = key.map(|k| f64::from(k) * SIDE as f64 * voxel);
    let half = 0.5 * (SIDE - 1) as f64 * voxel;
    let center = corner.map(|c| c + half);
    let radius = half * 3f64.sqrt();
    let band = (BAND * voxel) as f32;
    for map in maps {
        let (camera, k) = (&map.camera, &map.camera.intrinsics);
        let c = camera.cam_from_world.apply(center);
        if c[2] + radius <= camera.near {
            continue;
        }
        if c[2] > radius {
            // Where the block's ball is outside the image on one side, so is its projection.
            let out_of = |i: usize, f: f64, p: f64, size: usize| {
                let (low, high) = (-p / f, (size as f64 - p) / f);
                let outside = |slope: f64, sign: f64| sign * (c[i] - slope * c[2]) > radius * slope.hypot(1.0);
                outside(high, 1.0) || outside(low, -1.0)
            };
            if out_of(0, k.fx, k.cx, camera.width) || out_of(1, k.fy, k.cy, camera.height) {
                continue;
            }
        }
        let first = camera.cam_from_world.apply(corner).map(|x| x as f32);
        let steps: [[f32; 3]; 3] = std::array::from_fn(|axis| {
            std::array::from_fn(|i| (voxel * camera.cam_from_world.rotation[i][axis]) as f32)
        });
        let [fx, fy, cx, cy] = [k.fx, k.fy, k.cx, k.cy].map(|x| x as f32);
        let near = camera.near as f32;
        for v in 0..VOXELS {
            let [x, y, z] = [v % SIDE, v / SIDE % SIDE, v / (SIDE * SIDE)].map(|n| n as f32);
            let p: [f32; 3] = std::array::from_fn(|i| first[i] + x * steps[0][i] + y * steps[1][i] + z * steps[2][i]);
            if p[2] <= near {
                continue;
            }
            let (px, py) = ((fx * p[0] / p[2] + cx).floor(), (fy * p[1] / p[2] + cy).floor());
            if !(px >= 0.0 && py >= 0.0 && px < camera.width as f32 && py < camera.height as f32) {
                continue;
            }
            let sample = &map.samples[py as usize * camera.width + px as usize];
            let depth = sample.depth;
            if depth.is_nan() {
                continue;
            }
            if depth.is_infinite() {
                sums[v][0] += FREE;
                sums[v][1] += FREE;
                continue;
            }
            // Distance from the plane that the pixel shows.
            let ray = [(px + 0.5 - cx) / fx, (py + 0.5 - cy) / fy, 1.0];
            let n = sample.normal.map(|n| f32::from(n) / 127.0);
            let distance: f32 = (0..3).map(|i| n[i] * (p[i] - ray[i] * depth)).sum();
            if distance < -band {
                continue;
            }
            let length = (ray[0] * ray[0] + ray[1] * ray[1] + 1.0).sqrt();
            let cosine = (-(0..3).map(|i| n[i] * ray[i]).sum::<f32>() / length).max(GRAZING);
            let weight = if distance > band { FREE } else { cosine * cosine };
            sums[v][0] += weight * (distance / band).min(1.0);
            sums[v][1] += weight;
            if distance <= band {
                let color = &mut colors[v];
                (0..3).for_each(|i| color[i] += weight * f32::from(sample.color[i]));
                color[3] += weight;
            }
        }
    }
    for v in 0..VOXELS {
        let [sum, weight] = sums[v];
        if weight > 0.0 {
            out.distance[v] = sum / weight;
        }
        let [r, g, b, weight] = colors[v];
        if weight > 0.0 {
            let byte = |x: f32| (x / weight).round() as u8;
            out.color[v] = [byte(r), byte(g), byte(b), 255];
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn coordinates_of_blocks_are_packed_in_their_order() {
        let keys = [[-3, 5, -1_000_000], [-3, 6, 2], [0, -1, 0], [0, 0, -1], [1_000_000, 0, 0]];
        assert!(keys.windows(2).all(|w| pack(w[0]) < pack(w[1])));
        keys.iter().for_each(|key| assert_eq!(unpack(pack(*key)), *key));
    }
}
