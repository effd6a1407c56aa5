//! Interface to the renderer: renders a scene, a camera and a time as an image for display.

mod exposing;
mod layers;
mod panorama;
mod transfer;

use crate::channels;
use crate::events::Listener;
use rayon::prelude::*;
use splat4d::channels::{feature_columns, label_columns};
use splat4d::device;
use splat4d::flow;
use splat4d::layers::{ALWAYS, Evaluation, Head, Scene};
use splat4d::play::Player;
use splat4d::render::{Abilities, Antialias, Backend, Image, RenderConfig, Shot};
use splat4d::scene::{Camera, Planes, Time};
use splat4d::{Error, Result};
use splat4d_train::encode::{self, Pixels};
use splat4d_train::labels::best;

pub use exposing::{Course, Exposure, Light};
pub use layers::Layers;
pub use panorama::Panorama;
pub use transfer::Transfer;

/// Channel of the rendering that is shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Channel {
    /// Colour over the background
    Color,
    /// Opacity: white is opaque
    Alpha,
    /// Expected depth: near is bright
    Depth,
    /// Motion of pixels to the next frame for this camera: direction as hue, length as saturation
    Flow,
    /// Velocity in the world: x, y, z as red, green, blue around grey
    Velocity,
    /// Normals in the camera's axes: right, up, towards the camera as red, green, blue
    Normal,
    /// The most probable label, one colour per label
    Label,
    /// Feature channels: the first three as red, green, blue around grey
    Feature,
    /// Seconds of the clip in which the visible surface exists: long is bright
    Life,
    /// Standard deviation of the depths that a pixel shows: uncertain is bright
    Uncertainty,
}

impl Channel {
    /// All of them.
    pub const ALL: [Self; 10] = [
        Self::Color,
        Self::Alpha,
        Self::Depth,
        Self::Flow,
        Self::Velocity,
        Self::Normal,
        Self::Label,
        Self::Feature,
        Self::Life,
        Self::Uncertainty,
    ];

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Color => "color",
            Self::Alpha => "alpha",
            Self::Depth => "depth",
            Self::Flow => "flow",
            Self::Velocity => "velocity",
            Self::Normal => "normal",
            Self::Label => "label",
            Self::Feature => "feature",
            Self::Life => "life",
            Self::Uncertainty => "uncertainty",
        }
    }

    /// Its content.
    pub fn about(self) -> &'static str {
        match self {
            Self::Color => "Colour over the background",
            Self::Alpha => "Opacity: white is opaque",
            Self::Depth => "Expected depth: near is bright",
            Self::Flow => "Motion of pixels to the next frame for this camera: direction as hue, length as saturation",
            Self::Velocity => "Velocity in the world: x, y, z as red, green, blue around grey",
            Self::Normal => "Normals in the camera's axes: right, up, towards the camera as red, green, blue",
            Self::Label => "The most probable label, one colour per label",
            Self::Feature => "Feature channels: the first three as red, green, blue around grey",
            Self::Life => "Seconds of the clip in which the visible surface exists: long is bright",
            Self::Uncertainty => "Standard deviation of the depths that a pixel shows: uncertain is bright",
        }
    }

    /// The channel with this name.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|c| c.name() == name)
    }

    /// Whether it is the mean of a number of what a pixel shows.
    pub fn is_field(self) -> bool {
        !matches!(self, Self::Color | Self::Alpha | Self::Depth)
    }

    /// Name of a plane of [`Painter::raw`], for files that name them.
    pub fn plane(self, c: usize) -> String {
        let names: &[&str] = match self {
            Self::Color => &["R", "G", "B"],
            Self::Alpha => &["A"],
            Self::Depth => &["Z"],
            Self::Flow => &["U", "V"],
            Self::Velocity | Self::Normal => &["X", "Y", "Z"],
            Self::Label => &["label"],
            Self::Feature => return format!("F{c:02}"),
            Self::Life => &["life"],
            Self::Uncertainty => &["uncertainty"],
        };
        names[c].into()
    }
}

/// Alpha below which a pixel has no depth, and no other value to show.
const DEPTH_ALPHA: f32 = 0.1;
/// Smallest uncertainty with a colour of its own, as a share of the largest.
const LEAST_UNCERTAINTY: f32 = 1e-3;
/// Colours from little to much, sRGB: dark blue to pale yellow, brightness rising throughout.
const RAMP: [[f32; 3]; 6] = [
    [13.0, 10.0, 36.0],
    [74.0, 25.0, 101.0],
    [148.0, 44.0, 98.0],
    [218.0, 84.0, 67.0],
    [250.0, 158.0, 74.0],
    [252.0, 245.0, 186.0],
];
/// Turn of the hue from one label to the next, of a whole one: the golden section, so that few labels are far apart and
/// many never meet.
const GOLDEN: f32 = 0.618_034;

