//! The surface of a grid of signed distances as triangles: dual contouring by surface nets (Gibson 1998), with one vertex
//! for each sheet of the surface in a cell (Nielson 2004), so that sheets that meet in a cell stay apart.
//!
//! A cell without a known distance at each of its eight corners has no surface: what no camera saw stays open.

use super::fusion::{Block, Grid, SIDE, VOXELS};
use super::mesh::Mesh;
use rayon::prelude::*;

/// Corners along a side of the cells of a block.
const PADDED: usize = SIDE + 1;
/// No sheet of the surface crosses this edge.
const NONE: u8 = u8::MAX;
/// Colour of what has none, as closed sides.
const GREY: [u8; 3] = [128; 3];

/// Edge of a cell from corner `base` along `axis`; corners are numbered by their bits x, y, z.
fn edge(axis: usize, base: usize) -> usize {
    let [b, c] = [(axis + 1) % 3, (axis + 2) % 3];
    4 * axis + (base >> b & 1) + 2 * (base >> c & 1)
}

/// Both corners of an edge.
fn corners(edge: usize) -> [usize; 2] {
    let axis = edge / 4;
    let base = (edge & 1) << ((axis + 1) % 3) | (edge >> 1 & 1) << ((axis + 2) % 3);
    [base, base | 1 << axis]
}

/// For every choice of corners that are inside, the sheet of each edge, and how many sheets there are.
struct Sheets {
    of: Vec<[u8; 12]>,
    count: Vec<u8>,
}

impl Sheets {
    fn new() -> Self {
        let (of, count) = (0..256).map(Self::case).unzip();
        Self { of, count }
    }

    fn case(inside: usize) -> ([u8; 12], u8) {
        let crossed = |e: usize| corners(e).map(|c| inside >> c & 1).iter().sum::<usize>() == 1;
        let mut group: [usize; 12] = std::array::from_fn(|e| e);
        let mut join = |a: usize, b: usize| {
            let (from, to) = (group[a].max(group[b]), group[a].min(group[b]));
            group.iter_mut().filter(|g| **g == from).for_each(|g| *g = to);
        };
        for face in 0..6 {
            let (axis, side) = (face / 2, face % 2);
            let [b, c] = [(axis + 1) % 3, (axis + 2) % 3];
            let around = [[0, 0], [1, 0], [1, 1], [0, 1]].map(|[x, y]| side << axis | x << b | y << c);
            let edges = [edge(b, around[0]), edge(c, around[1]), edge(b, around[3]), edge(c, around[0])];
            let cut: Vec<usize> = edges.into_iter().filter(|e| crossed(*e)).collect();
            match cut[..] {
                [one, other] => join(one, other),
                // Opposite corners are inside: both cells of the face separate them.
                [_, _, _, _] => {
                    (0..4).filter(|i| inside >> around[*i] & 1 == 1).for_each(|i| join(edges[(i + 3) % 4], edges[i]))
                }
                _ => {}
            }
        }
        let mut numbers: Vec<usize> = (0..12).filter(|e| crossed(*e)).map(|e| group[e]).collect();
        numbers.sort_unstable();
        numbers.dedup();
        let number = |e: usize| numbers.iter().position(|n| *n == group[e]).expect("it is in the list") as u8;
        (std::array::from_fn(|e| if crossed(e) { number(e) } else { NONE }), numbers.len() as u8)
    }
}

/// The vertices of the cells whose first corner is in a block.
struct Cells {
    /// Corners that are inside, as bits; 0: no surface.
    inside: Vec<u8>,
    /// The cell's first vertex in the block.
    first: Vec<u32>,
    /// In voxels.
    positions: Vec<[f32; 3]>,
    colors: Vec<[u8; 3]>,
}

/// A block and its neighbours behind it as one array.
struct Padded {
    distance: Vec<f32>,
    color: Vec<[u8; 4]>,
}

