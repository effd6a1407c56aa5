//! Photographic renders: shutter, lens, whole spheres, two eyes, and files for compositing.

use super::RenderOptions;
use crate::draw::{Channel, Course, Exposure, Layers, Light, Painter, Panorama, Rgb, Transfer};
use crate::paths::Shot;
use crate::raw_values::open_exr_layers;
use crate::sequence::Pattern;
use splat4d::layers::Scene;
use splat4d::math::Se3;
use splat4d::math::se3::{dot, norm};
use splat4d::scene::{Camera, Planes};
use splat4d::{Error, Result};
use std::cell::Cell;
use std::path::{Path, PathBuf};

#[cfg(test)]
mod tests;

/// Samples of an image by default: with a shutter alone, and with a lens.
const SAMPLES: [usize; 2] = [8, 16];
/// Most samples of an image.
pub const MAX_SAMPLES: usize = 4096;
/// Degrees of a shutter that is open for a whole frame.
const FULL_SHUTTER: f64 = 360.0;
/// Pixels across a sphere by default.
const AROUND: usize = 2048;
/// Cosine of the angle between a viewing direction and `up` at which no horizon is defined.
const VERTICAL: f64 = 0.999;

/// What is sharp.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Focus {
    /// At this distance, scene units (z in camera axes).
    Distance(f64),
    /// What this pixel of each image shows.
    Pixel([f64; 2]),
}

/// How directions become pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum Projection {
    /// A pinhole or lens, as the camera's
    #[default]
    Perspective,
    /// The whole sphere: longitude across, latitude down; twice as wide as high
    Equirectangular,
}

impl Projection {
    /// All of them.
    pub const ALL: [Self; 2] = [Self::Perspective, Self::Equirectangular];

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Perspective => "perspective",
            Self::Equirectangular => "equirectangular",
        }
    }

    /// Its meaning.
    pub fn about(self) -> &'static str {
        match self {
            Self::Perspective => "As the camera's",
            Self::Equirectangular => {
                "The whole sphere, twice as wide as high; the camera's direction is in the middle, and the scene's horizon \
                 is level"
            }
        }
    }
}

/// Where the images of two eyes are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stereo {
    /// The left eye's image left of the right eye's
    SideBySide,
    /// The left eye's image above the right eye's
    OverUnder,
}

impl Stereo {
    /// All of them.
    pub const ALL: [Self; 2] = [Self::SideBySide, Self::OverUnder];

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::SideBySide => "side-by-side",
            Self::OverUnder => "over-under",
        }
    }

    /// Its meaning.
    pub fn about(self) -> &'static str {
        match self {
            Self::SideBySide => "The left eye's image left of the right eye's",
            Self::OverUnder => "The left eye's image above the right eye's",
        }
    }
}

/// Photographic options of [`film`](super::film) and [`image`](super::image()).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Photo {
    /// Shutter angle, degrees above 0 to 360: motion blur.
    pub shutter: Option<f64>,
    /// Diameter of the lens, scene units: depth of field.
    pub aperture: Option<f64>,
    /// What is sharp. `None`: what the middle of the image shows.
    pub focus: Option<Focus>,
    /// Images of which the mean is taken. `None`: 8, or 16 with a lens.
    pub samples: Option<usize>,
    /// How directions become pixels.
    pub projection: Projection,
    /// Two eyes.
    pub stereo: Option<Stereo>,
    /// Distance of the eyes, scene units.
    pub eye_distance: Option<f64>,
    /// Images without a background.
    pub transparent: bool,
    /// Colours of .exr files. `None`: linear.
    pub transfer: Option<Transfer>,
}

/// What is written of a frame.
pub(super) enum Written {
    /// An image for a film.
    Rgb(Rgb),
    /// The bytes of a file.
    File(Vec<u8>),
}

