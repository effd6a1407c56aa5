//! Captures that are shipped as a video per camera and their poses: Neural 3D Video (`cam00.mp4` …,
//! `poses_bounds.npy`). Frames are extracted once, below the capture, where its reader searches for them.

use crate::video::{self, Info, Selection, Source};
use crate::write::{self, Clip, Format};
use splat4d::format::npy::Npy;
use splat4d::{Error, ErrorKind, Result};
use splat4d_train::capture::{about_rows, rows_of};
use splat4d_train::event::Progress;
use std::path::{Path, PathBuf};

/// The poses: one row per camera, in the order of the videos' names.
const POSES: &str = "poses_bounds.npy";
/// Endings of the videos.
const VIDEOS: [&str; 5] = ["mp4", "mov", "mkv", "avi", "webm"];
/// Pixels of the shorter side that frames have at most. Sides are divided by a whole number, so that intrinsics scale
/// exactly: Neural 3D Video's 2704x2028 become the 1352x1014 that its papers train on.
const SIDE: usize = 1080;
/// Folder of the notes that `write::pictures` keeps of what it stored.
const NOTES: &str = "import";

/// The extracted frames.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Extracted {
    /// Cameras.
    pub cameras: usize,
    /// Frames of all of them.
    pub frames: usize,
    /// Pixels across and down.
    pub size: [usize; 2],
    /// Remarks, a sentence or two each.
    pub warnings: Vec<String>,
}

/// The videos of a capture that is shipped so and whose frames are not extracted in another way; empty: it is no such
/// capture.
pub fn videos(root: &Path) -> Vec<PathBuf> {
    if !root.join(POSES).is_file() || root.join("capture.json").is_file() {
        return Vec::new();
    }
    let Ok(entries) = std::fs::read_dir(root) else { return Vec::new() };
    let is_video = |p: &PathBuf| {
        let name = p.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let ending = p.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default();
        !name.starts_with('.') && VIDEOS.contains(&ending.as_str()) && p.is_file()
    };
    let mut all: Vec<PathBuf> = entries.filter_map(|e| e.ok().map(|e| e.path())).filter(is_video).collect();
    all.sort();
    let elsewhere = |video: &PathBuf| {
        let name = stem(video);
        let stored = root.join("images").join(&name);
        let noted = root.join(NOTES).join(format!("{name}.json")).is_file();
        root.join(&name).is_dir() || (stored.is_dir() && !noted)
    };
    if all.iter().any(elsewhere) { Vec::new() } else { all }
}

fn stem(video: &Path) -> String {
    video.file_stem().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default()
}

/// Extracts the frames of such a capture into its folder `images/`; existing files are kept, and work that was
/// interrupted continues. `None`: not such a capture. `stop` is called after every few frames.
///
/// Errors: other poses than videos, a video that cannot be read, no space; of kind `Interrupted` if `stop` requested
/// it.
pub fn extract(root: &Path, progress: &mut Progress<'_>, stop: &dyn Fn() -> bool) -> Result<Option<Extracted>> {
    let videos = videos(root);
    if videos.is_empty() {
        return Ok(None);
    }
    check_poses(&root.join(POSES), &videos)?;
    // Poses state no frame rate; folders are not among the videos.
    let sources = videos.iter().map(|path| video::open(path, 1.0)).collect::<Result<Vec<Box<dyn Source>>>>()?;
    let infos: Vec<&Info> = sources.iter().map(|s| s.info()).collect();
    check_rates(&videos, &infos)?;
    let clips: Vec<Clip<'_>> = videos
        .iter()
        .zip(&sources)
        .map(|(path, source)| {
            let selection = Selection { size: Some(side(source.info())), ..Selection::default() };
            Clip { name: stem(path), source: &**source, selection }
        })
        .collect();
    let pictures = write::pictures(root, &clips, Format::default(), progress, stop).map_err(|e| match e.kind() {
        ErrorKind::Interrupted => e,
        _ => e.remedy(
            "Frames are stored in the folder `images` of the capture: copy it to a disk with space where you may write.",
        ),
    })?;
    let mut warnings: Vec<String> = Vec::new();
    for p in &pictures {
        warnings.extend(p.warnings.iter().map(|w| format!("{}: {w}", p.name)));
    }
    Ok(Some(Extracted {
        cameras: pictures.len(),
        frames: pictures.iter().map(|p| p.shots.len()).sum(),
        size: pictures[0].size,
        warnings,
    }))
}

/// Pixels of the frames' shorter side.
fn side(info: &Info) -> usize {
    let own = info.size[0].min(info.size[1]);
    own / own.div_ceil(SIDE).max(1)
}

