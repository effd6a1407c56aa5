//! Images on disk that a reconstruction does not pose: they share their camera's pose where it is fixed, else are left out.

use super::super::account::Severity;
use super::super::account::{Account, Aspect, first_names};
use super::super::lookup::Twins;
use super::super::{CaptureOptions, Unregistered, lookup, rig, sequence};
use super::Shot;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Below this part of registered images the reconstruction is probably incomplete, and below the second broken.
const FEW_REGISTERED: [f64; 2] = [0.9, 0.7];

/// Adds the images that share a pose to `shots` and `files`, and states how many are without one.
///
/// A pose can be shared where every camera has exactly one registered image: the usual way to calibrate a fixed rig is to
/// reconstruct one time.
pub(super) fn settle(
    base: &Path,
    shots: &mut Vec<Shot>,
    files: &mut Vec<PathBuf>,
    options: &CaptureOptions,
    account: &mut Account,
) {
    let names: Vec<&str> = shots.iter().map(|(name, _)| name.as_str()).collect();
    let naming = rig::naming(&names);
    // Folders as they were found, and as names have them: those may be absolute paths of another machine.
    let of_name = |name: &str| name.rsplit_once('/').map_or(String::new(), |(folder, _)| format!("{folder}/"));
    let of_file = |file: &PathBuf| file.parent().unwrap_or(base).to_path_buf();
    let folders: BTreeMap<PathBuf, String> =
        files.iter().zip(&names).map(|(file, name)| (of_file(file), of_name(name))).collect();
    let known: BTreeSet<&PathBuf> = files.iter().collect();
    let stem = |file: &Path| {
        let name = file.file_name().unwrap_or_default().to_string_lossy();
        file.with_file_name(lookup::fold(lookup::without_ending(&name)))
    };
    let stems: BTreeMap<PathBuf, &PathBuf> = files.iter().map(|file| (stem(file), file)).collect();
    let mut others: Vec<(String, PathBuf)> = Vec::new();
    // The model names the image that is meant, whatever size its twin has.
    let mut twins = Twins::default();
    for (path, folder) in &folders {
        for file in rig::image_names(path) {
            let image = path.join(&file);
            if known.contains(&image) {
                continue;
            }
            match stems.get(&stem(&image)) {
                Some(read) => twins.named((*read).clone(), image),
                None => others.push((format!("{folder}{file}"), image)),
            }
        }
    }
    twins.report(base, account);
    if others.is_empty() {
        return;
    }
    let one_each = naming.stated && naming.cameras.len() == shots.len();
    let share = match options.unregistered {
        Unregistered::Share => true,
        Unregistered::Leave => false,
        Unregistered::Auto => naming.cameras.len() > 1 && sequence::name_a_rig(&naming.cameras),
    };
    let all = shots.len() + others.len();
    let registered = shots.len();
    let camera_of: BTreeMap<&str, usize> =
        naming.cameras.iter().enumerate().map(|(k, name)| (name.as_str(), k)).collect();
    let shot_of: BTreeMap<usize, usize> = naming.frames.iter().enumerate().map(|(i, f)| (f.0, i)).collect();
    let same_camera = |name: &str| {
        let own = rig::naming(&[name]);
        let camera = camera_of.get(own.cameras.first().filter(|_| own.stated)?.as_str())?;
        shot_of.get(camera).copied()
    };
    if one_each && share {
        let mut shared = 0;
        let sources: Vec<_> = others.iter().map(|(name, _)| same_camera(name)).collect();
        for ((name, image), of) in others.into_iter().zip(sources) {
            let Some(of) = of else { continue };
            let source = shots[of].1.clone();
            shots.push((name, source));
            files.push(image);
            shared += 1;
        }
        account.add(
            Aspect::Assumed,
            Severity::Note,
            format!(
                "COLMAP registered {registered} of {all} images, one of each camera: {shared} others share the pose of their \
                 camera, which is assumed to be fixed. If cameras move, use --set capture.unregistered=leave."
            ),
        );
        return;
    }
    let part = registered as f64 / all as f64;
    let few = part < FEW_REGISTERED[0];
    let advice = match part {
        _ if one_each => "",
        p if p < FEW_REGISTERED[1] => " The reconstruction is probably broken.",
        p if p < FEW_REGISTERED[0] => " Parts may be missing.",
        _ => "",
    };
    let fixed = match one_each {
        true => " If the cameras are fixed, use --set capture.unregistered=share.",
        false => "",
    };
    let names: Vec<&str> = others.iter().map(|(name, _)| name.as_str()).collect();
    let what = format!(
        "COLMAP registered {registered} of {all} images; {} have no pose and are left out: {}.{advice}{fixed}",
        others.len(),
        first_names(&names)
    );
    account.add(Aspect::NotFound, if few { Severity::Warning } else { Severity::Note }, what);
}
