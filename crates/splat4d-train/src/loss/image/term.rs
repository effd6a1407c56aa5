//! The contract of losses on rendered images, [`ImageTerm`]: it states which channels it needs, compares an image and
//! its truth, and adds its gradient.

use crate::capture::frames::{DepthTruth, FlowTruth};
use crate::capture::shutter::Shutter;
use crate::loss::terms::StepInfo;
use splat4d::math::Real;
use splat4d::render::{Comparison, Image, ImageGrads, Target};
use splat4d::scene::{Camera, Planes, Time};

/// The loss of one image.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LossValue {
    /// (1 − λ)·l1 + λ·(1 − ssim)
    pub total: f64,
    /// Weighted mean |render − truth| over pixels and channels.
    pub l1: f64,
    /// Weighted mean of the SSIM map over pixels and channels; 1 for equal images.
    pub ssim: f64,
    /// Weighted mean of (render − truth)², the render clamped to [0, 1]; no part of `total`.
    pub mse: f64,
}

/// One image that the scene is compared with.
#[derive(Clone, Copy, Debug)]
pub struct View<'a, F = f32> {
    /// From where.
    pub camera: &'a Camera,
    /// When.
    pub t: Time,
    /// Colour behind the scene.
    pub background: [F; 3],
    /// The truth, 3 channels.
    pub truth: &'a Planes<F>,
    /// Foreground mask, 1 channel.
    pub mask: Option<&'a Planes<F>>,
    /// Pixels that count, 1 channel.
    pub weight: Option<&'a Planes<F>>,
    /// Its depth, where known.
    pub depth: Option<DepthTruth<'a, F>>,
    /// Depth of measured geometry, where known.
    pub measured: Option<DepthTruth<'a, F>>,
    /// Its optical flow, where known.
    pub flow: Option<FlowTruth<'a, F>>,
    /// Positions of tracked points at another time: flow that is known in their pixels alone.
    pub tracks: Option<FlowTruth<'a, F>>,
    /// The frame's number in the capture, for messages and for devices that keep its image.
    pub frame: usize,
    /// The camera's number in the capture, for the exposure.
    pub rig: usize,
    /// The image's shutter, where that is not ideal.
    pub shutter: Option<Shutter>,
}

/// A further channel: a number or a few of every splat, blended as colours are, over nothing. The declared order is the
/// order in which they are rendered.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Channel {
    /// Σ α T n, n the shortest axis of a splat towards the camera, camera axes, 3 planes.
    Normals,
    /// Σ α T f, f the displacement of a splat's centre on the screen to the time of the view's flow, pixels, 2 planes,
    /// and Σ α T of the splats that have an f. Only views with flow may request it.
    Flow,
    /// The same to the time of the view's tracks.
    Tracks,
    /// Σ α T s, s the sigmoid of this column of the Gaussians, 1 plane; 0 in layers without that column, and not
    /// rendered if no layer has it.
    Sigmoid(String),
}

impl Channel {
    /// Its planes.
    pub(crate) fn width(&self) -> usize {
        match self {
            Channel::Normals | Channel::Flow | Channel::Tracks => 3,
            Channel::Sigmoid(_) => 1,
        }
    }

    /// The other time at which it needs the view's splats.
    pub(crate) fn other_time<F: Copy>(&self, view: &View<'_, F>) -> Option<Time> {
        match self {
            Channel::Flow | Channel::Tracks => Some(self.way(view)?.to),
            Channel::Normals | Channel::Sigmoid(_) => None,
        }
    }

    /// Known motion of a channel to render.
    pub(crate) fn way<'a, F: Copy>(&self, view: &View<'a, F>) -> Option<FlowTruth<'a, F>> {
        match self {
            Channel::Flow => view.flow,
            Channel::Tracks => view.tracks,
            Channel::Normals | Channel::Sigmoid(_) => None,
        }
    }
}

/// The planes to render of a view next to colour and alpha.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Needs {
    /// Σ z α T.
    pub depth: bool,
    /// Further channels, in order, without duplicates.
    pub extra: Vec<Channel>,
}

impl Needs {
    /// Adds what another term needs.
    pub(crate) fn join(&mut self, other: Needs) {
        self.depth |= other.depth;
        self.extra.extend(other.extra);
        self.extra.sort_unstable();
        self.extra.dedup();
    }
}

/// An image as terms see it.
#[derive(Clone, Copy, Debug)]
pub struct Shown<'a, F = f32> {
    /// Red, green, blue over the background, as the view's camera exposes them, [3, h, w].
    pub color: &'a Planes<F>,
    /// 1 − final transmittance, [1, h, w].
    pub alpha: &'a Planes<F>,
    /// Σ z α T, [1, h, w]; no plane where no term needs it.
    pub depth: &'a Planes<F>,
    /// Further channels, [C, h, w].
    pub extra: &'a Planes<F>,
    /// The kinds of these, each with its first plane.
    pub channels: &'a [(Channel, usize)],
}

