//! Captures with poses: files, cameras and times of all images, and the images themselves, decoded on demand.
//!
//! [`Capture::open`] identifies the layout of a folder, reads poses and times, checks them and converts them to one
//! form: pinhole cameras with OpenCV axes, seconds, and one held-out split. An [`ImageStore`] decodes images on demand
//! within a byte budget. Every reader produces a `RawCapture` (the content of the files); `assemble` alone turns takes
//! into captures, so all layouts are checked alike.

mod account;
mod arriving;
mod assemble;
mod borders;
mod colmap;
mod colmap_files;
mod computed;
mod convention;
mod depth;
pub(crate) mod depth_field;
mod elsewhere;
mod evidence;
mod exr;
mod extra_model;
pub(crate) mod features;
pub(crate) mod flow;
mod foreign;
pub mod frames;
mod geometry;
mod json;
pub(crate) mod labels;
mod layout;
mod lens;
mod llff;
mod lookup;
mod masks;
mod n3dv;
mod nerfies;
mod observe;
mod offset;
mod options;
mod own;
mod panoptic;
mod panorama;
mod picture;
mod plausible;
mod points;
mod pose;
mod posed;
mod preflight;
mod raster;
mod rgb8;
mod rig;
mod sequence;
pub(crate) mod shutter;
mod splits;
mod store;
mod stray;
mod tracks;
mod transforms;
mod vignetting;

pub use account::{Aspect, Remark, Severity};
pub(crate) use arriving::{frame_files, growing_root};
pub use convention::{Convention, Poses};
pub use depth::{DepthFile, DepthKind};
pub(crate) use depth::{DepthFit, read as depth_map};
pub use evidence::{Agreement, PoseCheck};
pub(crate) use flow::{FlowFile, to_picture as flow_picture};
pub use geometry::{Geometry, check_scan};
pub use lens::Distortion;
pub use n3dv::{about_rows, rows_of};
pub use options::{
    Borders, CaptureOptions, CaptureSettings, Exif, FlowSource, HoldOut, Lenses, Sequence, Text, Times, Unregistered,
};
pub use points::PointCloud;
pub use posed::{PosedCamera, check_intrinsics, colmap_cameras, is_colmap, rigid, transforms_cameras};
pub use preflight::{Finding, Reach};
pub use rgb8::Rgb8;
pub use sequence::Timing;
pub use shutter::Shutter;
pub use store::{ImageStore, Picture, StoredPicture};
pub use tracks::Tracks;
pub(crate) use vignetting::parsed as parsed_vignetting;

use account::Account;
use splat4d::Result;
use splat4d::math::se3::{norm, sub};
use splat4d::scene::time::DEFAULT_FPS;
use splat4d::scene::{Camera, Time};
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// A reader: the capture's folder and the marker file that was found, to what the files specify.
type Reader = fn(&Path, &Path, &CaptureOptions) -> Result<RawCapture>;

/// The list of layouts: a reader is its file, its name in [`CaptureKind`] and an entry here. Marker files (or folders)
/// in search order, with their readers.
const READERS: &[(&str, Reader)] = &[
    ("capture.json", own::read),
    (transforms::TRAIN, transforms::read),
    ("train_meta.json", panoptic::read),
    (transforms::ALL, transforms::read),
    (nerfies::MARKER, nerfies::read),
    (layout::BOUNDS, layout::read_bounds),
    (colmap::SPARSE, colmap::read),
    (colmap::NESTED, colmap::read),
    (colmap::MULTIVIEW, colmap::read),
    ("cameras.bin", colmap::read),
    ("cameras.txt", colmap::read),
    (colmap::COLMAP, colmap::read),
    (colmap::WORKSPACES[0], colmap::read),
    (colmap::WORKSPACES[1], colmap::read),
    (colmap::WORKSPACES[2], colmap::read),
    (colmap::WORKSPACES[3], colmap::read),
];

/// Which layout a capture was read from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum CaptureKind {
    /// Our own `capture.json`.
    Own,
    /// `transforms_{train,val,test}.json`: D-NeRF, Blender and programs that write like them.
    DNerf,
    /// PanopticSports `train_meta.json` and `test_meta.json`.
    Panoptic,
    /// `transforms.json`: Nerfstudio, instant-ngp.
    Nerfstudio,
    /// A COLMAP reconstruction in `sparse/`.
    Colmap,
    /// N3DV: `poses_bounds.npy` and a folder of frames per camera.
    N3dv,
    /// LLFF: `poses_bounds.npy` and one folder of images.
    Llff,
    /// Nerfies and HyperNeRF: `dataset.json`, `metadata.json` and a camera file an image.
    Nerfies,
    /// Agisoft Metashape's cameras as XML.
    Metashape,
    /// RealityScan's (RealityCapture's) camera parameters as CSV.
    RealityScan,
    /// Polycam's raw data, `keyframes/`.
    Polycam,
    /// Record3D's images with `metadata.json`.
    Record3d,
}

