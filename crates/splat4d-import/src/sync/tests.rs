//! Lags and offsets of synthetic sound, motion and geometry, where the truth is known.

use super::drawn::{Dance, FPS, Rig};
use super::epipolar::{self, Range};
use super::graph::{Evidence, Kind, Offset, solve};
use super::motion::{self, Motion};
use super::sound::{self, SoundTrack};
use super::tracks::{Track, Tracker, moving};
use super::{Refusal, grey::Grey};
use crate::video::SOUND_RATE;
use splat4d::math::Rng;

const FRAME: f64 = 1.0 / FPS;

// Sound.

/// A person talks and claps: bursts of noise of all lengths, as heard `late` seconds later by a clock that is `drift`
/// fast, with an echo, and noise of the room as loud as the rest times `noise`.
fn heard(seed: u64, seconds: f64, late: f64, drift: f64, noise: f64, ear: u64) -> SoundTrack {
    let source = Rng::new(seed, "a sound", 0);
    let count = ((seconds + 4.0) * SOUND_RATE) as usize;
    let mut dry = vec![0.0f64; count];
    let mut at = 0.1;
    let mut k = 0u64;
    while at < seconds + 3.5 {
        let [gap, length, loud] = [0, 1, 2].map(|i| source.uniform(3 * k + i));
        let (from, decay) = ((at * SOUND_RATE) as usize, (0.004 + 0.05 * length) * SOUND_RATE);
        for i in 0..(5.0 * decay) as usize {
            if let Some(v) = dry.get_mut(from + i) {
                let n = source.fork(k).normal(i as u64);
                *v += (0.3 + loud) * n * (-(i as f64) / decay).exp();
            }
        }
        at += 0.05 + 0.5 * gap;
        k += 1;
    }
    let power = (dry.iter().map(|v| v * v).sum::<f64>() / count as f64).sqrt();
    let room = Rng::new(seed, "noise of a room", ear);
    let at = |t: f64| {
        let x = t * SOUND_RATE;
        let (i, part) = (x.floor(), x - x.floor());
        let value = |i: f64| if i < 0.0 { 0.0 } else { dry.get(i as usize).copied().unwrap_or(0.0) };
        value(i) * (1.0 - part) + value(i + 1.0) * part
    };
    let sample = |i: usize| {
        // What this clock calls t happens at t/(1 + drift) − late.
        let t = i as f64 / SOUND_RATE / (1.0 + drift) - late;
        let echo = 0.4 * at(t - 0.011 - 0.007 * ear as f64);
        (at(t) + echo + noise * power * room.normal(i as u64)) as f32
    };
    SoundTrack::new((0..(seconds * SOUND_RATE) as usize).map(sample).collect())
}

#[test]
fn a_lag_is_heard_through_noise_as_loud_as_the_sound() {
    for late in [0.0373, -0.0373, 1.7021] {
        let (a, b) = (heard(1, 8.0, 2.0, 0.0, 1.0, 0), heard(1, 8.0, 2.0 + late, 0.0, 1.0, 1));
        let found = sound::lag(&a, &b, None).unwrap();
        assert!((found.seconds - late).abs() < 1e-3, "{late}: {found:?}");
        assert!(found.sigma < 2e-3 && found.windows[0] >= 3 && found.ratio > 1.5, "{found:?}");
    }
}

#[test]
fn sounds_without_anything_in_common_are_refused() {
    for seed in 2..5 {
        let (a, b) = (heard(1, 8.0, 0.0, 0.0, 0.1, 0), heard(seed, 8.0, 0.0, 0.0, 0.1, 1));
        assert_eq!(sound::lag(&a, &b, None), Err(Refusal::Unrelated));
    }
    let (a, b) = (heard(1, 4.0, 0.0, 0.0, 0.0, 0), SoundTrack::new(vec![0.0; 64_000]));
    assert_eq!(sound::lag(&a, &b, None), Err(Refusal::Silent));
    assert_eq!(sound::lag(&a, &SoundTrack::new(vec![0.1; 800]), None), Err(Refusal::Short("sound")));
    // A lag beyond what is allowed is not found.
    let late = heard(1, 4.0, 1.0, 0.0, 0.0, 1);
    assert!(sound::lag(&a, &late, None).is_ok() && sound::lag(&a, &late, Some(0.5)).is_err());
}

