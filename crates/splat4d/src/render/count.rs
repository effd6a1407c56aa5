//! Counts what the blend loop did: a slow pass over the lists of the last render, for benchmarks.

use super::RenderConfig;
use super::bin::BIN;
use super::blend::{Forward, Limits, Tile, Visit, begin, walk};
use super::gather::{CHANNELS, Record, SIDE, TILE, TILES};
use super::rasterize::Raster;
use crate::math::Real;
use rayon::prelude::*;

/// Pairs of a pixel and a splat.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PairCounts {
    /// That the blend loop evaluates, lanes outside the image and pixels that have stopped included.
    pub tested: usize,
    /// Of these: whose α reaches the cut-off before the pixel stops. No blend could do with fewer.
    pub contributing: usize,
}

impl<F: Real> Raster<F> {
    /// Counts of what [`Raster::blend`] does with the pairs that are held (all of them, but for absurd scenes).
    pub(crate) fn count_pairs(&self, config: &RenderConfig) -> PairCounts {
        let limits = Limits::new(config);
        let counts = self.bins.starts.par_windows(2).enumerate().map(|(bin, pair)| {
            let records = &self.records[pair[0] as usize..pair[1] as usize];
            let (x, y) = (bin % self.bins.across * BIN, bin / self.bins.across * BIN);
            count_bin(records, [self.width - x, self.height - y], &limits)
        });
        counts.reduce(PairCounts::default, |a, b| PairCounts {
            tested: a.tested + b.tested,
            contributing: a.contributing + b.contributing,
        })
    }
}

fn count_bin<F: Real>(records: &[Record<F>], inside: [usize; 2], limits: &Limits<F>) -> PairCounts {
    let mut tiles = [Tile::default(); TILES];
    let open = begin(&mut tiles, inside);
    let forward = Forward { tiles: &mut tiles, limits: *limits };
    let mut counting = Counting { forward, counts: PairCounts::default() };
    walk::<F, _, false>(records, open, &mut counting);
    counting.counts
}

/// Blends as forward does, white light alone: where it grew, the splat was seen.
struct Counting<'a, F> {
    forward: Forward<'a, F, TILE>,
    counts: PairCounts,
}

impl<F: Real> Visit<F> for Counting<'_, F> {
    fn splat<const FMA: bool>(&mut self, t: usize, i: usize, r: &Record<F>) {
        let mut record = *r;
        record.channels = [F::ZERO; CHANNELS];
        record.channels[0] = F::ONE;
        self.forward.tiles[t].color[0].fill(F::ZERO);
        self.forward.splat::<FMA>(t, i, &record);
        self.counts.tested += r.tile_rows(t % SIDE, t / SIDE).len() * TILE;
        let light = &self.forward.tiles[t].color[0];
        self.counts.contributing += light.iter().filter(|v| **v > F::ZERO).count();
    }

    fn stopped(&self, t: usize) -> bool {
        self.forward.stopped(t)
    }

    fn passed(&mut self, _: usize, _: usize) {}
}

#[cfg(test)]
mod tests {
    use crate::math::{Rng, Se3, sym3};
    use crate::render::{Image, RenderConfig, Renderer, Shot, Simd};
    use crate::scene::splats::{Part, SPLAT_COLUMNS};
    use crate::scene::{Camera, Color, Splats, Table};

    #[test]
    fn counts_are_those_of_every_pixel_and_every_splat() {
        let (n, rng) = (400, Rng::new(8, "count", 0));
        let (mut out, mut colors) = (Table::<f32>::new(&SPLAT_COLUMNS, n), Table::<f32>::new(&[("rgb", 3)], n));
        for j in 0..n {
            let r = rng.fork(j as u64);
            out.write(j, 0, std::array::from_fn::<f32, 3, _>(|k| 2.0 * r.uniform(k as u64) as f32 - 1.0));
            let s: [f32; 3] = std::array::from_fn(|k| -2.0 + 0.4 * r.normal(20 + k as u64) as f32);
            let q = std::array::from_fn(|k| r.normal(10 + k as u64) as f32);
            out.write(j, 3, sym3::from_quat_log_scales(q, s));
            out.set(j, 9, (0.1 + 0.89 * r.uniform(4)) as f32);
            colors.write(j, 0, [0.5; 3]);
        }
        let splats = Splats { parts: vec![Part::new(&out, Color::Direct { table: &colors })], head: None };
        let pose = Se3::look_at([0.0, 0.0, -4.0], [0.0; 3], [0.0, -1.0, 0.0]);
        // Odd sizes: tiles and bins that the image's edges cut.
        let camera = Camera::with_fov_y(pose, 0.5, 77, 61);
        let config = RenderConfig { simd: Simd::Scalar, ..RenderConfig::default() };
        let mut renderer = Renderer::new(config);
        renderer.render(&Shot::new(&splats, &camera, [0.0; 3]), &mut Image::default());
        let counts = renderer.count_pairs();

        let mut order: Vec<_> = renderer.projected().iter().filter(|p| p.radius > 0.0).collect();
        order.sort_by(|a, b| a.depth.total_cmp(&b.depth));
        let mut seen = 0;
        for pixel in 0..77 * 61 {
            let at = [(pixel % 77) as f32 + 0.5, (pixel / 77) as f32 + 0.5];
            let mut t = 1.0f64;
            for p in &order {
                let (dx, dy) = (p.mean2d[0] - at[0], p.mean2d[1] - at[1]);
                let [a, b, c] = p.conic;
                let power = -0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy;
                let alpha = f64::from(p.opacity * power.exp()).min(config.alpha_max);
                if alpha < config.alpha_min {
                    continue;
                }
                if t * (1.0 - alpha) < config.transmittance_min {
                    break;
                }
                t *= 1.0 - alpha;
                seen += 1;
            }
        }
        // Rounding at the cut-off and where pixels stop.
        assert!(counts.contributing.abs_diff(seen) * 1000 < seen, "{counts:?}, {seen} by every pixel");
        assert!(counts.contributing < counts.tested && counts.tested < 77 * 61 * n, "{counts:?}");
        assert!(seen > 77 * 61, "the picture is covered");
    }
}
