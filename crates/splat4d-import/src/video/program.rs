//! The programs ffmpeg and ffprobe: search, supported features, start without a shell.

use splat4d::{Error, ErrorKind, Result};
use std::collections::VecDeque;
use std::ffi::OsString;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::thread::JoinHandle;

/// How to install what is missing.
const INSTALL: &str = "Install it: apt install ffmpeg (Debian, Ubuntu), brew install ffmpeg (macOS) or winget \
                       install ffmpeg (Windows). Or extract the frames elsewhere and give folders of images.";
/// The first version with `-fps_mode`; newer ones lack the older name.
const FPS_MODE_SINCE: (u32, u32) = (5, 1);
/// The first version whose `showinfo` can leave out checksums, and the oldest that is used.
const OLDEST: (u32, u32) = (4, 3);
/// Complaints of a program that are remembered: the first ones.
const COMPLAINTS: usize = 8;
/// Words of a complaint that can be ignored.
const MUXER: &str = "dts to muxer";
/// Characters of a complaint that are repeated.
const COMPLAINT_LENGTH: usize = 300;

/// The programs, and what they can do.
#[derive(Clone, Debug)]
pub struct Tools {
    ffmpeg: PathBuf,
    ffprobe: PathBuf,
    /// Major and minor version; None: not a release.
    version: Option<(u32, u32)>,
    /// Whether images of high dynamic range can be mapped to ordinary ones.
    pub(super) tone_mapping: bool,
}

impl Tools {
    /// Searches the programs in the system's search path. Errors: missing, too old.
    pub(crate) fn find() -> Result<Self> {
        Self::at(Path::new("ffmpeg"), Path::new("ffprobe"))
    }

    /// Takes the programs from these folders.
    pub(crate) fn at(ffmpeg: &Path, ffprobe: &Path) -> Result<Self> {
        let ask = |program: &Path, arguments: &[&str]| {
            let mut command = Command::new(program);
            let out = command.args(arguments).stdin(Stdio::null()).stderr(Stdio::null()).output();
            let out = out.map_err(|e| {
                let what =
                    format!("videos are read through the program {}, which cannot be started", program.display());
                Error::io(what, e).remedy(INSTALL)
            })?;
            Ok(String::from_utf8_lossy(&out.stdout).into_owned())
        };
        let version = version(&ask(ffmpeg, &["-hide_banner", "-version"])?);
        ask(ffprobe, &["-hide_banner", "-version"])?;
        if let Some((major, minor)) = version.filter(|v| *v < OLDEST) {
            let what = format!("ffmpeg is version {major}.{minor}, older than {}.{}", OLDEST.0, OLDEST.1);
            return Err(Error::new(ErrorKind::Unsupported, what).remedy("Install a newer one."));
        }
        let filters = ask(ffmpeg, &["-hide_banner", "-filters"])?;
        let has = |name: &str| filters.lines().any(|l| l.split_whitespace().nth(1) == Some(name));
        let tone_mapping = has("zscale") && has("tonemap");
        Ok(Self { ffmpeg: ffmpeg.to_owned(), ffprobe: ffprobe.to_owned(), version, tone_mapping })
    }

    /// Arguments that let every decoded frame through, once, with its own time.
    pub(super) fn passthrough(&self) -> [&'static str; 2] {
        if self.version.is_none_or(|v| v >= FPS_MODE_SINCE) { ["-fps_mode", "passthrough"] } else { ["-vsync", "0"] }
    }

    /// Whether there is a decoder of this name.
    pub(super) fn decodes(&self, name: &str) -> bool {
        let out = Command::new(&self.ffmpeg).args(["-hide_banner", "-decoders"]).stdin(Stdio::null()).output();
        let named = |line: &str| line.split_whitespace().nth(1) == Some(name);
        out.is_ok_and(|out| String::from_utf8_lossy(&out.stdout).lines().any(named))
    }

