//! Cameras and frame numbers of images without timestamps: photos of one time, or frames of videos, by their names.

use super::{Sequence, rig};
use splat4d::math::Se3;
use std::collections::{BTreeMap, BTreeSet};

/// Source of a capture's times.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Timing {
    /// The capture states them.
    Told,
    /// It states none; the numbers in image names count frames.
    Numbers,
    /// It states none; all images show one time.
    Moment,
}

/// Camera and time of every image.
pub(super) struct FrameOrder {
    /// Camera names.
    pub cameras: Vec<String>,
    /// For each image its camera, its frame number and its time in seconds.
    pub frames: Vec<(usize, usize, f64)>,
    /// Whether the data set distinguishes cameras; else one entry may represent many.
    pub named: bool,
    /// Source of the times.
    pub timing: Timing,
}

/// Words before the number in the names of a film's frames: what guides to ffmpeg, COLMAP and renderers write. Photos
/// are named by the camera that took them (`IMG_1234`, `DSC01234`, `cam07`) or by the date.
const FILM_WORDS: [&str; 12] =
    ["", "frame", "frames", "image", "img", "out", "output", "video", "thumb", "rgb", "color", "f"];
/// The one that telephones and cameras write for photos.
const PHOTO_WORD: &str = "IMG";
/// Nerfstudio's name of every image, photos and frames alike: a word and five digits. It states nothing of time.
const RENAMED: (&str, usize) = ("frame_", 5);
/// Words before the number in the names of a rig's cameras.
const CAMERA_WORDS: [&str; 2] = ["cam", "camera"];
/// Part of the steps from number to number that are alike where a film was cut into frames; some images may not have
/// been registered.
const EVEN: f64 = 0.5;

/// Finds cameras and frame numbers of images without times. Assumptions, and how to override them, are reported.
pub(super) fn order(
    names: &[&str],
    poses: &[Se3],
    sequence: Sequence,
    fps: f64,
    warnings: &mut Vec<String>,
    notes: &mut Vec<String>,
) -> FrameOrder {
    let naming = rig::naming(names);
    let rig = naming.stated && naming.cameras.len() > 1;
    let mut groups = vec![Vec::new(); naming.cameras.len()];
    naming.frames.iter().enumerate().for_each(|(i, f)| groups[f.0].push(i));
    let one_each = rig && naming.cameras.len() == names.len();
    let renamed = !rig && names.iter().all(|name| is_renamed(name));
    let film =
        !one_each && groups.iter().all(|group| is_film(group, names, poses) && (!renamed || still(group, poses)));
    let moment = match sequence {
        Sequence::Auto => !film,
        Sequence::Photos => true,
        Sequence::Video => false,
    };
    let count = names.len();
    let fixed = groups.iter().all(|group| still(group, poses));
    if sequence == Sequence::Auto
        && !fixed
        && let Some(order) = repeated(names, poses, fps)
    {
        notes.push(format!(
            "The capture has no times: its {count} images have {} poses, which repeat to the last bit. They are read as the frames of \
             {} fixed cameras, numbered by their names ({} and so on). If they are photos of one time, use --set \
             capture.sequence=photos.",
            order.cameras.len(),
            order.cameras.len(),
            names[0]
        ));
        return order;
    }
    if sequence == Sequence::Auto && moment && !one_each && count > 1 {
        notes.push(format!(
            "The capture has no times, and its names do not number the frames of a video: its {count} images are \
             given the same time. If they are frames of a video, use --set capture.sequence=video."
        ));
    }
    if sequence == Sequence::Auto && !moment && !rig && count > 1 && !still(&groups[0], poses) {
        warnings.push(format!(
            "The capture has no times: its {count} images are numbered like frames ({}) and read as a video of one \
             moving camera at {fps} frames per second. If they are photos of one time, use --set \
             capture.sequence=photos.",
            names[0]
        ));
    }
    // Folders that are named after cameras are believed.
    let moving = || groups.iter().all(|group| !still(group, poses));
    if sequence == Sequence::Auto && !moment && rig && !are_cameras(&naming.cameras) && moving() {
        warnings.push(format!(
            "The capture has no times: its {count} images are in the folders of {} cameras, numbered like frames ({} and so \
             on), and read as the videos of moving cameras that record together at {fps} frames per second. If they were recorded \
             one after another, or are photos of one time, use --set capture.sequence=photos.",
            groups.len(),
            names[0]
        ));
    }
    if moment && !one_each {
        return self::moment(names);
    }
    let mut naming = naming;
    if let Some(ranks) = naming.ranks.take().filter(|_| rig && !one_each && groups.iter().all(|g| still(g, poses))) {
        // Fixed cameras that recorded together and count apart.
        naming.frames.iter_mut().zip(ranks).for_each(|(frame, rank)| frame.1 = rank);
        warnings.push(format!(
            "Each camera's images have numbers of their own ({} and so on): they are matched by their order. Check that every \
             camera starts at the same time.",
            names[0]
        ));
    }
    let place = |&(camera, number): &(usize, usize)| {
        let number = if moment { 0 } else { number };
        (camera, number, number as f64 / fps)
    };
    FrameOrder {
        frames: naming.frames.iter().map(place).collect(),
        cameras: naming.cameras,
        named: rig,
        timing: if moment { Timing::Moment } else { Timing::Numbers },
    }
}

