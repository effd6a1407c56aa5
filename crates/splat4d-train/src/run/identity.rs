//! Fingerprint of a run: a checkpoint is only continued with the same capture and the same recipe.

use super::checkpoint::Identity;
use crate::capture::Capture;
use crate::recipe::Recipe;
use crate::step::replans::ScheduleChanges;

/// The mark of a run: its capture, its recipe and, optionally `text`.
pub(super) fn identity(capture: &Capture, recipe: &Recipe, text: &str) -> Identity {
    Identity { capture: fingerprint(capture), recipe: recipe_print(recipe, text) }
}

/// A recipe in 16 hexadecimal digits, as it was written before it had tables: runs of then continue.
pub(super) fn recipe_print(recipe: &Recipe, text: &str) -> String {
    // Settings of memory alone never affect a result and may change between resumes.
    let neutral = recipe.clone().with(|r| {
        r.run.image_memory = 0;
        r.run.device_images = 0;
        r.run.memory_limit = 0;
        r.run.checkpoint_interval = 0;
        // Checkpoints hold what they followed of it.
        r.run.replans = ScheduleChanges::default();
    });
    hash(&(neutral.flat_toml() + text))
}

/// Names, sizes, poses and times of a capture in 16 hexadecimal digits.
pub(super) fn fingerprint(capture: &Capture) -> String {
    let mut text = String::new();
    for &i in &capture.train {
        let f = &capture.frames[i];
        let image = f.image.strip_prefix(&capture.root).unwrap_or(&f.image);
        text += &format!("{image:?} {:?} {:?};", f.view, f.time);
    }
    text.extend(capture.geometry.as_ref().map(|g| g.mark(&capture.root)));
    hash(&text)
}

/// The content of a file that a run depends on in 16 hexadecimal digits.
pub(super) fn file_print(bytes: &[u8]) -> String {
    fnv(bytes)
}

/// FNV-1a, 64 bits: it guards against mistakes, not against malice.
fn hash(text: &str) -> String {
    fnv(text.as_bytes())
}

fn fnv(bytes: &[u8]) -> String {
    let h = bytes.iter().fold(0xcbf2_9ce4_8422_2325u64, |h, b| (h ^ u64::from(*b)).wrapping_mul(0x0100_0000_01b3));
    format!("{h:016x}")
}
