//! `model.toml`: what a network in an `.onnx` file takes and returns.

use serde::Deserialize;
use splat4d::{Error, Result};
use std::path::{Path, PathBuf};

/// The version of the format that this program reads.
const VERSION: u32 = 1;
/// Longest side of a network's input, pixels: more is a slip, and would take all memory.
const MOST_SIDE: usize = 16_384;
/// Most windows that run together.
const MOST_BATCH: usize = 64;
/// Remedy of mistakes in a description.
pub(super) const REMEDY: &str =
    "Correct the description. `splat4d priors --describe` lists examples, and docs/networks.md every key";

/// What a network takes and returns.
#[derive(Clone, Debug, Deserialize, PartialEq)]
#[serde(deny_unknown_fields)]
pub struct Description {
    /// The format's version, 1.
    version: u32,
    /// Name for people.
    #[serde(default)]
    pub name: String,
    /// Source of the export.
    #[serde(default)]
    pub source: String,
    /// Licence of the weights.
    #[serde(default)]
    pub licence: String,
    /// Remarks for people.
    #[serde(default)]
    pub note: String,
    /// The images that it takes.
    pub input: Input,
    /// What it returns.
    pub output: Output,
}

/// The images that a network takes.
#[derive(Clone, Debug, Deserialize, PartialEq)]
#[serde(deny_unknown_fields)]
pub struct Input {
    /// Names of its inputs; empty: all of them, in their order.
    #[serde(default)]
    pub names: Vec<String>,
    /// Order of the axes.
    #[serde(default)]
    pub layout: InputLayout,
    /// Channels, in their order.
    #[serde(default)]
    pub channels: Channels,
    /// The number that white (255) becomes, before `mean` and `std`.
    #[serde(default = "one")]
    pub range: f32,
    /// Is subtracted, per channel.
    #[serde(default)]
    pub mean: [f32; 3],
    /// Divides, per channel.
    #[serde(default = "ones")]
    pub std: [f32; 3],
    /// Width and height, where they are fixed.
    #[serde(default)]
    pub size: Option<[usize; 2]>,
    /// Pixels of the longer side, where the size is free; an image keeps its own size without it.
    #[serde(default)]
    pub longest: Option<usize>,
    /// Sides are multiples of this.
    #[serde(default = "whole_one")]
    pub multiple: usize,
    /// Splits larger images into windows of `size` that overlap by this many pixels; without it images are resized.
    #[serde(default)]
    pub overlap: Option<usize>,
    /// Grey, 0 to 255, right of and below images that keep their shape within `size`; without it they are stretched.
    #[serde(default)]
    pub pad: Option<u8>,
    /// Windows that run together.
    #[serde(default = "whole_one")]
    pub batch: usize,
    /// How the two images of flow and matches are given.
    #[serde(default)]
    pub pair: Pair,
}

/// What a network returns.
#[derive(Clone, Debug, Deserialize, PartialEq)]
#[serde(deny_unknown_fields)]
pub struct Output {
    /// Its kind.
    pub kind: Kind,
    /// Names of its outputs; empty: the first one (of matches: the first three, or as `form` requires).
    #[serde(default)]
    pub names: Vec<String>,
    /// The number of the output that is used, from 0, where names are empty.
    #[serde(default)]
    pub number: usize,
    /// Axes of the first output, a letter each: n (images), c (channels), h, w; empty: nchw, nhw or hw.
    #[serde(default)]
    pub layout: String,
    /// The channel that is used; of flow the first of two.
    #[serde(default)]
    pub channel: usize,
    /// The channel that is subtracted from it, of masks.
    #[serde(default)]
    pub minus: Option<usize>,
    /// Multiplies values. Of metric depth: scene units per number.
    #[serde(default = "one_wide")]
    pub scale: f64,
    /// Whether depth is metric.
    #[serde(default)]
    pub metric: bool,
    /// Masks: values from here on count; matches and people: scores below do not.
    #[serde(default)]
    pub threshold: f32,
    /// Matches and people: coordinates of the centre of the first pixel.
    #[serde(default)]
    pub pixel_centre: f32,
    /// How matches are given.
    #[serde(default)]
    pub form: Form,
    /// People: of two whose boxes share more than this part of their union, the one with the lower score is left out.
    #[serde(default = "usual_overlap")]
    pub overlap: f32,
}

