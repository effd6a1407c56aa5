//! Networks that users bring as `.onnx` files, each with a description (`model.toml`) of what it takes and returns.
//!
//! The program never downloads weights. A network runs on the CPU (`network.rs`); images are given to it in its own size,
//! or in windows that overlap; matches and people are positions in whole images (`points.rs`). Descriptions of published exports are part of the program.

mod describe;
mod network;
mod pixels;
mod points;
mod published;
#[cfg(all(test, feature = "models"))]
pub(crate) mod tests;
mod tiles;

pub use describe::{Description, Form, Kind};
pub use pixels::Map;
pub use points::{Matches, Person};
pub use published::{PUBLISHED, published};

use crate::files;
use describe::{Pair, REMEDY};
use network::{Network, Tensor};
use splat4d::{Error, Result};
use splat4d_train::capture::Rgb8;
use std::path::{Path, PathBuf};

/// Largest network file, bytes.
const MOST_BYTES: u64 = 4 << 30;

/// A network with its description.
pub struct Model {
    path: PathBuf,
    description: Description,
    network: Network,
    /// Width and height of its input, where they are fixed.
    size: Option<[usize; 2]>,
    identity: String,
}

impl Model {
    /// Loads a network and the description next to it; `described`: the name of a description that the program has instead.
    ///
    /// Errors: files that are missing, damaged or contradict each other; operators that the runtime lacks.
    pub fn load(path: &Path, described: Option<&str>) -> Result<Self> {
        let length = std::fs::metadata(path).map_err(|e| files::cannot_read(path, e))?.len();
        if length > MOST_BYTES {
            let what =
                format!("the network has {}, more than {}", files::human_bytes(length), files::human_bytes(MOST_BYTES));
            return Err(Error::input(what).at(path.display()).remedy("Use a smaller network"));
        }
        let (text, place) = match described {
            Some(name) => (published(name)?.to_owned(), PathBuf::from(name)),
            None => {
                let file = Description::file_of(path);
                if !file.is_file() {
                    return Err(Error::input(format!("expected a description of {} there", path.display()))
                        .at(file.display())
                        .remedy("Write it: `splat4d priors --describe` lists ready-made ones"));
                }
                (files::read_text(&file)?, file)
            }
        };
        let description = Description::parse(&text).map_err(|e| e.at(place.display()))?;
        let count = match description.output.kind {
            Kind::Matches if description.output.form == Form::Warp => 2,
            Kind::Matches => 3,
            Kind::People => description.output.names.len().clamp(1, 2),
            _ if description.output.names.is_empty() => description.output.number + 1,
            _ => 1,
        };
        let network = Network::load(path, &description.input.names, &description.output.names, count)?;
        let size = declared_size(&description, &network).map_err(|e| e.at(place.display()))?;
        if size.is_none() && description.input.overlap.is_some() {
            return Err(Error::input("input.overlap needs input.size").at(place.display()).remedy(REMEDY));
        }
        let identity = files::fingerprint(format!("{} {text}", files::fingerprint(files::read(path)?)));
        Ok(Self { path: path.to_owned(), description, network, size, identity })
    }

    /// Its description.
    pub fn description(&self) -> &Description {
        &self.description
    }

    /// Its file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Distinguishes it, with its description, from others.
    pub fn identity(&self) -> &str {
        &self.identity
    }

    /// What to report of it before it runs.
    pub fn warning(&self) -> Option<String> {
        self.network.cubic.then(|| {
            format!(
                "{}: the network interpolates cubically somewhere, which is computed linearly here: results differ slightly from \
                 other programs. An export for one fixed input size avoids most of it",
                self.path.display()
            )
        })
    }

    /// Its map of an image, or of two: depth and masks have one channel, flow two. In the network's own resolution, or in that
    /// of the image where it runs in windows. Flow is in pixels of the images.
    ///
    /// Errors: images of different sizes; outputs of another shape than described.
    pub fn map(&self, images: &[&Rgb8]) -> Result<Map> {
        let expected = 1 + usize::from(self.description.output.kind.of_pairs());
        assert!(images.len() == expected, "{} images for {}", images.len(), self.description.output.kind.name());
        let (width, height) = (images[0].width, images[0].height);
        if images.iter().any(|i| (i.width, i.height) != (width, height)) {
            return Err(Error::input("two images of a camera have different sizes").remedy("Resize them alike"));
        }
        let whole = || self.whole(images, self.input_size([width, height]));
        match (self.description.input.overlap, self.size) {
            (Some(overlap), Some(size)) if width > size[0] || height > size[1] => {
                let relative = match self.description.output.kind {
                    Kind::InverseDepth => true,
                    Kind::Depth => !self.description.output.metric,
                    _ => false,
                };
                let guide = if relative { Some(whole()?.resized(width, height)) } else { None };
                self.windows(images, size, overlap, guide.as_ref())
            }
            (Some(_), Some(size)) => {
                // In its corner: what is outside of it is left out.
                let mut map = Map { channels: 0, height, width, values: Vec::new() };
                let window = self.run(&[images.iter().map(|i| (*i, [0, 0])).collect()], size)?.remove(0);
                map.channels = window.channels;
                let window = window.resized(size[0], size[1]);
                for c in 0..window.channels {
                    let rows = window.plane(c).chunks_exact(size[0]).take(height);
                    map.values.extend(rows.flat_map(|row| &row[..width]));
                }
                Ok(map)
            }
            _ => whole(),
        }
    }

