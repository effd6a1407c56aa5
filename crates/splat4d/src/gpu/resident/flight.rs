//! Steps in flight: submitted without waiting, and completed some steps later, when the GPU has written their status
//! record (record.wgsl).
//!
//! If a view has more pairs than fit, the GPU stops: nothing later is applied, neither of that step nor of later ones,
//! which may already be in flight. The reader of the record enlarges the buffers, or cuts images into more bands, and
//! starts again from that view. A step is a function of its inputs, so that neither the buffer size nor the time at
//! which its record is read changes a bit.

use super::{ResidentPass, STEP_WORDS, Tables, VIEW_WORDS};
use crate::gpu::buffers::{Grown, UNIFORM_STRIDE};
use crate::gpu::clock::{self, Recorder, StageClock, TIMES_BYTES};
use crate::gpu::compare::{Loss, PARTIALS, RESPONSES, means, sums_at};
use crate::gpu::frame::{Back, Band, Frame, Groups, RECORD_BYTES, TILE, count};
use crate::gpu::pictures::Held;
use crate::gpu::{GpuRenderer, GpuStats, GpuTimings, Way, back};
use crate::render::{KEPT, ResidentNoise, ResidentRule, ResidentStep, ResidentStepped, RowWeights, Shot};
use crate::scene::{Camera, Splats, Time};
use crate::{Error, ErrorKind, Result};
use std::collections::VecDeque;

/// Steps that are in flight at most: enough that a hiccup of the CPU of some steps' length is not seen, few enough that
/// what they hold (an image each, where images are not kept) is little.
pub(in crate::gpu) const AHEAD: usize = 8;
/// Flag that stops steps because of a non-finite number (record.wgsl).
const NOT_FINITE: u32 = u32::MAX;

/// A view of a step that was begun.
#[derive(Debug)]
pub(super) struct PendingView {
    camera: Camera,
    pub t: Time,
    background: [f32; 3],
    held: Held,
    dssim: f64,
    /// Number of the camera; one past all where it shows what is rendered.
    pub rig: usize,
}

/// All that a step is of.
#[derive(Debug)]
pub(super) struct Begun {
    pub views: Vec<PendingView>,
    sh_degree: usize,
    pub alpha_min: f64,
    pub rules: Vec<[Option<ResidentRule>; KEPT]>,
    pub rows: RowWeights,
    pub noise: Vec<Option<ResidentNoise>>,
    pub cameras: f64,
}

/// A step in flight.
#[derive(Debug)]
struct Flight {
    step: Begun,
    /// Its record and its times.
    record: Grown,
    times_at: u64,
    /// The last work of it.
    work: wgpu::SubmissionIndex,
    recorded: Option<[usize; 2]>,
}

/// All of them, the oldest first.
#[derive(Debug, Default)]
pub(in crate::gpu) struct Flights {
    under_way: VecDeque<Flight>,
    /// Those that are done, not reported yet.
    done: Vec<ResidentStepped>,
    /// Memory of records that are not in use.
    spare: Vec<Grown>,
    /// Steps that were restarted because buffers were too small.
    #[cfg(test)]
    pub again: usize,
}

/// The record of a step.
struct Record {
    words: Vec<u32>,
    stages: Option<[f64; clock::STAGES]>,
}

impl GpuRenderer {
    /// Does something with the tables that stay, whose rendered parts take the place of the last scene's meanwhile.
    pub(super) fn with_tables<T>(&mut self, f: impl FnOnce(&mut Self, &Tables) -> T) -> T {
        let mut tables = self.resident.take().expect("tables are kept before steps are taken");
        std::mem::swap(&mut self.upload, &mut tables.upload);
        let out = f(self, &tables);
        std::mem::swap(&mut self.upload, &mut tables.upload);
        self.resident = Some(tables);
        out
    }

    /// [`Resident::step`](crate::render::Resident::step).
    pub(super) fn begin(&mut self, step: &ResidentStep<'_>) -> Result<Option<Vec<ResidentStepped>>> {
        let Some(begun) = self.take_over(step)? else { return Ok(None) };
        self.make_room_for_status(begun.views.len())?;
        self.with_tables(|renderer, tables| renderer.launch(tables, begun, 0))?;
        while self.flights.under_way.len() > self.ahead {
            self.land()?;
        }
        Ok(Some(std::mem::take(&mut self.flights.done)))
    }

