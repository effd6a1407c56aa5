//! Small videos made by ffmpeg, read through it. Skipped where there is none.

use super::*;
use std::path::PathBuf;
use std::process::Command;

/// The programs, or a word that the test is skipped. `REQUIRE_FFMPEG` makes their absence a failure.
fn tools() -> Option<Tools> {
    match Tools::find() {
        Ok(tools) => Some(tools),
        Err(e) => {
            assert!(std::env::var_os("REQUIRE_FFMPEG").is_none(), "{e}");
            println!("skipped: {e}");
            None
        }
    }
}

/// A folder for videos.
struct Made {
    folder: tempfile::TempDir,
    tools: Tools,
}

impl Made {
    fn new() -> Option<Self> {
        Some(Self { folder: tempfile::tempdir().unwrap(), tools: tools()? })
    }

    /// Makes a video with these arguments.
    fn make(&self, name: &str, arguments: &str) -> PathBuf {
        let path = self.folder.path().join(name);
        let mut command = Command::new("ffmpeg");
        command.args(["-loglevel", "error", "-nostdin", "-y"]).args(arguments.split(' '));
        let target =
            if name.starts_with('-') { format!("file:{}", path.display()) } else { path.display().to_string() };
        assert!(command.arg(target).status().unwrap().success(), "ffmpeg makes {name}");
        path
    }

    fn open(&self, path: &Path) -> Result<Box<dyn Source>> {
        open_with(path, 30.0, Ok(self.tools.clone()))
    }

    fn read(&self, path: &Path, selection: &Selection) -> Read {
        let source = self.open(path).unwrap();
        let mut reader = source.frames(selection).unwrap();
        let mut frame = Frame::default();
        let mut read = Read::default();
        while reader.next(&mut frame).unwrap() {
            if let Some(last) = read.frames.last()
                && frame.number == last.number + 1
            {
                read.differences.push((frame.number, mean_difference(&frame.picture, &last.picture)));
            }
            read.frames.push(frame.clone());
        }
        read.times = reader.times().to_vec();
        read.warnings = reader.warnings().to_vec();
        read
    }
}

#[derive(Default)]
struct Read {
    frames: Vec<Frame>,
    times: Vec<f64>,
    differences: Vec<(usize, f64)>,
    warnings: Vec<String>,
}

/// The middle pixel.
fn middle(picture: &Rgb8) -> [u8; 3] {
    let at = (picture.height / 2 * picture.width + picture.width / 2) * 3;
    [picture.data[at], picture.data[at + 1], picture.data[at + 2]]
}

/// Waves that run.
const MOVING: &str = "-f lavfi -i nullsrc=s=64x48:r=30:d=0.6,geq=lum=128+60*sin(X/5+N/2)*cos(Y/7):cb=128:cr=128";
/// A codec that keeps every bit, of which every frame can be decoded alone.
const EXACT: &str = "-c:v ffv1 -pix_fmt bgr0";

#[test]
fn frames_have_their_times() {
    let Some(made) = Made::new() else { return };
    let path = made.make("-a film.mp4", &format!("{MOVING} -f lavfi -i sine=d=0.6 -c:v mpeg4 -c:a aac -f mp4"));
    let source = made.open(&path).unwrap();
    let info = source.info();
    assert_eq!((info.name.as_str(), info.size, info.frames, info.sound), ("-a film", [64, 48], Some(18), true));
    assert_eq!((info.nominal_rate, info.codec.as_str()), (Some(30.0), "mpeg4"));
    let all = made.read(&path, &Selection::default());
    assert_eq!((all.frames.len(), all.times.len()), (18, 18));
    let even = |f: &Frame| (f.time - f.number as f64 / 30.0).abs() < 1e-4;
    assert!(all.frames.iter().enumerate().all(|(i, f)| f.number == i && even(f)));
    let clock = Clock::of(&all.times, &all.differences);
    assert!(clock.dropped.is_empty() && clock.doubled.is_empty() && !clock.variable && !clock.still, "{clock:?}");
    // A part of it, every second frame, smaller.
    let selection = Selection { every: 2, from: Some(0.2), to: Some(0.4), size: Some(24), ..Selection::default() };
    let part = made.read(&path, &selection);
    let times: Vec<f64> = part.frames.iter().map(|f| (f.time * 30.0).round()).collect();
    assert_eq!(times, [6.0, 8.0, 10.0]);
    assert!(part.frames.iter().all(|f| (f.picture.width, f.picture.height) == (32, 24)));
    assert!(part.warnings.iter().all(|w| !w.contains("truncated")), "{:?}", part.warnings);
}