    /// Output of ffprobe for a file, as JSON. Errors: an unsupported file, damage.
    pub(super) fn probe(&self, path: &Path) -> Result<String> {
        let mut command = Command::new(&self.ffprobe);
        command.args([
            "-v",
            "error",
            "-protocol_whitelist",
            "file",
            "-show_streams",
            "-show_format",
            "-of",
            "json",
            "-i",
        ]);
        command.arg(file(path)).stdin(Stdio::null());
        let out = command.output().map_err(|e| Error::environment("ffprobe cannot be started", e).remedy(INSTALL))?;
        if !out.status.success() {
            let said = String::from_utf8_lossy(&out.stderr);
            // The last line states that it did not work, the one before why.
            let lines: Vec<String> = said.lines().map(|l| plain(l, path)).filter(|l| !l.is_empty()).collect();
            let last = lines[lines.len().saturating_sub(2)..].join("; ");
            let what = format!("ffmpeg cannot read it as a video, or it is damaged ({last})");
            return Err(Error::input(what)
                .at(path.display())
                .remedy("Play it; if it plays, convert it to mp4, else copy it again from the camera."));
        }
        Ok(String::from_utf8_lossy(&out.stdout).into_owned())
    }

    /// Number of a file's first sound stream. Errors: an unsupported file, one without sound.
    pub(crate) fn sound_stream(&self, path: &Path) -> Result<usize> {
        let text = self.probe(path)?;
        let of = |top: serde_json::Value| {
            let streams = top["streams"].as_array()?.iter();
            streams.clone().find(|s| s["codec_type"] == "audio")?["index"].as_u64()
        };
        serde_json::from_str(&text).ok().and_then(of).map(|index| index as usize).ok_or_else(|| {
            Error::input("there is no sound in it").at(path.display()).remedy("Give a file with a sound track.")
        })
    }

    /// Runs ffmpeg, which writes the file `out`. Errors: it cannot be started, or fails.
    pub(super) fn write(&self, arguments: &[OsString], out: &Path) -> Result<()> {
        let mut command = Command::new(&self.ffmpeg);
        command.args(["-hide_banner", "-nostats", "-nostdin", "-loglevel", "error", "-y"]).args(arguments);
        let ran = command.arg(file(out)).stdin(Stdio::null()).output();
        let ran = ran.map_err(|e| Error::environment("ffmpeg cannot be started", e).remedy(INSTALL))?;
        if ran.status.success() {
            return Ok(());
        }
        let said = String::from_utf8_lossy(&ran.stderr);
        let last = said.lines().map(|l| plain(l, out)).rfind(|l| !l.is_empty()).unwrap_or_default();
        Err(Error::environment("ffmpeg could not write the sound", std::io::Error::other(last))
            .at(out.display())
            .remedy("Check that there is space, and that the file plays."))
    }

    /// Starts ffmpeg on a file; `input` is before the file's name, `output` behind it, and what it makes comes through
    /// a pipe.
    pub(super) fn start(&self, path: &Path, input: &[String], output: &[String]) -> Result<Running> {
        let mut command = Command::new(&self.ffmpeg);
        command.args([
            "-hide_banner",
            "-nostats",
            "-nostdin",
            "-loglevel",
            "level+info",
            "-protocol_whitelist",
            "file,pipe",
        ]);
        command.args(input).arg("-i").arg(file(path)).args(output).arg("pipe:1");
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child =
            command.spawn().map_err(|e| Error::environment("ffmpeg cannot be started", e).remedy(INSTALL))?;
        let stdout = child.stdout.take().expect("standard output is a pipe");
        let stderr = child.stderr.take().expect("standard error is a pipe");
        let (send, stamps) = channel();
        let name = path.to_owned();
        // It is read all the time, so that ffmpeg never waits for a reader.
        let listener = std::thread::spawn(move || {
            let mut said = Said::default();
            let mut units = [None; 2];
            let mut lines = BufReader::new(stderr);
            let mut line = Vec::new();
            while matches!(lines.read_until(b'\n', &mut line), Ok(1..)) {
                let text = String::from_utf8_lossy(&line);
                if let Some((which, time)) = stamp(&text, &mut units) {
                    // The receiver may be dropped.
                    let _ = send.send((which, time));
                } else if text.contains(MUXER) {
                    // It warns about the times of raw images, which are not used.
                } else if text.contains("[error]") || text.contains("[fatal]") {
                    said.add(plain(&text, &name));
                }
                line.clear();
            }
            said
        });
        Ok(Running { child, stdout, stamps, listener: Some(listener) })
    }
}

