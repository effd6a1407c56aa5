//! The first channel of an OpenEXR file that may be a depth, as 32-bit floats.

use exr::prelude::{self, FlatSamples, ReadChannels, ReadLayers};
use splat4d::{Error, Result};

/// Channels by which renderers and tools call depth, in this order; else a file's only channel.
const NAMES: [&str; 5] = ["Z", "depth", "Depth.Z", "Y", "R"];

/// Width, height and numbers. Errors: damage, no channel that is known for depth.
pub(super) fn read(bytes: &[u8]) -> Result<(usize, usize, Vec<f32>)> {
    let bad = |what: String| Error::input(what).remedy("Write one channel Z (or depth) of 16 or 32-bit floats");
    let image = prelude::read()
        .no_deep_data()
        .largest_resolution_level()
        .all_channels()
        .first_valid_layer()
        .all_attributes()
        .non_parallel()
        .from_buffered(std::io::Cursor::new(bytes))
        .map_err(|e| bad(format!("the OpenEXR file cannot be read ({e})")))?;
    let layer = image.layer_data;
    let channels = &layer.channel_data.list;
    let named = NAMES.iter().find_map(|name| channels.iter().find(|c| c.name.to_string() == *name));
    let ending = || channels.iter().find(|c| c.name.to_string().ends_with(".Z"));
    let only = || channels.first().filter(|_| channels.len() == 1);
    let channel = named.or_else(ending).or_else(only).ok_or_else(|| {
        let have: Vec<String> = channels.iter().map(|c| c.name.to_string()).collect();
        bad(format!("no channel of the OpenEXR file is known for depth: it has {}", have.join(", ")))
    })?;
    let values = match &channel.sample_data {
        FlatSamples::F16(v) => v.iter().map(|x| x.to_f32()).collect(),
        FlatSamples::F32(v) => v.clone(),
        FlatSamples::U32(v) => v.iter().map(|&x| x as f32).collect(),
    };
    Ok((layer.size.width(), layer.size.height(), values))
}
