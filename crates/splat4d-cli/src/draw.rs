//! The seam to the renderer: a scene, a camera and a time become a picture for people.

use crate::console::Console;
use crate::device::Device;
use crate::video::Rgb;
use rayon::prelude::*;
use splat4d::device;
use splat4d::layers::{Head, Scene};
use splat4d::play::Player;
use splat4d::render::{Antialias, Backend, Image, RenderConfig, Shot, Wanted};
use splat4d::scene::{Camera, Planes, Time};

/// Channel of the rendering that is shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum Channel {
    /// Colour over the background
    Color,
    /// How opaque: white where something is
    Alpha,
    /// Expected depth: near is bright
    Depth,
}

/// Alpha below which a pixel has no depth worth showing.
const DEPTH_ALPHA: f32 = 0.1;
/// Colours of depth from far to near, sRGB: dark blue to pale yellow, brightness rising throughout.
const DEPTH_COLORS: [[f32; 3]; 6] = [
    [13.0, 10.0, 36.0],
    [74.0, 25.0, 101.0],
    [148.0, 44.0, 98.0],
    [218.0, 84.0, 67.0],
    [250.0, 158.0, 74.0],
    [252.0, 245.0, 186.0],
];

/// Pixels that a thread turns into bytes at once: enough to be worth its while.
const CHUNK: usize = 1 << 14;

/// Draws, on the CPU unless told; memory is reused from picture to picture.
pub(crate) struct Painter<'a> {
    player: Player<'a>,
    background: [f32; 3],
    depth: bool,
    backend: Box<dyn Backend>,
    /// Abilities that the scene needs of a device.
    wanted: Wanted,
    console: Option<&'a Console>,
    /// The last picture.
    pub image: Image<f32>,
    bytes: Vec<[u8; 4]>,
}

impl<'a> Painter<'a> {
    /// `depth`: whether pictures of depth will be asked for.
    pub(crate) fn new(scene: &'a Scene<f32>, background: [f32; 3], antialias: bool, depth: bool) -> Self {
        let config = RenderConfig { antialias: self::antialias(antialias), ..RenderConfig::default() };
        let (player, backend, image) = (Player::of_scene(scene), device::cpu(config), Image::default());
        let wanted = Wanted { head: scene.head != Head::Identity, ..Wanted::default() };
        Self { player, background, depth, backend, wanted, console: None, image, bytes: Vec::new() }
    }

    /// The same on another device, where that can draw the scene.
    pub(crate) fn on(mut self, device: Device, console: &'a Console) -> Self {
        self.backend = crate::device::open(device, *self.backend.config(), &self.wanted, console).backend;
        self.console = Some(console);
        self
    }

    /// The device's name.
    pub(crate) fn device(&self) -> &str {
        self.backend.name()
    }

    /// Draws into [`image`](Self::image). A GPU that fails on the way is said, and left for the CPU.
    pub(crate) fn draw(&mut self, camera: &Camera, time: f64) {
        let splats = self.player.at(Time(time)).expect("nothing is read for a scene that is in memory");
        let shot = Shot { depth: self.depth, ..Shot::new(&splats, camera, self.background) };
        if let Some(error) = device::draw(&mut self.backend, &shot, &mut self.image)
            && let Some(console) = self.console
        {
            console.warn(&format!("drawing on the CPU: {error}"));
        }
    }

    /// Draws and takes over the picture in 8 bits, without more of it where the device has a way to that; `range` as in
    /// [`rgb`](Self::rgb).
    pub(crate) fn picture(&mut self, camera: &Camera, time: f64, channel: Channel, range: [f32; 2]) -> Rgb {
        if channel == Channel::Color {
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

    /// The last picture in 8 bits. `range`: nearest and farthest depth of the depth colours.
    pub(crate) fn rgb(&self, channel: Channel, range: [f32; 2]) -> Rgb {
        match channel {
            Channel::Color => color_rgb(&self.image.color),
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
        }
    }

    /// Nearest and farthest of the last picture's expected depths, without the outermost hundredths.
    pub(crate) fn depth_range(&self) -> Option<[f32; 2]> {
        let pairs = self.image.depth.data.iter().zip(&self.image.alpha.data);
        let mut depths: Vec<f32> = pairs.filter(|(_, a)| **a >= 0.5).map(|(d, a)| d / a).collect();
        if depths.is_empty() {
            return None;
        }
        depths.sort_by(f32::total_cmp);
        let n = depths.len();
        Some([depths[n / 100], depths[n - 1 - n / 100]])
    }
}

/// As recipes say it, for the renderer.
pub fn antialias(on: bool) -> Antialias {
    if on { Antialias::On } else { Antialias::Off }
}

/// Near is bright; even steps of disparity look even.
fn depth_color(depth: f32, [near, far]: [f32; 2]) -> [u8; 3] {
    let (n, f) = (1.0 / near.max(1e-6), 1.0 / far.max(near * 1.0001).max(1e-6));
    let share = ((1.0 / depth.max(1e-6) - f) / (n - f)).clamp(0.0, 1.0);
    let place = share * (DEPTH_COLORS.len() - 1) as f32;
    let i = (place as usize).min(DEPTH_COLORS.len() - 2);
    let u = place - i as f32;
    std::array::from_fn(|k| (DEPTH_COLORS[i][k] * (1.0 - u) + DEPTH_COLORS[i + 1][k] * u).round() as u8)
}

/// Clamped and rounded; NaN is black. Half is added and cut off, which is rounding here and vectorises.
fn byte(v: f32) -> u8 {
    (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8
}

/// Colour planes in 8 bits.
pub(crate) fn color_rgb(color: &Planes<f32>) -> Rgb {
    let mut data = Vec::new();
    color_into(color, &mut data);
    Rgb { width: color.width, height: color.height, data }
}

/// Colour planes in 8 bits, red, green and blue of a pixel side by side; `out`'s memory is reused.
pub(crate) fn color_into(color: &Planes<f32>, out: &mut Vec<u8>) {
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