#[test]
fn drifting_clocks_are_detected_in_long_recordings() {
    let drift = 60e-6;
    let (a, b) = (heard(1, 90.0, 0.5, 0.0, 0.3, 0), heard(1, 90.0, 0.7, drift, 0.3, 1));
    let found = sound::lag(&a, &b, None).unwrap();
    assert!((found.drift.unwrap() - drift).abs() < 8e-6, "{found:?}");
    assert!((found.at_zero() - 0.2).abs() < 1e-3, "{found:?}");
    assert!((sound::without_way(0.01, [3.43, 6.86]) - 0.0).abs() < 1e-12 && (sound::way(3.43) - 0.01).abs() < 1e-12);
}

// Motion.

fn motion(rig: &Rig, camera: usize, frames: usize) -> Motion {
    let mut motion = Motion::default();
    (0..frames).for_each(|n| motion.push(n as f64 / FPS, &rig.picture(camera, n as f64 / FPS)));
    motion
}

#[test]
fn motion_suggests_the_lag_to_a_frame() {
    let rig = Rig::new(&[0.0, 5.4 * FRAME, -11.8 * FRAME], 25, Dance::Free);
    let all: Vec<Motion> = (0..3).map(|c| motion(&rig, c, 150)).collect();
    for (a, b) in [(0, 1), (0, 2), (1, 2)] {
        let found = motion::lag(&all[a], &all[b], None).unwrap();
        let truth = rig.offsets[a] - rig.offsets[b];
        assert!((found.seconds - truth).abs() < FRAME, "{a} {b}: {found:?}, {truth}");
    }
}

#[test]
fn periodic_motion_gives_no_time_offset() {
    let rig = Rig::new(&[0.0, 3.0 * FRAME], 25, Dance::Loop);
    let [a, b] = [0, 1].map(|c| motion(&rig, c, 100));
    assert!(matches!(motion::lag(&a, &b, None), Err(Refusal::Repeating(_))), "{:?}", motion::lag(&a, &b, None));
    let still = Rig::new(&[0.0, 0.0], 10, Dance::Still);
    let [a, b] = [0, 1].map(|c| motion(&still, c, 30));
    assert_eq!(motion::lag(&a, &b, None), Err(Refusal::Still));
    let [one, other] = [Rig::new(&[0.0], 25, Dance::Free), Rig::new(&[0.0], 25, Dance::Free).other_take()];
    let (a, b) = (motion(&one, 0, 100), motion(&other, 0, 100));
    assert!(motion::lag(&a, &b, None).is_err(), "{:?}", motion::lag(&a, &b, None));
}

// Geometry.

const AROUND_ZERO: Range = Range { around: 0.0, within: 5.0 * FRAME };

fn pairs(count: usize) -> Vec<[usize; 2]> {
    (0..count).map(|k| [k, k]).collect()
}

#[test]
fn sub_frame_offsets_follow_from_the_geometry() {
    for part in [0.37, -2.63] {
        let rig = Rig::new(&[0.0, -part * FRAME], 60, Dance::Free);
        let [a, b] = [0, 1].map(|c| rig.tracks(c, 20, 0.3));
        let f = rig.fundamental(0, 1);
        // With matches of which every fourth is wrong, and with none at all.
        let mut told = pairs(60);
        told.iter_mut().step_by(4).for_each(|p| p[1] = (p[1] + 17) % 60);
        for matches in [Some(told.as_slice()), None] {
            let found = epipolar::lag(&f, [&a, &b], matches, AROUND_ZERO).unwrap();
            assert!((found.seconds - part * FRAME).abs() < 0.05 * FRAME, "{part}: {:?}", found.seconds / FRAME);
            assert!(found.sigma < 0.05 * FRAME && found.sigma > 1e-3 * FRAME, "{}", found.sigma / FRAME);
            let right = found.matches.iter().filter(|p| p[0] == p[1]).count();
            assert!(right * 10 >= found.matches.len() * 8 && right >= 30, "{right} of {}", found.matches.len());
        }
    }
}