    /// A buffer of the status of steps of this many views.
    pub(super) fn make_room_for_status(&mut self, views: usize) -> Result<()> {
        let tables = self.resident.as_ref().expect("tables are kept before steps are taken");
        let bytes = 4 * tables.status(views).words as u64;
        if tables.status.bytes() >= bytes {
            return Ok(());
        }
        // Those in flight write into the old one.
        while !self.flights.under_way.is_empty() {
            self.land()?;
        }
        let tables = self.resident.as_mut().expect("they are still there");
        tables.status.ensure(&self.gpu, bytes).map(|_| ())
    }

    /// [`Resident::finish`](crate::render::Resident::finish).
    pub(super) fn land_all(&mut self) -> Result<Vec<ResidentStepped>> {
        while !self.flights.under_way.is_empty() {
            self.land()?;
        }
        Ok(std::mem::take(&mut self.flights.done))
    }

    /// Waits for all work, whatever its result.
    pub(super) fn forget_flights(&mut self) -> Result<()> {
        self.flights.done.clear();
        if self.flights.under_way.is_empty() {
            return Ok(());
        }
        let waited = self.gpu.wait();
        while let Some(Flight { step, record, .. }) = self.flights.under_way.pop_front() {
            record.get().unmap();
            self.flights.spare.push(record);
            step.views.into_iter().for_each(|view| self.pictures.give_back(view.held));
        }
        waited
    }

    /// A step with what it needs of its own; `None`: it cannot be taken.
    pub(super) fn take_over(&mut self, step: &ResidentStep<'_>) -> Result<Option<Begun>> {
        let tables = self.resident.as_ref().expect("tables are kept before steps are taken");
        let (n, cameras) = (tables.rows(), tables.cameras.count());
        let mut views = Vec::with_capacity(step.views.len());
        let mut able = true;
        for view in step.views {
            let target = &view.target;
            let size = [target.truth.width, target.truth.height];
            assert_eq!(size, [view.camera.width, view.camera.height], "an image and its truth have one shape");
            let left_out = target.truth.data.is_empty();
            able &= self.can_compare(n, size);
            able &= !left_out || self.pictures.holds(target.picture, size, target.weight.is_some());
            if !able {
                break;
            }
            let held = self.pictures.hold(&self.gpu, target, self.config.device_images)?;
            able &= held.weight > 0.0;
            views.push(PendingView {
                camera: view.camera.clone(),
                t: view.t,
                background: view.background,
                held,
                dssim: target.dssim,
                rig: if view.rig < cameras { view.rig } else { cameras },
            });
        }
        if !able || views.is_empty() {
            views.into_iter().for_each(|view| self.pictures.give_back(view.held));
            return Ok(None);
        }
        Ok(Some(Begun {
            views,
            sh_degree: step.sh_degree,
            alpha_min: step.alpha_min,
            rules: step.rules.to_vec(),
            rows: step.rows,
            noise: step.noise.to_vec(),
            cameras: step.cameras,
        }))
    }

    /// Submits a step from a view on.
    fn launch(&mut self, tables: &Tables, step: Begun, from: usize) -> Result<()> {
        let mut record = self.flights.spare.pop().unwrap_or_else(|| {
            Grown::new("records of steps", wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST)
        });
        let words = 4 * tables.status(step.views.len()).words as u64;
        let times_at = words.next_multiple_of(UNIFORM_STRIDE);
        record.ensure(&self.gpu, times_at + TIMES_BYTES)?;
        for at in from..step.views.len() {
            let pass = ResidentPass { tables, step: &step, view: at };
            let to = pass.is_last().then_some((&record, words, times_at));
            let (work, recorded) = self.submit_view(&pass, to)?;
            if pass.is_last() {
                record.get().map_async(wgpu::MapMode::Read, .., |_| ());
                self.flights.under_way.push_back(Flight { step, record, times_at, work, recorded });
                return self.gpu.check();
            }
        }
        unreachable!("a step has a last view")
    }