    /// Width and height of the input for an image.
    fn input_size(&self, [width, height]: [usize; 2]) -> [usize; 2] {
        let (input, multiple) = (&self.description.input, self.description.input.multiple);
        let factor = input.longest.map_or(1.0, |l| l as f64 / width.max(height) as f64);
        self.size.unwrap_or_else(|| {
            [width, height].map(|side| {
                let side = side as f64 * factor / multiple as f64;
                (side.round() as usize).max(1) * multiple
            })
        })
    }

    /// The map of whole images, resized to the network's input.
    fn whole(&self, images: &[&Rgb8], size: [usize; 2]) -> Result<Map> {
        let scaled: Vec<_> = images.iter().map(|image| pixels::scaled(image, size)).collect();
        let mut map = self.run(&[scaled.iter().map(|i| (&**i, [0, 0])).collect()], size)?.remove(0);
        if self.description.output.kind == Kind::Flow {
            let factors = [images[0].width as f32 / size[0] as f32, images[0].height as f32 / size[1] as f32];
            let pixels = map.width * map.height;
            map.values
                .chunks_exact_mut(pixels)
                .zip(factors)
                .for_each(|(plane, f)| plane.iter_mut().for_each(|v| *v *= f));
        }
        Ok(map)
    }

    /// The map of images in windows. `guide`: values of the whole image, to whose scale and shift each window is fitted.
    fn windows(&self, images: &[&Rgb8], size: [usize; 2], overlap: usize, guide: Option<&Map>) -> Result<Map> {
        let (width, height) = (images[0].width, images[0].height);
        let columns = tiles::starts(width, size[0], overlap);
        let places: Vec<[usize; 2]> = tiles::starts(height, size[1], overlap)
            .into_iter()
            .flat_map(|y| columns.iter().map(move |&x| [x, y]))
            .collect();
        let mut joined: Option<tiles::Joined> = None;
        for places in places.chunks(self.description.input.batch) {
            let batch: Vec<Vec<(&Rgb8, [usize; 2])>> =
                places.iter().map(|at| images.iter().map(|i| (*i, *at)).collect()).collect();
            for (map, at) in self.run(&batch, size)?.into_iter().zip(places) {
                let mut map = map.resized(size[0], size[1]);
                if let Some(guide) = guide {
                    fit(&mut map, guide, *at);
                }
                let channels = map.channels;
                let joined = joined.get_or_insert_with(|| tiles::Joined::new(channels, height, width));
                joined.add(&map.values, *at, size, overlap);
            }
        }
        let joined = joined.expect("there is a window");
        Ok(Map { channels: joined.values.len() / (width * height), height, width, values: joined.values })
    }

    /// Input tensors of a batch of windows, each of one image or two.
    fn inputs(&self, batch: &[Vec<(&Rgb8, [usize; 2])>], size: [usize; 2]) -> Result<Vec<Tensor>> {
        let images = batch[0].len();
        let own = |k: usize| batch.iter().map(|window| window[k]).collect::<Vec<_>>();
        let inputs: Vec<Tensor> = match self.description.input.pair {
            Pair::Batch if images == 2 => {
                vec![pixels::tensor(&batch.iter().flatten().copied().collect::<Vec<_>>(), size, &self.description)]
            }
            _ => (0..images).map(|k| pixels::tensor(&own(k), size, &self.description)).collect(),
        };
        let declared = self.network.inputs().count();
        if declared != inputs.len() {
            return Err(self.unlike(&format!("{} inputs", inputs.len()), &declared.to_string()));
        }
        Ok(inputs)
    }

    /// The maps of a batch of windows, in the network's resolution.
    fn run(&self, batch: &[Vec<(&Rgb8, [usize; 2])>], size: [usize; 2]) -> Result<Vec<Map>> {
        let mut outputs = self.network.run(self.inputs(batch, size)?)?;
        let output = outputs.pop().expect("as many as were requested");
        self.decode(output, batch.len())
    }