impl Photo {
    /// Errors: numbers out of range, options that exclude each other or the output.
    pub(super) fn check(&self, args: &RenderOptions) -> Result<()> {
        let output = args.output.as_deref();
        let exr = output.is_some_and(is_exr);
        let number = |value: Option<f64>, name: &str, range: std::ops::RangeInclusive<f64>, remedy: &str| match value {
            Some(v) if !range.contains(&v) => Err(Error::input(format!("invalid option `{name}`: {v}")).remedy(remedy)),
            _ => Ok(()),
        };
        let positive = f64::MIN_POSITIVE..=1e12;
        let degrees = f64::MIN_POSITIVE..=FULL_SHUTTER;
        number(
            self.shutter,
            "shutter",
            degrees,
            "Give degrees above 0 up to 360; 180 is usual. Leave it out for sharp frames.",
        )?;
        number(self.aperture, "aperture", positive.clone(), "Give the diameter of the lens in scene units, above 0.")?;
        number(
            self.eye_distance,
            "eye_distance",
            positive.clone(),
            "Give the distance of the eyes in scene units, above 0.",
        )?;
        if let Some(Focus::Distance(z)) = self.focus {
            number(
                Some(z),
                "focus",
                positive,
                "Give a distance in front of the camera, or a pixel of the image: X,Y.",
            )?;
        }
        let refuse = |what: &str, remedy: &str| Err(Error::input(what).remedy(remedy));
        if self.samples.is_some_and(|n| !(1..=MAX_SAMPLES).contains(&n)) {
            return refuse(&format!("invalid option `samples`: {}", self.samples.unwrap_or(0)), "Give 1 to 4096.");
        }
        if self.samples.is_some() && !self.is_exposed() {
            return refuse("option `samples` needs a shutter or a lens", "Add option `shutter` or option `aperture`.");
        }
        if self.focus.is_some() && self.aperture.is_none() {
            return refuse("a pinhole has no focus", "Add option `aperture`, the diameter of the lens in scene units.");
        }
        let around = self.projection == Projection::Equirectangular;
        if around && self.aperture.is_some() {
            return refuse(
                "depth of field of a whole sphere is not supported",
                "Leave out option `aperture`, or the projection.",
            );
        }
        if around && self.stereo.is_some() {
            return refuse(
                "stereo of a whole sphere is not supported: two eyes need a centre of their own in every direction",
                "Leave out option `stereo`, or render perspective images.",
            );
        }
        if self.stereo.is_some() != self.eye_distance.is_some() {
            return refuse(
                "option `stereo` and option `eye_distance` need each other",
                "Give both; 0.065 where a scene unit is one metre.",
            );
        }
        if let Some([w, h]) = args.size.filter(|[w, h]| around && *w != 2 * h) {
            return refuse(
                &format!("invalid option `size`: a whole sphere is twice as wide as high, {w}x{h} is not"),
                &format!("Use {}x{h}.", 2 * h),
            );
        }
        let color = args.channel == Channel::Color;
        if around && !matches!(args.channel, Channel::Color | Channel::Alpha | Channel::Depth) {
            return refuse(
                &format!("the channel {} of a whole sphere is not supported", args.channel.name()),
                "Use color, alpha or depth. An .exr of colour also holds motion and labels.",
            );
        }
        if self.is_exposed() && !color {
            return refuse(
                &format!("the channel {} has no shutter or lens", args.channel.name()),
                "Render it without them, or write colour as .exr: its depth, motion and labels are sharp.",
            );
        }
        if self.transparent && !(color && output.is_none_or(writes_png)) {
            return refuse(
                "only colour in .png files has transparency",
                "Use option `output` NAME.png, NAME.%04d.png or a folder; .exr always has alpha.",
            );
        }
        if (self.transparent || exr && color) && args.background.is_some() {
            return refuse("images with alpha have no background", "Leave out option `background`.");
        }
        if self.transfer.is_some() && !(exr && color) {
            return refuse("option `transfer` is for colour in .exr files", "Other files hold sRGB values.");
        }
        if args.raw.is_some() && *self != Self::default() {
            return refuse(
                "raw values are those of sharp perspective images",
                "Leave out option `raw`; option `output` NAME.exr holds colour, depth, motion and labels.",
            );
        }
        Ok(())
    }