/// How a network returns matches.
#[derive(Clone, Copy, Debug, Default, Deserialize, Eq, PartialEq)]
#[serde(rename_all = "kebab-case")]
pub enum Form {
    /// Key points of both images [2, points, 2], matches [matches, 3] (pair, number in the first and second image), and
    /// their scores [matches].
    #[default]
    Numbered,
    /// Positions in the first image [matches, 2], those in the second [matches, 2], and scores [matches].
    Pairs,
    /// For each pixel of the first image its position in both, from -1 to 1 over the image [1, h, w, 4] (x, y, x, y), and
    /// its score [1, h, w].
    Warp,
}

/// Axes of an input.
#[derive(Clone, Copy, Debug, Default, Deserialize, Eq, PartialEq)]
#[serde(rename_all = "lowercase")]
pub enum InputLayout {
    /// Images, channels, rows, columns.
    #[default]
    Nchw,
    /// Images, rows, columns, channels.
    Nhwc,
}

/// Channels of an input.
#[derive(Clone, Copy, Debug, Default, Deserialize, Eq, PartialEq)]
#[serde(rename_all = "lowercase")]
pub enum Channels {
    /// Red, green, blue.
    #[default]
    Rgb,
    /// Blue, green, red.
    Bgr,
    /// One: 0.299 red + 0.587 green + 0.114 blue.
    Grey,
}

/// How two images are given.
#[derive(Clone, Copy, Debug, Default, Deserialize, Eq, PartialEq)]
#[serde(rename_all = "lowercase")]
pub enum Pair {
    /// As two inputs.
    #[default]
    Inputs,
    /// As a batch of two.
    Batch,
}

/// Kinds of output.
#[derive(Clone, Copy, Debug, Deserialize, Eq, PartialEq)]
#[serde(rename_all = "kebab-case")]
pub enum Kind {
    /// z along the camera's axis; `metric`: times a known scale.
    Depth,
    /// a / z + b, a and b of each image unknown: disparity.
    InverseDepth,
    /// Pixels of the input, from the first image to the second: right, down.
    Flow,
    /// Foreground, larger where it is.
    Mask,
    /// What two images share; see [`Form`].
    Matches,
    /// Keypoints of the people in an image [people, keypoints, 3] (x, y, confidence), and their boxes and scores [people, 5]
    /// (left, top, right, bottom, score) if a second output is named.
    People,
}

impl Kind {
    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Kind::Depth => "depth",
            Kind::InverseDepth => "inverse-depth",
            Kind::Flow => "flow",
            Kind::Mask => "mask",
            Kind::Matches => "matches",
            Kind::People => "people",
        }
    }

    /// Whether it takes two images.
    pub(super) fn of_pairs(self) -> bool {
        matches!(self, Kind::Flow | Kind::Matches)
    }
}

fn one() -> f32 {
    1.0
}

fn one_wide() -> f64 {
    1.0
}

fn ones() -> [f32; 3] {
    [1.0; 3]
}

fn whole_one() -> usize {
    1
}

/// As RTMO's own program has it.
fn usual_overlap() -> f32 {
    0.45
}

impl Description {
    /// Reads a description. Errors: no TOML; unknown keys; values that contradict each other.
    pub fn parse(text: &str) -> Result<Self> {
        let read: Self = toml::from_str(text).map_err(|e| {
            let what = e.to_string();
            Error::input(format!("invalid model description: {}", what.trim_end())).remedy(REMEDY)
        })?;
        read.check()?;
        Ok(read)
    }

    /// The file that describes a network: its name with `.toml` for `.onnx`, else `model.toml` next to it.
    pub fn file_of(network: &Path) -> PathBuf {
        let own = network.with_extension("toml");
        if own.is_file() { own } else { network.with_file_name("model.toml") }
    }

