//! Tests of a device before it is used: a small scene against the CPU, and the time of a step against the CPU's.
#![cfg_attr(not(feature = "gpu"), allow(dead_code))]

use super::cpu;
use crate::math::{Rng, Se3, sym3};
use crate::render::{Backend, Image, ImageGrads, RenderGrads, Shot};
use crate::scene::splats::{COV, SPLAT_COLUMNS, SPLAT_OPACITY};
use crate::scene::{Camera, Color, Part, Planes, Splats, Table};
use crate::{Error, ErrorKind, Result};
use std::sync::OnceLock;
use std::time::Instant;

/// Splats of the self-test, the logarithm of their scale, and width and height of its image: no whole tiles.
const TEST: (usize, f32, [usize; 2]) = (200, -2.5, [75, 45]);
/// Largest difference of a channel, and of a gradient as a share of its length, at which a device is trusted: far above
/// roundings and a splat at the α cut-off, far below any mistake.
const TRUSTED: [f64; 2] = [0.02, 0.05];
/// The same of the timed work: the size of a small scene, such as the bundled capture (docs/bundled-capture.md), with
/// splats of about two pixels. Larger scenes favour a GPU more.
const TIMED: (usize, f32, [usize; 2]) = (30_000, -4.0, [400, 300]);
/// How often the work is timed, after one that allocates; the fastest counts.
const TIMES: usize = 3;

/// What a device is to do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Work {
    /// Render.
    Image,
    /// Render, and run the backward pass.
    Step,
}

impl Work {
    fn name(self) -> &'static str {
        match self {
            Self::Image => "image",
            Self::Step => "step",
        }
    }

    /// Does a small piece of the work as the CPU does it. Errors: the results differ.
    pub(super) fn trusted(self, backend: &mut dyn Backend) -> Result<()> {
        let sample = Sample::new(TEST);
        let (image, d) = sample.done(self, backend)?;
        let (expected, d_expected) = sample.done(self, cpu(*backend.config()).as_mut())?;
        let off = |(a, b): (&f32, &f32)| f64::from(a - b);
        // NaN is no less than anything.
        let same = image.color.data.iter().zip(&expected.color.data).map(off).all(|v| v.abs() < TRUSTED[0]);
        let square = |v: f64| v * v;
        let apart: f64 = d.data().iter().zip(d_expected.data()).map(off).map(square).sum();
        let length: f64 = d_expected.data().iter().map(|v| square(f64::from(*v))).sum();
        if same && (self == Self::Image || (apart / length).sqrt() < TRUSTED[1]) {
            return Ok(());
        }
        Err(Error::new(
            ErrorKind::Unsupported,
            "the GPU's driver fails a self-test: its image or its gradients differ from the CPU's",
        )
        .remedy("Update the driver, or use the CPU."))
    }

    /// Compares the times of the work on a device and on the CPU. Errors: the device is slower, or fails.
    pub(super) fn slower(self, backend: &mut dyn Backend) -> Result<()> {
        let sample = Sample::new(TIMED);
        let own = sample.seconds(self, backend)?;
        self.compared([own, sample.seconds(self, cpu(*backend.config()).as_mut())?])
    }

    /// Compares the seconds of a device with the CPU's.
    pub(super) fn compared(self, [own, other]: [f64; 2]) -> Result<()> {
        if own <= other {
            return Ok(());
        }
        let [own, other] = [own, other].map(|s| 1e3 * s);
        let what = format!("it takes {own:.1} ms for a test {}, the CPU {other:.1} ms", self.name());
        Err(Error::new(ErrorKind::Unsupported, what))
    }

    /// The same, timed once a process, so that all parts of a long capture run on the same device.
    pub(super) fn slower_once(self, backend: &mut dyn Backend) -> Result<()> {
        static FOUND: [OnceLock<Option<String>>; 2] = [const { OnceLock::new() }; 2];
        let found = FOUND[self as usize].get_or_init(|| self.slower(backend).err().map(|e| e.cause()));
        found.as_ref().map_or(Ok(()), |why| Err(Error::new(ErrorKind::Unsupported, why)))
    }
}

/// Random splats in a cube, a camera in front of it, and the gradient to its image.
struct Sample {
    out: Table,
    colors: Table,
    camera: Camera,
    d_color: Planes,
}

impl Sample {
    fn new((splats, log_scale, [width, height]): (usize, f32, [usize; 2])) -> Self {
        let rng = Rng::new(1, "self-test", 0);
        let (mut out, mut colors) = (Table::new(&SPLAT_COLUMNS, splats), Table::new(&[("rgb", 3)], splats));
        for j in 0..splats {
            let r = rng.fork(j as u64);
            out.write::<3>(j, 0, std::array::from_fn(|k| 2.0 * r.uniform(k as u64) as f32 - 1.0));
            let turn: [f32; 4] = std::array::from_fn(|k| r.normal(10 + k as u64) as f32);
            let scales = std::array::from_fn(|k| r.normal(20 + k as u64) as f32 + log_scale);
            out.write(j, COV, sym3::from_quat_log_scales(turn, scales));
            out.set(j, SPLAT_OPACITY, r.uniform(4) as f32);
            colors.write::<3>(j, 0, std::array::from_fn(|k| r.uniform(30 + k as u64) as f32));
        }
        let pose = Se3::look_at([0.0, 0.5, -4.0], [0.0; 3], [0.0, 1.0, 0.0]);
        let mut d_color = Planes::new(3, height, width);
        d_color.data.iter_mut().enumerate().for_each(|(i, v)| *v = rng.normal(i as u64) as f32);
        Self { out, colors, camera: Camera::with_fov_y(pose, 0.6, width, height), d_color }
    }

    /// The image, and the gradients of the splats if they belong to the work.
    fn done(&self, work: Work, backend: &mut dyn Backend) -> Result<(Image, Table)> {
        let parts = vec![Part::new(&self.out, Color::Direct { table: &self.colors })];
        let splats = Splats { parts, head: None };
        let shot = Shot::new(&splats, &self.camera, [0.2, 0.5, 0.8]);
        let (mut image, mut d) = (Image::default(), RenderGrads::default());
        backend.render(&shot, &mut image)?;
        if work == Work::Image {
            return Ok((image, Table::default()));
        }
        let grads = ImageGrads { color: &self.d_color, alpha: None, depth: None, extra: None };
        backend.vjp(&shot, &grads, &mut [None], &mut d)?;
        Ok((image, d.parts.swap_remove(0).out))
    }

    fn seconds(&self, work: Work, backend: &mut dyn Backend) -> Result<f64> {
        self.done(work, backend)?;
        let mut fastest = f64::INFINITY;
        for _ in 0..TIMES {
            let start = Instant::now();
            self.done(work, backend)?;
            fastest = fastest.min(start.elapsed().as_secs_f64());
        }
        Ok(fastest)
    }
}