impl Padded {
    fn of(grid: &Grid, key: [i32; 3]) -> Self {
        let near: [Option<&Block>; 8] = std::array::from_fn(|i| {
            grid.find(std::array::from_fn(|k| key[k] + (i >> k & 1) as i32)).map(|b| &grid.blocks[b])
        });
        let count = PADDED * PADDED * PADDED;
        let (mut distance, mut color) = (vec![f32::NAN; count], vec![[0; 4]; count]);
        for p in 0..count {
            let at = [p % PADDED, p / PADDED % PADDED, p / (PADDED * PADDED)];
            let which = (0..3).fold(0, |w, k| w | (at[k] / SIDE) << k);
            if let Some(block) = near[which] {
                let v = at[0] % SIDE + SIDE * (at[1] % SIDE + SIDE * (at[2] % SIDE));
                (distance[p], color[p]) = (block.distance[v], block.color[v]);
            }
        }
        Self { distance, color }
    }
}

impl Cells {
    fn of(grid: &Grid, key: [i32; 3], sheets: &Sheets) -> Self {
        let padded = Padded::of(grid, key);
        let (mut inside, mut first) = (vec![0; VOXELS], vec![0; VOXELS]);
        let (mut positions, mut colors) = (Vec::new(), Vec::new());
        for cell in 0..VOXELS {
            let at = [cell % SIDE, cell / SIDE % SIDE, cell / (SIDE * SIDE)];
            let place = |corner: usize| {
                let [x, y, z]: [usize; 3] = std::array::from_fn(|k| at[k] + (corner >> k & 1));
                x + PADDED * (y + PADDED * z)
            };
            let values: [f32; 8] = std::array::from_fn(|c| padded.distance[place(c)]);
            if values.iter().any(|v| v.is_nan()) {
                continue;
            }
            let mask = (0..8).fold(0usize, |m, c| m | usize::from(values[c] < 0.0) << c);
            if mask == 0 || mask == 255 {
                continue;
            }
            (inside[cell], first[cell]) = (mask as u8, positions.len() as u32);
            for sheet in 0..sheets.count[mask] {
                let (mut sum, mut count, mut color, mut known) = ([0.0f32; 3], 0.0f32, [0.0f32; 3], 0.0f32);
                for e in (0..12).filter(|e| sheets.of[mask][*e] == sheet) {
                    let ends = corners(e);
                    let share = values[ends[0]] / (values[ends[0]] - values[ends[1]]);
                    (0..3).for_each(|k| sum[k] += (ends[0] >> k & 1) as f32);
                    sum[e / 4] += share;
                    count += 1.0;
                    for (end, share) in ends.into_iter().zip([1.0 - share, share]) {
                        let [r, g, b, there] = padded.color[place(end)];
                        if there > 0 {
                            // Of two colours the nearer one counts more; of one, it alone.
                            let share = share + 1e-3;
                            [r, g, b].iter().zip(&mut color).for_each(|(c, sum)| *sum += share * f32::from(*c));
                            known += share;
                        }
                    }
                }
                let voxel = |k: usize| (key[k] * SIDE as i32 + at[k] as i32) as f32 + sum[k] / count;
                positions.push([voxel(0), voxel(1), voxel(2)]);
                colors.push(if known > 0.0 { color.map(|c| (c / known).round() as u8) } else { GREY });
            }
        }
        Self { inside, first, positions, colors }
    }
}

/// The surface of a grid, in scene units in the axes of the grid, with vertices that no triangle uses.
pub(super) fn extract(grid: &Grid) -> Mesh {
    let sheets = Sheets::new();
    let cells: Vec<Cells> = grid.keys.par_iter().map(|key| Cells::of(grid, *key, &sheets)).collect();
    let mut starts = Vec::with_capacity(cells.len());
    let mut total = 0u32;
    for cells in &cells {
        starts.push(total);
        total += cells.positions.len() as u32;
    }
    let triangles =
        (0..cells.len()).into_par_iter().flat_map_iter(|b| quads(grid, &cells, &starts, b, &sheets)).collect();
    let voxel = grid.voxel as f32;
    let mut mesh = Mesh { triangles, ..Mesh::default() };
    for cells in cells {
        mesh.positions.extend(cells.positions.iter().map(|p| p.map(|x| x * voxel)));
        mesh.colors.extend(cells.colors);
    }
    mesh
}