/// One image of the capture.
#[derive(Clone, Debug)]
pub struct Frame {
    /// Index into [`Capture::cameras`].
    pub camera: usize,
    /// The camera of the image that [`ImageStore::load`] returns: a pinhole, undistorted and downscaled.
    pub view: Camera,
    /// The camera of the image file: full size, with its lens.
    pub source: Camera,
    /// Seconds on the scene clock.
    pub time: Time,
    /// Frame number in the capture, from 0; frames of several cameras with one number belong to one time unless the
    /// cameras have time offsets.
    pub index: usize,
    /// The image file.
    pub image: PathBuf,
    /// Whether its EXIF orientation is applied; else its camera describes the pixels as stored.
    pub upright: bool,
    /// The foreground mask file (white = foreground).
    pub mask: Option<PathBuf>,
    /// Its depth map.
    pub depth: Option<DepthFile>,
    /// Its optical flow.
    pub flow: Option<FlowFile>,
    /// The mask of labels: its values number [`Capture::labels`].
    pub labels: Option<PathBuf>,
    /// The image of features: numbers of its pixels.
    pub features: Option<PathBuf>,
    /// The tracks of its camera.
    pub tracks: Option<Arc<Tracks>>,
    /// [height · width] of the image file: 1 where its lens recorded something, 0 in black borders; `None`: no borders.
    pub recorded: Option<Arc<Vec<u8>>>,
    /// Its rolling shutter and exposure; `None`: all rows are of its time.
    pub shutter: Option<Shutter>,
    /// Coefficients of the vignetting that is removed from its image; `None`: there is none.
    pub vignetting: Option<[f64; 3]>,
    /// Distortion that remains after the stated one, as training has learnt it: a ray (x, y, 1) of the view is the ray
    /// (x, y) (1 + k1 r² + k2 r⁴) of the stated lens. Images and masks are undistorted with both.
    pub residual: [f64; 2],
}

impl Frame {
    /// The lens of its image file, with what remains.
    fn distortion(&self) -> Distortion {
        Distortion::after(self.source.lens, self.residual)
    }
}

/// One camera of the rig, or one moving camera.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Rig {
    /// Its name in the data set.
    pub name: String,
    /// Whether one pose holds for the whole capture.
    pub fixed: bool,
}

/// The purpose of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Split {
    /// Trained on.
    Train,
    /// Kept from training: measures the result.
    Held,
    /// Kept from training: the data set's own validation set (D-NeRF).
    Validation,
    /// Later than what is observed (`Capture::observe`): only scores predictions.
    Future,
}

/// Size of a capture.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Extent {
    /// The first frame number, and the one after the last.
    pub frames: Range<usize>,
    /// Images of all cameras.
    pub pictures: usize,
}

impl Extent {
    /// With one image more for each of these frame numbers.
    fn add(&mut self, frames: Range<usize>) {
        let both = self.frames.start.min(frames.start)..self.frames.end.max(frames.end);
        self.pictures += frames.len();
        self.frames = if self.frames.is_empty() { frames } else { both };
    }
}

/// A posed, timed set of images on disk.
#[derive(Clone, Debug)]
pub struct Capture {
    /// A short name: what the capture calls itself, else the folder's.
    pub name: String,
    /// The folder.
    pub root: PathBuf,
    /// Real folders of its images, masks and maps that are elsewhere, and such files.
    pub elsewhere: BTreeSet<PathBuf>,
    /// The layout it was read from.
    pub kind: CaptureKind,
    /// The cameras; a moving camera is one entry that is not `fixed`.
    pub cameras: Vec<Rig>,
    /// Whether the data set, or the names of its images (`cam07`), separate cameras; else an entry is one camera's
    /// photo of a time, or represents many.
    pub named: bool,
    /// All images, or those that were requested ([`CaptureOptions::frames`]).
    pub frames: Vec<Frame>,
    /// The whole capture, whatever of it is listed.
    pub take: Extent,
    /// Indices of the frames held out to measure.
    pub held: Vec<usize>,
    /// Indices of the frames to train on.
    pub train: Vec<usize>,
    /// Indices of the data set's own validation frames.
    pub validation: Vec<usize>,
    /// Indices of the frames after the observed part, of every camera; see `observe`.
    pub future: Vec<usize>,
    /// Source of the times.
    pub timing: Timing,
    /// Frames per second.
    pub fps: f64,
    /// The initial cloud, in the scene's units, already thinned to [`CaptureOptions::max_points`].
    pub points: Option<PointCloud>,
    /// A scan or a mesh that constrains depth during training.
    pub geometry: Option<Arc<Geometry>>,
    /// The background of transparent pixels, sRGB from 0 to 1; `None`: the images have no alpha.
    pub background: Option<[f32; 3]>,
    /// Offset subtracted from the world coordinates of poses and points, because f32 resolves them badly; zero near the
    /// origin ([`splat4d::scene::offset`]).
    pub offset: [f64; 3],
    /// Upwards in the world (unit); estimated from the cameras where the data set states none.
    pub up: [f64; 3],
    /// Names of what masks of labels number; empty: there are none.
    pub labels: Vec<String>,
    /// The k of [`CaptureOptions::downscale`].
    pub downscale: usize,
    /// Pose convention of the layout.
    pub convention: Convention,
    /// Convention that was used instead.
    pub poses: Poses,
    /// Recorded area of its lenses: black borders, or none.
    pub lenses: Lenses,
    /// Content not found, not read or assumed.
    pub account: Vec<Remark>,
    /// The reader's warnings, a sentence or two each.
    pub warnings: Vec<String>,
    /// Harmless choices and assumptions of the reader, a sentence or two each.
    pub notes: Vec<String>,
}