/// Pixels that a thread turns into bytes at once: enough to amortise the overhead.
const CHUNK: usize = 1 << 14;

/// An image of 8-bit samples, rows from the top.
#[derive(Clone, Debug)]
pub struct Rgb {
    pub width: usize,
    pub height: usize,
    /// width·height·3 bytes.
    pub data: Vec<u8>,
}

impl Rgb {
    /// The bytes of a PNG file.
    pub fn png(&self) -> Vec<u8> {
        encode::png(Pixels::Eight(&self.data), [self.width, self.height], 3)
    }
}

/// Renders, on the CPU by default; memory is reused from image to image.
pub struct Painter<'a> {
    player: Player<'a>,
    scene: &'a Scene<f32>,
    background: [f32; 3],
    depth: bool,
    backend: Box<dyn Backend>,
    /// Abilities that the scene needs of a device.
    abilities: Abilities,
    listener: Option<&'a dyn Listener>,
    /// The last image.
    pub image: Image<f32>,
    bytes: Vec<[u8; 4]>,
    channel: Channel,
    /// A number per Gaussian, by layer and row, of channels that show one.
    numbers: Vec<Vec<f32>>,
    instant: Evaluation<f32>,
    /// Of the last image: the channel's values and the weight of what has one.
    field: (Planes<f32>, Planes<f32>),
    /// Images are of the whole sphere, if there is one.
    panorama: Option<Panorama>,
}

/// Renders a shot, or the sphere around its camera. A device that fails is reported, and the CPU takes over.
fn shoot(
    backend: &mut Box<dyn Backend>,
    listener: Option<&dyn Listener>,
    panorama: &mut Option<Panorama>,
    shot: &Shot<'_>,
    out: &mut Image,
) {
    let mut pinhole = |shot: &Shot<'_>, out: &mut Image| {
        if let Some(error) = device::draw(backend, shot, out)
            && let Some(listener) = listener
        {
            listener.warn(&format!("rendering on the CPU: {}", error.cause()));
        }
    };
    match panorama {
        None => pinhole(shot, out),
        Some(panorama) => panorama.render(shot, &mut pinhole, out),
    }
}

impl<'a> Painter<'a> {
    /// `depth`: whether images of depth will be requested.
    pub fn new(scene: &'a Scene<f32>, background: [f32; 3], antialias: bool, depth: bool) -> Self {
        let config = RenderConfig { antialias: self::antialias(antialias), ..RenderConfig::default() };
        let (player, backend, image) = (Player::of_scene(scene), device::cpu(config), Image::default());
        let abilities = Abilities { head: scene.head != Head::Identity, ..Abilities::default() };
        Self {
            player,
            scene,
            background,
            depth,
            backend,
            abilities,
            listener: None,
            image,
            bytes: Vec::new(),
            channel: Channel::Color,
            numbers: Vec::new(),
            instant: Evaluation::default(),
            field: Default::default(),
            panorama: None,
        }
    }

    /// The same with images of the whole sphere.
    pub fn around(mut self, panorama: Option<Panorama>) -> Self {
        self.panorama = panorama;
        self
    }

    /// As players do: what is beyond the clip of spans is its end.
    fn scene_time(&self, time: f64) -> Time {
        let scene = self.scene;
        let spans = scene.layers.iter().any(|l| l.span != ALWAYS);
        Time(if spans { time.max(scene.clip[0]).min(scene.clip[1]) } else { time })
    }

    /// The same for images of this channel. Errors: a scene without the labels or features that are requested.
    pub fn of_channel(mut self, channel: Channel) -> Result<Self> {
        self.channel = channel;
        self.depth |= channel == Channel::Depth;
        self.abilities.extra = channel.is_field();
        match channel {
            Channel::Label if self.scene.labels.is_empty() => {
                return Err(Error::input("the scene has no labels")
                    .remedy("Give the capture's cameras label masks, then: splat4d label RUN (docs/labels.md)."));
            }
            Channel::Feature if self.scene.feature_channels() == 0 => {
                return Err(Error::input("the scene has no features")
                    .remedy("Give the capture's cameras feature images, then: splat4d label RUN (docs/labels.md)."));
            }
            Channel::Life => self.numbers = channels::lifetimes(self.scene),
            _ => {}
        }
        Ok(self)
    }