#[test]
fn geometry_without_evidence_is_refused() {
    let rig = |dance| Rig::new(&[0.0, 0.4 * FRAME], 40, dance);
    let lag = |rig: &Rig, frames: usize, within: f64| {
        let [a, b] = [0, 1].map(|c| rig.tracks(c, frames, 0.1));
        epipolar::lag(&rig.fundamental(0, 1), [&a, &b], Some(&pairs(40)), Range { around: 0.0, within })
    };
    assert_eq!(lag(&rig(Dance::Still), 20, 5.0 * FRAME), Err(Refusal::Still));
    // 0.4 s are twelve frames.
    let repeating = lag(&rig(Dance::Loop), 60, 20.0 * FRAME);
    assert!(matches!(repeating, Err(Refusal::Repeating(_))), "{repeating:?}");
    assert!(lag(&rig(Dance::Loop), 60, 5.0 * FRAME).is_ok(), "within half a period there is one answer");
    let free = rig(Dance::Free);
    let other = rig(Dance::Free).other_take();
    let (a, b) = (free.tracks(0, 20, 0.1), other.tracks(1, 20, 0.1));
    let matches = pairs(40);
    for matches in [Some(matches.as_slice()), None] {
        let found = epipolar::lag(&free.fundamental(0, 1), [&a, &b], matches, AROUND_ZERO);
        assert!(found.is_err(), "other takes: {found:?}");
    }
}

#[test]
fn motion_along_epipolar_lines_gives_no_time_offset() {
    // Cameras side by side, and everything moves sideways.
    let f = [[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]];
    let track = |k: usize, shift: f64| Track {
        samples: (0..15).map(|n| (n as f64 * FRAME, [3.0 * n as f64 + shift, 10.0 * k as f64])).collect(),
    };
    let [a, b] = [0.0, 30.0].map(|shift| (0..20).map(|k| track(k, shift)).collect::<Vec<_>>());
    let found = epipolar::lag(&f, [&a, &b], Some(&pairs(20)), AROUND_ZERO);
    assert!(matches!(found, Err(Refusal::Vague(_) | Refusal::Unrelated)), "{found:?}");
}

#[test]
fn images_become_tracks_and_tracks_an_offset() {
    let rig = Rig::new(&[0.0, 1.37 * FRAME], 30, Dance::Free);
    let frames = 26;
    let tracks = [0, 1].map(|c| {
        let still = rig.still(c, 90);
        let mut tracker = Tracker::new(80, 5.0);
        for n in 0..frames {
            let time = n as f64 / FPS;
            let grey = Grey::of(&rig.picture(c, time));
            let wanted = moving(&grey, &still);
            tracker.push(time, grey, Some(&wanted));
        }
        tracker.finish()
    });
    assert!(tracks.iter().all(|t| t.len() >= 25), "{} {}", tracks[0].len(), tracks[1].len());
    let found = epipolar::lag(&rig.fundamental(0, 1), [&tracks[0], &tracks[1]], None, AROUND_ZERO).unwrap();
    assert!((found.seconds + 1.37 * FRAME).abs() < 0.1 * FRAME, "{:?} {}", found.seconds / FRAME, found.matches.len());
}

// The graph.

/// Lags of all pairs of these offsets, with noise of a millisecond.
fn lags(offsets: &[f64], kind: Kind) -> Vec<Evidence> {
    let rng = Rng::new(3, "lags", offsets.len() as u64);
    let mut out = Vec::new();
    for a in 0..offsets.len() {
        for b in a + 1..offsets.len() {
            let noise = 1e-3 * rng.normal(out.len() as u64);
            let lag = offsets[a] - offsets[b] + noise;
            out.push(Evidence { cameras: [a, b], lag, sigma: 1e-3, drift: None, kind });
        }
    }
    out
}

fn close(found: &Option<Offset>, truth: f64) -> bool {
    found.as_ref().is_some_and(|o| (o.seconds - truth).abs() < 3e-3)
}

const TRUTH: [f64; 7] = [0.0, 0.31, -1.2, 4.0, 0.02, 2.5, -0.4];

#[test]
fn wrong_lags_are_left_out_and_named() {
    let mut evidence = lags(&TRUTH, Kind::Geometry);
    // A third is wrong, some by a single frame.
    let wrong = [0, 3, 5, 8, 11, 16, 19];
    for (k, &i) in wrong.iter().enumerate() {
        evidence[i].lag += [0.7, -0.033, 0.05, -2.0, 0.033, 0.4, -0.2][k];
    }
    let solution = solve(7, &evidence, &[], 0.5 * FRAME);
    for (c, offset) in solution.offsets.iter().enumerate() {
        assert!(close(offset, TRUTH[c]), "{c}: {offset:?}");
        let offset = offset.as_ref().unwrap();
        assert!(offset.checked && offset.kinds == [Kind::Geometry] && (c == 0) == (offset.sigma == 0.0));
        assert!(offset.sigma < 2e-3);
    }
    let refused: Vec<usize> = solution.refused.iter().map(|r| r.evidence).collect();
    assert_eq!(refused, wrong);
    assert!((solution.refused[0].off.unwrap() - 0.7).abs() < 5e-3, "by how much the cycles do not close");
}