/// A reader's findings in the files, before any check.
struct RawCapture {
    name: Option<String>,
    root: PathBuf,
    kind: CaptureKind,
    cameras: Vec<String>,
    /// Whether the data set distinguishes cameras; else one entry may represent many.
    named: bool,
    timing: Timing,
    frames: Vec<RawFrame>,
    /// The whole capture, where the reader listed a part of it; empty: all is listed.
    take: Extent,
    /// The first image of each camera, where the reader listed a part of the capture.
    firsts: BTreeMap<usize, PathBuf>,
    /// The data set's convention, where the frames' splits do not give it.
    hold_out: Option<HoldOut>,
    fps: f64,
    points: Option<PointCloud>,
    geometry: Option<Geometry>,
    /// Files named in its metadata that were read and are no frame's.
    files: Vec<PathBuf>,
    background: Option<[f32; 3]>,
    up: Option<[f64; 3]>,
    labels: Vec<String>,
    warnings: Vec<String>,
    notes: Vec<String>,
    account: Account,
    /// Pose convention of the layout.
    convention: Convention,
}

impl RawCapture {
    /// An empty take of a layout; readers fill in what it states.
    fn new(root: &Path, kind: CaptureKind, convention: Convention) -> Self {
        Self {
            name: None,
            root: root.to_path_buf(),
            kind,
            cameras: Vec::new(),
            named: false,
            timing: Timing::Told,
            frames: Vec::new(),
            take: Extent::default(),
            firsts: BTreeMap::new(),
            hold_out: None,
            fps: DEFAULT_FPS,
            points: None,
            geometry: None,
            files: Vec::new(),
            background: None,
            up: None,
            labels: Vec::new(),
            warnings: Vec::new(),
            notes: Vec::new(),
            account: Account::default(),
            convention,
        }
    }
}

/// A frame as a reader found it.
struct RawFrame {
    camera: usize,
    source: Camera,
    time: f64,
    index: usize,
    image: PathBuf,
    mask: Option<PathBuf>,
    depth: Option<DepthFile>,
    flow: Option<PathBuf>,
    labels: Option<PathBuf>,
    features: Option<PathBuf>,
    tracks: Option<Arc<Tracks>>,
    /// Readout and exposure, seconds, as stated.
    shutter: [Option<f64>; 2],
    vignetting: Option<[f64; 3]>,
    split: Split,
}

impl RawFrame {
    /// An image to train on, with nothing next to it. `place`: its camera, frame number and seconds.
    fn new((camera, index, time): (usize, usize, f64), source: Camera, image: PathBuf) -> Self {
        Self {
            camera,
            source,
            time,
            index,
            image,
            mask: None,
            depth: None,
            flow: None,
            labels: None,
            features: None,
            tracks: None,
            shutter: [None; 2],
            vignetting: None,
            split: Split::Train,
        }
    }
}

impl Capture {
    /// Opens the capture in a folder, or that of a marker file.
    ///
    /// Reads poses, times and the headers of one image per camera; checks that every image exists. Errors name the
    /// file, frame or camera and what to do.
    pub fn open(path: &Path, options: &CaptureOptions) -> Result<Self> {
        options.check()?;
        assemble::assemble(layout::read(path, options)?, options)
    }

    /// Reads a frame's mask of labels and its features, where there are such. Errors: damage; another size.
    pub fn check_labels(&self, frame: &Frame) -> Result<()> {
        labels::read(frame, self)?;
        features::read(frame, self).map(drop)
    }