/// Triangles of the edges that begin in a block: for each edge across the surface, the vertices of the four cells around.
fn quads(grid: &Grid, cells: &[Cells], starts: &[u32], block: usize, sheets: &Sheets) -> Vec<[u32; 3]> {
    let key = grid.keys[block];
    let mut out = Vec::new();
    let distance = &grid.blocks[block].distance;
    // Neighbours before the block on some axes, as bits.
    let before: [Option<usize>; 8] =
        std::array::from_fn(|i| grid.find(std::array::from_fn(|k| key[k] - (i >> k & 1) as i32)));
    let after: [Option<usize>; 3] =
        std::array::from_fn(|a| grid.find(std::array::from_fn(|k| key[k] + i32::from(k == a))));
    for v in 0..VOXELS {
        let here = distance[v];
        if here.is_nan() {
            continue;
        }
        let at = [v % SIDE, v / SIDE % SIDE, v / (SIDE * SIDE)];
        for axis in 0..3 {
            let stride = [1, SIDE, SIDE * SIDE][axis];
            let there = if at[axis] + 1 < SIDE {
                distance[v + stride]
            } else {
                after[axis].map_or(f32::NAN, |b| grid.blocks[b].distance[v - (SIDE - 1) * stride])
            };
            if there.is_nan() || (here < 0.0) == (there < 0.0) {
                continue;
            }
            let [b, c] = [(axis + 1) % 3, (axis + 2) % 3];
            let vertex = |[back_b, back_c]: [usize; 2]| -> Option<(u32, [f32; 3])> {
                let mut place = at;
                let mut which = 0;
                for (k, back) in [(b, back_b), (c, back_c)] {
                    if back == 1 {
                        which |= usize::from(place[k] == 0) << k;
                        place[k] = (place[k] + SIDE - 1) % SIDE;
                    }
                }
                let other = before[which]?;
                let cell = place[0] + SIDE * (place[1] + SIDE * place[2]);
                let mask = usize::from(cells[other].inside[cell]);
                let sheet = sheets.of[mask][edge(axis, back_b << b | back_c << c)];
                let index = cells[other].first[cell] + u32::from(sheet);
                (mask != 0).then(|| (starts[other] + index, cells[other].positions[index as usize]))
            };
            let [Some(p), Some(q), Some(r), Some(s)] = [[1, 1], [0, 1], [0, 0], [1, 0]].map(vertex) else { continue };
            let far = |a: [f32; 3], b: [f32; 3]| (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f32>();
            let [p_r, q_s] = [far(p.1, r.1), far(q.1, s.1)];
            let [p, q, r, s] = [p, q, r, s].map(|v| v.0);
            let two = if p_r <= q_s { [[p, q, r], [p, r, s]] } else { [[p, q, s], [q, r, s]] };
            out.extend(if here < 0.0 { two } else { two.map(|[a, b, c]| [a, c, b]) });
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_edge_across_the_surface_belongs_to_one_sheet() {
        let sheets = Sheets::new();
        for mask in 0..256usize {
            for e in 0..12 {
                let [a, b] = corners(e).map(|c| mask >> c & 1);
                assert_eq!(a != b, sheets.of[mask][e] != NONE, "{mask} {e}");
            }
        }
        assert_eq!((sheets.count[0], sheets.count[1], sheets.count[255]), (0, 1, 0));
        assert_eq!(sheets.count[0b1000_0001], 2, "opposite corners");
        assert_eq!(sheets.count[0b0110_1001], 4, "every second corner");
        (0..12).for_each(|e| assert_eq!(edge(e / 4, corners(e)[0]), e));
    }
}
