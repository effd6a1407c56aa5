//! Events of the trainer for its listeners: progress bar, log, live viewer, Python.

use std::path::PathBuf;
use std::sync::Arc;

/// Reports the progress of long work, and messages for the user.
pub struct Progress<'a>(pub &'a mut dyn FnMut(&Event));

impl Progress<'_> {
    /// Reports the work in progress, how much of it is done, and of how much (0: not known).
    pub fn phase(&mut self, name: &str, done: usize, total: usize) {
        (self.0)(&Event::Phase { name: name.to_owned(), done, total });
    }

    /// A message for the user: what happened, and what to do.
    pub fn warn(&mut self, message: String) {
        (self.0)(&Event::Warning { message });
    }
}

/// A frame of a followed capture.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct FollowedFrame {
    /// Its number.
    pub frame: usize,
    /// Its second on the scene clock.
    pub at: f64,
    /// Seconds that it took: images read, Gaussians trained, held-out views rendered.
    pub seconds: f64,
    /// Gaussians of the scene.
    pub gaussians: usize,
    /// Gaussians that the frame replaced or added.
    pub changed: usize,
    /// Mean PSNR of its held-out views, dB; none: no camera is held out.
    pub psnr: Option<f64>,
}

/// One event. `--json` prints it serialised (with `type`), one per line.
#[derive(Clone, Debug, serde::Serialize)]
#[serde(tag = "type", rename_all = "snake_case")]
#[non_exhaustive]
pub enum Event {
    /// A long preparation began or moved on (reading, initial points, probes, evaluation).
    Phase {
        /// Name of the work in progress.
        name: String,
        /// Finished.
        done: usize,
        /// To do in all; 0 when not known.
        total: usize,
    },
    /// Training begins.
    Started {
        /// Folder of the run.
        #[serde(serialize_with = "crate::path_text::lossy")]
        run: PathBuf,
        /// First iteration (not 0 after a resume).
        iteration: usize,
        /// Last iteration.
        iterations: usize,
        /// Gaussians at the start.
        gaussians: usize,
        /// Estimated peak memory of training, bytes.
        memory_estimate: u64,
    },
    /// Estimated time of a run, from steps timed before it.
    Predicted {
        /// Its steps.
        iterations: usize,
        /// Gaussians at most.
        gaussians: usize,
        /// Width and height of its images, pixels.
        size: [usize; 2],
        /// Seconds from the command's start to its end, about.
        seconds: f64,
        /// Estimated peak memory of training, bytes.
        memory_estimate: u64,
    },
    /// The run was given another length, because it would not have ended at the requested time.
    Replanned {
        /// Steps taken.
        iteration: usize,
        /// Steps in all from now on.
        iterations: usize,
        /// Seconds after the command's start at which it would have ended.
        seconds: f64,
        /// The minutes that were requested.
        minutes: f64,
    },
    /// A step was taken; sent every n iterations.
    Progress {
        /// Steps taken.
        iteration: usize,
        /// Steps in all.
        iterations: usize,
        /// The stage's name.
        stage: String,
        /// Smoothed loss.
        loss: f64,
        /// Smoothed PSNR of the training views seen lately, dB.
        psnr: f64,
        /// Gaussians now.
        gaussians: usize,
        /// Seconds of training.
        seconds: f64,
        /// Seconds that are left, estimated.
        seconds_left: f64,
    },
    /// On what a run trains, where that was requested or changed.
    Device {
        /// It in words, its driver too.
        name: String,
        /// One line: what was taken, and why.
        why: String,
    },
    /// The model that `motion = "auto"` has become.
    Chosen {
        /// Its name.
        motion: String,
        /// One sentence about the capture.
        why: String,
    },
    /// The number that `densify.max_cap = 0` has become.
    Counted {
        /// Gaussians at most.
        gaussians: usize,
        /// The reason from the capture.
        why: String,
    },
    /// Whether the scene gets a far shell (`init.shell`), where cameras see much without near points.
    Shell {
        /// Its distance from the cameras' centre, scene units; none: there is no shell.
        distance: Option<f64>,
        /// The reason from points and images.
        why: String,
    },
    /// A checkpoint is on disk.
    Checkpoint {
        /// Steps taken.
        iteration: usize,
        /// The file.
        #[serde(serialize_with = "crate::path_text::lossy")]
        path: PathBuf,
    },
    /// A message for the user.
    Warning {
        /// The finding and its remedy.
        message: String,
    },
    /// A number was not finite; training went back to the last checkpoint with smaller steps.
    RolledBack {
        /// The step that failed.
        iteration: usize,
        /// The step it went back to.
        to: usize,
        /// Tensor, row and camera.
        what: String,
    },
    /// A scene to show while it learns, in the playback file's own bytes.
    Snapshot {
        /// Steps taken.
        iteration: usize,
        /// The file's bytes.
        #[serde(skip)]
        bytes: Arc<[u8]>,
        /// Mean PSNR of some held-out views, dB; none: no view is held out.
        held_out: Option<f64>,
    },
    /// A frame of a capture that is still being filmed is part of the scene.
    Frame(FollowedFrame),
    /// How far the trained scene is from the capture's measured geometry. `geometry.json` of the run has it by camera.
    Geometry {
        /// Share of the pixels of training images with a measurement.
        measured: f64,
        /// Median relative error of depth, |D / D* − 1|: the median of the cameras'; none: too few pixels.
        error: Option<f64>,
        /// The camera with the largest error.
        worst: Option<String>,
        /// Its error.
        worst_error: Option<f64>,
    },
    /// Training is over.
    Finished {
        /// Steps taken.
        iteration: usize,
        /// Seconds of training, resumed ones included.
        seconds: f64,
        /// Gaussians at the end.
        gaussians: usize,
        /// Peak resident memory of the process, bytes; 0 where the system does not report it.
        peak_memory: u64,
        /// Advice to improve the result, if the run ended too early or with too few Gaussians.
        advice: Option<String>,
    },
}
