//! Frames one after the other of a scene that stays on the GPU, none of them read back: how fast a screen could show them.

use super::{STATS_WIDTH, Tables, at};
use crate::Result;
use crate::gpu::buffers::UNIFORM_STRIDE;
use crate::gpu::clock::{Recorder, StageClock};
use crate::gpu::frame::{Band, Groups, TILE, count};
use crate::gpu::{GpuRenderer, GpuStats, Way};
use crate::layers::{ALPHA_MIN, Scene};
use crate::render::{KeptLayer, KeptMotion, KeptTable, Resident, Shot};
use crate::scene::{BLOCK, Camera, Key, Splats, Time};
use std::collections::VecDeque;
use std::time::Instant;

/// Frames that are under way at most, as on a screen with three pictures.
const FRAMES: usize = 3;
/// The step of which the frames are a view, as far as room for pairs goes.
const VIEW: u32 = 1;

impl GpuRenderer {
    /// Draws frames of a scene, which takes the place of whatever is kept, as planes on the GPU: seconds from the first submission to the end of the last.
    /// `None`: the motion of a layer is not known here, or a picture must be drawn in bands. Errors: a driver that failed.
    pub fn film(&mut self, scene: &Scene<f32>, frames: &[(Camera, Time)]) -> Result<Option<f64>> {
        let times: Vec<Time> = frames.iter().map(|f| f.1).collect();
        let Some(known) = scene.layers.iter().map(|l| KeptMotion::new(l, &times)).collect::<Option<Vec<_>>>() else {
            return Ok(None);
        };
        let stats: Vec<Vec<f32>> =
            scene.layers.iter().map(|l| vec![0.0; STATS_WIDTH * l.params.len().next_multiple_of(BLOCK)]).collect();
        let layers: Vec<KeptLayer<'_>> = scene
            .layers
            .iter()
            .zip(&known)
            .zip(&stats)
            .map(|((layer, known), stats)| {
                let table = |key: Option<Key>| {
                    key.map_or(KeptTable::default(), |key| {
                        let table = &layer.params[key];
                        KeptTable { width: table.width(), params: table.data(), moments: &[] }
                    })
                };
                let tables = known.keys.map(table);
                KeptLayer { rows: layer.params.len(), moves: known.moves, life: layer.life, tables, stats, ties: None }
            })
            .collect();
        self.keep(&layers, None, &[[1.0; 2]])?;
        loop {
            // Once to make room, and once for the clock.
            for measured in [false, true] {
                let seconds = self.with_tables(|renderer, tables| renderer.show(tables, scene, frames))?;
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

    fn show(&mut self, tables: &Tables, scene: &Scene<f32>, frames: &[(Camera, Time)]) -> Result<f64> {
        let nothing = Splats::default();
        let mut under_way = VecDeque::new();
        let n = tables.rows();
        let clock = Instant::now();
        for (camera, t) in frames {
            let (across, down) = (camera.width.div_ceil(TILE), camera.height.div_ceil(TILE));
            let band = Band { first: 0, rows: down };
            self.stats = GpuStats { splats: n, bands: 1, ..GpuStats::default() };
            let mut fresh = self.make_room_for_splats(n)?;
            fresh |= self.make_room_for_band(band, across, camera.width)?;
            if fresh || self.groups.is_none() {
                self.groups = Some(Groups::new(&self.gpu, &self.kernels, &self.buffers));
            }
            tables.write_asks(&self.gpu, *t);
            let shot = Shot::new(&nothing, camera, scene.background);
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
    /// Writes what is asked at a time, and nothing by which anything would learn.
    fn write_asks(&self, gpu: &crate::gpu::Gpu, t: Time) {
        let mut out = vec![0u8; self.pages.len() * at::ALL * UNIFORM_STRIDE as usize];
        let mut first_splat = 0;
        for (i, page) in self.pages.iter().enumerate() {
            let ask = super::Ask::new(page, t, true, ALPHA_MIN, first_splat);
            let bytes = bytemuck::bytes_of(&ask);
            out[(i * at::ALL + at::ASK) * UNIFORM_STRIDE as usize..][..bytes.len()].copy_from_slice(bytes);
            first_splat += page.rows;
        }
        gpu.queue.write_buffer(self.uniforms.get(), 0, &out);
    }
}
