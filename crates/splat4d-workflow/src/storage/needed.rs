//! The files of a capture that a part of the work does not need.

use serde_json::Value;
use splat4d_train::recipe::Recipe;
use std::collections::BTreeSet;
use std::ops::Range;

/// Files per frame.
const FILES: [&str; 6] = ["images", "masks", "depth", "flow", "labels", "features"];

/// Files of frames outside of `frames`, as a `capture.json` of fixed cameras names them; empty where the capture can
/// only be read as a whole, as in `capture/own.rs`. A frame more on each side is kept. `most`: files of the capture.
pub(super) fn not_needed(capture: &Value, recipe: &Recipe, frames: &[Range<usize>], most: usize) -> BTreeSet<String> {
    let (mut others, mut kept) = (BTreeSet::new(), BTreeSet::new());
    let rule = recipe.get("capture.hold_out").and_then(|v| v.as_str().map(str::to_owned)).unwrap_or_default();
    let stated = &capture["hold_out"];
    let every = if rule.is_empty() {
        stated.as_str().is_some_and(|s| s.contains("every")) || !stated["every"].is_null()
    } else {
        rule.contains("every")
    };
    let cameras = capture["cameras"].as_array().map(Vec::as_slice).unwrap_or_default();
    if every || cameras.len() < 2 {
        return others;
    }
    let is_near = |i: usize| frames.iter().any(|f| (f.start.saturating_sub(1)..f.end + 1).contains(&i));
    for camera in cameras {
        let own = |key: &str| if camera[key].is_null() { &capture[key] } else { &camera[key] };
        let moves = ["world_to_camera", "camera_to_world"].iter().any(|k| camera[*k].pointer("/0/0/0").is_some());
        let start = if own("start").is_null() { Some(0) } else { own("start").as_u64() };
        let (Some(start), Some(count), false) = (start, own("frames").as_u64(), moves) else {
            return BTreeSet::new();
        };
        // More frames than files: the reader reports it.
        if count > most as u64 {
            return BTreeSet::new();
        }
        for name in FILES.iter().filter_map(|key| Names::read(&camera[*key])) {
            for i in 0..count as usize {
                let Some(file) = name.of(start as usize, i) else { break };
                if is_near(i) { &mut kept } else { &mut others }.insert(file);
            }
        }
    }
    others.retain(|file| !kept.contains(file));
    others
}

/// Names of one file per frame.
enum Names<'a> {
    Pattern { before: &'a str, digits: usize, after: &'a str },
    List(&'a [Value]),
}

impl<'a> Names<'a> {
    fn read(value: &'a Value) -> Option<Self> {
        if let Some(list) = value.as_array() {
            return Some(Self::List(list));
        }
        let (before, rest) = value.as_str()?.split_once('%')?;
        let (digits, after) = rest.split_once('d')?;
        let digits = if digits.is_empty() { 0 } else { digits.strip_prefix('0')?.parse().ok()? };
        (digits <= 32).then_some(Self::Pattern { before, digits, after })
    }

    fn of(&self, start: usize, index: usize) -> Option<String> {
        match self {
            Self::List(names) => names.get(index)?.as_str().map(str::to_owned),
            Self::Pattern { before, digits, after } => {
                let (number, digits) = (start.checked_add(index)?, *digits);
                Some(format!("{before}{number:0digits$}{after}"))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn only_files_of_other_frames_are_left_out() {
        let pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]];
        let camera = |name: &str| json!({"name": name, "world_to_camera": pose, "images": format!("{name}/%03d.png"), "masks": format!("m/{name}%d.png")});
        let capture = json!({"frames": 10, "start": 5, "cameras": [camera("a"), camera("b")]});
        let recipe = Recipe::default();
        let found = not_needed(&capture, &recipe, &[0..2, 6..8], 40);
        let frames: Vec<&str> = found.iter().filter_map(|f| f.strip_prefix("a/")).collect();
        assert_eq!(frames, ["008.png", "009.png", "014.png"], "frames 3, 4 and 9");
        assert!(found.contains("m/b8.png") && found.len() == 12);
        let whole = |change: &dyn Fn(&mut Value)| {
            let mut capture = capture.clone();
            change(&mut capture);
            not_needed(&capture, &recipe, &[0..1, 1..2], 40).is_empty()
        };
        assert!(whole(&|c| c["cameras"][1]["world_to_camera"] = json!([pose, pose])), "a camera moves");
        assert!(whole(&|c| c["frames"] = Value::Null), "the number of frames is that of the files");
        assert!(whole(&|c| c["hold_out"] = json!({"every": 8})));
        assert!(whole(&|c| c["cameras"] = json!([c["cameras"][0]])));
        assert!(whole(&|c| *c = json!("no capture")));
        let mut every = Recipe::default();
        every.set("hold_out=every=8").unwrap();
        assert!(not_needed(&capture, &every, &[0..1, 1..2], 40).is_empty());
        assert!(whole(&|c| c["frames"] = json!(u64::MAX)), "no such frames");
    }
}