/// One time: every image has a place of its own, and is its own camera.
pub(super) fn moment(names: &[&str]) -> FrameOrder {
    let stem = |name: &str| name.rsplit_once('.').map_or(name, |(stem, _)| stem).to_owned();
    let short = |name: &str| stem(name.rsplit_once('/').map_or(name, |(_, file)| file));
    let distinct = names.iter().map(|n| short(n)).collect::<BTreeSet<_>>().len() == names.len();
    let full: Vec<String> = names.iter().map(|n| if distinct { short(n) } else { stem(n) }).collect();
    let sorted: BTreeMap<(&str, usize), usize> = full.iter().enumerate().map(|(i, n)| ((n.as_str(), i), i)).collect();
    let mut frames = vec![(0, 0, 0.0); names.len()];
    sorted.values().enumerate().for_each(|(camera, &i)| frames[i].0 = camera);
    let cameras = sorted.keys().map(|(name, _)| (*name).to_owned()).collect();
    FrameOrder { cameras, frames, named: false, timing: Timing::Moment }
}

/// Fixed cameras whose names specify otherwise (`0001/cam00.png`, `cam00_0001.png`): every pose repeats to the last
/// bit, as that of no photo does. `None`: some do not.
fn repeated(names: &[&str], poses: &[Se3], fps: f64) -> Option<FrameOrder> {
    let bits = |p: &Se3| p.rotation.iter().flatten().chain(&p.translation).map(|v| v.to_bits()).collect::<Vec<u64>>();
    let mut views: BTreeMap<Vec<u64>, Vec<usize>> = BTreeMap::new();
    (0..names.len()).for_each(|i| views.entry(bits(&poses[i])).or_default().push(i));
    if views.len() < 2 || views.values().any(|view| view.len() < 2) {
        return None;
    }
    let mut views: Vec<Vec<usize>> = views.into_values().collect();
    views.iter_mut().for_each(|view| view.sort_by_key(|&i| names[i]));
    views.sort_by_key(|view| names[view[0]]);
    let numbers = frame_numbers(names, &views);
    let first = numbers.iter().min().copied().unwrap_or(0);
    let mut frames = vec![(0, 0, 0.0); names.len()];
    for (camera, view) in views.iter().enumerate() {
        for &i in view {
            let number = numbers[i] - first;
            frames[i] = (camera, number, number as f64 / fps);
        }
    }
    let cameras = (0..views.len()).map(|i| format!("view{i:03}")).collect();
    Some(FrameOrder { cameras, frames, named: false, timing: Timing::Numbers })
}