    /// Submits a view of a step, and, after its last, what it leaves: this many bytes of its status, and behind them
    /// its times. Returns the last work, and the stages that are timed.
    fn submit_view(
        &mut self,
        pass: &ResidentPass<'_>,
        to: Option<(&Grown, u64, u64)>,
    ) -> Result<(wgpu::SubmissionIndex, Option<[usize; 2]>)> {
        let (tables, view) = (pass.tables, &pass.step.views[pass.view]);
        let (n, [w, h]) = (tables.rows(), view.held.size);
        let (across, down) = (w.div_ceil(TILE), h.div_ceil(TILE));
        let nothing = Splats::default();
        let shot = Shot { sh_degree: pass.step.sh_degree, ..Shot::new(&nothing, &view.camera, view.background) };
        self.stats = GpuStats { splats: n, bands: 1, ..GpuStats::default() };
        let whole = Band { first: 0, rows: down };
        let mut fresh = self.make_room_for_splats(n)?;
        fresh |= self.make_room_for_band(whole, across, w)?;
        fresh |= self.make_room_for_loss([w, h], PARTIALS * across * down)?;
        let room = self.pair_capacity();
        let records = RECORD_BYTES * room as u64 + 12 * (across * down) as u64;
        self.make_room_for_gradients(n, (w * h) as u64, records)?;
        if fresh || self.groups.is_none() {
            self.groups = Some(Groups::new(&self.gpu, &self.kernels, &self.buffers));
        }
        let rows = self.band_rows.min(down);
        let bands: Vec<Band> =
            (0..down).step_by(rows).map(|first| Band { first, rows: rows.min(down - first) }).collect();
        let rig = (view.rig < tables.cameras.count()).then_some(view.rig);
        let loss = Loss::new(view.dssim, &view.held, rig);
        let flags = if self.config.abs_grads { back::FLAG_ABS } else { 0 };
        let way = Way { flags, sums_at: sums_at(room), further: false, whole: true, view: 1 + pass.view as u32 };
        pass.write_uniforms(&self.gpu, across * down);
        self.write_uniforms(&shot, bands[0], across, way)?;
        self.write_loss(&loss);
        // A stage is timed once in a submission, and of images in bands none is.
        let clock = if bands.len() == 1 { self.clock } else { StageClock::Off };
        let mut recorder = Recorder::new(&self.gpu, &self.queries, clock);
        tables.answer(&self.gpu, &self.buffers, &self.upload, &mut recorder)?;
        self.frame().splats(&mut recorder, &self.upload, n)?;
        for (i, &band) in bands.iter().enumerate() {
            if i > 0 {
                recorder.submit();
                drop(recorder);
                self.write_uniforms(&shot, band, across, way)?;
                self.write_loss(&loss);
                recorder = Recorder::new(&self.gpu, &self.queries, clock);
            }
            self.frame().band(&mut recorder, band, across, None)?;
        }
        let responses = tables.cameras.buffer();
        self.back(room).loss(&mut recorder, &view.held.buffer, responses, [across, down])?;
        for (i, &band) in bands.iter().enumerate() {
            if bands.len() > 1 {
                recorder.submit();
                drop(recorder);
                self.write_uniforms(&shot, band, across, Way { further: i > 0, ..way })?;
                recorder = Recorder::new(&self.gpu, &self.queries, clock);
                // The lists of another band are there.
                self.frame().band(&mut recorder, band, across, None)?;
            }
            self.back(room).band(&mut recorder, band, across)?;
        }
        self.back(room).splats(&mut recorder, &self.upload)?;
        pass.learn(&self.gpu, &self.buffers, &self.upload, &mut recorder)?;
        let mut timed = false;
        if let Some((record, words, times_at)) = to {
            recorder.copy(tables.status.get(), record.get(), 0, words);
            timed = recorder.resolve(self.buffers.times.get());
            if timed {
                recorder.copy(self.buffers.times.get(), record.get(), times_at, TIMES_BYTES);
            }
        }
        let work = recorder.submit();
        let (recorded, by_wall) = (timed.then(|| recorder.recorded()), recorder.by_wall);
        if self.clock == StageClock::Wall {
            self.timings = GpuTimings::default();
            self.timings.add(by_wall);
        }
        Ok((work, recorded))
    }