/// Extraction takes minutes: poses of another number of cameras are reported before. Returns how many there are.
fn check_poses(path: &Path, videos: &[PathBuf]) -> Result<usize> {
    let bytes = splat4d_train::files::read(path)?;
    let rows = Npy::read(&bytes).map_err(|e| e.at(path.display()))?.shape.first().copied().unwrap_or(0);
    let names: Vec<String> = videos.iter().map(|v| stem(v)).collect();
    if rows_of(&names, rows).is_some() {
        return Ok(rows);
    }
    let what = format!("it has {rows} cameras, but there are {} videos", videos.len());
    Err(Error::input(what).at(path.display()).remedy(
        "Keep exactly the videos that the poses are of, in the order of their names (cam00.mp4, cam01.mp4, …); where some are \
         missing, names that number the rows from 0.",
    ))
}

/// Of a frame: videos whose rates differ by more over their length show other times under one frame number.
const DRIFT: f64 = 0.5;

/// Errors: videos of different rates, whose frames with one number are not of one time.
fn check_rates(videos: &[PathBuf], infos: &[&Info]) -> Result<()> {
    let rates: Vec<Option<f64>> = infos.iter().map(|i| i.average_rate.or(i.nominal_rate)).collect();
    let Some((first, of_first)) = rates.iter().zip(videos).find_map(|(r, v)| Some(((*r)?, v))) else { return Ok(()) };
    for ((rate, video), info) in rates.iter().zip(videos).zip(infos) {
        let Some(rate) = *rate else { continue };
        let frames = frames_of(info).unwrap_or(1) as f64;
        if (rate / first - 1.0).abs() * frames > DRIFT {
            let what = format!(
                "the videos have different frame rates ({first:.3} frames a second of {}, {rate:.3} of this one), and poses_bounds.npy \
                 states no clocks",
                stem(of_first)
            );
            let remedy = format!(
                "Convert it to the rate of the others, for example with `ffmpeg -i {0}.mp4 -r {first:.3} {0}-new.mp4`.",
                stem(video)
            );
            return Err(Error::input(what).at(video.display()).remedy(remedy));
        }
    }
    Ok(())
}

/// Frames of a video, as its file states them or by its length.
fn frames_of(info: &Info) -> Option<usize> {
    info.frames.or_else(|| Some((info.duration? * info.average_rate.or(info.nominal_rate)?).round() as usize))
}

/// Content of such a capture before extraction.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Contents {
    /// Names of the cameras, and frames of each, where its file states them.
    pub cameras: Vec<(String, Option<usize>)>,
    /// Pixels across and down, of each size.
    pub sizes: Vec<[usize; 2]>,
    /// Pixels across and down of the frames that are extracted from the first video.
    pub extracted: [usize; 2],
    /// Frames a second, where files state them.
    pub rate: Option<f64>,
    /// Seconds of the longest, where files state them.
    pub seconds: Option<f64>,
    /// Remarks, a sentence or two each; those that spoil the result first.
    pub warnings: Vec<String>,
}

/// Whether all frames of a video are extracted, by the notes of that.
fn is_extracted(root: &Path, video: &Path) -> bool {
    let note = splat4d_train::files::read(&root.join(NOTES).join(format!("{}.json", stem(video)))).ok();
    let note: Option<serde_json::Value> = note.and_then(|bytes| serde_json::from_slice(&bytes).ok());
    note.is_some_and(|n| n["complete"] == true)
}