    /// Maps from an output.
    fn decode(&self, output: Tensor, images: usize) -> Result<Vec<Map>> {
        let described = &self.description.output;
        let layout = match (described.layout.as_str(), output.shape.len()) {
            ("", 2) => "hw",
            ("", 3) if described.kind == Kind::Flow => "chw",
            ("", 3) => "nhw",
            ("", _) => "nchw",
            (stated, _) => stated,
        };
        let found = format!("{:?}", output.shape);
        if layout.len() != output.shape.len() {
            return Err(self.unlike(&format!("an output with the axes \"{layout}\""), &found));
        }
        let (mut size, mut step) = ([1; 4], [0; 4]);
        let mut stride = 1;
        for (k, letter) in layout.char_indices().rev() {
            let length = output.shape[k];
            let axis = "nchw".find(letter).expect("checked when it was read");
            (size[axis], step[axis]) = (length, stride);
            stride *= length;
        }
        let [n, channels, height, width] = size;
        if n != images {
            return Err(self.unlike(&format!("an output of {images} images"), &found));
        }
        let used: Vec<usize> = match described.kind {
            Kind::Flow => vec![described.channel, described.channel + 1],
            _ => vec![described.channel],
        };
        let last = used.iter().chain(&described.minus).max().expect("there is one");
        if *last >= channels || width * height == 0 {
            return Err(self.unlike(&format!("an output with {} channels", last + 1), &found));
        }
        let scale = described.scale as f32;
        let map = |i: usize| {
            let mut values = Vec::with_capacity(used.len() * width * height);
            for c in &used {
                for (y, x) in (0..height).flat_map(|y| (0..width).map(move |x| (y, x))) {
                    let at = |c: usize| output.data[i * step[0] + c * step[1] + y * step[2] + x * step[3]];
                    values.push(scale * (at(*c) - described.minus.map_or(0.0, at)));
                }
            }
            Map { channels: used.len(), height, width, values }
        };
        Ok((0..images).map(map).collect())
    }

    /// The error of a network that is not as described.
    fn unlike(&self, expected: &str, found: &str) -> Error {
        Error::input(format!("the network is not as described: expected {expected}, found {found}"))
            .at(self.path.display())
            .remedy(REMEDY)
    }
}

/// Width and height of the input: stated, or declared by the network. Errors: both, and they differ.
fn declared_size(description: &Description, network: &Network) -> Result<Option<[usize; 2]>> {
    let input = &description.input;
    let Some(first) = network.inputs().next() else {
        return Err(Error::input("the network has no inputs").remedy("Use another export"));
    };
    if first.shape.is_empty() {
        return Ok(input.size);
    }
    let bad = |expected: String| {
        let axes = first.shape.iter().map(|n| n.map_or("?".into(), |n| n.to_string())).collect::<Vec<_>>().join("x");
        Err(Error::input(format!(
            "the network is not as described: expected {expected}, its input \"{}\" is {axes}",
            first.name
        ))
        .remedy(REMEDY))
    };
    let [n, a, b, c] = first.shape[..] else { return bad("an input with four axes".into()) };
    let (channels, height, width) = if input.layout == describe::InputLayout::Nchw { (a, b, c) } else { (c, a, b) };
    let pair = if input.pair == Pair::Batch { 2 } else { 1 };
    if n.is_some_and(|n| n != input.batch * pair) {
        return bad(format!("batches of {}", input.batch * pair));
    }
    if channels.is_some_and(|c| c != description.depth()) {
        return bad(format!("{} channels (input.channels, input.layout)", description.depth()));
    }
    match (input.size, width, height) {
        (None, Some(width), Some(height)) => Ok(Some([width, height])),
        (Some([w, h]), ..) if width.is_some_and(|n| n != w) || height.is_some_and(|n| n != h) => {
            bad(format!("{w}x{h} pixels (input.size)"))
        }
        (stated, ..) => Ok(stated),
    }
}

/// Brings a window to the scale and shift of the whole image there (least squares).
fn fit(window: &mut Map, guide: &Map, [x0, y0]: [usize; 2]) {
    let (mut sums, mut n) = ([0.0f64; 4], 0.0);
    for y in 0..window.height.min(guide.height - y0) {
        for x in 0..window.width.min(guide.width - x0) {
            let own = f64::from(window.values[y * window.width + x]);
            let other = f64::from(guide.values[(y0 + y) * guide.width + x0 + x]);
            if own.is_finite() && other.is_finite() {
                [own, other, own * own, own * other].iter().zip(&mut sums).for_each(|(v, sum)| *sum += v);
                n += 1.0;
            }
        }
    }
    let [own, other, square, both] = sums;
    let spread = n * square - own * own;
    // A window without contrast has no scale of its own; one that contradicts the whole image is not turned over.
    let scale = if spread > 1e-9 * square * n { ((n * both - own * other) / spread).max(0.0) } else { 0.0 };
    let shift = if n > 0.0 { (other - scale * own) / n } else { 0.0 };
    window.values.iter_mut().for_each(|v| *v = (scale * f64::from(*v) + shift) as f32);
}
