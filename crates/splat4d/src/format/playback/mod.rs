//! The playback file `.s4d`: a dynamic scene, small, readable in parts, checked. docs/format.md is its specification.
//!
//! [`write()`] takes a [`Draft`] (floats, sorted into time spans by the baker), orders, quantises and packs it.
//! [`Index::parse`] reads the start of a file, `decode_page` and `decode_palette` any section alone, and [`read()`] a
//! whole file as a scene of one layer per page.

mod block;
pub(in crate::format) mod cluster;
mod coder;
mod deflate;
mod depths;
mod features;
mod grow;
mod index;
mod labels;
mod ladder;
mod layer;
mod mask;
mod meta;
mod order;
mod page;
mod pages;
mod palette;
mod provenance;
mod read;
mod rungs;
mod sound;
mod strict;
#[cfg(test)]
mod tests;
mod write;

pub use coder::Coder;
pub use depths::Depths;
pub use features::feature_ranges;
pub(crate) use features::of_layer as features_of;
pub use grow::{Growing, finish};
pub use index::{Codec, Entry, Index, Kind};
pub(crate) use labels::of_layer as labels_of;
pub(crate) use layer::{as_layers, is_page, primitives};
pub(crate) use mask::decode_masks;
pub use meta::{Meta, NamedCamera, PathKey, Viewpoint};
pub(crate) use page::{Page, decode_page};
pub use pages::{Pages, PagesDraft, read_pages, write_pages};
pub use palette::Palette;
pub(crate) use palette::decode_palette;
#[cfg(test)]
use provenance::with_provenance;
pub use provenance::{Provenance, provenance};
pub use read::read;
pub use rungs::Rung;
#[cfg(test)]
use sound::with_sound;
pub use sound::{Sound, sound, with_extras};
pub use strict::strict;
pub use write::{ErrorStat, Errors, Summary, WriteConfig, write};

/// Extension of playback files.
pub const EXTENSION: &str = "s4d";
/// Extension of playback files before version 0.1. Read and accepted; another program writes another format under it.
pub const OLD_EXTENSION: &str = "splat4d";
/// Media type of playback files, for servers.
pub const MEDIA_TYPE: &str = "application/vnd.s4d";
/// First bytes of a playback file.
pub const MAGIC: [u8; 8] = *b"\x89S4D\r\n\x1a\n";
/// The version of this library: major, minor. A file states the lowest version that has all of its content.
pub(crate) const VERSION: [u16; 2] = [1, 2];
/// The version of a file with masks and without labels.
const MASKED: [u16; 2] = [1, 1];
/// The version of a file without either.
const FIRST_VERSION: [u16; 2] = [1, 0];
/// The version of a file that grows, which readers of version 1 refuse: its index is not where they search for it.
const GROWING: [u16; 2] = [2, 0];
/// Bytes of the header.
pub const HEADER_BYTES: usize = 64;
/// Gaussians in a block, which share ranges.
pub const BLOCK_GAUSSIANS: usize = 256;
/// Most Gaussians of a page: 2 MiB of words, and a row number has 16 bits.
pub(crate) const MAX_PAGE_GAUSSIANS: usize = 65_536;
/// Words of a Gaussian.
pub(crate) const PAGE_WORDS: usize = 8;
/// Numbers in a block's header.
pub(crate) const BLOCK_HEADER: usize = 24;
/// Most entries of a palette: labels have 16 bits.
pub const MAX_PALETTE: usize = 65_536;
/// The least importance a `σ` has before it counts as dead, as everywhere: 1/255.
const ALPHA_MIN: f64 = crate::layers::ALPHA_MIN;

/// One Gaussian in floats that moves on a straight line and turns at an even rate, before quantisation (docs/format.md,
/// "Page").
#[derive(Clone, Debug, PartialEq)]
pub struct Primitive {
    /// Mean at `center`, scene units.
    pub mean: [f64; 3],
    /// Middle of its lifespan, and the time to which mean and rotation belong, seconds.
    pub center: f64,
    /// Seconds before and after the centre for which it is fully there; infinite: it has an infinite lifespan.
    pub half_width: f64,
    /// Standard deviation of the Gaussian tails of its lifespan, seconds.
    pub softness: f64,
    /// Rotation wxyz at `center`; need not be normalised.
    pub quat: [f32; 4],
    /// Standard deviations along its axes, scene units.
    pub scales: [f32; 3],
    /// Opacity in the middle of its lifespan, 0 to 1.
    pub opacity: f32,
    /// Scene units per second.
    pub velocity: [f32; 3],
    /// Angular velocity about the world's axes, radians a second.
    pub turn: [f32; 3],
    /// ½ + Y₀₀·(SH coefficient 0), not clamped.
    pub base_color: [f32; 3],
    /// SH coefficients k = 1 … 15 of channel c at 3(k − 1) + c; those above the scene's degree are not read.
    pub sh_rest: [f32; 45],
    /// How much it adds to images; any unit. Decides tiers and how much the palette cares.
    pub importance: f32,
    /// Number of its label in [`Meta::labels`]; none: it has none.
    pub label: Option<u8>,
    /// Its feature channels, as many as [`Meta::features`] has; empty: it has none.
    pub features: Vec<f32>,
}

/// Gaussians that are rendered for from ≤ t < to.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Node {
    /// First second.
    pub from: f64,
    /// The second at which it ends.
    pub to: f64,
    /// In any order.
    pub primitives: Vec<Primitive>,
}

/// Content of a playback file.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Draft {
    /// About the scene; `gaussians` is counted by the writer.
    pub meta: Meta,
    /// Spans of time.
    pub nodes: Vec<Node>,
    /// A JPEG or PNG image.
    pub poster: Option<Vec<u8>>,
}
