//! `import` on the bundled capture's pictures, of which nothing but the pictures is told.

use crate::sample::splat4d;
use crate::{json_of, str};
use splat4d::math::align::apart;
use splat4d_train::capture::{Capture, CaptureOptions};
use std::path::{Path, PathBuf};

/// Neighbouring cameras, and after how many frames each of them begins.
const CAMERAS: [(&str, usize); 6] =
    [("cam06", 0), ("cam07", 2), ("cam08", 1), ("cam09", 3), ("cam10", 0), ("cam11", 2)];
/// Frames that each films.
const FRAMES: usize = 14;

fn bundled() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/knight")
}

/// Folders of pictures, cut out of the bundled capture.
fn filmed(to: &Path) {
    for (name, begin) in CAMERAS {
        let folder = to.join(name);
        std::fs::create_dir_all(&folder).unwrap();
        for k in 0..FRAMES {
            let from = bundled().join(format!("images/{name}/{:04}.jpg", begin + k));
            std::fs::copy(from, folder.join(format!("{k:04}.jpg"))).unwrap();
        }
    }
}

#[test]
fn pictures_alone_become_a_capture_with_clocks_and_poses() {
    let dir = tempfile::tempdir().unwrap();
    let (films, take) = (dir.path().join("films"), dir.path().join("take"));
    filmed(&films);
    let told = splat4d(&["import", str(&films), "-o", str(&take)]).run().ok();
    assert!(told.contains("cam09") && told.contains("geometry") && told.contains("doctor: 6 cameras"), "{told}");
    assert!(take.join("import/doctor.html").is_file() && take.join("import/doctor.json").is_file());

    let report = json_of(&take.join("import/report.json"));
    let offset = |k: usize| report["cameras"][k]["offset"].as_f64().unwrap();
    for (k, (name, begin)) in CAMERAS.iter().enumerate() {
        // The same event is at a smaller time on the clock of a camera that began later.
        let off = (offset(k) - offset(0)) * 30.0 - *begin as f64;
        assert!(off.abs() < 0.2, "{name}: {off} frames off");
    }
    let open = |path: &Path| Capture::open(path, &CaptureOptions::default()).unwrap();
    let (found, truth) = (open(&take), open(&bundled()));
    assert_eq!((found.cameras.len(), found.frames.len()), (CAMERAS.len(), CAMERAS.len() * FRAMES));
    let poses = |capture: &Capture| {
        let of = |(name, _): &(&str, usize)| {
            let frame = capture.frames.iter().find(|f| capture.cameras[f.camera].name == *name).unwrap();
            frame.source.cam_from_world
        };
        CAMERAS.iter().map(of).collect::<Vec<_>>()
    };
    for (off, (name, _)) in apart(&poses(&found), &poses(&truth)).unwrap().iter().zip(&CAMERAS) {
        assert!(off.degrees < 3.0 && off.center < 0.05, "{name}: {off:?}");
    }
}

/// Samples of sound a second, and the films' frames a second: slow, so that a second of pictures is long enough to listen.
const SOUND_RATE: u32 = 16_000;
const SLOW: usize = 10;

