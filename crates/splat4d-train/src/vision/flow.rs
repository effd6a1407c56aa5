//! Dense optical flow from one image to the next: least squares of the differences of small patches that overlap,
//! coarse to fine (Kroeger et al. 2016, "Fast Optical Flow using Dense Inverse Search", without the variational step).

use super::raster::{blurred, every_second, sample};
use rayon::prelude::*;
use splat4d::scene::Planes;

/// Shorter side of the smallest image, pixels: patches must be able to move.
const SMALLEST: usize = 56;
/// Images of falling size; motion of up to some 30 pixels is followed.
const LEVELS: usize = 4;
/// Steps shorter than this change nothing, pixels.
const STILL: f32 = 0.01;
/// Blur before every second pixel is taken, pixels.
const HALVING_BLUR: f64 = 1.0;
/// The least eigenvalue of a window's gradients, a pixel: less has no corner to follow (of images in [0, 1]).
const CORNER: f32 = 1e-5;

/// A grey image at falling sizes.
pub(crate) struct Pyramid(Vec<Planes<f32>>);

impl Pyramid {
    /// Of a grey image.
    pub(crate) fn new(grey: Planes<f32>) -> Self {
        let mut levels = vec![grey];
        while levels.len() < LEVELS {
            let last = &levels[levels.len() - 1];
            if last.width.min(last.height) < SMALLEST {
                break;
            }
            levels.push(every_second(&blurred(last, HALVING_BLUR)));
        }
        Self(levels)
    }
}

/// Side of a patch, and the step from one to the next, pixels (Kroeger et al. 2016).
const PATCH: usize = 8;
const STRIDE: usize = 4;
/// Steps of a patch on a level, at most.
const PATCH_STEPS: usize = 16;
/// Differences below this, of images in [0, 1], weigh alike where patches overlap (one grey level there).
const GREY_LEVEL: f32 = 1.0 / 255.0;
/// Forward and backward flow agree if |F + B|² is below this share of |F|² + |B|² and this many squared pixels
/// (Sundaram et al. 2010).
const AGREE_SHARE: f32 = 0.01;
const AGREE_PIXELS: f32 = 0.5;

/// The flow from one image to the next and 1 where it is known: [3, height, width], u right and v down in pixels.
///
/// Known is what has texture, arrives within the image, and is led back by the flow from there (occlusion test).
/// Panics:
/// images of two sizes.
pub(crate) fn dense(from: &Pyramid, to: &Pyramid) -> Planes<f32> {
    let (a, b) = (&from.0[0], &to.0[0]);
    assert_eq!((a.width, a.height), (b.width, b.height), "flow is between images of one size");
    let (forth, back) = (one_way(from, to), one_way(to, from));
    let mut out = Planes::new(3, a.height, a.width);
    let n = a.pixels();
    let known = |p: usize| {
        let (x, y, [u, v]) = (p % a.width, p / a.width, forth.vectors[p]);
        let (at_x, at_y) = (x as f32 + 0.5 + u, y as f32 + 0.5 + v);
        if !(0.0..a.width as f32).contains(&at_x) || !(0.0..a.height as f32).contains(&at_y) || !forth.textured[p] {
            return false;
        }
        let there = at_y as usize * a.width + at_x as usize;
        let [r, s] = back.vectors[there];
        let apart = (u + r) * (u + r) + (v + s) * (v + s);
        apart < AGREE_SHARE * (u * u + v * v + r * r + s * s) + AGREE_PIXELS
    };
    for p in (0..n).filter(|&p| known(p)) {
        let [u, v] = forth.vectors[p];
        (out.data[p], out.data[n + p], out.data[2 * n + p]) = (u, v, 1.0);
    }
    out
}

/// A vector a pixel, and whether there is anything to follow.
#[derive(Default)]
struct Field {
    vectors: Vec<[f32; 2]>,
    textured: Vec<bool>,
}

/// A patch of the first image: its vector, and whether it has texture.
#[derive(Clone, Copy, Default)]
struct Patch {
    vector: [f32; 2],
    textured: bool,
}

/// First pixels of the patches along a side, so that the last one ends with it.
fn places(side: usize) -> Vec<usize> {
    let last = side - PATCH;
    (0..last).step_by(STRIDE).chain([last]).collect()
}

