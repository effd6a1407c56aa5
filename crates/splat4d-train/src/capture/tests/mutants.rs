//! Mutated files: a reader returns a capture or an error; never a panic, a hang or a huge allocation. The corpus is a
//! pure function of the seed.

use super::super::*;
use super::samples;
use splat4d::math::Rng;
use std::sync::Arc;

/// Mutants of every metadata file and image.
const MUTANTS: u64 = 120;
const SEED: u64 = 20_261_121;

/// One to three mutations: bit flips, cuts, repeated, exchanged and removed stretches, extreme numbers.
fn mutate(bytes: &[u8], rng: Rng) -> Vec<u8> {
    let mut out = bytes.to_vec();
    for round in 0..=rng.below(0, 3) as u64 {
        let rng = rng.fork(round + 1);
        if out.is_empty() {
            return out;
        }
        let at = rng.below(1, out.len());
        let span = rng.below(2, (out.len() - at).min(40)) + 1;
        let other = rng.below(3, out.len());
        match rng.below(4, 8) {
            0 | 1 => out[at] ^= 1 << rng.below(5, 8),
            2 => out.truncate(at),
            3 => {
                let piece = out[at..at + span].to_vec();
                out.splice(other..other, piece);
            }
            4 => drop(out.drain(at..at + span)),
            5 => out[at..at + span].fill([0x00, 0xFF, b'9', b'-'][rng.below(5, 4)]),
            6 => {
                let extreme: &[&[u8]] =
                    &[b"1e308", b"-1", b"null", b"\"\"", b"99999999999999999999", b"[", b"{}", b"nan"];
                out.splice(at..at, extreme[rng.below(5, 8)].iter().copied());
            }
            _ => {
                let value = [u64::MAX, 1 << 40, f64::NAN.to_bits(), 0][rng.below(5, 4)].to_le_bytes();
                let end = (at + 8).min(out.len());
                out[at..end].copy_from_slice(&value[..end - at]);
            }
        }
    }
    out
}

/// Opens a capture and does everything with it that a training run would do first.
fn use_capture(root: &Path) -> bool {
    let Ok(capture) = Capture::open(root, &CaptureOptions::default()) else { return false };
    assert!(!capture.train.is_empty());
    assert!(capture.frames.iter().all(|f| f.time.0.is_finite() && f.view.cam_from_world.det() > 0.9));
    assert!(capture.points.iter().flat_map(|p| p.points.iter().flatten()).all(|v| v.is_finite()));
    assert!(capture.up.iter().chain(&capture.center_and_radius().0).all(|v| v.is_finite()));
    capture.preflight();
    let frames = capture.frames.len();
    let store = ImageStore::new(Arc::new(capture), 1 << 20);
    (0..frames).all(|i| store.load(i).is_ok_and(|p| p.to_picture().color.data.iter().all(|v| (0.0..=1.0).contains(v))))
}

#[test]
fn mutated_metadata_never_breaks_a_reader() {
    let (mut accepted, mut refused) = (0, 0);
    for (name, sample) in samples::all() {
        assert!(use_capture(sample.root()), "{name}: the unchanged sample must be fine");
        for (f, file) in sample.files.iter().enumerate() {
            let bytes = std::fs::read(sample.path(file)).unwrap();
            for i in 0..MUTANTS {
                sample.write(file, &mutate(&bytes, Rng::new(SEED, name, f as u64).fork(i)));
                *(if use_capture(sample.root()) { &mut accepted } else { &mut refused }) += 1;
            }
            sample.write(file, &bytes);
        }
    }
    assert!(accepted > 50 && refused > 500, "a corpus that is always refused tests little: {accepted}, {refused}");
}

#[test]
fn mutated_images_never_break_the_store() {
    let sample = samples::own();
    sample.rgba("a.png", |x, y| [x as u8, y as u8, 7, (x * 10) as u8]);
    sample.write("a.jpg", include_bytes!("tiny.jpg"));
    let webp = image::ImageBuffer::from_fn(24, 16, |x, y| image::Rgb([(x * 10) as u8, (y * 16) as u8, 0]));
    sample.save("a.webp", webp);
    for name in ["a.png", "a.jpg", "a.webp"] {
        sample.edit("capture.json", |v| {
            v["cameras"] = serde_json::json!([v["cameras"][0]]);
            v["cameras"][0].as_object_mut().unwrap().remove("masks");
            v["cameras"][0]["images"] = serde_json::json!([name]);
        });
        assert!(use_capture(sample.root()), "{name}: the unchanged sample must be fine");
        let bytes = std::fs::read(sample.path(name)).unwrap();
        let mut refused = 0;
        for i in 0..3 * MUTANTS {
            sample.write(name, &mutate(&bytes, Rng::new(SEED, name, 0).fork(i)));
            refused += u32::from(!use_capture(sample.root()));
        }
        sample.write(name, &bytes);
        assert!(refused > 100, "{name}: {refused}");
    }
}