    /// The same on another device: `open` gets the limits of the renderer and what the scene needs. A device that fails
    /// later is reported to `listener`.
    pub fn on(
        mut self,
        open: impl FnOnce(RenderConfig, &Abilities) -> Box<dyn Backend>,
        listener: &'a dyn Listener,
    ) -> Self {
        self.backend = open(*self.backend.config(), &self.abilities);
        self.listener = Some(listener);
        self
    }

    /// Names of the scene's labels.
    pub fn labels(&self) -> &[String] {
        &self.scene.labels
    }

    /// The device's name.
    pub fn device(&self) -> &str {
        self.backend.name()
    }

    /// Renders into [`image`](Self::image). A GPU that fails on the way is reported, and the CPU takes over.
    pub fn draw(&mut self, camera: &Camera, time: f64) {
        if self.channel.is_field() {
            return self.draw_field(camera, time);
        }
        let splats = self.player.at(Time(time)).expect("nothing is read for a scene that is in memory");
        let shot = Shot { depth: self.depth, ..Shot::new(&splats, camera, self.background) };
        shoot(&mut self.backend, self.listener, &mut self.panorama, &shot, &mut self.image);
    }

    /// Renders the means of the channel's numbers into `field`.
    fn draw_field(&mut self, camera: &Camera, time: f64) {
        let scene = self.scene;
        let t = self.scene_time(time);
        scene.at(t, &mut self.instant);
        let columns = match self.channel {
            Channel::Flow => {
                let next = flow::Shot { t: Time(t.0 + 1.0 / scene.fps), camera };
                flow::flow_columns(scene, &self.instant, camera, next)
            }
            Channel::Velocity => flow::velocity_columns(scene, &self.instant),
            Channel::Normal => channels::normal_columns(&self.instant, camera),
            Channel::Label => label_columns(scene, &self.instant).expect("a scene with labels was requested"),
            Channel::Feature => feature_columns(scene, &self.instant).expect("a scene with features was requested"),
            Channel::Uncertainty => channels::depth_columns(&self.instant, camera, self.panorama.is_some()),
            _ => channels::number_columns(&self.instant, &self.numbers),
        };
        let splats = scene.splats(&self.instant);
        let shot = Shot { extra: Some(&columns), ..Shot::new(&splats, camera, self.background) };
        shoot(&mut self.backend, self.listener, &mut self.panorama, &shot, &mut self.image);
        self.field = flow::divided(&self.image.extra);
        if self.channel == Channel::Uncertainty {
            self.field.0 = channels::spread(&self.field.0);
        }
    }

    /// The numbers of the last image, plane by plane (`Channel::planes`), NaN where nothing has any: colours over the
    /// background; alpha; expected depth, scene units; flow, pixels; velocity, scene units per second; unit normals in
    /// camera axes (x right, y down, z forward); the number of the likeliest label, −1 for none; seconds; scene units.
    pub fn raw(&self) -> Planes<f32> {
        let (values, weight) = &self.field;
        let known = |p: usize| weight.data[p] >= DEPTH_ALPHA;
        match self.channel {
            Channel::Color => self.image.color.clone(),
            Channel::Alpha => self.image.alpha.clone(),
            Channel::Depth => {
                let mut out = self.image.depth.clone();
                let pairs = out.data.iter_mut().zip(&self.image.alpha.data);
                pairs.for_each(|(d, a)| *d = if *a < DEPTH_ALPHA { f32::NAN } else { *d / a });
                out
            }
            Channel::Label => {
                let mut out = Planes::new(1, values.height, values.width);
                for (p, label) in out.data.iter_mut().enumerate() {
                    *label = best(&self.image.extra, p).map_or(-1.0, |l| l as f32);
                }
                out
            }
            channel => {
                let mut out = values.clone();
                for p in 0..out.pixels() {
                    let length = (0..out.channels).map(|c| out.plane(c)[p].powi(2)).sum::<f32>().sqrt();
                    // A mean of normals is no unit vector.
                    let unit = if channel == Channel::Normal { 1.0 / length } else { 1.0 };
                    for c in 0..out.channels {
                        out.plane_mut(c)[p] = if known(p) { unit * values.plane(c)[p] } else { f32::NAN };
                    }
                }
                out
            }
        }
    }