    /// The first and last time of all frames, seconds.
    pub fn time_range(&self) -> (f64, f64) {
        let times = self.frames.iter().map(|f| f.time.0);
        times.fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), t| (lo.min(t), hi.max(t)))
    }

    /// All distinct times, seconds, in order.
    pub fn times(&self) -> Vec<f64> {
        let mut times: Vec<f64> = self.frames.iter().map(|f| f.time.0).collect();
        times.sort_by(f64::total_cmp);
        times.dedup();
        times
    }

    /// Adds points to its own, and lowers the near plane to the nearest; `near`: as [`CaptureOptions::near`].
    pub(crate) fn add_points(&mut self, mut more: PointCloud, near: f64) {
        let points = self.points.get_or_insert_default();
        points.points.append(&mut more.points);
        points.colors.append(&mut more.colors);
        points.times.append(&mut more.times);
        if points.points.is_empty() {
            self.points = None;
        }
        let near = assemble::near(self, near);
        self.frames.iter_mut().for_each(|f| f.view.near = near);
    }

    /// Whether every camera keeps one pose for the whole capture.
    pub(crate) fn fixed_cameras(&self) -> bool {
        self.cameras.iter().all(|c| c.fixed)
    }

    /// The purpose of `frame`.
    pub fn split(&self, frame: usize) -> Split {
        if self.held.binary_search(&frame).is_ok() {
            Split::Held
        } else if self.validation.binary_search(&frame).is_ok() {
            Split::Validation
        } else if self.future.binary_search(&frame).is_ok() {
            Split::Future
        } else {
            Split::Train
        }
    }

    /// Whether it consists of photos of a moment, whose cameras have no names: each photo is its own camera.
    pub(crate) fn of_photos(&self) -> bool {
        self.timing == Timing::Moment && !self.named
    }

    /// The views of the training cameras: one of every fixed camera, all of moving ones.
    pub(crate) fn places(&self) -> impl Iterator<Item = &Camera> {
        let mut seen = vec![false; self.cameras.len()];
        let frames = self.train.iter().map(|&i| &self.frames[i]);
        let new = move |f: &&Frame| !(self.cameras[f.camera].fixed && std::mem::replace(&mut seen[f.camera], true));
        frames.filter(new).map(|f| &f.view)
    }

    /// The centroid of the training cameras' centres and 1.1 times the largest distance from it: the length scale that
    /// the field's learning rates refer to (Kerbl 2023, `getNerfppNorm`). At least 10⁻⁶.
    pub(crate) fn center_and_radius(&self) -> ([f64; 3], f64) {
        /// Margin around the outermost camera (Kerbl 2023).
        const MARGIN: f64 = 1.1;
        let centers: Vec<[f64; 3]> = self.places().map(Camera::center).collect();
        let n = centers.len().max(1) as f64;
        let mut mean = [0.0; 3];
        for c in &centers {
            (0..3).for_each(|k| mean[k] += c[k] / n);
        }
        let far = centers.iter().map(|&c| norm(sub(c, mean)));
        (mean, (MARGIN * far.fold(0.0, f64::max)).max(1e-6))
    }
}

#[cfg(test)]
mod tests;

/// Whether a file's name is one that a capture's metadata can have: [`Capture::open`] takes such files too.
pub fn is_metadata(path: &Path) -> bool {
    layout::is_metadata(path)
}

/// Whether a folder holds a capture, by the files in it; they need not be readable.
pub fn is_folder(path: &Path) -> bool {
    path.is_dir() && layout::is_capture(path)
}

/// Whether a folder holds a capture and images or videos that were filmed for it. It is opened only where these do not lie in
/// their usual places.
pub(crate) fn is_filmed(path: &Path) -> bool {
    let usual = || colmap::has_images(path) || !stray::videos(path).is_empty();
    is_folder(path) && (usual() || Capture::open(path, &CaptureOptions::default()).is_ok())
}

/// Images and videos in a folder and in the folders below it, three levels deep.
pub(crate) fn films(folder: &Path) -> Vec<PathBuf> {
    fn collect(folder: &Path, levels: usize, out: &mut Vec<PathBuf>) {
        out.extend(stray::videos(folder).into_iter().map(|name| folder.join(name)));
        for name in rig::file_names(folder) {
            let path = folder.join(&name);
            if rig::is_image(&name) {
                out.push(path);
            } else if levels > 0 && path.is_dir() {
                collect(&path, levels - 1, out);
            }
        }
    }
    let mut out = Vec::new();
    collect(folder, 3, &mut out);
    out
}

/// A coloured point cloud from a .ply, .npy or .npz file. Errors: not a point cloud, damage, absurd counts.
pub(crate) fn read_points(path: &Path) -> Result<PointCloud> {
    points::read_cloud(path)
}
