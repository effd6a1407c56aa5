//! Content of a folder that is not a capture, and how to make one of it: archives, captures above and below, files
//! under other names, images and videos without poses.

use super::account::first_names;
use super::{colmap, lookup, rig, sequence};
use crate::path_text::in_command;
use std::io::Read;
use std::path::{Path, PathBuf};

/// Usual folders of a rig's videos.
const VIDEO_FOLDER: &str = "videos";
const VIDEO_ENDINGS: &[&str] = &["mp4", "mov", "mkv", "avi", "webm"];
const ARCHIVE_ENDINGS: &[&str] = &["zip", "7z", "rar", "tar", "tgz", "gz", "r3d"];
/// COLMAP's features and matches.
const DATABASE: &str = "database.db";
/// The cameras of a 3DGS output: names of images and poses, without the images.
const OUTPUT_CAMERAS: &str = "cameras.json";
/// The settings of a 3DGS output, and the folder of checkpoints of one of Nerfstudio.
const OUTPUT_SETTINGS: &str = "cfg_args";
const CHECKPOINTS: &str = "nerfstudio_models";
const SCENE_ENDINGS: &[&str] = &["ply", "spz", "splat", "splatv", "sog", "ksplat", "glb", "s4d", "pt", "ckpt"];
/// Projects and poses of other programs that are not read: endings, what they are, and what to do.
const PROJECTS: [(&str, &str, &str); 6] = [
    ("psx", "a project of Metashape", METASHAPE),
    ("psz", "a project of Metashape", METASHAPE),
    ("rcproj", "a project of RealityCapture", REALITYSCAN),
    ("rsproj", "a project of RealityScan", REALITYSCAN),
    ("nvm", "a reconstruction of VisualSFM", AS_COLMAP),
    ("p4d", "a project of Pix4D", AS_COLMAP),
];
const METASHAPE: &str = "export its cameras next to the photos (File, Export, Export Cameras, Agisoft XML)";
const REALITYSCAN: &str =
    "export the registration next to the images as \"Internal/External camera parameters\" (.csv)";
const AS_COLMAP: &str = "export the cameras as COLMAP";
/// Files and folders of captures of Nerfies.
const NERFIES: [&str; 4] = ["dataset.json", "metadata.json", "camera", "rgb"];
/// Numbers next to the name of an image in a line that describes its camera, at least.
const POSE_NUMBERS: usize = 6;
/// Bytes of a text in which keys are searched for.
const HEAD: u64 = 1 << 16;
/// First lines of a table that are examined.
const HEADER_LINES: usize = 5;
/// Folders that are looked into for a capture.
const MOST_FOLDERS: usize = 100;
/// The same in each of them.
const MOST_INNER: usize = 10;

/// Remedy for a folder that is not a capture, which the user called `named`, by what it holds. `None`: it holds nothing
/// that is known.
pub(super) fn advice(root: &Path, named: &Path, is_capture: &dyn Fn(&Path) -> bool) -> Option<String> {
    let names = rig::file_names(root);
    let folders = || names.iter().map(|n| root.join(n)).filter(|p| p.is_dir()).take(MOST_FOLDERS);
    // Archives are often unpacked into a folder of their own name.
    let deeper = || {
        folders().flat_map(|folder| {
            let names = rig::file_names(&folder);
            names.into_iter().map(move |n| folder.join(n)).filter(|p| p.is_dir()).take(MOST_INNER)
        })
    };
    if let Some(inner) = folders().find(|folder| is_capture(folder)).or_else(|| deeper().find(|f| is_capture(f))) {
        return Some(format!("A folder in it is a capture: give {}.", inner.display()));
    }
    if let Some(above) = above(root).filter(|folder| is_part(root) && is_capture(folder)) {
        return Some(format!("The folder that holds it is a capture: give {}.", above.display()));
    }
    if let Some(name) = names.iter().find(|n| is_transforms(&root.join(n))) {
        return Some(format!("{name} has poses as transforms.json has them: give its path, or rename it."));
    }
    if let Some(name) = names.iter().find(|n| ends(Path::new(n), ARCHIVE_ENDINGS)) {
        return Some(format!("{name} is an archive: unpack it, and give the folder that it makes."));
    }
    if names.iter().any(|n| n == NERFIES[0]) && NERFIES[1..].iter().any(|n| root.join(n).is_dir()) {
        let missing: Vec<&str> = NERFIES.into_iter().filter(|n| !root.join(n).exists()).collect();
        return Some(format!(
            "It looks like a capture of Nerfies, HyperNeRF or DyCheck, but has no {}: copy it too.",
            missing.join(", ")
        ));
    }
    if let Some(advice) = foreign_poses(root, &names) {
        return Some(advice);
    }
    if let Some(advice) = scenes(root, &names) {
        return Some(advice);
    }
    if root.join(OUTPUT_CAMERAS).is_file() && head(&root.join(OUTPUT_CAMERAS)).trim_start().starts_with('[') {
        return Some(format!(
            "{OUTPUT_CAMERAS} is that of a 3DGS output, which has no images: give the capture that it was trained on."
        ));
    }
    if let Some(video) = first_video(root) {
        return Some(format!(
            "It holds videos, but no camera poses that are known here. Make a capture of them with `splat4d import {} -o TAKE`, \
             which finds time offsets and poses, or reads a calibration that you have (docs/filming.md); or extract frames with `{}` \
             and write a capture.json (docs/capture-format.md).",
            in_command(named),
            ffmpeg_command(&video)
        ));
    }
    let reconstruct = format!(
        "make a capture of them with `splat4d import {} -o TAKE` (docs/filming.md), or reconstruct them with COLMAP \
         (`colmap automatic_reconstructor`) and give its folder",
        in_command(named)
    );
    if root.join(DATABASE).is_file() {
        return Some(format!("{DATABASE} holds no poses yet (`colmap mapper` finds them): {reconstruct}."));
    }
    let images = colmap::has_images(root) || folders().any(|folder| !rig::image_names(&folder).is_empty());
    images.then(|| format!("It holds images, but no camera poses: {reconstruct}."))
}