    pub(super) fn frame(&self) -> Frame<'_> {
        let groups = self.groups.as_ref().expect("groups are made before a frame");
        Frame { gpu: &self.gpu, kernels: &self.kernels, buffers: &self.buffers, groups }
    }

    fn back(&self, pairs: usize) -> Back<'_> {
        let kernels = self.back_kernels.as_ref().expect("they were compiled");
        Back { frame: self.frame(), kernels, pairs }
    }

    /// Waits for the oldest step, which is restarted while its buffers are too small.
    fn land(&mut self) -> Result<()> {
        loop {
            let Some(flight) = self.flights.under_way.pop_front() else { return Ok(()) };
            let record = self.read_record(&flight)?;
            let Flight { step, record: memory, .. } = flight;
            self.flights.spare.push(memory);
            match record.words[0] {
                0 | NOT_FINITE => {
                    if let Some(stages) = record.stages {
                        self.timings = GpuTimings::default();
                        self.timings.add(stages);
                    }
                    let stepped = self.stepped(&step, &record.words);
                    step.views.into_iter().for_each(|view| self.pictures.give_back(view.held));
                    self.flights.done.push(stepped);
                    return Ok(());
                }
                view => self.begin_again(step, view as usize - 1, record.words[1] as usize)?,
            }
        }
    }

    /// Enlarges buffers, then restarts a step from the view with this many pairs, and all later steps.
    fn begin_again(&mut self, step: Begun, view: usize, pairs: usize) -> Result<()> {
        let mut steps = vec![step];
        self.gpu.wait()?;
        while let Some(Flight { step, record, .. }) = self.flights.under_way.pop_front() {
            record.get().unmap();
            self.flights.spare.push(record);
            steps.push(step);
        }
        let rows = steps[0].views[view].held.size[1].div_ceil(TILE);
        if pairs > self.most_pairs {
            let rows = self.band_rows.min(rows);
            if rows == 1 {
                let text = format!("{pairs} pairs of Gaussian and tile in one row of tiles are too many for the GPU");
                return Err(Error::new(ErrorKind::Unsupported, text).remedy("Train on the CPU."));
            }
            self.band_rows = rows.div_ceil(2);
        }
        let wanted = pairs.min(self.most_pairs);
        match self.make_room_for_pairs(wanted) {
            Ok(_) => {}
            Err(e) if e.kind() == ErrorKind::Memory => {
                // Images can be sent again.
                self.pictures.shrink();
                self.make_room_for_pairs(wanted)?;
            }
            Err(e) => return Err(e),
        }
        self.groups = None;
        self.go_on();
        #[cfg(test)]
        {
            self.flights.again += 1;
        }
        self.with_tables(|renderer, tables| {
            let from = [view].into_iter().chain(std::iter::repeat(0));
            steps.into_iter().zip(from).try_for_each(|(step, from)| renderer.launch(tables, step, from))
        })
    }

    /// Lets steps be applied again that follow.
    pub(super) fn go_on(&self) {
        let zeros = [0u8; 4 * (count::ALL - count::STOP)];
        self.gpu.queue.write_buffer(self.buffers.counts.get(), 4 * count::STOP as u64, &zeros);
    }

    /// The GPU's record of a step.
    fn read_record(&self, flight: &Flight) -> Result<Record> {
        self.gpu.wait_for(&flight.work)?;
        let lost = |e: wgpu::MapRangeError| {
            Error::new(ErrorKind::Unsupported, format!("a step's record cannot be read from the GPU ({e})"))
                .at(self.gpu.name())
                .remedy("Train on the CPU.")
        };
        let view = flight.record.get().get_mapped_range(..).map_err(lost)?;
        let words = bytemuck::pod_collect_to_vec(&view[..flight.times_at as usize]);
        let stamps: Vec<u64> = bytemuck::pod_collect_to_vec(&view[flight.times_at as usize..][..TIMES_BYTES as usize]);
        drop(view);
        flight.record.get().unmap();
        let stages = flight.recorded.map(|recorded| clock::stages(&self.gpu, recorded, &stamps));
        Ok(Record { words, stages })
    }

    /// The result of a step that was applied.
    fn stepped(&mut self, step: &Begun, words: &[u32]) -> ResidentStepped {
        let tables = self.resident.as_ref().expect("tables are kept");
        let status = tables.status(step.views.len());
        let view = |(i, view): (usize, &PendingView)| {
            let at = STEP_WORDS + VIEW_WORDS * i;
            let sums = [0, 1, 2].map(|k| f64::from(f32::from_bits(words[at + k])));
            (self.stats.visible, self.stats.pairs) = (words[at + 3] as usize, words[at + 4] as usize);
            means(&view.held, sums, None)
        };
        let comparisons = step.views.iter().enumerate().map(view).collect();
        let bad = words[status.bad..status.alive].iter().position(|w| *w != 0);
        let bad = bad.map(|at| [at / KEPT, at % KEPT, words[status.bad + at] as usize - 1]);
        let first = status.sums.first().map_or(status.words, |sums| sums[0]);
        let loss = words[first..status.words].iter().map(|bits| f64::from(f32::from_bits(*bits))).sum();
        ResidentStepped { comparisons, loss, bad }
    }
}

const _: () = assert!(RESPONSES == 12, "record.wgsl has this many columns per camera");
