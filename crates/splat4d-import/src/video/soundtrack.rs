//! Sound that is kept with a capture: parts of files, one after the other, as AAC in MP4, which all browsers decode.

use super::Tools;
use super::program::file;
use splat4d::Result;
use std::ffi::OsString;
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// Samples and bits per second of what is written: the rate of videos, and transparent for most material.
const RATE: usize = 48_000;
const BITS: f64 = 128e3;
/// Bytes that are aimed at, at most: nine tenths of what a playback file holds (docs/format.md, "Sound").
const BYTES: f64 = 0.9 * (64 << 20) as f64;

/// A part of a track: its file, the number of the stream (none: there is silence), and how long it lasts, seconds.
pub(crate) type Part = (PathBuf, Option<usize>, f64);

/// Writes a part of a file's first sound track as AAC in MP4: `seconds` from second `from` on, or fewer where it ends.
///
/// Errors: no ffmpeg; no sound; nothing of it in this part; `out` cannot be written.
pub fn write_sound(source: &Path, [from, seconds]: [f64; 2], out: &Path) -> Result<()> {
    let tools = Tools::find()?;
    let stream = tools.sound_stream(source)?;
    encode(&tools, &[(source.to_owned(), Some(stream), f64::INFINITY)], [from, seconds], out)
}

/// The same of parts, one after the other.
pub(crate) fn encode(tools: &Tools, parts: &[Part], [from, seconds]: [f64; 2], out: &Path) -> Result<()> {
    let (mut arguments, mut graph, mut inputs) = (Vec::<OsString>::new(), String::new(), 0);
    for (i, (path, stream, length)) in parts.iter().enumerate() {
        let filled = if length.is_finite() {
            format!(",apad=whole_dur={length:.6},atrim=duration={length:.6}")
        } else {
            String::new()
        };
        let _ = match stream {
            Some(stream) => {
                arguments.extend(["-protocol_whitelist", "file", "-i"].map(OsString::from));
                arguments.push(file(path));
                inputs += 1;
                // As when it is decoded to be compared: what begins later than the images is preceded by silence.
                let filters = format!("aresample={RATE}:async=1:first_pts=0{filled}");
                write!(graph, "[{}:{stream}]{filters}[p{i}];", inputs - 1)
            }
            None => write!(graph, "anullsrc=r={RATE}:cl=mono,atrim=duration={length:.6}[p{i}];"),
        };
    }
    let all: String = (0..parts.len()).map(|i| format!("[p{i}]")).collect();
    let joined = if parts.len() > 1 { format!("concat=n={}:v=0:a=1,", parts.len()) } else { String::new() };
    let _ = write!(
        graph,
        "{all}{joined}atrim=start={from:.6}:duration={seconds:.6},asetpts=PTS-STARTPTS,\
         aformat=channel_layouts=mono|stereo[out]"
    );
    let bits = BITS.min(8.0 * BYTES / seconds) as usize;
    arguments.extend(["-filter_complex", &graph, "-map", "[out]", "-c:a", "aac", "-b:a"].map(OsString::from));
    // Nothing of the camera goes along: its place and its owner's name may be in there.
    let rest = ["-map_metadata", "-1", "-fflags", "+bitexact", "-flags:a", "+bitexact"];
    arguments.push(bits.to_string().into());
    arguments.extend(rest.into_iter().chain(["-movflags", "+faststart", "-f", "mp4"]).map(OsString::from));
    tools.write(&arguments, out)
}