    /// Errors: images of this scene need a background, but the output has none; a film cannot hold transparency.
    pub(super) fn check_output(&self, output: &Path, args: &RenderOptions, scene: &Scene<f32>) -> Result<()> {
        if self.transparent && !writes_png(output) {
            return Err(Error::input("only .png files have transparency")
                .at(output.display())
                .remedy("Use option `output` NAME.%04d.png or a folder."));
        }
        if self.transparent || is_exr(output) && args.channel == Channel::Color {
            // A network makes its colours of what is blended over the background.
            scene.without_head("images without a background")?;
        }
        Ok(())
    }

    /// Whether images are a mean of several.
    fn is_exposed(&self) -> bool {
        self.shutter.is_some() || self.aperture.is_some()
    }

    /// The sphere's raster; none: perspective.
    pub(super) fn panorama(&self, size: [usize; 2]) -> Option<Panorama> {
        (self.projection == Projection::Equirectangular).then(|| Panorama::new(size[0]))
    }

    /// The size of cameras: the given one, or the default of a sphere.
    pub(super) fn size(&self, asked: Option<[usize; 2]>) -> Option<[usize; 2]> {
        let around = self.projection == Projection::Equirectangular;
        asked.or(around.then_some([AROUND, AROUND / 2]))
    }

    /// The size of a written image.
    pub(super) fn written_size(&self, [w, h]: [usize; 2]) -> [usize; 2] {
        match self.stereo {
            None => [w, h],
            Some(Stereo::SideBySide) => [2 * w, h],
            Some(Stereo::OverUnder) => [w, 2 * h],
        }
    }

    fn exposure(&self, focus: f64) -> Exposure {
        let lens = self.aperture.unwrap_or(0.0);
        let samples = match (self.samples, lens > 0.0) {
            _ if !self.is_exposed() => 1,
            (Some(n), _) => n,
            (None, lens) => SAMPLES[usize::from(lens)],
        };
        let shutter = self.shutter.unwrap_or(0.0) / FULL_SHUTTER;
        Exposure { shutter, aperture: lens, focus, samples }
    }
}

/// Shots and what they are exposed with.
pub(super) struct Studio<'s> {
    pub photo: &'s Photo,
    pub channel: Channel,
    pub shots: &'s [Shot],
    /// Whether shots are views of their own, and not frames of one camera's film.
    pub views: bool,
    /// First and last second of the scene.
    pub clip: [f64; 2],
    /// Seconds of the scene from one frame to the next, for views.
    pub frame: f64,
    /// Range of the channel's colours.
    pub range: [f32; 2],
    pub exr: bool,
    /// Distance of what was sharp last: it stays where a frame shows nothing there.
    pub focus: Cell<Option<f64>>,
}