/// What to do with poses and projects of other programs. `None`: there are none.
fn foreign_poses(root: &Path, names: &[String]) -> Option<String> {
    for (ending, what, remedy) in PROJECTS {
        if let Some(name) = names.iter().find(|n| ends(Path::new(n), &[ending])) {
            return Some(format!("{name} is {what}: {remedy}."));
        }
    }
    let blocks = |n: &&String| ends(Path::new(n), &["xml"]) && head(&root.join(n)).contains("<BlocksExchange");
    if let Some(name) = names.iter().find(blocks) {
        return Some(format!("{name} has poses as BlocksExchange, which is not read: {AS_COLMAP}."));
    }
    // COLMAP's own table is part of a model.
    let is_other = |n: &&String| !n.eq_ignore_ascii_case("images.txt");
    let is_table = |n: &&String| ends(Path::new(n), &["csv", "txt"]) && is_table(&head(&root.join(n)));
    let table = names.iter().filter(is_other).find(is_table)?;
    Some(format!(
        "{table} is a table of images with numbers, without names of columns that are known: begin it with name, x, y, alt, heading, \
         pitch, roll, f, px, py (docs/layouts.md), or export the cameras as COLMAP."
    ))
}

/// The beginning of a file as text; empty where it cannot be read.
fn head(path: &Path) -> String {
    let mut head = Vec::new();
    let read = crate::files::open(path).is_ok_and(|f| f.take(HEAD).read_to_end(&mut head).is_ok());
    if read { String::from_utf8_lossy(&head).into_owned() } else { String::new() }
}

/// Whether one of the first lines of a text names an image and many numbers.
fn is_table(text: &str) -> bool {
    let of_pose = |line: &str| {
        let cells: Vec<&str> = line.split([',', ';', '\t', ' ']).map(|c| c.trim_matches('"')).collect();
        cells.iter().any(|c| rig::is_image(c))
            && cells.iter().filter(|c| c.parse::<f64>().is_ok()).count() >= POSE_NUMBERS
    };
    text.lines().take(HEADER_LINES).any(of_pose)
}

/// What to do with scenes that are no captures: outputs of trainings and files of Gaussians. `None`: there are none.
fn scenes(root: &Path, names: &[String]) -> Option<String> {
    let checkpoints = root.join(CHECKPOINTS);
    let newest = rig::file_names(&checkpoints).into_iter().rfind(|n| ends(Path::new(n), &["ckpt"]));
    if let Some(checkpoint) = newest {
        return Some(format!(
            "It is the output of a training of Nerfstudio: give its newest checkpoint, {}.",
            checkpoints.join(checkpoint).display()
        ));
    }
    if names.iter().any(|n| n == OUTPUT_SETTINGS) {
        return Some(
            "It is an output folder of 3DGS without point_cloud/iteration_N/point_cloud.ply: train again, or copy that too.".into(),
        );
    }
    let files: Vec<&String> = names.iter().filter(|n| ends(Path::new(n), SCENE_ENDINGS)).collect();
    (!files.is_empty())
        .then(|| format!("It holds scenes or points, but no cameras: give one of {}.", first_names(&files)))
}

/// Whether a name ends in one of these.
fn ends(path: &Path, endings: &[&str]) -> bool {
    path.extension().is_some_and(|e| endings.iter().any(|v| e.eq_ignore_ascii_case(v)))
}

/// Whether a file is an archive by its name, which is to be unpacked.
pub(super) fn is_archive(path: &Path) -> bool {
    ends(path, ARCHIVE_ENDINGS)
}

/// Whether a folder is called like the images of a capture, or like one of its cameras.
fn is_part(root: &Path) -> bool {
    let name = root.file_name().unwrap_or_default().to_string_lossy().into_owned();
    lookup::is_image_folder(&name) || rig::is_plain(&name) || sequence::are_cameras(&[name])
}

/// The folder that holds this one.
fn above(root: &Path) -> Option<PathBuf> {
    let full = std::path::absolute(root).ok()?;
    full.parent().map(Path::to_path_buf)
}

/// Whether a JSON file, whatever its name, lists frames with matrices as a transforms file does.
pub(super) fn is_transforms(path: &Path) -> bool {
    ends(path, &["json"]) && path.is_file() && head(path).contains("\"transform_matrix\"")
}

/// The first video in a folder, or in the usual one below it.
fn first_video(root: &Path) -> Option<String> {
    let below = videos(&root.join(VIDEO_FOLDER)).into_iter().map(|name| format!("{VIDEO_FOLDER}/{name}"));
    videos(root).into_iter().chain(below).next()
}

/// Names of the video files in a folder, sorted.
pub(super) fn videos(folder: &Path) -> Vec<String> {
    let video = |n: &String| !n.starts_with('.') && ends(Path::new(n), VIDEO_ENDINGS);
    rig::file_names(folder).into_iter().filter(video).collect()
}

/// The command that turns one video into a folder of frames named as the readers expect.
pub(super) fn ffmpeg_command(video: &str) -> String {
    let stem = Path::new(video).file_stem().and_then(|s| s.to_str()).unwrap_or("cam00");
    let folder = in_command(&Path::new("images").join(stem));
    let frames = in_command(&Path::new("images").join(stem).join("%06d.jpg"));
    let video = in_command(Path::new(video));
    format!("mkdir -p {folder} && ffmpeg -i {video} -start_number 0 -qscale:v 2 {frames}")
}
