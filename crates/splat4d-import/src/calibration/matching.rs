//! Which video is which camera's.

use super::{Calibrated, Calibration, same_name};
use splat4d::{Error, Result};

/// A video that a camera is searched for.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Video<'a> {
    /// Its name.
    pub name: &'a str,
    /// Pixels across and down of its upright images.
    pub size: [usize; 2],
}

/// For every video the number of its camera, and sentences about what was assumed.
///
/// By name; else by a word of the video's name that is a camera's name; else, where cameras have nothing but numbers,
/// by the number in the video's name. Never by order alone.
///
/// Errors: a video without a camera; names that fit several.
pub(crate) fn assign(calibration: &Calibration, videos: &[Video<'_>]) -> Result<(Vec<usize>, Vec<String>)> {
    let cameras = &calibration.cameras;
    let exact: Vec<Vec<usize>> = videos.iter().map(|v| named(cameras, &|name| same_name(name, v.name))).collect();
    if let Some(found) = sure(&exact) {
        return Ok((found, unused(cameras, videos, &exact)));
    }
    if exact.iter().all(Vec::is_empty) {
        let words: Vec<Vec<usize>> = videos
            .iter()
            .map(|v| {
                let own: Vec<String> = words(v.name).collect();
                named(cameras, &|name| own.iter().any(|w| same_name(w, name)))
            })
            .collect();
        if let Some(found) = sure(&words) {
            let mut notes = unused(cameras, videos, &words);
            notes.push(format!(
                "Cameras of the calibration were found in the videos' names: {}.",
                pairs(cameras, videos, &found)
            ));
            return Ok((found, notes));
        }
        if let Some(found) = by_number(cameras, videos) {
            let pairs = pairs(cameras, videos, &found);
            let note =
                format!("The calibration has numbers and no names; they are taken for the videos' numbers: {pairs}.");
            return Ok((found, vec![note]));
        }
    }
    let list = |names: Vec<&str>| names.join(", ");
    let own = list(cameras.iter().map(|c| c.names[0].as_str()).collect());
    let all = list(videos.iter().map(|v| v.name).collect());
    let open: Vec<&str> = videos.iter().zip(&exact).filter(|(_, e)| e.len() != 1).map(|(v, _)| v.name).collect();
    Err(Error::input(format!("these videos have no camera in the calibration: {}", list(open))).remedy(format!(
        "Videos are {all}; cameras of the calibration are {own}. Call the videos (or the calibration's cameras) alike: which \
         video is whose is not guessed. Or leave a video out (use = false in import.toml)."
    )))
}

fn named(cameras: &[Calibrated], fits: &dyn Fn(&str) -> bool) -> Vec<usize> {
    let of = |(k, c): (usize, &Calibrated)| c.names.iter().any(|n| fits(n)).then_some(k);
    cameras.iter().enumerate().filter_map(of).collect()
}

/// One camera for every video, without duplicates.
fn sure(found: &[Vec<usize>]) -> Option<Vec<usize>> {
    let all: Vec<usize> =
        found.iter().map(|f| <[usize; 1]>::try_from(f.as_slice()).ok().map(|f| f[0])).collect::<Option<_>>()?;
    let mut once = all.clone();
    once.sort_unstable();
    once.dedup();
    (once.len() == all.len()).then_some(all)
}

/// The words of a name: the parts between spaces, dashes and the like.
fn words(name: &str) -> impl Iterator<Item = String> + '_ {
    name.split(|c: char| !c.is_alphanumeric()).filter(|w| !w.is_empty()).map(str::to_owned)
}

/// The number at the end of a name, if there is one.
fn number(name: &str) -> Option<u64> {
    let digits = name.len() - name.trim_end_matches(|c: char| c.is_ascii_digit()).len();
    name[name.len() - digits..].parse().ok()
}

/// By number, where all names of cameras are one word and a number, and videos have the same numbers (or all one more
/// or less).
fn by_number(cameras: &[Calibrated], videos: &[Video<'_>]) -> Option<Vec<usize>> {
    let plain = |name: &str| -> Option<u64> {
        let rest = name.trim_end_matches(|c: char| c.is_ascii_digit()).trim_end_matches(['_', '-', ' ']).to_lowercase();
        // What programs call cameras without names.
        ["", "cam", "camera", "port"].contains(&rest.as_str()).then(|| number(name))?
    };
    let own: Vec<u64> = cameras.iter().map(|c| plain(&c.names[0])).collect::<Option<_>>()?;
    let all: Vec<u64> = videos.iter().map(|v| number(v.name)).collect::<Option<_>>()?;
    let sorted = |v: &[u64]| {
        let mut v = v.to_vec();
        v.sort_unstable();
        v
    };
    let (a, b) = (sorted(&own), sorted(&all));
    if a.windows(2).any(|w| w[0] == w[1]) || b.windows(2).any(|w| w[0] == w[1]) {
        return None;
    }
    let shift = i128::from(*b.first()?) - i128::from(*a.first()?);
    let alike = a.len() == b.len() && a.iter().zip(&b).all(|(x, y)| i128::from(*x) + shift == i128::from(*y));
    if !alike || shift.abs() > 1 {
        return None;
    }
    all.iter().map(|n| own.iter().position(|o| i128::from(*o) + shift == i128::from(*n))).collect()
}

fn pairs(cameras: &[Calibrated], videos: &[Video<'_>], found: &[usize]) -> String {
    let one = |(v, &k): (&Video<'_>, &usize)| format!("{} is {}", v.name, cameras[k].names[0]);
    videos.iter().zip(found).map(one).collect::<Vec<_>>().join(", ")
}

fn unused(cameras: &[Calibrated], videos: &[Video<'_>], found: &[Vec<usize>]) -> Vec<String> {
    let left: Vec<&str> = (0..cameras.len())
        .filter(|k| !found.iter().any(|f| f.contains(k)))
        .map(|k| cameras[k].names[0].as_str())
        .collect();
    if left.is_empty() || videos.is_empty() {
        return Vec::new();
    }
    vec![format!("Cameras of the calibration without a video: {}.", left.join(", "))]
}