fn one_way(from: &Pyramid, to: &Pyramid) -> Field {
    let mut field = Field::default();
    let mut coarse = [0, 0];
    for (a, b) in from.0.iter().zip(&to.0).rev() {
        let size = [a.width, a.height];
        if size.iter().any(|&s| s < PATCH) {
            continue;
        }
        let begin = |x: usize, y: usize| match field.vectors.as_slice() {
            [] => [0.0; 2],
            vectors => {
                // Every second pixel was kept, the first one too.
                let (cx, cy) = ((x / 2).min(coarse[0] - 1), (y / 2).min(coarse[1] - 1));
                vectors[cy * coarse[0] + cx].map(|v| 2.0 * v)
            }
        };
        let (columns, rows) = (places(a.width), places(a.height));
        let middle = PATCH / 2;
        let mut patches: Vec<Patch> = (0..columns.len() * rows.len())
            .into_par_iter()
            .map(|k| {
                let (x, y) = (columns[k % columns.len()], rows[k / columns.len()]);
                search(a, b, [x, y], &[begin(x + middle, y + middle)])
            })
            .collect();
        // A neighbour's result may be better: small fast objects are lost on coarse levels.
        for pass in 0..2 {
            let old = patches.clone();
            patches = (0..old.len())
                .into_par_iter()
                .map(|k| {
                    let (i, j) = (k % columns.len(), k / columns.len());
                    if !old[k].textured || (i + j) % 2 != pass {
                        return old[k];
                    }
                    let mut begins = vec![old[k].vector];
                    let mut add = |i: usize, j: usize| begins.push(old[j * columns.len() + i].vector);
                    if i > 0 {
                        add(i - 1, j);
                    }
                    if i + 1 < columns.len() {
                        add(i + 1, j);
                    }
                    if j > 0 {
                        add(i, j - 1);
                    }
                    if j + 1 < rows.len() {
                        add(i, j + 1);
                    }
                    search(a, b, [columns[i], rows[j]], &begins)
                })
                .collect();
        }
        field = blend(a, b, &patches, [&columns, &rows]);
        coarse = size;
    }
    if field.vectors.is_empty() {
        let n = from.0[0].pixels();
        return Field { vectors: vec![[0.0; 2]; n], textured: vec![false; n] };
    }
    field
}

/// The vector of the patch whose first pixel is `at`: from the best of these beginnings by Gauss-Newton steps on the
/// squared difference of the patches, each less its mean, so that a change of light is no motion.
fn search(a: &Planes<f32>, b: &Planes<f32>, at: [usize; 2], begins: &[[f32; 2]]) -> Patch {
    const N: usize = PATCH * PATCH;
    let mut template = [0.0f32; N];
    let mut slopes = [[0.0f32; 2]; N];
    for k in 0..N {
        let (x, y) = ((at[0] + k % PATCH) as f32 + 0.5, (at[1] + k / PATCH) as f32 + 0.5);
        template[k] = sample(a, x, y);
        slopes[k] = [
            0.5 * (sample(a, x + 1.0, y) - sample(a, x - 1.0, y)),
            0.5 * (sample(a, x, y + 1.0) - sample(a, x, y - 1.0)),
        ];
    }
    let mean = template.iter().sum::<f32>() / N as f32;
    template.iter_mut().for_each(|t| *t -= mean);
    for c in 0..2 {
        let mean = slopes.iter().map(|s| s[c]).sum::<f32>() / N as f32;
        slopes.iter_mut().for_each(|s| s[c] -= mean);
    }
    let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
    for [gx, gy] in slopes {
        (xx, xy, yy) = (xx + gx * gx, xy + gx * gy, yy + gy * gy);
    }
    let half = 0.5 * (xx + yy);
    let least = half - (0.25 * (xx - yy) * (xx - yy) + xy * xy).sqrt();
    let textured = least >= CORNER * N as f32;
    // Along an edge nothing holds the patch: the coarser level's result stays.
    let ridge = CORNER * N as f32;
    let (hxx, hyy) = (xx + ridge, yy + ridge);
    let det = hxx * hyy - xy * xy;
    let off = |vector: [f32; 2]| {
        let mut off = [0.0f32; N];
        for (k, off) in off.iter_mut().enumerate() {
            let x = (at[0] + k % PATCH) as f32 + 0.5 + vector[0];
            let y = (at[1] + k / PATCH) as f32 + 0.5 + vector[1];
            *off = sample(b, x, y);
        }
        let mean = off.iter().sum::<f32>() / N as f32;
        off.iter_mut().zip(&template).for_each(|(o, t)| *o -= mean + t);
        off
    };
    let cost = |off: &[f32; N]| off.iter().map(|o| o * o).sum::<f32>();
    let (begin, _) =
        begins.iter().map(|&v| (v, cost(&off(v)))).min_by(|a, b| a.1.total_cmp(&b.1)).expect("a beginning");
    let (mut vector, mut best) = (begin, (begin, cost(&off(begin))));
    for _ in 0..PATCH_STEPS {
        let now = off(vector);
        let (mut gx, mut gy) = (0.0, 0.0);
        for (o, [sx, sy]) in now.iter().zip(&slopes) {
            (gx, gy) = (gx + o * sx, gy + o * sy);
        }
        let step = [(hyy * gx - xy * gy) / det, (hxx * gy - xy * gx) / det];
        vector = [vector[0] - step[0], vector[1] - step[1]];
        let far = (vector[0] - begin[0]).hypot(vector[1] - begin[1]);
        if !step.iter().all(|s| s.is_finite()) || far > PATCH as f32 {
            break;
        }
        let now = cost(&off(vector));
        if now < best.1 {
            best = (vector, now);
        }
        if step[0].abs().max(step[1].abs()) < STILL {
            break;
        }
    }
    Patch { vector: best.0, textured }
}

