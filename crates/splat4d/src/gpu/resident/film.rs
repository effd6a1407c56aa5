//! Renders successive frames of a scene that stays on the GPU without reading them back: the rate at which a screen
//! could show them.

use super::{Tables, at};
use crate::Result;
use crate::gpu::buffers::UNIFORM_STRIDE;
use crate::gpu::clock::{Recorder, StageClock};
use crate::gpu::frame::{Band, Groups, TILE, count};
use crate::gpu::{GpuRenderer, GpuStats, Way};
use crate::render::{Resident, ResidentLayer, Shot};
use crate::scene::{Camera, Splats, Time};
use std::collections::VecDeque;
use std::time::Instant;

/// Frames that are in flight at most, as on a screen with three images.
const FRAMES: usize = 3;
/// The step that the frames belong to, for the capacity for pairs.
const VIEW: u32 = 1;

/// Content of a film.
struct Film<'a> {
    alpha_min: f64,
    background: [f32; 3],
    frames: &'a [(Camera, Time)],
}

impl GpuRenderer {
    /// Renders frames of a scene, which takes the place of whatever is kept, as planes on the GPU: seconds from the
    /// first submission to the end of the last. `None`: an image must be rendered in bands. Errors: a driver that
    /// failed.
    pub fn film(
        &mut self,
        layers: &[ResidentLayer<'_>],
        alpha_min: f64,
        background: [f32; 3],
        frames: &[(Camera, Time)],
    ) -> Result<Option<f64>> {
        let film = Film { alpha_min, background, frames };
        self.keep(layers, None, &[[1.0; 2]])?;
        loop {
            // Once as a warm-up, and once for the measurement.
            for measured in [false, true] {
                let seconds = self.with_tables(|renderer, tables| renderer.show(tables, &film))?;
                let [_, _, _, stop, wanted] = self.counts()?;
                if stop != 0 {
                    if wanted > self.most_pairs {
                        return Ok(None);
                    }
                    self.make_room_for_pairs(wanted)?;
                    self.groups = None;
                    self.go_on();
                    break;
                }
                if measured {
                    return Ok(Some(seconds));
                }
            }
        }
    }

    fn show(&mut self, tables: &Tables, film: &Film<'_>) -> Result<f64> {
        let nothing = Splats::default();
        let mut under_way = VecDeque::new();
        let n = tables.rows();
        let clock = Instant::now();
        for (camera, t) in film.frames {
            let (across, down) = (camera.width.div_ceil(TILE), camera.height.div_ceil(TILE));
            let band = Band { first: 0, rows: down };
            self.stats = GpuStats { splats: n, bands: 1, ..GpuStats::default() };
            let mut fresh = self.make_room_for_splats(n)?;
            fresh |= self.make_room_for_band(band, across, camera.width)?;
            if fresh || self.groups.is_none() {
                self.groups = Some(Groups::new(&self.gpu, &self.kernels, &self.buffers));
            }
            tables.write_queries(&self.gpu, *t, film.alpha_min);
            let shot = Shot::new(&nothing, camera, film.background);
            self.write_uniforms(&shot, band, across, Way { view: VIEW, ..Way::default() })?;
            let mut recorder = Recorder::new(&self.gpu, &self.queries, StageClock::Off);
            tables.answer(&self.gpu, &self.buffers, &self.upload, &mut recorder)?;
            self.frame().splats(&mut recorder, &self.upload, n)?;
            self.frame().band(&mut recorder, band, across, None)?;
            under_way.push_back(recorder.submit());
            if under_way.len() > FRAMES {
                let first = under_way.pop_front().expect("there are several");
                self.gpu.wait_for(&first)?;
            }
        }
        self.gpu.wait()?;
        Ok(clock.elapsed().as_secs_f64())
    }

    /// The counts of the last frame.
    fn counts(&self) -> Result<[usize; count::ALL]> {
        let counts = self.read_back(&self.buffers.counts, count::ALL)?;
        Ok(std::array::from_fn(|i| counts.get(i).map_or(0, |c| *c as usize)))
    }
}

impl Tables {
    /// Writes the queries at a time, without rules of learning.
    fn write_queries(&self, gpu: &crate::gpu::Gpu, t: Time, alpha_min: f64) {
        let mut out = vec![0u8; self.pages.len() * at::ALL * UNIFORM_STRIDE as usize];
        let mut first_splat = 0;
        for (i, page) in self.pages.iter().enumerate() {
            let query = super::Query::new(page, t, true, alpha_min, first_splat);
            let bytes = bytemuck::bytes_of(&query);
            out[(i * at::ALL + at::QUERY) * UNIFORM_STRIDE as usize..][..bytes.len()].copy_from_slice(bytes);
            first_splat += page.rows;
        }
        gpu.queue.write_buffer(self.uniforms.get(), 0, &out);
    }
}