    fn check(&self) -> Result<()> {
        let bad = |what: String| Err(Error::input(format!("invalid model description: {what}")).remedy(REMEDY));
        let (input, output) = (&self.input, &self.output);
        if self.version != VERSION {
            return bad(format!("expected version = {VERSION}, found {}", self.version));
        }
        let numbers =
            input.mean.iter().chain(&input.std).chain([&input.range, &output.threshold, &output.pixel_centre]);
        if numbers.into_iter().any(|v| !v.is_finite()) || !output.scale.is_finite() {
            return bad("a number is not finite".into());
        }
        if input.std.contains(&0.0) || input.range == 0.0 {
            return bad("expected numbers other than 0 for input.std and input.range".into());
        }
        if output.scale <= 0.0 {
            return bad(format!("expected a positive output.scale, found {}", output.scale));
        }
        let sides = input.size.iter().flatten().chain(&input.longest).chain([&input.multiple]);
        if let Some(side) = sides.into_iter().find(|s| !(1..=MOST_SIDE).contains(*s)) {
            return bad(format!("expected sizes from 1 to {MOST_SIDE} pixels, found {side}"));
        }
        if input.size.is_some() && input.longest.is_some() {
            return bad("expected one of input.size (fixed) and input.longest (free), found both".into());
        }
        if let Some(size) = input.size.filter(|s| s.iter().any(|side| !side.is_multiple_of(input.multiple))) {
            return bad(format!("input.size {}x{} is not a multiple of {}", size[0], size[1], input.multiple));
        }
        if !(1..=MOST_BATCH).contains(&input.batch) {
            return bad(format!("expected input.batch from 1 to {MOST_BATCH}, found {}", input.batch));
        }
        match (input.overlap, input.size) {
            (Some(_), None) => return bad("input.overlap needs input.size, the size of a window".into()),
            (Some(overlap), Some(size)) if 2 * overlap > size[0].min(size[1]) => {
                return bad(format!("input.overlap of {overlap} pixels is more than half of a window"));
            }
            (Some(_), _) if matches!(output.kind, Kind::Matches | Kind::People) => {
                return bad(format!("input.overlap is not supported for {}: remove it", output.kind.name()));
            }
            _ => {}
        }
        if input.pair == Pair::Batch && !output.kind.of_pairs() {
            return bad(format!("input.pair is for flow and matches, not for {}", output.kind.name()));
        }
        if input.pad.is_some() && (!matches!(output.kind, Kind::Matches | Kind::People) || input.overlap.is_some()) {
            return bad("input.pad is for matches and people, without input.overlap".into());
        }
        if output.form != Form::Numbered && output.kind != Kind::Matches {
            return bad(format!("output.form is for matches, not for {}", output.kind.name()));
        }
        if !(0.0..=1.0).contains(&output.overlap) {
            return bad(format!("expected output.overlap from 0 to 1, found {}", output.overlap));
        }
        if output.minus.is_some() && output.kind != Kind::Mask {
            return bad(format!("output.minus is for masks, not for {}", output.kind.name()));
        }
        if output.metric && output.kind != Kind::Depth {
            return bad(format!("output.metric is for depth, not for {}", output.kind.name()));
        }
        let letters: Vec<char> = output.layout.chars().collect();
        let unique = (1..letters.len()).all(|i| !letters[..i].contains(&letters[i]));
        let known = letters.iter().all(|c| "nchw".contains(*c));
        let whole = unique && known && letters.contains(&'h') && letters.contains(&'w');
        if !letters.is_empty() && !whole {
            return bad(format!(
                "expected output.layout of the letters n, c, h and w, such as \"nchw\" or \"hw\", found \"{:.30}\"",
                output.layout
            ));
        }
        Ok(())
    }

    /// Channels of the input.
    pub(super) fn depth(&self) -> usize {
        if self.input.channels == Channels::Grey { 1 } else { 3 }
    }
}