/// A vector a pixel: the mean of the patches that hold it, each by how well it explains the pixel.
fn blend(a: &Planes<f32>, b: &Planes<f32>, patches: &[Patch], [columns, rows]: [&[usize]; 2]) -> Field {
    let mut field = Field { vectors: vec![[0.0; 2]; a.pixels()], textured: vec![false; a.pixels()] };
    let over = |places: &[usize], p: usize| {
        let end = places.partition_point(|&first| first <= p);
        let begin = places.partition_point(|&first| first + PATCH <= p);
        begin..end
    };
    let rows_of = field.vectors.par_chunks_mut(a.width).zip(field.textured.par_chunks_mut(a.width));
    rows_of.enumerate().for_each(|(y, (vectors, textured))| {
        for (x, (out, textured)) in vectors.iter_mut().zip(textured).enumerate() {
            let (mut sum, mut weights) = ([0.0f32; 2], 0.0f32);
            for j in over(rows, y) {
                for i in over(columns, x) {
                    let patch = &patches[j * columns.len() + i];
                    let [u, v] = patch.vector;
                    let off = sample(b, x as f32 + 0.5 + u, y as f32 + 0.5 + v) - a.data[y * a.width + x];
                    let weight = 1.0 / off.abs().max(GREY_LEVEL);
                    sum = [sum[0] + weight * u, sum[1] + weight * v];
                    weights += weight;
                    *textured |= patch.textured;
                }
            }
            *out = sum.map(|s| s / weights);
        }
    });
    field
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::math::Rng;

    /// Noise that is smooth, and a patch of other noise in its middle that moves by `way` more than all else.
    fn scene(all: [f32; 2], way: [f32; 2]) -> Planes<f32> {
        let noise = |seed: u64| {
            let rng = Rng::new(seed, "noise", 0);
            let mut out = Planes::<f32>::new(1, 120, 160);
            out.data.iter_mut().enumerate().for_each(|(k, v)| *v = rng.uniform(k as u64) as f32);
            blurred(&out, 1.5)
        };
        let (far, near) = (noise(1), noise(2));
        let mut out = far.clone();
        for (p, v) in out.data.iter_mut().enumerate() {
            let (x, y) = ((p % 160) as f32 + 0.5, (p / 160) as f32 + 0.5);
            let (u, w) = (x - all[0] - way[0], y - all[1] - way[1]);
            let inside = (60.0..100.0).contains(&u) && (40.0..80.0).contains(&w);
            *v = if inside { sample(&near, u, w) } else { sample(&far, x - all[0], y - all[1]) };
        }
        out
    }

    #[test]
    fn flow_is_found_for_all_pixels_except_occluded_ones() {
        let (all, way) = ([2.3, -1.4], [-7.0, 5.5]);
        let (a, b) = (scene([0.0; 2], [0.0; 2]), scene(all, way));
        let flow = dense(&Pyramid::new(a), &Pyramid::new(b));
        let (mut known, mut errors, mut inner) = (0, Vec::new(), Vec::new());
        for p in 0..160 * 120 {
            let (x, y) = (p % 160, p / 160);
            let moving = (60..100).contains(&x) && (40..80).contains(&y);
            let truth = if moving { [all[0] + way[0], all[1] + way[1]] } else { all };
            if flow.plane(2)[p] == 0.0 {
                continue;
            }
            known += 1;
            let error = (flow.plane(0)[p] - truth[0]).hypot(flow.plane(1)[p] - truth[1]);
            errors.push(error);
            if (66..94).contains(&x) && (46..74).contains(&y) {
                inner.push(error);
            }
        }
        errors.sort_by(f32::total_cmp);
        inner.sort_by(f32::total_cmp);
        assert!(known > 160 * 120 * 8 / 10, "{known} pixels are known");
        assert!(inner.len() > 700, "{} of what moves", inner.len());
        let (median, most) = (errors[errors.len() / 2], errors[errors.len() * 95 / 100]);
        assert!(median < 0.06 && most < 0.5, "half of all within {median} px, 95 % within {most} px");
        assert!(inner[inner.len() / 2] < 0.1, "{} px", inner[inner.len() / 2]);
        // The patch's target in the second image has no flow.
        let hidden = |x: usize, y: usize| flow.plane(2)[y * 160 + x];
        let gone = (52..58).flat_map(|x| (52..78).map(move |y| hidden(x, y))).sum::<f32>();
        assert!(gone < 0.5 * 6.0 * 26.0, "{gone} of 156 pixels that are hidden");
        let blank = Pyramid::new(Planes::new(1, 120, 160));
        assert!(dense(&blank, &blank).data.iter().all(|v| *v == 0.0), "nothing to follow");
    }
}