    /// Renders and takes over the image in 8 bits, without more of it where the device has a way to that; `range` as in
    /// [`rgb`](Self::rgb).
    pub fn picture(&mut self, camera: &Camera, time: f64, channel: Channel, range: [f32; 2]) -> Rgb {
        if channel == Channel::Color && self.panorama.is_none() {
            let splats = self.player.at(Time(time)).expect("nothing is read for a scene that is in memory");
            let shot = Shot::new(&splats, camera, self.background);
            // A device that fails is left by what follows.
            if let Ok(true) = self.backend.render_bytes(&shot, &mut self.bytes) {
                let data = self.bytes.iter().flat_map(|[r, g, b, _]| [*r, *g, *b]).collect();
                return Rgb { width: camera.width, height: camera.height, data };
            }
        }
        self.draw(camera, time);
        self.rgb(channel, range)
    }

    /// The last image in 8 bits. `range`: nearest and farthest depth of the depth colours.
    pub fn rgb(&self, channel: Channel, range: [f32; 2]) -> Rgb {
        if channel.is_field() {
            return field_rgb(&self.raw(), channel, range);
        }
        match channel {
            Channel::Alpha => {
                let plane = &self.image.alpha;
                let data = plane.data.iter().flat_map(|a| [byte(*a); 3]).collect();
                Rgb { width: plane.width, height: plane.height, data }
            }
            Channel::Depth => {
                let (depth, alpha) = (&self.image.depth, &self.image.alpha);
                let pixel = |(d, a): (&f32, &f32)| {
                    if *a < DEPTH_ALPHA { [0; 3] } else { depth_color(d / a, range) }
                };
                let data = depth.data.iter().zip(&alpha.data).flat_map(pixel).collect();
                Rgb { width: depth.width, height: depth.height, data }
            }
            _ => color_rgb(&self.image.color),
        }
    }

    /// The range of the last image's numbers that its colours spread over, without the outermost hundredths: of depth
    /// and uncertainty from the least on, of flow and velocity the largest length behind 0, of lifespan the whole clip.
    /// `None`: nothing is seen, or the channel needs no range.
    pub fn range(&self) -> Option<[f32; 2]> {
        if self.channel == Channel::Life {
            return Some([0.0, (self.scene.clip[1] - self.scene.clip[0]) as f32]);
        }
        let mut numbers: Vec<f32> = match self.channel {
            Channel::Depth => {
                let pairs = self.image.depth.data.iter().zip(&self.image.alpha.data);
                pairs.filter(|(_, a)| **a >= 0.5).map(|(d, a)| d / a).collect()
            }
            Channel::Flow | Channel::Velocity | Channel::Uncertainty => {
                let raw = self.raw();
                let length = |p: usize| (0..raw.channels).map(|c| raw.plane(c)[p].powi(2)).sum::<f32>().sqrt();
                (0..raw.pixels()).map(length).filter(|l| l.is_finite()).collect()
            }
            _ => return None,
        };
        if numbers.is_empty() {
            return None;
        }
        numbers.sort_by(f32::total_cmp);
        let n = numbers.len();
        let [low, high] = [numbers[n / 100], numbers[n - 1 - n / 100]];
        Some(match self.channel {
            Channel::Flow | Channel::Velocity => [0.0, high],
            // A pixel with one Gaussian has none, which no logarithm shows.
            Channel::Uncertainty => [low.max(LEAST_UNCERTAINTY * high), high],
            _ => [low, high],
        })
    }
}

/// The recipe's value for the renderer.
pub fn antialias(on: bool) -> Antialias {
    if on { Antialias::On } else { Antialias::Off }
}

/// Near is bright; equal steps of disparity appear equal.
fn depth_color(depth: f32, [near, far]: [f32; 2]) -> [u8; 3] {
    let (n, f) = (1.0 / near.max(1e-6), 1.0 / far.max(near * 1.0001).max(1e-6));
    ramp((1.0 / depth.max(1e-6) - f) / (n - f))
}

/// The colour of a share from 0 to 1.
fn ramp(share: f32) -> [u8; 3] {
    let place = share.clamp(0.0, 1.0) * (RAMP.len() - 1) as f32;
    let i = (place as usize).min(RAMP.len() - 2);
    let u = place - i as f32;
    std::array::from_fn(|k| (RAMP[i][k] * (1.0 - u) + RAMP[i + 1][k] * u).round() as u8)
}