/// The number of each image's frame: the one in its name that differs between the images of a view and is found in
/// other views too; without such a number, its place among the images of its view.
fn frame_numbers(names: &[&str], views: &[Vec<usize>]) -> Vec<usize> {
    let all: Vec<Vec<usize>> = names
        .iter()
        .map(|n| n.split(|c: char| !c.is_ascii_digit()).filter_map(|digits| digits.parse().ok()).collect())
        .collect();
    let places = all.iter().map(Vec::len).min().unwrap_or(0);
    let counts_frames = |place: &usize| {
        let of = |view: &Vec<usize>| view.iter().map(|&i| all[i][*place]).collect::<BTreeSet<usize>>();
        let known: Vec<BTreeSet<usize>> = views.iter().map(of).collect();
        let span = || known.iter().flatten().max().zip(known.iter().flatten().min()).map_or(0, |(a, b)| a - b);
        known.iter().zip(views).all(|(numbers, view)| numbers.len() == view.len())
            && known.windows(2).all(|w| !w[0].is_disjoint(&w[1]))
            && span() <= rig::MAX_SPAN
    };
    let same_length = all.iter().all(|numbers| numbers.len() == places);
    match (0..places).find(|place| same_length && counts_frames(place)) {
        Some(place) => all.iter().map(|numbers| numbers[place]).collect(),
        None => {
            let mut out = vec![0; names.len()];
            views.iter().for_each(|view| view.iter().enumerate().for_each(|(rank, &i)| out[i] = rank));
            out
        }
    }
}

/// Whether the images are frames of one camera's film: it never moves, or they are numbered evenly as films are.
fn is_film(group: &[usize], names: &[&str], poses: &[Se3]) -> bool {
    let words: BTreeSet<Option<&str>> = group.iter().map(|&i| film_word(names[i])).collect();
    let numbers: BTreeSet<usize> = group.iter().filter_map(|&i| rig::trailing_number(names[i])).collect();
    let mut steps: BTreeMap<usize, usize> = BTreeMap::new();
    numbers.iter().zip(numbers.iter().skip(1)).for_each(|(a, b)| *steps.entry(b - a).or_default() += 1);
    let most = steps.values().max().copied().unwrap_or(0) as f64;
    let numbered = words.len() == 1 && !words.contains(&None) && numbers.len() == group.len();
    still(group, poses) || numbered && most >= EVEN * (group.len() - 1) as f64
}

fn still(group: &[usize], poses: &[Se3]) -> bool {
    group.len() > 1 && group.iter().all(|&i| poses[i] == poses[group[0]])
}

/// The word before the number of an image's name, if it is one that frames have.
fn film_word(name: &str) -> Option<&str> {
    let file = name.rsplit_once('/').map_or(name, |(_, file)| file);
    let word = word_before_number(file.rsplit_once('.').map_or(file, |(stem, _)| stem))?;
    let known = FILM_WORDS.contains(&word.to_ascii_lowercase().as_str());
    (known && word != PHOTO_WORD).then_some(word)
}

/// Whether Nerfstudio gave an image its name.
fn is_renamed(name: &str) -> bool {
    let file = name.rsplit_once('/').map_or(name, |(_, file)| file);
    let number = file.rsplit_once('.').map_or(file, |(stem, _)| stem).strip_prefix(RENAMED.0);
    number.is_some_and(|n| n.len() == RENAMED.1 && n.bytes().all(|b| b.is_ascii_digit()))
}

/// Whether images are called by the cameras of a rig (`cam07`).
pub(super) fn are_cameras(stems: &[String]) -> bool {
    let known = |word: &str| CAMERA_WORDS.contains(&word.to_ascii_lowercase().as_str());
    stems.iter().all(|stem| word_before_number(stem).is_some_and(known))
}