#[test]
fn the_trusted_kind_wins_and_guesses_come_last() {
    let mut evidence = lags(&TRUTH[..3], Kind::Geometry);
    // Echoes: sound is wrong for one pair, and the only evidence for camera 3; motion has a guess for all.
    evidence.push(Evidence { lag: evidence[0].lag + 0.2, kind: Kind::Sound, ..evidence[0].clone() });
    evidence.push(Evidence { cameras: [3, 0], lag: 4.0, sigma: 1e-3, drift: None, kind: Kind::Sound });
    evidence.push(Evidence { cameras: [0, 1], lag: 3.0, sigma: FRAME, drift: None, kind: Kind::Motion });
    evidence.push(Evidence { cameras: [3, 4], lag: 3.98, sigma: FRAME, drift: None, kind: Kind::Motion });
    let solution = solve(6, &evidence, &[], 0.5 * FRAME);
    assert!((0..4).all(|c| close(&solution.offsets[c], TRUTH[c])), "{solution:?}");
    let offset = |c: usize| solution.offsets[c].as_ref().unwrap();
    assert_eq!((offset(1).kinds.as_slice(), offset(1).checked), (&[Kind::Geometry][..], true));
    assert_eq!((offset(3).kinds.as_slice(), offset(3).checked), (&[Kind::Sound, Kind::Motion][..], false));
    assert_eq!((offset(4).kinds.as_slice(), offset(4).checked), (&[Kind::Motion][..], false));
    assert!((offset(4).seconds - 0.02).abs() < 5e-3 && offset(4).sigma > 0.02);
    assert!(solution.offsets[5].is_none(), "nothing is known of camera 5");
    let refused: Vec<usize> = solution.refused.iter().map(|r| r.evidence).collect();
    assert_eq!(refused, [3, 5]);
}

#[test]
fn contradicting_offsets_are_not_averaged() {
    let geometry = Evidence { cameras: [0, 1], lag: 0.1, sigma: 2e-3, drift: None, kind: Kind::Geometry };
    let sound = Evidence { lag: 0.4, sigma: 1e-3, kind: Kind::Sound, ..geometry.clone() };
    for evidence in [[geometry.clone(), sound.clone()], [sound, geometry]] {
        let solution = solve(2, &evidence, &[], 0.5 * FRAME);
        let offset = solution.offsets[1].as_ref().unwrap();
        assert!((offset.seconds + 0.1).abs() < 1e-9 && !offset.checked, "{solution:?}");
        assert_eq!(solution.refused.len(), 1);
    }
}

#[test]
fn settings_of_the_user_stay() {
    let evidence = lags(&TRUTH, Kind::Sound);
    let mut given = vec![None; 7];
    (given[2], given[3]) = (Some(10.0), Some(15.2));
    let solution = solve(7, &evidence, &given, 0.5 * FRAME);
    let offset = |c: usize| solution.offsets[c].as_ref().unwrap();
    assert_eq!((offset(2).seconds, offset(3).seconds, offset(3).sigma), (10.0, 15.2, 0.0));
    assert!(close(&solution.offsets[0], 11.2) && offset(2).kinds.contains(&Kind::Given));
}

#[test]
fn drifts_are_solved_with_the_offsets() {
    let rates = [0.0, 30e-6, -20e-6, 5e-6];
    let mut evidence = lags(&TRUTH[..4], Kind::Sound);
    evidence.iter_mut().for_each(|e| e.drift = Some(rates[e.cameras[0]] - rates[e.cameras[1]]));
    let solution = solve(4, &evidence, &[], 0.5 * FRAME);
    for (offset, rate) in solution.offsets.iter().zip(rates) {
        assert!((offset.as_ref().unwrap().rate - rate).abs() < 1e-9);
    }
    assert!((solution.offsets[1].as_ref().unwrap().global(100.0) - 100.313).abs() < 3e-3);
    assert!(solve(0, &[], &[], 0.01).offsets.is_empty());
}
