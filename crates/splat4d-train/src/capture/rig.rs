//! Names and files: which pictures lie in a folder, and what a picture's name says about camera and frame number.

use std::path::Path;

/// Endings of pictures that can be decoded.
pub(super) const IMAGE_ENDINGS: &[&str] = &["png", "jpg", "jpeg", "webp"];

/// Sorted names of the files and folders directly in `folder`; empty where it cannot be read.
pub(super) fn file_names(folder: &Path) -> Vec<String> {
    let Ok(entries) = std::fs::read_dir(folder) else { return Vec::new() };
    let mut names: Vec<String> = entries.flatten().filter_map(|e| e.file_name().into_string().ok()).collect();
    names.sort();
    names
}

/// Whether a name ends like a picture.
pub(super) fn is_image(name: &str) -> bool {
    let ending = Path::new(name).extension();
    !name.starts_with('.') && ending.is_some_and(|e| IMAGE_ENDINGS.iter().any(|v| e.eq_ignore_ascii_case(v)))
}

/// Sorted names of the pictures directly in `folder`.
pub(super) fn image_names(folder: &Path) -> Vec<String> {
    file_names(folder).into_iter().filter(|n| is_image(n)).collect()
}

/// The number at the end of a name without its ending: `frame_00012.png` → 12.
pub(super) fn trailing_number(name: &str) -> Option<usize> {
    let stem = name.rsplit_once('.').map_or(name, |(stem, _)| stem);
    let digits = stem.len() - stem.trim_end_matches(|c: char| c.is_ascii_digit()).len();
    stem[stem.len() - digits..].parse().ok()
}
