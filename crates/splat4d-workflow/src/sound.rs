//! Sound of scenes: with a capture, a run or a playback file; converted, cut, and put into films.

use crate::camera_file;
use crate::events::Listener;
use crate::files::{self, human_bytes};
use crate::run_folder::Run;
use splat4d::edit::Step;
use splat4d::format::playback::{self, Sound};
use splat4d::layers::Scene;
use splat4d::scene::time::DEFAULT_FPS;
use splat4d::{Error, Result};
#[cfg(feature = "import")]
use splat4d_import::video::write_sound as convert;
use splat4d_train::output::Staged;
use std::path::{Path, PathBuf};

/// Marker of captures that may name sound (docs/capture-format.md).
const CAPTURE: &str = "capture.json";
/// Name of a run's playback file.
const PLAYBACK: &str = "scene.s4d";
/// A cut that removes less than this is none, seconds.
const NOTHING: f64 = 0.01;

/// Sound of a playback file that is baked.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum SoundChoice {
    /// That of the source.
    #[default]
    Kept,
    /// No sound.
    None,
    /// A file that ffmpeg reads; it begins with the clip and is cut at its end.
    File(PathBuf),
}

/// The sound that a capture names.
///
/// Errors: the file is missing, too large, or not AAC in MP4.
pub(crate) fn of_capture(capture: &Path) -> Result<Option<Sound>> {
    let marker = if capture.is_dir() { capture.join(CAPTURE) } else { capture.to_owned() };
    if marker.file_name().is_none_or(|name| name != CAPTURE) || !marker.is_file() {
        return Ok(None);
    }
    let value = camera_file::json(&files::read_text(&marker)?).map_err(|e| e.at(marker.display()))?;
    let Some(name) = value["sound"]["file"].as_str() else { return Ok(None) };
    let file = marker.parent().unwrap_or(Path::new("")).join(name);
    let start = value["sound"]["start"].as_f64().unwrap_or(0.0);
    Sound::try_from((start, files::read(&file)?)).map(Some).map_err(|e| e.at(file.display()))
}

/// The sound of a run: that of its capture or, where that is gone, of its playback file.
pub(crate) fn of_run(run: &Run) -> Result<Option<Sound>> {
    let file = run.path.join(PLAYBACK);
    match run.capture().filter(|capture| capture.exists()) {
        Some(capture) => of_capture(&capture),
        None if file.is_file() => playback::sound(&files::read(&file)?),
        None => Ok(None),
    }
}

/// Seconds of a clip, its last frame included.
fn seconds(scene: &Scene<f32>) -> f64 {
    let fps = if scene.fps > 0.0 && scene.fps.is_finite() { scene.fps } else { DEFAULT_FPS };
    scene.clip[1] - scene.clip[0] + 1.0 / fps
}

/// The sound that is requested for a scene with this one; `near` is the file that is to be written.
///
/// Errors: a file that cannot be read or has no sound.
pub(crate) fn chosen(
    own: Option<Sound>,
    choice: &SoundChoice,
    scene: &Scene<f32>,
    near: &Path,
    console: &dyn Listener,
) -> Result<Option<Sound>> {
    match choice {
        SoundChoice::Kept => Ok(own),
        SoundChoice::None => Ok(None),
        SoundChoice::File(file) => {
            std::fs::metadata(file).map_err(|e| files::cannot_read(file, e))?;
            console.phase("converting the sound", 0, 0);
            let clip = seconds(scene);
            let sound = part(file, [0.0, clip], scene.clip[0], near)?;
            let length = sound.span[1] - sound.span[0];
            console.clear();
            console.result(&format!("{}: its first {length:.2} s, for a clip of {clip:.2} s", file.display()));
            Ok(Some(sound))
        }
    }
}

/// Seconds `from` to `from + seconds` of a file as the sound that begins at second `start` of the scene.
fn part(file: &Path, [from, seconds]: [f64; 2], start: f64, near: &Path) -> Result<Sound> {
    let staged = Staged::new(&near.with_extension("m4a"))?;
    convert(file, [from, seconds], staged.path())?;
    Sound::try_from((start, files::read(staged.path())?)).map_err(|e| e.at(file.display()))
}

#[cfg(not(feature = "import"))]
fn convert(_: &Path, _: [f64; 2], _: &Path) -> Result<()> {
    Err(crate::parts::left_out("the conversion of sound", "import"))
}

/// The sound of an edited scene: cut as its clip; none where time runs otherwise. A line reports what became of it.
pub(crate) fn edited(
    sound: Sound,
    steps: &[Step],
    scene: &Scene<f32>,
    near: &Path,
    console: &dyn Listener,
) -> Option<Sound> {
    let dropped = |why: &str| {
        console.result(&format!("the sound is left out: {why}"));
        None
    };
    if steps.iter().any(|s| matches!(s, Step::Retime { .. })) {
        return dropped("an edit changes the speed of time; give one with `splat4d bake --sound FILE`");
    }
    let [from, to] = [sound.span[0].max(scene.clip[0]), sound.span[1].min(scene.clip[0] + seconds(scene))];
    if from >= to {
        return dropped("there is none in the new clip");
    }
    if from - sound.span[0] < NOTHING && sound.span[1] - to < NOTHING {
        return Some(sound);
    }
    let cut = || {
        let staged = Staged::new(&near.with_extension("m4a"))?;
        std::fs::write(staged.path(), &sound.mp4).map_err(|e| files::cannot_write(staged.path(), e))?;
        part(staged.path(), [from - sound.span[0], to - from], from, &near.with_extension("cut.m4a"))
    };
    match cut() {
        Ok(sound) => {
            console.result(&format!("the sound is cut to {from:.3} to {to:.3} s"));
            Some(sound)
        }
        Err(e) => dropped(&format!("it could not be cut ({e})")),
    }
}

