//! Keypoints of people in the images of cameras, as detectors write them: a file a frame (OpenPose and all that write its
//! layout), or a list of results a camera (COCO, AlphaPose).

use crate::{Error, Result};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Largest file, bytes: ten people in a hundred thousand frames are less.
const LARGEST: u64 = 512 << 20;
/// Most keypoints of a person: a whole body with face and hands has 133 to 137.
const MOST_KEYPOINTS: usize = 1000;
/// Endings of folders and files behind a camera's name.
const ENDINGS: [&str; 4] = ["", "_json", "_keypoints", "_pose"];

/// Keypoints of a person in an image: pixel position (the first pixel's centre is at 0.5) and confidence from 0 to 1.
pub(crate) type Person = Vec<[f64; 3]>;

/// People in the frames of one camera, by number of the frame in its video, from 0.
pub(crate) type Frames = BTreeMap<usize, Vec<Person>>;

/// Reads the keypoints of cameras in a folder with a folder or a file for each of them: `NAME/`, `NAME_json/`, `NAME.json`.
///
/// Errors: a camera without keypoints; files that are not JSON, or have another layout.
pub(crate) fn read_keypoints(folder: &Path, names: &[&str]) -> Result<Vec<Frames>> {
    names.iter().map(|name| of_camera(folder, name)).collect()
}

fn of_camera(folder: &Path, name: &str) -> Result<Frames> {
    let there = ENDINGS.iter().map(|ending| folder.join(format!("{name}{ending}")));
    for path in there {
        if path.is_dir() {
            return of_files(&path);
        }
        let file = PathBuf::from(format!("{}.json", path.display()));
        if file.is_file() {
            return numbered(list(&parse(&file)?).map_err(|e| e.at(file.display()))?);
        }
    }
    Err(Error::input(format!("no keypoints of camera {name}"))
        .at(folder.display())
        .remedy(format!("Name the folder of its files {name} or {name}_json, or its file {name}.json.")))
}

/// A file a frame.
fn of_files(folder: &Path) -> Result<Frames> {
    let read = |e: std::io::Error| Error::io("the folder cannot be read", e).at(folder.display());
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(read)? {
        let path = entry.map_err(read)?.path();
        if path.extension().is_some_and(|e| e.eq_ignore_ascii_case("json")) {
            files.push(path);
        }
    }
    files.sort();
    let mut frames = Vec::with_capacity(files.len());
    for path in files {
        let name = path.file_stem().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let number = number(&name).ok_or_else(|| {
            Error::input("the file's name contains no frame number").at(path.display()).remedy("Name it 000012.json.")
        })?;
        let people = parse(&path)?;
        let people = people["people"].as_array().ok_or_else(|| {
            Error::input("invalid keypoints: expected a list `people`")
                .at(path.display())
                .remedy("Give the files of one frame each that OpenPose writes with --write_json.")
        })?;
        let person = |p: &Value| triples(&p["pose_keypoints_2d"], OPENPOSE_CENTER);
        let people = people.iter().map(person).collect::<Result<Vec<Person>>>().map_err(|e| e.at(path.display()))?;
        frames.push((number, people));
    }
    numbered(frames)
}

/// OpenPose and COCO have the first pixel's centre at 0.
const OPENPOSE_CENTER: f64 = 0.5;

/// Results of a camera's images: a list of people, each with its image, or a data set with lists of both.
fn list(value: &Value) -> Result<Vec<(usize, Vec<Person>)>> {
    let invalid = |what: &str| {
        Error::input(format!("invalid keypoints: {what}"))
            .remedy("Give COCO results: a list of {\"image_id\": ..., \"keypoints\": [x, y, score, ...]}.")
    };
    let all = value.as_array().or_else(|| value["annotations"].as_array());
    let all = all.ok_or_else(|| invalid("expected a list of people"))?;
    let mut named = BTreeMap::new();
    for image in value["images"].as_array().into_iter().flatten() {
        if let (Some(id), Some(file)) = (image["id"].as_u64(), image["file_name"].as_str()) {
            named.insert(id, file.to_owned());
        }
    }
    let mut frames: BTreeMap<usize, Vec<Person>> = BTreeMap::new();
    for person in all {
        let id = &person["image_id"];
        let by_name = id.as_u64().and_then(|id| named.get(&id)).map(String::as_str).or(id.as_str());
        let at = match by_name {
            Some(file) => number(file.rsplit_once('.').map_or(file, |(stem, _)| stem)),
            None => id.as_u64().and_then(|id| usize::try_from(id).ok()),
        };
        let at = at.ok_or_else(|| invalid("a person has no `image_id` with a frame number"))?;
        frames.entry(at).or_default().push(triples(&person["keypoints"], OPENPOSE_CENTER)?);
    }
    Ok(frames.into_iter().collect())
}

/// The last number in a name, `_keypoints` aside.
fn number(name: &str) -> Option<usize> {
    let digits = |c: char| !c.is_ascii_digit();
    name.rsplit(digits).find(|part| !part.is_empty())?.parse().ok()
}

/// Frames by number; those of files that begin with 1 are one less. Errors: two files of one frame.
fn numbered(frames: Vec<(usize, Vec<Person>)>) -> Result<Frames> {
    let first = frames.iter().map(|f| f.0).min().unwrap_or(0);
    let mut out = Frames::new();
    for (number, people) in frames {
        if out.insert(number - usize::from(first == 1), people).is_some() {
            return Err(Error::input(format!("two files contain frame {number}")).remedy("Remove one of them."));
        }
    }
    Ok(out)
}

/// x, y and confidence, one after the other. Points that were not found have no confidence. Confidences above 1 are
/// visibilities of COCO's annotations: 1 and 2 are seen.
fn triples(value: &Value, center: f64) -> Result<Person> {
    let invalid = |what: String| Error::input(format!("invalid keypoints: {what}"));
    let numbers = value.as_array().ok_or_else(|| invalid("a person has none".into()))?;
    if !numbers.len().is_multiple_of(3) || numbers.len() > 3 * MOST_KEYPOINTS {
        return Err(invalid(format!(
            "expected x, y and confidence of at most {MOST_KEYPOINTS}, found {} numbers",
            numbers.len()
        )));
    }
    let number =
        |v: &Value| v.as_f64().filter(|x| x.is_finite()).ok_or_else(|| invalid(format!("{v:.40} is not a number")));
    let point = |p: &[Value]| -> Result<[f64; 3]> {
        let [x, y, confidence] = [number(&p[0])?, number(&p[1])?, number(&p[2])?];
        Ok([x + center, y + center, confidence.clamp(0.0, 1.0)])
    };
    numbers.chunks_exact(3).map(point).collect()
}

fn parse(path: &Path) -> Result<Value> {
    let size = std::fs::metadata(path).map_err(|e| Error::io("cannot be read", e).at(path.display()))?.len();
    if size > LARGEST {
        return Err(Error::input(format!(
            "invalid keypoints: the file has {} MB, at most {} are read",
            size >> 20,
            LARGEST >> 20
        ))
        .at(path.display()));
    }
    let text = splat4d_train::files::read_text(path)?;
    serde_json::from_str(&text).map_err(|e| {
        Error::input(format!("invalid keypoints: {e}")).at(path.display()).remedy("Give the JSON files of a detector.")
    })
}

#[cfg(test)]
mod tests;