/// A file as ffmpeg takes it: whatever its name begins with, it is neither an option nor an address.
pub(super) fn file(path: &Path) -> OsString {
    let mut name = OsString::from("file:");
    name.push(path);
    name
}

/// Warnings of ffmpeg.
#[derive(Clone, Debug, Default)]
pub(super) struct Said {
    /// The first complaints.
    first: VecDeque<String>,
    /// The last one.
    pub last: Option<String>,
    /// How many there were.
    pub count: usize,
}

impl Said {
    fn add(&mut self, line: String) {
        self.count += 1;
        if self.first.len() < COMPLAINTS {
            self.first.push_back(line.clone());
        }
        self.last = Some(line);
    }

    /// Whether one of the first complaints, or the last one, has these words.
    pub(super) fn has(&self, words: &str) -> bool {
        self.first.iter().chain(&self.last).any(|l| l.contains(words))
    }

    /// The last complaint, in brackets and with a space before it, or nothing.
    pub(super) fn bracketed(&self) -> String {
        self.last.as_ref().map(|l| format!(" ({l})")).unwrap_or_default()
    }
}

/// Which of the two points in the chain of filters printed a time: all frames, or those that are kept.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Stamp {
    All,
    Kept,
}

/// A running ffmpeg; dropped, it is stopped.
pub(super) struct Running {
    child: Child,
    stdout: ChildStdout,
    /// Times of frames, seconds; None: the frame has none.
    pub stamps: Receiver<(Stamp, Option<f64>)>,
    listener: Option<JoinHandle<Said>>,
}

impl Running {
    /// Fills a buffer; how much of it there was.
    pub(super) fn fill(&mut self, buffer: &mut [u8]) -> usize {
        let mut done = 0;
        while done < buffer.len() {
            match self.stdout.read(&mut buffer[done..]) {
                Ok(0) => break,
                Ok(n) => done += n,
                Err(e) if e.kind() == std::io::ErrorKind::Interrupted => {}
                Err(_) => break,
            }
        }
        done
    }

    /// Waits for the end: whether it succeeded, and its messages.
    pub(super) fn finish(&mut self) -> (bool, Said) {
        let well = self.child.wait().is_ok_and(|s| s.success());
        let said = self.listener.take().and_then(|l| l.join().ok()).unwrap_or_default();
        (well, said)
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        if self.listener.is_some() {
            let _ = self.child.kill();
            let _ = self.child.wait();
        }
    }
}

/// The version in the first line of `ffmpeg -version`: "ffmpeg version 5.1.9-0+deb12u1 Copyright", "version n6.0". None
/// where it is a build from between two releases ("N-109468-gd39b34123d").
fn version(text: &str) -> Option<(u32, u32)> {
    let word = text.split_whitespace().nth(2)?.trim_start_matches('n');
    let mut numbers = word.split(|c: char| !c.is_ascii_digit()).map(str::parse);
    let major = numbers.next()?.ok()?;
    Some((major, numbers.next().and_then(Result::ok).unwrap_or(0)))
}