impl<'a, F: Real> Shown<'a, F> {
    /// A rendered image with these further channels.
    pub(crate) fn new(image: &'a Image<F>, channels: &'a [(Channel, usize)]) -> Self {
        Self { color: &image.color, alpha: &image.alpha, depth: &image.depth, extra: &image.extra, channels }
    }

    /// First plane of a channel, and a copy of its planes; `None`: it was not rendered.
    pub fn channel(&self, channel: &Channel) -> Option<(usize, Planes<F>)> {
        let first = self.channels.iter().find(|(c, _)| c == channel)?.1;
        let (n, channels) = (self.extra.pixels(), channel.width());
        let data = self.extra.data[first * n..(first + channels) * n].to_vec();
        Some((first, Planes { channels, height: self.extra.height, width: self.extra.width, data }))
    }
}

/// The gradient to some planes of an image: zero until a term touches it.
#[derive(Clone, Debug, Default)]
pub struct Gradient<F = f32> {
    planes: Planes<F>,
    shape: [usize; 3],
    touched: bool,
}

impl<F: Real> Gradient<F> {
    fn begin(&mut self, like: &Planes<F>) {
        (self.shape, self.touched) = ([like.channels, like.height, like.width], false);
    }

    /// The planes, to be added to.
    pub fn add(&mut self) -> &mut Planes<F> {
        if !std::mem::replace(&mut self.touched, true) {
            let [channels, height, width] = self.shape;
            self.planes.reset(channels, height, width);
        }
        &mut self.planes
    }

    /// The planes, of any shape and content, to be overwritten as a whole; `None`: a term has added to them already.
    pub(crate) fn overwrite(&mut self) -> Option<&mut Planes<F>> {
        (!std::mem::replace(&mut self.touched, true)).then_some(&mut self.planes)
    }

    /// The planes, if a term has touched them.
    pub(crate) fn get(&self) -> Option<&Planes<F>> {
        self.touched.then_some(&self.planes)
    }
}

/// The gradient to an image.
#[derive(Clone, Debug, Default)]
pub struct LossGrads<F = f32> {
    /// To colour, [3, h, w].
    pub color: Gradient<F>,
    /// To alpha, [1, h, w].
    pub alpha: Gradient<F>,
    /// To Σ z α T, [1, h, w].
    pub depth: Gradient<F>,
    /// To the further channels, [C, h, w].
    pub extra: Gradient<F>,
}

impl<F: Real> LossGrads<F> {
    /// Zeros in the shape of `image`.
    pub(crate) fn begin(&mut self, image: &Image<F>) {
        self.color.begin(&image.color);
        self.alpha.begin(&image.alpha);
        self.depth.begin(&image.depth);
        self.extra.begin(&image.extra);
    }

    /// Adds to the gradient of further channels, from plane `first` on.
    pub fn add_extra(&mut self, first: usize, planes: &Planes<F>) {
        let n = planes.pixels();
        let to = &mut self.extra.add().data[first * n..first * n + planes.data.len()];
        to.iter_mut().zip(&planes.data).for_each(|(d, x)| *d += *x);
    }

    /// As the renderer takes it.
    pub(crate) fn grads(&mut self) -> ImageGrads<'_, F> {
        self.color.add();
        ImageGrads {
            color: &self.color.planes,
            alpha: self.alpha.get(),
            depth: self.depth.get(),
            extra: self.extra.get(),
        }
    }
}

/// A loss on rendered images.
pub trait ImageTerm<F: Real = f32>: Send {
    /// The planes that it needs of this view next to colour and alpha.
    fn needs(&self, _view: &View<'_, F>) -> Needs {
        Needs::default()
    }

    /// Whether it applies to this view: if not, its value is 0 and it adds no gradient.
    fn applies_to(&self, _view: &View<'_, F>) -> bool {
        true
    }

    /// Its value for one view; adds its gradient to `d`.
    fn eval(&mut self, info: &StepInfo, view: &View<'_, F>, shown: &Shown<'_, F>, d: &mut LossGrads<F>) -> f64;

    /// The loss of a view as plain data, where it is that of 3DGS and nothing else: a device may then compute it.
    fn target<'a>(&self, _view: &View<'a, F>) -> Option<Target<'a, F>> {
        None
    }

    /// Takes over what a device made of [`target`](Self::target) instead of [`eval`](Self::eval), the gradient apart.
    /// Returns the value.
    fn compared(&mut self, _view: &View<'_, F>, _comparison: &Comparison) -> f64 {
        unreachable!("only what has a target is compared by a device")
    }

    /// Its measurement of the last view, for progress and metrics.
    fn measured(&self) -> Option<LossValue> {
        None
    }
}
