//! The first channel of an OpenEXR file that may be a depth, as 32-bit floats.

use exr::meta::header::Header;
use exr::meta::{BlockDescription, MetaData};
use exr::prelude::{self, ReadChannels, ReadLayers, ReadSpecificChannel};
use splat4d::{Error, Result};
use std::io::Cursor;

/// Channels by which renderers and tools call depth, in this order; else a file's only channel.
const NAMES: [&str; 5] = ["Z", "depth", "Depth.Z", "Y", "R"];
/// Most scan lines that a compression packs together (DWAB; OpenEXR's documentation of compressions).
const MOST_LINES: usize = 256;
/// Most bytes of a block of all channels, which is decompressed as a whole.
const MOST_BLOCK: usize = 256 << 20;

/// Width, height and numbers. `check` gets the size before anything of that size is allocated.
///
/// Errors: damage, no channel that is known for depth, those of `check`.
pub(super) fn read(bytes: &[u8], check: impl Fn((usize, usize)) -> Result<()>) -> Result<(usize, usize, Vec<f32>)> {
    let bad = |what: String| Error::input(what).remedy("Write one channel Z (or depth) of 16 or 32-bit floats");
    let unreadable = |e: exr::error::Error| bad(format!("the OpenEXR file cannot be read ({e})"));
    let meta = MetaData::read_from_buffered(Cursor::new(bytes), false).map_err(unreadable)?;
    let layers = || meta.headers.iter().filter(|h| !h.deep);
    let Some((header, name)) = layers().find_map(|h| Some((h, depth_channel(h)?))) else {
        let have: Vec<String> = layers().flat_map(|h| &h.channels.list).map(|c| c.name.to_string()).collect();
        return Err(bad(format!("no channel of the OpenEXR file is known for depth: it has {}", have.join(", "))));
    };
    let (width, height) = (header.layer_size.width(), header.layer_size.height());
    check((width, height))?;
    let (across, lines) = match header.blocks {
        BlockDescription::ScanLines => (width, MOST_LINES),
        BlockDescription::Tiles(tiles) => (tiles.tile_size.width(), tiles.tile_size.height()),
    };
    let block = across.min(width) * lines.min(height);
    if block.saturating_mul(header.channels.bytes_per_pixel) > MOST_BLOCK {
        let what = format!("the OpenEXR file has {} channels of {width}x{height}", header.channels.list.len());
        return Err(bad(format!("{what}: too much to unpack")));
    }
    let image = prelude::read()
        .no_deep_data()
        .largest_resolution_level()
        .specific_channels()
        .required(name)
        .collect_pixels(
            |size, _| (size.width(), vec![0.0; size.area()]),
            |(width, values): &mut (usize, Vec<f32>), at, (value,): (f32,)| values[at.y() * *width + at.x()] = value,
        )
        .first_valid_layer()
        .all_attributes()
        .non_parallel()
        .from_buffered(Cursor::new(bytes))
        .map_err(unreadable)?;
    let (_, values) = image.layer_data.channel_data.pixels;
    if values.len() != width * height {
        return Err(bad("the layers of the OpenEXR file differ in size".into()));
    }
    Ok((width, height, values))
}

/// Name of the channel that holds depth.
fn depth_channel(header: &Header) -> Option<prelude::Text> {
    let channels = &header.channels.list;
    let named = NAMES.iter().find_map(|name| channels.iter().find(|c| c.name.to_string() == *name));
    let ending = || channels.iter().find(|c| c.name.to_string().ends_with(".Z"));
    let only = || channels.first().filter(|_| channels.len() == 1);
    named.or_else(ending).or_else(only).map(|c| c.name.clone())
}