/// The time in a line of one of our two `showinfo` filters:
/// `[showinfo@all @ 0x5] [info] n: 3 pts: 1536 pts_time:0.1 ...`. `units` are the unit of time stamps, printed before:
/// `[showinfo@all @ 0x5] [info] config in time_base: 1/15360, ...`. (`pts_time` has six digits, too few for long
/// recordings.)
fn stamp(line: &str, units: &mut [Option<f64>; 2]) -> Option<(Stamp, Option<f64>)> {
    let rest = line.strip_prefix("[showinfo@")?;
    let which = match rest.split(' ').next()? {
        "all" => Stamp::All,
        "kept" => Stamp::Kept,
        _ => return None,
    };
    if let Some((_, unit)) = rest.split_once("config in time_base:") {
        units[which as usize] = ratio(unit.split(',').next()?.trim());
        return None;
    }
    let word = |key: &str| rest.split_once(key).map(|(_, r)| r.split_whitespace().next().unwrap_or(""));
    let pts = word(" pts:")?.parse::<f64>().ok();
    let time = match (pts, units[which as usize]) {
        (Some(pts), Some(unit)) => Some(pts * unit),
        _ => word(" pts_time:").and_then(|t| t.parse().ok()).filter(|t: &f64| t.is_finite()),
    };
    Some((which, time))
}

/// "30000/1001" as a number; None for 0/0 and nonsense.
pub(super) fn ratio(text: &str) -> Option<f64> {
    let (above, below) = text.split_once(['/', ':'])?;
    let value = above.parse::<f64>().ok()? / below.parse::<f64>().ok()?;
    (value.is_finite() && value > 0.0).then_some(value)
}

/// A complaint for people: without addresses, marks and the file's name, which is printed anyway.
fn plain(line: &str, path: &Path) -> String {
    let mut text = line.trim();
    // "[mov,mp4 @ 0x55d5] [error] moov atom not found"
    while text.starts_with('[')
        && let Some((_, rest)) = text.split_once(']')
    {
        text = rest.trim_start();
    }
    let name = path.to_string_lossy();
    let text = text.trim_start_matches("file:").trim_start_matches(&*name).trim_start_matches(':').trim();
    text.chars().take(COMPLAINT_LENGTH).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn versions_of_releases_and_of_builds_between_them() {
        assert_eq!(version("ffmpeg version 5.1.9-0+deb12u1 Copyright (c)"), Some((5, 1)));
        assert_eq!(version("ffmpeg version n7.0 Copyright"), Some((7, 0)));
        assert_eq!(version("ffmpeg version 8 Copyright"), Some((8, 0)));
        assert_eq!(version("ffmpeg version N-109468-gd39b34123d Copyright"), None);
    }

    #[test]
    fn time_stamps_keep_their_precision_in_long_recordings() {
        let mut units = [None; 2];
        assert_eq!(
            stamp("[showinfo@kept @ 0x55] [info] config in time_base: 1/90000, frame_rate: 30/1", &mut units),
            None
        );
        let line = "[showinfo@kept @ 0x55] [info] n:   7 pts: 111110999 pts_time:1234.57 pos: 1 fmt:yuv420p";
        let (which, time) = stamp(line, &mut units).unwrap();
        assert_eq!(which, Stamp::Kept);
        assert!((time.unwrap() - 111_110_999.0 / 90_000.0).abs() < 1e-9);
        // Without a unit, what is there.
        let line = "[showinfo@all @ 0x55] [info] n:   0 pts:      0 pts_time:0.5     pos: 1";
        assert_eq!(stamp(line, &mut units), Some((Stamp::All, Some(0.5))));
        let line = "[showinfo@all @ 0x55] [info] n:   0 pts:   NOPTS pts_time:NOPTS   pos: 1";
        assert_eq!(stamp(line, &mut units), Some((Stamp::All, None)));
        assert_eq!(stamp("[showinfo@all @ 0x55] [info] color_range:unknown", &mut units), None);
    }

    #[test]
    fn warnings_are_reported_without_addresses() {
        let line = "[mov,mp4,m4a,3gp,3g2,mj2 @ 0x558] [error] moov atom not found\n";
        assert_eq!(plain(line, Path::new("a.mp4")), "moov atom not found");
        assert_eq!(plain("file:-a.mp4: Invalid data found", Path::new("-a.mp4")), "Invalid data found");
    }

    #[test]
    fn a_missing_program_is_reported_with_install_instructions() {
        let error = Tools::at(Path::new("no-such-program-here"), Path::new("ffprobe")).unwrap_err().to_string();
        assert!(["apt install", "brew install", "winget install"].iter().all(|w| error.contains(w)), "{error}");
    }
}