/// Content of such a capture; `None`: it is no such capture, or all frames are extracted. Errors: as [`extract`], but
/// of space.
pub fn contents(root: &Path) -> Result<Option<Contents>> {
    let videos = videos(root);
    if videos.iter().all(|v| is_extracted(root, v)) {
        return Ok(None);
    }
    let rows = check_poses(&root.join(POSES), &videos)?;
    let sources = videos.iter().map(|path| video::open(path, 1.0)).collect::<Result<Vec<Box<dyn Source>>>>()?;
    let infos: Vec<&Info> = sources.iter().map(|s| s.info()).collect();
    check_rates(&videos, &infos)?;
    let names: Vec<String> = videos.iter().map(|v| stem(v)).collect();
    let which = rows_of(&names, rows).unwrap_or_default();
    let mut out = Contents {
        cameras: names.iter().cloned().zip(infos.iter().map(|i| frames_of(i))).collect(),
        rate: infos[0].average_rate.or(infos[0].nominal_rate),
        seconds: infos.iter().filter_map(|i| i.duration).max_by(f64::total_cmp),
        warnings: about_rows(&names, &which, rows).into_iter().map(|(_, what)| what).collect(),
        extracted: Selection { size: Some(side(infos[0])), ..Selection::default() }.scaled(infos[0].size),
        ..Contents::default()
    };
    for info in &infos {
        if !out.sizes.contains(&info.size) {
            out.sizes.push(info.size);
        }
        out.warnings.extend(info.warnings.iter().map(|w| format!("{}: {w}", info.name)));
    }
    let longest = out.cameras.iter().filter_map(|(_, n)| *n).max().unwrap_or(0);
    let short = |(name, n): &(String, Option<usize>)| n.filter(|n| *n < longest).map(|n| format!("{name} ({n})"));
    let short: Vec<String> = out.cameras.iter().filter_map(short).collect();
    if !short.is_empty() {
        out.warnings.push(format!(
            "Videos are not equally long ({longest} frames at most): {}. Frames are counted from the beginning of each: if these did \
             not begin with the others, cut the others.",
            short.join(", ")
        ));
    }
    Ok(Some(out))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::process::Command;

    #[test]
    fn frames_are_extracted_once_and_incomplete_extraction_continues() {
        let dir = tempfile::tempdir().unwrap();
        let root = dir.path();
        let mut poses = Vec::new();
        splat4d::format::npy::write_f32(&[2, 17], &[0.5; 34], &mut poses).unwrap();
        std::fs::write(root.join(POSES), &poses).unwrap();
        let make = |name: &str| {
            let input = "-v error -f lavfi -i testsrc=s=64x48:r=10:d=0.5 -c:v mpeg4 -y".split_whitespace();
            Command::new("ffmpeg").args(input).arg(root.join(name)).status().is_ok_and(|s| s.success())
        };
        if !make("front.mp4") {
            eprintln!("skipped: there is no ffmpeg here");
            return;
        }
        let mut told = |_: &splat4d_train::event::Event| {};
        let mut progress = Progress(&mut told);
        let few = extract(root, &mut progress, &|| false).unwrap_err().to_string();
        assert!(few.contains("2 cameras") && few.contains("1 videos"), "{few}");
        std::fs::remove_file(root.join("front.mp4")).unwrap();
        assert!(make("cam00.mp4") && make("cam01.mp4"));
        let seen = contents(root).unwrap().unwrap();
        assert_eq!(seen.cameras, [("cam00".to_owned(), Some(5)), ("cam01".to_owned(), Some(5))]);
        assert_eq!(
            (seen.sizes, seen.extracted, seen.rate, seen.warnings.len()),
            (vec![[64, 48]], [64, 48], Some(10.0), 0)
        );
        let stopped = extract(root, &mut progress, &|| true);
        assert!(stopped.is_err_and(|e| e.kind() == ErrorKind::Interrupted));
        let found = extract(root, &mut progress, &|| false).unwrap().unwrap();
        assert_eq!((found.cameras, found.frames, found.size), (2, 10, [64, 48]));
        let frame = root.join("images/cam01/000004.jpg");
        let written = std::fs::metadata(&frame).unwrap().modified().unwrap();
        std::fs::remove_file(root.join("images/cam00/000002.jpg")).unwrap();
        assert_eq!(extract(root, &mut progress, &|| false).unwrap().unwrap(), found);
        assert!(root.join("images/cam00/000002.jpg").is_file());
        assert_eq!(std::fs::metadata(&frame).unwrap().modified().unwrap(), written, "what was there is left");
        assert_eq!(contents(root).unwrap(), None, "its frames are read");
        let note: serde_json::Value =
            serde_json::from_slice(&std::fs::read(root.join("import/cam00.json")).unwrap()).unwrap();
        assert!((note["interval"].as_f64().unwrap() - 0.1).abs() < 1e-6, "the capture's reader finds its rate there");
        // Frames of another program are the capture's own.
        std::fs::remove_dir_all(root.join(NOTES)).unwrap();
        assert!(extract(root, &mut progress, &|| false).unwrap().is_none());
    }

    #[test]
    fn videos_of_other_rates_and_lengths_are_named() {
        let video = |rate: f64, frames: usize| Info {
            name: "x".into(),
            size: [64, 48],
            stored: [64, 48],
            rotation: 0,
            nominal_rate: Some(rate),
            average_rate: Some(rate),
            time_base: None,
            duration: Some(frames as f64 / rate),
            frames: Some(frames),
            codec: "mpeg4".into(),
            pixels: "yuv420p".into(),
            interlaced: false,
            color: video::Color {
                matrix: None,
                tagged: false,
                range: video::Range::Full,
                transfer: video::Transfer::Standard,
            },
            sound: false,
            alpha: false,
            warnings: Vec::new(),
        };
        let videos = ["cam00.mp4", "cam01.mp4"].map(PathBuf::from);
        let check = |a: f64, b: f64| check_rates(&videos, &[&video(a, 300), &video(b, 300)]);
        assert!(check(30.0, 30.0).is_ok() && check(29.97, 29.9701).is_ok());
        let message = check(30.0, 15.0).unwrap_err().to_string();
        assert!(message.contains("different frame rates") && message.contains("cam01"), "{message}");
        assert!(check(30.0, 29.97).is_ok(), "a third of a frame after 10 s");
        assert!(check(30.0, 29.9).is_err(), "a frame after 10 s");
    }
}
