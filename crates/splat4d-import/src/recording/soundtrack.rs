//! The sound that is kept with the capture: which camera's, and which part of it.

use super::poses::Solved;
use super::{Camera, Request};
use crate::sync::median;
use crate::sync::sound::{self, SoundTrack};
use crate::video::{SOUND_RATE, Tools, encode, samples};
use crate::write::Placed;
use crate::{Error, Result};
use splat4d::format::playback::Sound;
use splat4d_train::event::Progress;
use splat4d_train::output::Staged;
use std::path::{Path, PathBuf};

/// The file in the capture's folder.
pub(super) const FILE: &str = "sound.m4a";
/// A track with less of the clip than this share is chosen only if none has more.
const WHOLE: f64 = 0.99;
/// Samples as loud as this are cut off by the recorder, and a track with this share of them is distorted.
const FULL: f32 = 0.99;
const CLIPPED: f64 = 1e-4;
/// A track below this level, dB of full scale, is a microphone that was off.
const SILENT: f64 = -70.0;

/// The part of a track that is in the clip.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Level {
    /// Share of the clip that the track covers.
    covers: f64,
    /// Share of the samples that are cut off.
    clipped: f64,
    /// Root mean square, dB of full scale.
    decibels: f64,
}

impl Level {
    /// Of seconds `from` to `to` of a track; none: it is silent there.
    fn of(track: &[f32], [from, to]: [f64; 2]) -> Option<Self> {
        let at = |t: f64| ((t * SOUND_RATE).max(0.0) as usize).min(track.len());
        let part = &track[at(from)..at(to)];
        let count = part.len() as f64;
        let power = part.iter().map(|s| f64::from(*s).powi(2)).sum::<f64>() / count;
        let decibels = 10.0 * power.log10();
        let clipped = part.iter().filter(|s| s.abs() >= FULL).count() as f64 / count;
        (decibels >= SILENT).then_some(Self { covers: count / ((to - from) * SOUND_RATE), clipped, decibels })
    }

    /// Greater is better: of the whole clip, undistorted, loud.
    fn rank(&self) -> (bool, bool, f64) {
        (self.covers >= WHOLE, self.clipped <= CLIPPED, self.decibels)
    }
}

/// Sound, and its place on the clock of all.
struct Track {
    parts: Vec<(PathBuf, Option<usize>, f64)>,
    /// What its seconds are on the clock of all: t·(1 + rate) + offset.
    offset: f64,
    rate: f64,
}

/// Writes the sound of the clip into the folder: that of the best camera, or what the request names. Returns its file
/// and the second of the clock of all at which it begins; a sentence for the report states which it is and why.
///
/// Errors, if the request names a track: it is not there, has no sound or cannot be aligned; no ffmpeg, no space.
pub(super) fn keep(
    request: &Request,
    cameras: &[Camera],
    solved: &Solved,
    placed: &[Placed],
    guesses: &mut Vec<String>,
    progress: &mut Progress<'_>,
) -> Result<Option<(PathBuf, f64)>> {
    let file = request.folder.join(FILE);
    let wanted = request.track.as_deref();
    let kept = match (wanted, clip(placed)) {
        (Some("none"), _) | (_, None) => None,
        (None, _) if !request.sound => None,
        (_, Some(clip)) => match write(wanted, cameras, solved, clip, &file, guesses, progress) {
            // It was not requested, and the capture is complete without it.
            Err(e) if wanted.is_none() => {
                guesses.push(format!("No sound is kept: {e}"));
                None
            }
            written => written?,
        },
    };
    if kept.is_none() {
        // That of an earlier import of these videos.
        let _ = std::fs::remove_file(&file);
    }
    Ok(kept.map(|start| (PathBuf::from(FILE), start)))
}

/// First second of the stored images, and the end of the last one, on the clock of all.
fn clip(placed: &[Placed]) -> Option<[f64; 2]> {
    let ends = |p: &Placed| {
        let shots = &p.pictures.shots;
        Some([p.offset.global(shots.first()?.time), p.offset.global(shots.last()?.time) + p.pictures.clock.interval])
    };
    let all = placed.iter().filter_map(ends).reduce(|a, b| [a[0].min(b[0]), a[1].max(b[1])])?;
    (all[1] > all[0]).then_some(all)
}

fn write(
    wanted: Option<&str>,
    cameras: &[Camera],
    solved: &Solved,
    clip: [f64; 2],
    file: &Path,
    guesses: &mut Vec<String>,
    progress: &mut Progress<'_>,
) -> Result<Option<f64>> {
    let Some((track, why)) = chosen(wanted, cameras, solved, clip, progress)? else { return Ok(None) };
    // Clocks drift: what is exact in the middle is off by half as much at either end.
    let middle = 0.5 * (clip[0] + clip[1]);
    let own = (middle - track.offset) / (1.0 + track.rate);
    let from = own - 0.5 * (clip[1] - clip[0]);
    let late = (-from).max(0.0);
    progress.phase("encoding the sound", 0, 0);
    let staged = Staged::new(file)?;
    encode(&Tools::find()?, &track.parts, [from + late, clip[1] - clip[0] - late], staged.path())?;
    let bytes = std::fs::read(staged.path()).map_err(|e| Error::io("cannot be read", e).at(file.display()))?;
    let start = clip[0] + late;
    let sound = Sound::try_from((start, bytes)).map_err(|e| e.at(file.display()))?;
    staged.keep()?;
    let seconds = sound.span[1] - sound.span[0];
    guesses.push(format!("{why} It lasts {seconds:.1} s of the clip's {:.1} s.", clip[1] - clip[0]));
    Ok(Some(start))
}