#[test]
fn rotated_videos_are_read_upright() {
    let Some(made) = Made::new() else { return };
    // Red above, blue below; played after a quarter turn.
    let flat = "-f lavfi -i color=red:s=64x24:d=0.1:r=10 -f lavfi -i color=blue:s=64x24:d=0.1:r=10";
    let plain = made.make("plain.mp4", &format!("{flat} -filter_complex vstack -c:v mpeg4 -q:v 1"));
    let turned = made.folder.path().join("turned.mp4");
    let mut command = Command::new("ffmpeg");
    command.args(["-loglevel", "error", "-i"]).arg(&plain).args(["-c", "copy", "-metadata:s:v:0", "rotate=90"]);
    assert!(command.arg(&turned).status().unwrap().success());
    let source = made.open(&turned).unwrap();
    if source.info().rotation == 0 {
        println!("skipped: this ffmpeg writes no rotation");
        return;
    }
    assert_eq!((source.info().size, source.info().stored), ([48, 64], [64, 48]));
    let frame = &made.read(&turned, &Selection::default()).frames[0];
    assert_eq!((frame.picture.width, frame.picture.height), (48, 64));
    // The upper side has become one of the two others.
    let left = frame.picture.data[frame.picture.width * 32 * 3..][..3].to_vec();
    let right = frame.picture.data[(frame.picture.width * 33 - 1) * 3..][..3].to_vec();
    let red = |p: &[u8]| p[0] > 200 && p[2] < 60;
    assert!(red(&left) != red(&right), "{left:?} {right:?}");
}

#[test]
fn colours_are_preserved() {
    let Some(made) = Made::new() else { return };
    let wanted = [200i32, 90, 40];
    let color = format!("color=0x{:02x}{:02x}{:02x}", wanted[0], wanted[1], wanted[2]);
    for (name, matrix, range, tags) in [
        ("709.mkv", "bt709", "limited", "-colorspace bt709 -color_range tv"),
        ("601.mkv", "smpte170m", "limited", "-colorspace smpte170m -color_range tv"),
        ("full.mkv", "bt709", "full", "-colorspace bt709 -color_range pc"),
        ("sd.mkv", "bt601", "limited", ""),
    ] {
        let convert =
            format!("-vf scale=out_color_matrix={matrix}:out_range={range}:flags=accurate_rnd,format=yuv444p");
        let input = format!("-f lavfi -i {color}:s=64x48:r=10:d=0.1,format=rgb24");
        let path = made.make(name, format!("{input} {convert} -c:v ffv1 {tags}").trim_end());
        let found = middle(&made.read(&path, &Selection::default()).frames[0].picture);
        let off = (0..3).map(|c| (i32::from(found[c]) - wanted[c]).abs()).max();
        assert!(off <= Some(3), "{name}: {found:?}");
    }
}

#[test]
fn a_high_dynamic_range_is_mapped_with_a_warning() {
    let Some(made) = Made::new() else { return };
    let input = "-f lavfi -i color=0x808080:s=64x48:r=10:d=0.1 -pix_fmt yuv420p10le -c:v ffv1";
    let tags = "-color_trc arib-std-b67 -colorspace bt2020nc -color_primaries bt2020 -color_range tv";
    let path = made.make("hlg.mkv", &format!("{input} {tags}"));
    let read = made.read(&path, &Selection::default());
    assert!(read.warnings.iter().any(|w| w.contains("HLG")), "{:?}", read.warnings);
    let [r, g, b] = middle(&read.frames[0].picture);
    assert!(r.abs_diff(g) <= 2 && g.abs_diff(b) <= 2 && (60..220).contains(&g), "grey stays grey: {r} {g} {b}");
}

#[test]
fn a_part_has_the_times_of_the_whole() {
    let Some(made) = Made::new() else { return };
    for (name, codec) in [
        ("a.avi", "-c:v mjpeg -q:v 3"),
        ("b.mkv", EXACT),
        ("c.mp4", "-c:v mpeg4 -g 4"),
        ("d.mov", "-c:v mjpeg -q:v 3 -video_track_timescale 30"),
    ] {
        let path = made.make(name, &format!("{MOVING} {codec}"));
        let whole = made.read(&path, &Selection::default());
        for from in [0.05, 0.1176, 0.2] {
            let part = made.read(&path, &Selection { from: Some(from), to: Some(0.45), ..Selection::default() });
            let wanted: Vec<_> =
                whole.frames.iter().filter(|f| f.time >= from - 1e-3 && f.time < 0.45 - 1e-3).collect();
            assert_eq!(part.frames.len(), wanted.len(), "{name} from {from}");
            for (a, b) in part.frames.iter().zip(wanted) {
                assert!((a.time - b.time).abs() < 1e-3, "{name} from {from}: {} for {}", a.time, b.time);
                assert_eq!(a.picture, b.picture, "{name} from {from}, at {}", a.time);
            }
        }
    }
}