impl Studio<'_> {
    /// Camera and time at a share of a frame from the middle of shot i.
    fn at(&self, i: usize, share: f64) -> Shot {
        let shot = &self.shots[i];
        let mut out = if self.views || self.shots.len() == 1 {
            Shot { time: shot.time + share * self.frame, ..shot.clone() }
        } else {
            // Between this frame and the one before or after; at the film's ends its first and last motion continue.
            let from = if share < 0.0 && i > 0 || i + 1 == self.shots.len() { i - 1 } else { i };
            self.shots[from].towards(&self.shots[from + 1], share + (i - from) as f64)
        };
        let [first, last] = self.clip;
        if (first..=last).contains(&shot.time) {
            out.time = out.time.clamp(first, last);
        }
        out
    }

    /// Renders what is written of shot i.
    ///
    /// Errors: what is sharp is nearer than the camera's near plane, or is not found.
    pub(super) fn write(&self, painter: &mut Painter<'_>, i: usize) -> Result<Written> {
        let photo = self.photo;
        let shot = &self.shots[i];
        let eyes = self.eyes();
        if !(photo.is_exposed() || photo.transparent || self.exr) {
            let images =
                eyes.iter().map(|&x| painter.picture(&eye(&shot.camera, x), shot.time, self.channel, self.range));
            return Ok(Written::Rgb(joined_rgb(images.collect(), photo.stereo)));
        }
        let exposure = photo.exposure(self.focus(painter, shot)?);
        let (mut lights, mut layers) = (Vec::new(), Vec::new());
        for &x in &eyes {
            let course = |share: f64| {
                let shot = self.at(i, share);
                Shot { camera: eye(&shot.camera, x), ..shot }
            };
            lights.push(painter.expose(&course as Course<'_>, &exposure, photo.transparent || self.exr));
            if self.exr {
                layers.push(painter.layers(&course(0.0), &course(1.0)));
            }
        }
        let join = |planes: Vec<&Planes<f32>>| joined(&planes, photo.stereo);
        let light = Light {
            color: join(lights.iter().map(|l| &l.color).collect()),
            alpha: join(lights.iter().map(|l| &l.alpha).collect()),
        };
        if self.exr {
            let layers = Layers {
                depth: join(layers.iter().map(|l| &l.depth).collect()),
                motion: join(layers.iter().map(|l| &l.motion).collect()),
                label: join(layers.iter().map(|l| &l.label).collect()),
            };
            return exr(&light, &layers, photo.transfer.unwrap_or(Transfer::Linear), painter.labels())
                .map(Written::File);
        }
        Ok(if photo.transparent { Written::File(light.png()) } else { Written::Rgb(light.rgb()) })
    }

    /// Distance of what is sharp. Without a lens it means nothing.
    fn focus(&self, painter: &mut Painter<'_>, shot: &Shot) -> Result<f64> {
        let camera = &shot.camera;
        let (z, from) = match self.photo.focus {
            _ if self.photo.aperture.is_none() => return Ok(1.0),
            Some(Focus::Distance(z)) => (z, "option `focus`".to_owned()),
            at => {
                let pixel = match at {
                    Some(Focus::Pixel(pixel)) => pixel,
                    _ => [camera.width, camera.height].map(|n| 0.5 * n as f64),
                };
                let [x, y] = pixel;
                if !(0.0..camera.width as f64).contains(&x) || !(0.0..camera.height as f64).contains(&y) {
                    return Err(Error::input(format!(
                        "invalid option `focus`: the pixel {x},{y} is outside of the image"
                    ))
                    .remedy(format!("Images have {}x{} pixels.", camera.width, camera.height)));
                }
                let z = painter.distance_at(shot, pixel).or(self.focus.get()).ok_or_else(|| {
                    Error::input(format!("nothing is to be seen at pixel {x},{y} at {} s", shot.time))
                        .remedy("Give option `focus` as a distance in scene units, or as another pixel X,Y.")
                })?;
                (z, format!("what pixel {x},{y} shows"))
            }
        };
        if z <= camera.near {
            return Err(Error::input(format!(
                "{from} is {z} away, nearer than the camera's near plane at {}",
                camera.near
            ))
            .remedy("Give a larger distance."));
        }
        self.focus.set(Some(z));
        Ok(z)
    }

    /// Where the eyes are, scene units to the right of the camera.
    fn eyes(&self) -> Vec<f64> {
        match (self.photo.stereo, self.photo.eye_distance) {
            (Some(_), Some(distance)) => vec![-0.5 * distance, 0.5 * distance],
            _ => vec![0.0],
        }
    }
}

/// The camera moved to the right: axes stay parallel.
fn eye(camera: &Camera, right: f64) -> Camera {
    let mut out = camera.clone();
    out.cam_from_world.translation[0] -= right;
    out
}

/// The camera with the scene's horizon level, as spheres are watched; as it is where it looks up or down.
pub(super) fn level(camera: &Camera, up: [f64; 3]) -> Camera {
    let (forward, length) = (camera.forward(), norm(up));
    let along = dot(forward, up) / length.max(f64::MIN_POSITIVE);
    if length == 0.0 || along.abs() > VERTICAL {
        return camera.clone();
    }
    let eye = camera.center();
    let target = std::array::from_fn(|k| eye[k] + forward[k] - along * up[k] / length);
    Camera { cam_from_world: Se3::look_at(eye, target, up), ..camera.clone() }
}

/// Whether a file is OpenEXR by its name.
pub(super) fn is_exr(path: &Path) -> bool {
    path.extension().is_some_and(|e| e.eq_ignore_ascii_case("exr"))
}

/// Whether an output is made of .png files: by its ending, or because it is a folder.
fn writes_png(path: &Path) -> bool {
    path.extension().is_none_or(|e| e.eq_ignore_ascii_case("png"))
}

/// The files of numbered or single images; `None`: the output is a film or a folder.
///
/// Errors: several frames for one file.
pub(super) fn files_of(output: &Path, transparent: bool, count: usize) -> Result<Option<Vec<PathBuf>>> {
    if let Some(pattern) = Pattern::of(output) {
        return Ok(Some((0..count).map(|i| pattern.file(i)).collect()));
    }
    if !(is_exr(output) || transparent && output.extension().is_some()) {
        return Ok(None);
    }
    if count > 1 {
        let (stem, ending) = (output.with_extension(""), output.extension().unwrap_or_default().to_string_lossy());
        return Err(Error::input(format!("{count} frames do not fit one .{ending}"))
            .at(output.display())
            .remedy(format!("Use option `output` {}.%04d.{ending} for numbered files.", stem.display())));
    }
    Ok(Some(vec![output.to_owned()]))
}

/// An OpenEXR file of an image.
fn exr(light: &Light, layers: &Layers, transfer: Transfer, labels: &[String]) -> Result<Vec<u8>> {
    let color = match transfer {
        Transfer::Linear => light.color.clone(),
        Transfer::Srgb => light.premultiplied(),
    };
    let up: Vec<f32> = layers.motion.plane(1).iter().map(|v| -v).collect();
    let mut planes: Vec<(String, &[f32])> = Vec::new();
    ["R", "G", "B"].iter().enumerate().for_each(|(c, name)| planes.push(((*name).into(), color.plane(c))));
    planes.push(("A".into(), light.alpha.plane(0)));
    planes.push(("Z".into(), layers.depth.plane(0)));
    planes.push(("forward.u".into(), layers.motion.plane(0)));
    planes.push(("forward.v".into(), &up));
    let mut comments = format!("Colours are times alpha. {}", transfer.about());
    if layers.label.channels > 0 {
        planes.push(("label".into(), layers.label.plane(0)));
        let names: Vec<String> = labels.iter().enumerate().map(|(i, name)| format!("{i} {name}")).collect();
        comments = format!("{comments}. Labels: {}", names.join(", "));
    }
    open_exr_layers(&planes, [color.width, color.height], &comments)
}

/// Images of one or two eyes as one.
fn joined(images: &[&Planes<f32>], stereo: Option<Stereo>) -> Planes<f32> {
    let (&[left, right], Some(stereo)) = (images, stereo) else { return images[0].clone() };
    let mut out = Planes { data: Vec::new(), ..*left };
    for c in 0..left.channels {
        match stereo {
            Stereo::OverUnder => [left, right].iter().for_each(|p| out.data.extend_from_slice(p.plane(c))),
            Stereo::SideBySide => {
                let rows = left.plane(c).chunks(left.width).zip(right.plane(c).chunks(right.width));
                rows.for_each(|(l, r)| out.data.extend(l.iter().chain(r)));
            }
        }
    }
    match stereo {
        Stereo::OverUnder => out.height *= 2,
        Stereo::SideBySide => out.width *= 2,
    }
    out
}

/// The same of images in 8 bits.
fn joined_rgb(mut images: Vec<Rgb>, stereo: Option<Stereo>) -> Rgb {
    let right = images.pop().expect("there is an eye");
    let (Some(left), Some(stereo)) = (images.pop(), stereo) else { return right };
    match stereo {
        Stereo::OverUnder => Rgb { width: left.width, height: 2 * left.height, data: [left.data, right.data].concat() },
        Stereo::SideBySide => {
            let rows = left.data.chunks(3 * left.width).zip(right.data.chunks(3 * right.width));
            let data = rows.flat_map(|(l, r)| [l, r].concat()).collect();
            Rgb { width: 2 * left.width, height: left.height, data }
        }
    }
}
