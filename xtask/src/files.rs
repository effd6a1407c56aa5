//! Files that the chores write.

use anyhow::{Context, Result};
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// A PNG file of `width` x `height` pixels; 16-bit samples in the machine's byte order.
pub(crate) fn png(data: &[u8], width: usize, height: usize, color: ExtendedColorType) -> Result<Vec<u8>> {
    let mut out = Vec::new();
    let filter = if color == ExtendedColorType::L8 { FilterType::NoFilter } else { FilterType::Adaptive };
    let encoder = PngEncoder::new_with_quality(&mut out, CompressionType::Level(9), filter);
    encoder.write_image(data, width as u32, height as u32, color)?;
    Ok(out)
}

/// Writes a file as a whole or not at all; makes the folder if need be.
pub(crate) fn write_file(path: &Path, bytes: &[u8]) -> Result<()> {
    Ok(splat4d_train::output::write_atomically(path, bytes)?)
}

/// All files below a folder with their contents, by their paths in it.
pub(crate) fn tree(folder: &Path) -> Result<BTreeMap<PathBuf, Vec<u8>>> {
    let (mut found, mut todo) = (BTreeMap::new(), vec![folder.to_owned()]);
    while let Some(next) = todo.pop() {
        for entry in std::fs::read_dir(&next).with_context(|| next.display().to_string())? {
            let path = entry?.path();
            if path.is_dir() {
                todo.push(path);
            } else {
                let bytes = std::fs::read(&path).with_context(|| path.display().to_string())?;
                found.insert(path.strip_prefix(folder)?.to_owned(), bytes);
            }
        }
    }
    Ok(found)
}