/// A WAV file of what a camera hears that begins after so many seconds: bursts of noise, the same for all.
fn heard(begin: f64, seconds: f64, camera: u64) -> Vec<u8> {
    let noise = |stream: u64, k: u64| {
        let mut z = (stream << 32 | k).wrapping_mul(0x9E37_79B9_7F4A_7C15);
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        ((z ^ (z >> 27)) >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    };
    let rate = f64::from(SOUND_RATE);
    let first = (begin * rate).round() as u64;
    let sample = |k: u64| {
        let own = 0.01 * noise(100 + camera, k);
        let t = (first + k) as f64 / rate;
        // A burst each quarter of a second, at places that do not repeat.
        let burst = (0..16u64).map(|b| {
            let since = t - 0.23 * b as f64 - 0.07 * noise(7, b).abs();
            if (0.0..0.06).contains(&since) { (1.0 - since / 0.06) * noise(8, first + k) } else { 0.0 }
        });
        ((own + burst.sum::<f64>()).clamp(-1.0, 1.0) * 20_000.0) as i16
    };
    let data: Vec<u8> = (0..(seconds * rate) as u64).flat_map(|k| sample(k).to_le_bytes()).collect();
    let mut out = b"RIFF".to_vec();
    out.extend((36 + data.len() as u32).to_le_bytes());
    out.extend(b"WAVEfmt ");
    out.extend([16, 0, 0, 0, 1, 0, 1, 0]);
    out.extend(SOUND_RATE.to_le_bytes());
    out.extend((2 * SOUND_RATE).to_le_bytes());
    out.extend([2, 0, 16, 0]);
    out.extend(b"data");
    out.extend((data.len() as u32).to_le_bytes());
    out.extend(data);
    out
}

#[test]
fn videos_with_sound_become_a_capture_whose_clocks_were_heard() {
    if std::process::Command::new("ffmpeg").arg("-version").output().is_err() {
        assert!(std::env::var_os("REQUIRE_FFMPEG").is_none(), "ffmpeg is missing");
        eprintln!("skipped: no ffmpeg");
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let (films, take) = (dir.path().join("films"), dir.path().join("take"));
    std::fs::create_dir_all(&films).unwrap();
    let taken = 20;
    for (k, (name, begin)) in CAMERAS.iter().enumerate() {
        let wave = dir.path().join(format!("{name}.wav"));
        let seconds = taken as f64 / SLOW as f64;
        std::fs::write(&wave, heard(*begin as f64 / SLOW as f64, seconds, k as u64)).unwrap();
        let pictures = bundled().join(format!("images/{name}/%04d.jpg"));
        let done = std::process::Command::new("ffmpeg")
            .args(["-v", "error", "-framerate", &SLOW.to_string(), "-start_number", &begin.to_string(), "-i"])
            .arg(&pictures)
            .arg("-i")
            .arg(&wave)
            .args(["-frames:v", &taken.to_string(), "-c:v", "mjpeg", "-q:v", "2", "-c:a", "copy"])
            .arg(films.join(format!("{name}.mov")))
            .output()
            .unwrap();
        assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    }
    splat4d(&["import", str(&films), "-o", str(&take), "--no-doctor"]).run().ok();
    let report = json_of(&take.join("import/report.json"));
    for (k, (name, begin)) in CAMERAS.iter().enumerate() {
        let camera = &report["cameras"][k];
        let by: Vec<&str> = camera["by"].as_array().unwrap().iter().map(|v| v.as_str().unwrap()).collect();
        assert!(by.contains(&"sound"), "{name}: {by:?}");
        let off = (camera["offset"].as_f64().unwrap() - report["cameras"][0]["offset"].as_f64().unwrap()) * SLOW as f64;
        assert!((off - *begin as f64).abs() < 0.2, "{name}: {off} frames, begun after {begin}");
    }
}

#[test]
fn what_cannot_be_imported_is_explained() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let take = at("take");
    let refused =
        |input: &Path, more: &[&str]| splat4d(&["import", str(input), "-o", str(&take)]).args(more).run().refused();
    assert!(refused(&at("nothing.mp4"), &[]).contains("nothing.mp4"));
    std::fs::create_dir(at("empty")).unwrap();
    assert!(refused(&at("empty"), &[]).contains("neither a video nor a picture"));
    std::fs::write(at("zero.mp4"), []).unwrap();
    assert!(refused(&at("zero.mp4"), &[]).contains("empty"));
    let films = at("films");
    filmed(&films);
    let one = films.join("cam06");
    assert!(refused(&one, &["--rig", "fixed"]).contains("nothing from two sides"));
    assert!(refused(&films, &["--from", "3", "--to", "2"]).contains("come after"));
    assert!(refused(&films, &["--apart", "cam06"]).contains("left,right=2.4"));
    assert!(refused(&films, &["--apart", "cam06,cam99=2"]).contains("cam99"));
    let twice = splat4d(&["import", str(&one), str(&one), "-o", str(&take)]).run().refused();
    assert!(twice.contains("the same as"), "{twice}");
    // Two cameras that see nothing in common.
    let far = at("far");
    for name in ["cam00", "cam19"] {
        std::fs::create_dir_all(far.join(name)).unwrap();
        for k in 0..4 {
            let from = bundled().join(format!("images/{name}/{k:04}.jpg"));
            std::fs::copy(from, far.join(name).join(format!("{k:04}.jpg"))).unwrap();
        }
    }
    let alone = refused(&far, &[]);
    assert!(alone.contains("30 degrees"), "{alone}");
    // Who is left out stays out.
    let path = take.join("import.toml");
    let text = std::fs::read_to_string(&path).unwrap();
    let (before, own) = text.split_once("name = \"cam19\"").unwrap();
    let own = own.replacen("use = true", "use = false", 1);
    std::fs::write(&path, format!("{before}name = \"cam19\"{own}")).unwrap();
    assert!(refused(&far, &["--rig", "fixed"]).contains("nothing from two sides"));
    // A capture that is somebody's own stays.
    let own = at("own");
    std::fs::create_dir(&own).unwrap();
    std::fs::write(own.join("capture.json"), "{}").unwrap();
    assert!(splat4d(&["import", str(&films), "-o", str(&own)]).run().refused().contains("a capture already"));
}