/// Reports that a file has no place for the scene's sound.
pub(crate) fn dropped(sound: Option<&Sound>, what: &str, console: &dyn Listener) {
    if sound.is_some() {
        console.result(&format!("the sound is left out: {what} has no sound, .s4d and mp4 have"));
    }
}

/// Length, place and rate, for reports.
pub(crate) fn in_words(sound: &Sound) -> String {
    let [from, to] = sound.span;
    let kilobits = sound.mp4.len() as f64 * 8e-3 / (to - from);
    let bytes = human_bytes(sound.mp4.len() as u64);
    format!("{:.2} s from {from:.3} s, {bytes}, {kilobits:.0} kbit/s", to - from)
}

/// Bytes of a file that remain for its Gaussians. Errors: the sound needs all of them.
pub(crate) fn left(sound: Option<&Sound>, most: Option<u64>) -> Result<Option<u64>> {
    let own = sound.map_or(0, |s| s.mp4.len() as u64);
    let left = |most: u64| {
        most.checked_sub(own).filter(|left| *left > 0).ok_or_else(|| {
            Error::input(format!("the sound alone has {}, the file may have {}", human_bytes(own), human_bytes(most)))
                .remedy("Give a larger size, or option `sound` none.")
        })
    };
    most.map(left).transpose()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::events::ignore;

    /// 0.3 s of a tone.
    const TONE: &[u8] = include_bytes!("../../splat4d/tests/data/tone.m4a");

    #[test]
    fn runs_have_the_sound_of_their_capture_and_keep_it_without_the_capture() {
        let work = tempfile::tempdir().unwrap();
        let (capture, run) = (work.path().join("take"), work.path().join("run"));
        [&capture, &run].iter().for_each(|folder| std::fs::create_dir(folder).unwrap());
        let marker = capture.join(CAPTURE);
        std::fs::write(&marker, r#"{"version": 1, "cameras": []}"#).unwrap();
        assert_eq!(of_capture(&capture).unwrap(), None);
        std::fs::write(&marker, r#"{"sound": {"file": "own.m4a", "start": 0.4}}"#).unwrap();
        let missing = of_capture(&capture).unwrap_err().to_string();
        assert!(missing.contains("own.m4a"), "{missing}");
        std::fs::write(capture.join("own.m4a"), TONE).unwrap();
        let sound = of_capture(&marker).unwrap().unwrap();
        assert_eq!((sound.span[0], &*sound.mp4), (0.4, TONE));
        std::fs::write(run.join("run.json"), serde_json::json!({"capture": capture}).to_string()).unwrap();
        assert_eq!(of_run(&Run::open(&run).unwrap()).unwrap().as_ref(), Some(&sound));
        // What is baked has it, also when the capture was moved away.
        let plain = include_bytes!("../../splat4d/tests/data/tiny.s4d");
        let baked = playback::with_extras(plain, None, Some(&sound)).unwrap();
        std::fs::write(run.join(PLAYBACK), baked).unwrap();
        std::fs::rename(&capture, work.path().join("elsewhere")).unwrap();
        assert_eq!(of_run(&Run::open(&run).unwrap()).unwrap(), Some(sound));
    }

    #[test]
    fn sound_takes_part_of_a_size_limit() {
        let sound = Sound::try_from((0.0, TONE.to_vec())).unwrap();
        assert_eq!(left(Some(&sound), Some(10_000)).unwrap(), Some(10_000 - TONE.len() as u64));
        assert!(left(Some(&sound), Some(1000)).unwrap_err().to_string().contains("the sound alone has"));
        assert_eq!(left(None, Some(1000)).unwrap(), Some(1000));
    }

    #[test]
    fn sound_outside_of_a_new_clip_or_of_another_speed_is_left_out() {
        let sound = Sound::try_from((0.0, TONE.to_vec())).unwrap();
        let scene = |clip: [f64; 2]| Scene { clip, fps: 30.0, ..Scene::default() };
        let out = Path::new("never.s4d");
        assert_eq!(edited(sound.clone(), &[], &scene([2.0, 3.0]), out, &ignore), None);
        let twice = [Step::Retime { rate: 2.0, from: None, to: None }];
        assert_eq!(edited(sound.clone(), &twice, &scene([0.0, 0.15]), out, &ignore), None);
        assert_eq!(edited(sound.clone(), &[], &scene([-1.0, 1.0]), out, &ignore), Some(sound));
    }
}