#[test]
fn variable_rates_and_lost_frames_are_detected() {
    let Some(made) = Made::new() else { return };
    // Frames 5 and 6 are left out; those left keep their times.
    let lost =
        made.make("lost.mkv", &format!("{MOVING} -vf select=not(between(n\\,5\\,6)) -fps_mode passthrough {EXACT}"));
    let read = made.read(&lost, &Selection::default());
    let clock = Clock::of(&read.times, &read.differences);
    assert_eq!(clock.dropped, [Gap { after: 4, missing: 2 }]);
    // Every fifth frame shows the one before again.
    let doubled = format!("{},fps=30:round=down", MOVING.replace("r=30:d=0.6", "r=24:d=0.5"));
    let path = made.make("doubled.mkv", &format!("{doubled} {EXACT}"));
    let read = made.read(&path, &Selection::default());
    let clock = Clock::of(&read.times, &read.differences);
    assert!((2..=3).contains(&clock.doubled.len()) && clock.dropped.is_empty(), "{clock:?}");
}

#[test]
fn sound_keeps_the_clock_of_the_images() {
    let Some(made) = Made::new() else { return };
    // A tone that begins at 0.3 s, in a track that begins at 0.1 s.
    let sound = "-itsoffset 0.1 -f lavfi -i sine=f=440:d=0.3,adelay=200";
    let path = made.make("sound.mkv", &format!("{MOVING} {sound} -map 0 -map 1 -c:v ffv1 -c:a pcm_s16le"));
    let samples = made.open(&path).unwrap().sound().unwrap().unwrap();
    let first = samples.iter().position(|s| s.abs() > 0.05).unwrap() as f64 / SOUND_RATE;
    assert!((first - 0.3).abs() < 0.004, "{first}");
    let silent = made.make("silent.mkv", &format!("{MOVING} {EXACT}"));
    assert!(made.open(&silent).unwrap().sound().unwrap().is_none());
}

#[test]
fn a_truncated_video_is_read_to_its_end() {
    let Some(made) = Made::new() else { return };
    let long = "-f lavfi -i testsrc2=s=64x48:r=30:d=1 -c:v mpeg4 -g 5 -q:v 2 -movflags +faststart";
    let path = made.make("whole.mp4", long);
    let bytes = std::fs::read(&path).unwrap();
    let cut = made.folder.path().join("cut.mp4");
    std::fs::write(&cut, &bytes[..bytes.len() * 6 / 10]).unwrap();
    let read = made.read(&cut, &Selection::default());
    assert!((6..28).contains(&read.frames.len()), "{}", read.frames.len());
    let told = format!("after {} frames", read.frames.len());
    assert!(read.warnings.iter().any(|w| w.contains(&told) && w.contains("truncated")), "{:?}", read.warnings);
}

#[test]
fn non_videos_are_refused_with_a_reason() {
    let Some(made) = Made::new() else { return };
    let path = |name: &str| made.folder.path().join(name);
    std::fs::write(path("empty.mp4"), b"").unwrap();
    std::fs::write(path("noise.mp4"), [7; 3000]).unwrap();
    made.make("sound.wav", "-f lavfi -i sine=d=0.1");
    let whole = made.make("whole.mp4", &format!("{MOVING} -c:v mpeg4"));
    // Without its table, which is at the end.
    let bytes = std::fs::read(&whole).unwrap();
    std::fs::write(path("headless.mp4"), &bytes[..bytes.len() / 2]).unwrap();
    for (name, word) in [
        ("empty.mp4", "empty"),
        ("noise.mp4", "damaged"),
        ("sound.wav", "no images"),
        ("headless.mp4", "moov"),
        ("absent.mp4", "cannot be read"),
    ] {
        let error = made.open(&path(name)).err().unwrap_or_else(|| panic!("{name}")).to_string();
        assert!(error.contains(word) && error.contains(name), "{error}");
    }
    let fields = made.make("fields.mkv", &format!("{MOVING} -c:v mpeg2video -flags +ildct+ilme -field_order tt"));
    let source = made.open(&fields).unwrap();
    if source.info().interlaced {
        let error = source.frames(&Selection::default()).err().unwrap().to_string();
        assert!(error.contains("interlaced") && error.contains("yadif"), "{error}");
        let taken = made.read(&fields, &Selection { deinterlace: true, ..Selection::default() });
        assert!(taken.frames.len() >= 17, "{}", taken.frames.len());
    }
    let source = made.open(&whole).unwrap();
    let mut late = source.frames(&Selection { from: Some(9.0), ..Selection::default() }).unwrap();
    let error = late.next(&mut Frame::default()).unwrap_err().to_string();
    assert!(error.contains("ends at 0.60 s"), "{error}");
    assert!(source.frames(&Selection { every: 0, ..Selection::default() }).is_err());
}

#[test]
fn a_reader_closed_early_stops_its_program() {
    let Some(made) = Made::new() else { return };
    let path = made.make("long.mkv", "-f lavfi -i testsrc2=s=320x240:r=30:d=1 -c:v mpeg4");
    let source = made.open(&path).unwrap();
    let mut reader = source.frames(&Selection::default()).unwrap();
    assert!(reader.next(&mut Frame::default()).unwrap());
    drop(reader);
    assert_ne!(source.fingerprint().unwrap(), made.open(&made.make("b.mkv", MOVING)).unwrap().fingerprint().unwrap());
}
