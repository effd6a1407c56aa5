//! Sound from a file to the playback file, its edits and films; and from videos to their capture, in time.

use crate::convert::moving;
use crate::import::{have_ffmpeg, heard};
use crate::sample::splat4d;
use crate::str;
use splat4d::format::playback::{Sound, sound};
use splat4d::format::scene;
use splat4d::layers::Scene;
use std::path::{Path, PathBuf};
use std::process::Command;
use tempfile::TempDir;

/// Samples per second that sounds are compared at.
const RATE: f64 = 16_000.0;
/// Largest difference of where sound is and where it belongs, seconds: a tenth of what viewers notice.
const OFF: f64 = 0.004;

/// What a file with sound gives, as one channel.
pub(crate) fn decoded(file: &Path) -> Vec<f64> {
    let args = ["-ac", "1", "-ar", "16000", "-f", "s16le", "-"];
    let out = Command::new("ffmpeg").args(["-v", "error", "-i"]).arg(file).args(args).output().unwrap();
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    out.stdout.as_chunks::<2>().0.iter().map(|b| f64::from(i16::from_le_bytes(*b))).collect()
}

/// Seconds of the world of [`heard`] at which a sound begins, searched near `near`, by cross-correlation.
pub(crate) fn begins(samples: &[f64], near: f64) -> f64 {
    let world: Vec<f64> =
        heard(0.0, 6.0, 0)[44..].as_chunks::<2>().0.iter().map(|b| f64::from(i16::from_le_bytes(*b))).collect();
    let samples = &samples[..samples.len().min(world.len())];
    let at = |lag: i64| {
        let pairs =
            samples.iter().enumerate().filter_map(|(i, s)| Some(s * world.get(usize::try_from(i as i64 + lag).ok()?)?));
        pairs.sum::<f64>()
    };
    let middle = (near * RATE).round() as i64;
    let best = (middle - 1600..=middle + 1600).max_by(|a, b| at(*a).total_cmp(&at(*b))).unwrap();
    best as f64 / RATE
}

fn of(file: &Path) -> Option<Sound> {
    sound(&std::fs::read(file).unwrap()).unwrap()
}

/// A moving scene and three seconds of sound, in a folder where `file` is not written yet.
struct Taken {
    work: TempDir,
    birds: PathBuf,
    wave: PathBuf,
    file: PathBuf,
    made: Scene,
}

fn taken() -> Taken {
    let work = tempfile::tempdir().unwrap();
    let at = |name: &str| work.path().join(name);
    let (birds, wave, file) = (at("birds.safetensors"), at("sound.wav"), at("birds.s4d"));
    let (made, mut bytes) = (moving(), Vec::new());
    scene::write(&made, &mut bytes).unwrap();
    std::fs::write(&birds, bytes).unwrap();
    std::fs::write(&wave, heard(0.0, 3.0, 0)).unwrap();
    Taken { work, birds, wave, file, made }
}

#[test]
fn sound_is_baked_kept_cut_and_left_out() {
    if !have_ffmpeg() {
        return;
    }
    let Taken { work, birds, wave, file, made } = taken();
    let at = |name: &str| work.path().join(name);
    let end = made.clip[1] + 1.0 / made.fps;
    let told = splat4d(&["bake", str(&birds), "-o", str(&file), "--sound", str(&wave)]).run().ok();
    assert!(told.contains("sound.wav: its first") && told.contains("kbit/s"), "{told}");
    let own = of(&file).unwrap();
    assert!(own.span[0] == made.clip[0] && (own.span[1] - end).abs() < 0.03, "{:?} of {end}", own.span);
    let put = |sound: &Sound, name: &str| {
        std::fs::write(at(name), &sound.mp4).unwrap();
        decoded(&at(name))
    };
    assert!((begins(&put(&own, "own.m4a"), 0.0)).abs() < OFF);
    let told = splat4d(&["info", str(&file)]).run().ok();
    assert!(told.contains("\nsound ") && told.contains("kbit/s"), "{told}");
    splat4d(&["info", str(&file), "--strict"]).run().ok();

    // Kept as it is, or left out with a word.
    let again = at("again.s4d");
    splat4d(&["convert", str(&file), str(&again)]).run().ok();
    assert_eq!(of(&again), Some(own.clone()));
    let told = splat4d(&["convert", str(&file), str(&at("one.ply")), "--time", "0.5"]).run().ok();
    assert!(told.contains("the sound is left out"), "{told}");
    for (more, says) in [(["--sound", "none"], ""), (["--repeat", "2"], "the sound is left out")] {
        let told = splat4d(&["bake", str(&file), "-o", str(&again)]).args(&more).run().ok();
        assert!(of(&again).is_none() && told.contains(says), "{told}");
    }

    // Cut with its clip, and silent where time runs otherwise.
    let edit = |text: &str| {
        std::fs::write(at("edits.toml"), format!("version = 1\n[[edit]]\n{text}")).unwrap();
        let told = splat4d(&["edit", str(&file), str(&at("edits.toml")), "-o", str(&again)]).run().ok();
        (told, of(&again))
    };
    let (told, cut) = edit("do = \"cut\"\nfrom = 0.25\nto = 0.75");
    let cut = cut.unwrap_or_else(|| panic!("{told}"));
    assert!(told.contains("the sound is cut to 0.250"), "{told}");
    assert!(cut.span[0] == 0.25 && (cut.span[1] - 0.75 - 1.0 / made.fps).abs() < 0.03, "{:?}", cut.span);
    assert!((begins(&put(&cut, "cut.m4a"), 0.25) - 0.25).abs() < OFF);
    let (told, none) = edit("do = \"retime\"\nrate = 2");
    assert!(none.is_none() && told.contains("changes the speed of time"), "{told}");

    // Refused before anything is written.
    let told = splat4d(&["bake", str(&file), "-o", str(&again), "--size", "1KB"]).run().refused();
    assert!(told.contains("the sound alone"), "{told}");
    let told = splat4d(&["bake", str(&birds), "-o", str(&again), "--sound", str(&at("none.wav"))]).run().refused();
    assert!(told.contains("none.wav: cannot be read"), "{told}");
    let told = splat4d(&["bake", str(&birds), "-o", str(&again), "--sound", str(&at("edits.toml"))]).run().refused();
    assert!(told.contains("edits.toml"), "{told}");
}

#[test]
fn films_in_real_time_have_sound() {
    if !have_ffmpeg() {
        return;
    }
    let Taken { work, birds, wave, file, .. } = taken();
    let at = |name: &str| work.path().join(name);
    splat4d(&["bake", str(&birds), "-o", str(&file), "--sound", str(&wave)]).run().ok();
    let film = |name: &str, more: &[&str]| {
        let out = at(name);
        let told = splat4d(&["render", str(&file), "-o", str(&out), "--size", "32x24"]).args(more).run().ok();
        (told, out)
    };
    // An orbit of a short clip is slower than the clip, unless its length is stated.
    let (_, whole) = film("whole.mp4", &["--seconds", "1"]);
    assert!(begins(&decoded(&whole), 0.0).abs() < OFF);
    let (_, later) = film("later.mp4", &["--from", "0.4", "--seconds", "0.6"]);
    assert!((begins(&decoded(&later), 0.4) - 0.4).abs() < OFF);
    for (name, more) in
        [("slow.mp4", &["--slow-motion", "2"][..]), ("frozen.mp4", &["--freeze", "0.5"]), ("film.png", &[])]
    {
        let (told, _) = film(name, more);
        assert!(told.contains("the sound is left out"), "{name}: {told}");
    }
}