/// Whether names are those of a rig's cameras: one word before different numbers (`cam07`, `gopro1`), or numbers alone.
pub(super) fn name_a_rig(cameras: &[String]) -> bool {
    let words: BTreeSet<Option<&str>> = cameras.iter().map(|name| word_before_number(name)).collect();
    words.len() == 1 && !words.contains(&None)
}

/// The last word of a name before the number that it ends in; `None`: it ends in none.
fn word_before_number(stem: &str) -> Option<&str> {
    let before = stem.trim_end_matches(|c: char| c.is_ascii_digit());
    let apart = |c: char| matches!(c, '_' | '-' | ' ' | '.');
    let word = before.trim_end_matches(apart).rsplit(apart).next().unwrap_or_default();
    (before.len() < stem.len()).then_some(word)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn camera_rigs_are_distinguished_from_photos() {
        let are = |names: &[&str]| are_cameras(&names.iter().map(|n| (*n).to_owned()).collect::<Vec<_>>());
        assert!(are(&["cam00", "cam_01"]) && are(&["left-camera2", "Camera 10"]));
        assert!(!are(&["cam00", "IMG_1234"]) && !are(&["webcam"]) && !are(&["20240212_003919"]) && !are(&["cam"]));
    }

    fn poses(count: usize) -> Vec<Se3> {
        let at =
            |i: usize| Se3 { translation: [i as f64, 0.0, 1.0], ..Se3::look_at([0.0; 3], [1.0; 3], [0.0, 0.0, 1.0]) };
        (0..count).map(at).collect()
    }

    fn timing(names: &[String]) -> (Timing, usize, usize, usize) {
        let names: Vec<&str> = names.iter().map(String::as_str).collect();
        let (mut warnings, mut notes) = (Vec::new(), Vec::new());
        let order = order(&names, &poses(names.len()), Sequence::Auto, 30.0, &mut warnings, &mut notes);
        assert!(warnings.len() + notes.len() <= 1);
        (order.timing, order.cameras.len(), warnings.len(), notes.len())
    }

    fn numbered(count: usize, name: impl Fn(usize) -> String) -> Vec<String> {
        (0..count).map(name).collect()
    }

    #[test]
    fn names_distinguish_photos_from_videos() {
        let films: [&dyn Fn(usize) -> String; 7] = [
            &|i| format!("frame_{:04}.png", i + 1),
            &|i| format!("{i:06}.jpg"),
            &|i| format!("images/image{:06}.png", i + 1),
            &|i| format!("img{:03}.png", 5 * i),
            &|i| format!("take/walk-frame-{i}.jpg"),
            // A few were not registered.
            &|i| format!("frame_{}.png", i + i / 4),
            &|i| format!("Frame{i}.png"),
        ];
        for name in films {
            assert_eq!(timing(&numbered(12, name)), (Timing::Numbers, 1, 1, 0), "{}", name(0));
        }
        let photos: [&dyn Fn(usize) -> String; 8] = [
            &|i| format!("cam{i:02}.png"),
            &|i| format!("IMG_{}.JPG", i + 1234),
            &|i| format!("DSC{:05}.jpg", i + 7),
            &|i| format!("20240212_{:06}.jpg", 3919 + i),
            &|i| format!("r_{i}.png"),
            &|i| format!("{}.png", i * i),
            &|i| format!("view-{}.png", char::from(b'a' + i as u8)),
            &|i| format!("photos/P10{i:02}.jpg"),
        ];
        for name in photos {
            assert_eq!(timing(&numbered(12, name)), (Timing::Moment, 12, 0, 1), "{}", name(0));
        }
    }

    #[test]
    fn rigs_number_their_frames_or_show_one_time() {
        let rig = |name: &dyn Fn(usize, usize) -> String| numbered(12, |i| name(i / 4, i % 4));
        assert_eq!(timing(&rig(&|c, t| format!("cam{c}/{t:04}.png"))), (Timing::Numbers, 3, 0, 0));
        assert_eq!(timing(&rig(&|c, t| format!("side{c}/DSC{t}.png"))), (Timing::Moment, 12, 0, 1));
        // Two walks, or two cameras that move.
        assert_eq!(timing(&rig(&|c, t| format!("take{c}/{t:04}.png"))), (Timing::Numbers, 3, 1, 0));
        let one_each = numbered(5, |c| format!("cam{c}/IMG_{}.png", c + 20));
        assert_eq!(timing(&one_each), (Timing::Moment, 5, 0, 0));
        assert_eq!(timing(&["a/1.png".to_owned()]).0, Timing::Numbers, "one picture is one moment either way");
    }

    #[test]
    fn cameras_of_a_time_are_named_by_their_images() {
        let order = moment(&["images/b.png", "images/a.jpg"]);
        assert_eq!((order.cameras, order.frames), (vec!["a".into(), "b".into()], vec![(1, 0, 0.0), (0, 0, 0.0)]));
        assert_eq!(moment(&["x/a.png", "y/a.png"]).cameras, ["x/a", "y/a"]);
    }

    #[test]
    fn a_camera_that_never_moves_makes_a_film_whatever_the_names() {
        let (mut warnings, mut notes) = (Vec::new(), Vec::new());
        let still =
            order(&["IMG_7.png", "IMG_9.png"], &[poses(1)[0]; 2], Sequence::Auto, 10.0, &mut warnings, &mut notes);
        assert_eq!((still.timing, still.frames), (Timing::Numbers, vec![(0, 0, 0.0), (0, 2, 0.2)]));
        assert!(warnings.is_empty() && notes.is_empty());
    }

    #[test]
    fn poses_that_repeat_are_those_of_fixed_cameras_whatever_the_names() {
        let places = poses(3);
        let of = |name: &dyn Fn(usize, usize) -> String, sequence: Sequence| {
            let names: Vec<String> = (0..12).map(|i| name(i / 4, 2 * (i % 4))).collect();
            let names: Vec<&str> = names.iter().map(String::as_str).collect();
            let of_each: Vec<Se3> = (0..12).map(|i| places[i / 4]).collect();
            let (mut warnings, mut notes) = (Vec::new(), Vec::new());
            let found = order(&names, &of_each, sequence, 10.0, &mut warnings, &mut notes);
            assert!(warnings.is_empty(), "{warnings:?}");
            (found.timing, found.cameras.len(), found.frames[7], notes.concat().contains("3 fixed cameras"))
        };
        let by_time: [&dyn Fn(usize, usize) -> String; 4] = [
            &|c, t| format!("{:04}/cam{c:02}.png", t + 3),
            &|c, t| format!("frame_{t:04}/{c}.png"),
            &|c, t| format!("cam{c}_{t:04}.png"),
            &|c, t| format!("{t:04}_left{c}.png"),
        ];
        for name in by_time {
            let found = of(name, Sequence::Auto);
            assert_eq!(found, (Timing::Numbers, 3, (1, 6, 0.6), true), "{}", name(0, 0));
        }
        // Numbers that no two views share carry no information: the order counts.
        let apart = of(&|c, t| format!("DSC{:04}.png", 100 * c + 7 * t), Sequence::Auto);
        assert_eq!(apart, (Timing::Numbers, 3, (1, 3, 0.3), true));
        assert_eq!(of(by_time[0], Sequence::Photos).0, Timing::Moment);
    }

    #[test]
    fn stated_times_override_names() {
        let (names, poses) = (["frame_1.png", "frame_2.png", "frame_3.png"], poses(3));
        let mut said = (Vec::new(), Vec::new());
        let mut of = |names, sequence| order(names, &poses, sequence, 30.0, &mut said.0, &mut said.1);
        assert_eq!(of(&names, Sequence::Photos).timing, Timing::Moment);
        assert_eq!(of(&["IMG_1.png", "IMG_5.png", "IMG_7.png"], Sequence::Video).frames[2], (0, 6, 0.2));
        assert_eq!(said, (Vec::new(), Vec::new()), "what the user said needs no comment");
    }
}