/// The track, and a sentence that states which it is and why.
fn chosen(
    wanted: Option<&str>,
    cameras: &[Camera],
    solved: &Solved,
    clip: [f64; 2],
    progress: &mut Progress<'_>,
) -> Result<Option<(Track, String)>> {
    let of = |k: usize| {
        let offset = solved.offset(k);
        Track { parts: cameras[k].source.sounds(), offset: offset.seconds, rate: offset.rate }
    };
    if let Some(k) = wanted.and_then(|name| cameras.iter().position(|c| c.name == name)) {
        let track = of(k);
        if track.parts.is_empty() {
            return Err(Error::input("its sound is to be kept, and it has none")
                .at(format!("camera {}", cameras[k].name))
                .remedy("Name another camera, a file or none with --sound."));
        }
        return Ok(Some((track, format!("The sound of camera {} is kept, as requested.", cameras[k].name))));
    }
    let file = wanted.map(|name| existing(name, cameras)).transpose()?;
    let (mut levels, mut lags, mut heard) = (Vec::new(), Vec::new(), 0);
    let tools = file.map(|_| Tools::find()).transpose()?;
    let own = match (file, &tools) {
        (Some(file), Some(tools)) => {
            let stream = tools.sound_stream(file)?;
            Some((SoundTrack::new(samples(tools, file, stream)?.unwrap_or_default()), stream))
        }
        _ => None,
    };
    for (k, camera) in cameras.iter().enumerate() {
        // Without a place in the rig's time there is no place for its sound.
        let unknown = cameras.len() > 1 && !solved.moving && solved.offsets.get(k).is_none_or(Option::is_none);
        if unknown || camera.source.sounds().is_empty() {
            continue;
        }
        progress.phase("comparing the sound", k, cameras.len());
        let track = match camera.source.sound() {
            Ok(Some(track)) => track,
            Ok(None) => continue,
            Err(e) => {
                progress.warn(format!("camera {}: {e}", camera.name));
                continue;
            }
        };
        let offset = solved.offset(k);
        if let Some((own, _)) = &own {
            // t_own − t_camera = lag, and both are the same second of the clock of all.
            lags.extend(sound::lag(&SoundTrack::new(track), own, None).ok().map(|lag| offset.seconds - lag.at_zero()));
            continue;
        }
        heard += 1;
        let part = clip.map(|t| (t - offset.seconds) / (1.0 + offset.rate));
        levels.extend(Level::of(&track, part).map(|level| (level, k)));
    }
    if let (Some(file), Some((_, stream))) = (file, own) {
        if lags.is_empty() {
            return Err(Error::input("it has nothing in common with the sound of the cameras, so its time is unknown")
                .at(file.display())
                .remedy("Leave --sound out, and give it later: splat4d bake --sound FILE starts it with the clip."));
        }
        let (cameras, offset) = (lags.len(), median(&mut lags));
        let parts = vec![(file.to_owned(), Some(stream), f64::INFINITY)];
        let why = format!("The sound of {} is kept, aligned with that of {cameras} cameras.", file.display());
        return Ok(Some((Track { parts, offset, rate: 0.0 }, why)));
    }
    // Of equals the first.
    let best = levels.iter().rev().max_by(|a, b| {
        let (a, b) = (a.0.rank(), b.0.rank());
        (a.0, a.1).cmp(&(b.0, b.1)).then(a.2.total_cmp(&b.2))
    });
    let Some((level, k)) = best else { return Ok(None) };
    let name = &cameras[*k].name;
    let doubts = [
        (level.covers < WHOLE, format!("covers {:.0} % of the clip", 100.0 * level.covers)),
        (level.clipped > CLIPPED, "is distorted: it clips, as do the others".to_owned()),
    ];
    let doubts: String = doubts.into_iter().filter(|d| d.0).map(|d| format!("; it {}", d.1)).collect();
    let why = format!(
        "The sound of camera {name} is kept: the loudest without clipping of {heard} ({:.0} dB){doubts}. --sound chooses \
         another.",
        level.decibels
    );
    Ok(Some((of(*k), why)))
}

/// A file that `--sound` names. Errors: neither a file nor a camera.
fn existing<'a>(name: &'a str, cameras: &[Camera]) -> Result<&'a Path> {
    let file = Path::new(name);
    if file.is_file() {
        return Ok(file);
    }
    let known: Vec<&str> = cameras.iter().map(|c| c.name.as_str()).collect();
    Err(Error::input(format!("the sound \"{name}\" is neither a file nor a camera"))
        .remedy(format!("Give a file, none, or one of: {}.", known.join(", "))))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tone(level: f32, seconds: f64) -> Vec<f32> {
        (0..(seconds * SOUND_RATE) as usize).map(|i| (level * (0.1 * i as f32).sin()).clamp(-1.0, 1.0)).collect()
    }

    #[test]
    fn the_loudest_track_that_covers_the_clip_without_clipping_ranks_first() {
        let clip = [1.0, 3.0];
        let rank = |track: &[f32]| Level::of(track, clip).map(|l| l.rank());
        let (soft, loud) = (rank(&tone(0.1, 4.0)).unwrap(), rank(&tone(0.5, 4.0)).unwrap());
        let (clipped, short) = (rank(&tone(3.0, 4.0)).unwrap(), rank(&tone(0.9, 2.0)).unwrap());
        assert!(loud > soft && soft > clipped && clipped > short, "{loud:?} {soft:?} {clipped:?} {short:?}");
        assert!((loud.2 - 20.0 * (0.5f64 / 2f64.sqrt()).log10()).abs() < 0.1, "{loud:?}");
        assert_eq!(rank(&tone(0.0, 4.0)), None, "silent");
        assert_eq!(rank(&tone(0.5, 0.5)), None, "ends before the clip");
    }
}