/// Numbers as colours; undefined ones are black.
fn field_rgb(raw: &Planes<f32>, channel: Channel, [low, high]: [f32; 2]) -> Rgb {
    let span = (high - low).max(f32::MIN_POSITIVE);
    let color = |p: usize| -> [u8; 3] {
        let at = |c: usize| raw.plane(c)[p];
        if (0..raw.channels).any(|c| !at(c).is_finite()) {
            return [0; 3];
        }
        match channel {
            Channel::Flow => {
                // Right is red, down yellow-green, left cyan, up violet; the static background is white.
                let turn = at(1).atan2(at(0)) / std::f32::consts::TAU;
                hue(turn.rem_euclid(1.0), (at(0).hypot(at(1)) / span).min(1.0), 1.0)
            }
            Channel::Velocity => std::array::from_fn(|c| byte(0.5 + 0.5 * at(c) / span)),
            Channel::Feature => {
                std::array::from_fn(|c| if c < raw.channels { byte(0.5 + 0.5 * at(c) / span) } else { byte(0.5) })
            }
            Channel::Normal => [byte(0.5 + 0.5 * at(0)), byte(0.5 - 0.5 * at(1)), byte(0.5 - 0.5 * at(2))],
            Channel::Label if at(0) < 0.0 => [0; 3],
            Channel::Label => label_color(at(0) as usize),
            Channel::Uncertainty => {
                let log = |x: f32| x.max(f32::MIN_POSITIVE).ln();
                ramp((log(at(0)) - log(low)) / (log(high) - log(low)).max(f32::MIN_POSITIVE))
            }
            _ => ramp((at(0) - low) / span),
        }
    };
    let data = (0..raw.pixels()).flat_map(color).collect();
    Rgb { width: raw.width, height: raw.height, data }
}

/// The colour of a label: hues a golden section apart, every other one paler.
pub fn label_color(label: usize) -> [u8; 3] {
    hue((label as f32 * GOLDEN).fract(), if label.is_multiple_of(2) { 0.75 } else { 0.45 }, 0.95)
}

/// Hue from 0 to 1 (red, yellow, green, cyan, blue, violet), saturation and value as 8 bits.
fn hue(turn: f32, saturation: f32, value: f32) -> [u8; 3] {
    let channel = |n: f32| {
        let k = (n + 6.0 * turn) % 6.0;
        byte(value - value * saturation * k.min(4.0 - k).clamp(0.0, 1.0))
    };
    [channel(5.0), channel(3.0), channel(1.0)]
}

/// Clamped and rounded; NaN is black. Half is added and cut off, which is rounding here and vectorises.
fn byte(v: f32) -> u8 {
    (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8
}

/// Colour planes in 8 bits.
pub fn color_rgb(color: &Planes<f32>) -> Rgb {
    let mut data = Vec::new();
    color_into(color, &mut data);
    Rgb { width: color.width, height: color.height, data }
}

/// Colour planes in 8 bits, red, green and blue of a pixel side by side; `out`'s memory is reused.
pub fn color_into(color: &Planes<f32>, out: &mut Vec<u8>) {
    out.resize(3 * color.pixels(), 0);
    let [red, green, blue] = [0, 1, 2].map(|c| color.plane(c).par_chunks(CHUNK));
    out.par_chunks_mut(3 * CHUNK).zip(red).zip(green).zip(blue).for_each(|(((out, red), green), blue)| {
        let (pixels, _) = out.as_chunks_mut::<3>();
        for (((out, r), g), b) in pixels.iter_mut().zip(red).zip(green).zip(blue) {
            *out = [byte(*r), byte(*g), byte(*b)];
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_are_clamped_and_rounded() {
        let color = Planes::from_interleaved(3, 1, 2, &[-0.2, 0.5, 1.7, 1.0 / 255.0, 0.0, f32::NAN]);
        assert_eq!(color_rgb(&color).data, [0, 128, 255, 1, 0, 0]);
        let shade = |i: usize| (i % 511) as f32 / 510.0;
        let wide = Planes::from_interleaved(3, 1, CHUNK + 5, &(0..3 * (CHUNK + 5)).map(shade).collect::<Vec<_>>());
        let mut out = vec![9; 7];
        color_into(&wide, &mut out);
        assert!(
            out.iter().enumerate().all(|(i, b)| *b == (255.0 * shade(i)).round() as u8) && out.len() == 3 * (CHUNK + 5)
        );
    }

    #[test]
    fn near_is_brighter_than_far() {
        let sum = |d: f32| depth_color(d, [1.0, 9.0]).iter().map(|b| u32::from(*b)).sum::<u32>();
        assert!(sum(1.0) > sum(2.0) && sum(2.0) > sum(5.0) && sum(5.0) > sum(9.0));
        assert_eq!(sum(0.5), sum(1.0));
        assert_eq!(depth_color(3.0, [3.0, 3.0]).len(), 3);
    }
}
