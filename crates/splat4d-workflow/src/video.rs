//! Films: mp4 through the `ffmpeg` program, animated PNG (plays in every browser, needs nothing), or a folder of PNGs.

use crate::draw::Rgb;
use crate::files::{self, cannot_write};
use crate::sequence::Pattern;
use splat4d::format::playback::Sound;
use splat4d::{Error, Result};
use splat4d_train::output::Staged;
use std::fs::File;
use std::io::{BufWriter, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};

/// x264's quality: 18 is visually lossless for most material (FFmpeg's H.264 guide).
const CRF: &str = "18";
/// Bits per second of its sound, and samples per second.
const AUDIO: &str = "160k";
const SAMPLES: f64 = 48_000.0;
/// File name endings that films may have.
const ENDINGS: &str = "Use .mp4, .mkv or .mov (needs ffmpeg), .png (animated), NAME.%04d.png or NAME.%04d.exr (numbered), or a name without extension for a folder of images.";
/// Remedy where ffmpeg is missing.
const INSTEAD: &str = "Install ffmpeg, or write an animated .png or a folder of images instead (option `output` NAME.png, option `output` FOLDER).";
/// What is in the folder in which ffmpeg works: the film and its sound.
const FILES: [&str; 2] = ["film", "sound.m4a"];
/// Most bytes kept of what ffmpeg states.
const STDERR_BYTES: usize = 64 << 10;

/// Whether the `ffmpeg` program can be called.
pub fn have_ffmpeg() -> bool {
    let mut probe = Command::new("ffmpeg");
    probe.arg("-version").stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    probe.status().is_ok_and(|s| s.success())
}

/// A film that is being written.
pub enum Film {
    /// Through ffmpeg.
    Mp4 {
        /// The temporary file.
        output: Staged,
        /// The program.
        child: Child,
        /// Destination of frames.
        pipe: Option<ChildStdin>,
        /// A folder for what ffmpeg writes and reads, removed with the film's maker. A program that outlives ours opens
        /// nothing there once it is removed.
        work: Staged,
        /// Collects what ffmpeg states.
        words: Option<std::thread::JoinHandle<Vec<u8>>>,
    },
    /// Animated PNG.
    Apng {
        /// The temporary file.
        output: Staged,
        /// Writes frames one by one.
        writer: Box<png::Writer<BufWriter<File>>>,
    },
    /// Numbered files with names that were given: one image each.
    Files {
        /// The files.
        files: Vec<PathBuf>,
        /// Number of frames.
        next: usize,
    },
    /// Numbered PNGs.
    Folder {
        /// The folder.
        path: PathBuf,
        /// Number of frames.
        next: usize,
    },
}

impl Film {
    /// Starts a film of `frames` frames at `path`: `.mp4`, `.mkv` and `.mov` through ffmpeg, `.png` and `.apng` as
    /// animated PNG, no ending as a folder of numbered PNGs. `sound`: sound of the first kind, and the scene's second at
    /// which the film begins, from which on time runs as it does.
    pub fn create(
        path: &Path,
        [width, height]: [usize; 2],
        fps: f64,
        frames: usize,
        sound: Option<(&Sound, f64)>,
    ) -> Result<Self> {
        let ending = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default();
        match ending.as_str() {
            "png" | "apng" => Self::apng(path, [width, height], fps, frames),
            "mp4" | "mkv" | "mov" => Self::ffmpeg(path, &ending, [width, height], fps, frames, sound),
            "" => {
                files::make_folder(path)?;
                Ok(Self::Folder { path: path.to_owned(), next: 0 })
            }
            _ => Err(Error::input(format!("films cannot be written as .{ending}")).at(path.display()).remedy(ENDINGS)),
        }
    }

    /// Starts a film of one file per frame, whose folder is made.
    pub fn files(files: Vec<PathBuf>) -> Result<Self> {
        if let Some(folder) = files.first().and_then(|f| f.parent()).filter(|p| !p.as_os_str().is_empty()) {
            files::make_folder(folder)?;
        }
        Ok(Self::Files { files, next: 0 })
    }

    fn ffmpeg(
        path: &Path,
        ending: &str,
        [width, height]: [usize; 2],
        fps: f64,
        frames: usize,
        sound: Option<(&Sound, f64)>,
    ) -> Result<Self> {
        let output = Staged::new(path)?;
        if output.path().exists() {
            return Err(Error::input("is a device or a pipe, and films need a file")
                .at(path.display())
                .remedy(ENDINGS));
        }
        let work = Staged::new(path)?;
        // ffmpeg would report an unwritable place only after the first frame, in its own words.
        std::fs::create_dir(work.path()).map_err(|e| cannot_write(path, e))?;
        let container = if ending == "mkv" { "matroska" } else { ending };
        let mut command = Command::new("ffmpeg");
        command.args(["-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24"]);
        command.args(["-s", &format!("{width}x{height}"), "-r", &fps.to_string(), "-i", "-"]);
        match sound {
            Some((sound, begins)) => {
                let (file, late) = (work.path().join(FILES[1]), sound.span[0] - begins);
                std::fs::write(&file, &sound.mp4).map_err(|e| cannot_write(path, e))?;
                command.arg("-i").arg(file).args(["-map", "0:v", "-map", "1:a", "-c:a", "aac", "-b:a", AUDIO]);
                // What the film begins after is left out; sound that begins later is preceded by silence.
                let cut = format!("atrim=start={:.6},asetpts=PTS-STARTPTS", (-late).max(0.0));
                let delay = format!("adelay=delays={:.0}S:all=1", late.max(0.0) * SAMPLES);
                command.args(["-af", &format!("aresample={SAMPLES},{cut},{delay}")]);
                command.args(["-t", &format!("{:.6}", frames as f64 / fps)]);
            }
            None => drop(command.arg("-an")),
        }
        // 4:2:0 needs even sides.
        command.args(["-vf", "crop=max(2\\,trunc(iw/2)*2):max(2\\,trunc(ih/2)*2)", "-c:v", "libx264", "-crf", CRF]);
        command
            .args(["-pix_fmt", "yuv420p", "-movflags", "+faststart", "-f", container])
            .arg(work.path().join(FILES[0]));
        command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped());
        let mut child = command.spawn().map_err(|e| {
            Error::environment("the program ffmpeg, which writes films, cannot be started", e).remedy(INSTEAD)
        })?;
        let pipe = child.stdin.take();
        let words = child.stderr.take().map(|mut stderr| {
            std::thread::spawn(move || {
                let mut all = Vec::new();
                let mut buffer = [0; 4096];
                while let Ok(n @ 1..) = stderr.read(&mut buffer) {
                    all.extend_from_slice(&buffer[..n.min(STDERR_BYTES.saturating_sub(all.len()))]);
                }
                all
            })
        });
        Ok(Self::Mp4 { output, work, child, pipe, words })
    }

    fn apng(path: &Path, [width, height]: [usize; 2], fps: f64, frames: usize) -> Result<Self> {
        let output = Staged::new(path)?;
        let file = File::create(output.path()).map_err(|e| cannot_write(path, e))?;
        let mut encoder = png::Encoder::new(BufWriter::new(file), width as u32, height as u32);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        encoder.set_compression(png::Compression::Balanced);
        encoder.set_filter(png::Filter::Adaptive);
        if frames > 1 {
            encoder.set_animated(frames as u32, 0).map_err(|e| full(path, e))?;
            // The delay is a fraction of two 16-bit numbers.
            encoder
                .set_frame_delay((1000.0 / fps).round().clamp(1.0, 65535.0) as u16, 1000)
                .map_err(|e| full(path, e))?;
        }
        let writer = encoder.write_header().map_err(|e| full(path, e))?;
        Ok(Self::Apng { output, writer: Box::new(writer) })
    }

    /// Adds a frame. Panics never; frames of another size than the film's are an error of ours that ffmpeg reports.
    pub fn frame(&mut self, picture: &Rgb) -> Result<()> {
        match self {
            Self::Mp4 { pipe, .. } => {
                let written = pipe.as_mut().map(|p| p.write_all(&picture.data));
                if !matches!(written, Some(Ok(()))) {
                    return Err(self.ffmpeg_messages());
                }
            }
            Self::Apng { writer, output } => {
                writer.write_image_data(&picture.data).map_err(|e| full(output.path(), e))?
            }
            Self::Folder { .. } | Self::Files { .. } => self.file(&picture.png())?,
        }
        Ok(())
    }

    /// Adds a frame as the bytes of its file. Panics: the film is a single file.
    pub fn file(&mut self, bytes: &[u8]) -> Result<()> {
        match self {
            Self::Folder { path, next } => {
                files::write(&path.join(format!("{next:05}.png")), bytes)?;
                *next += 1;
            }
            Self::Files { files, next } => {
                files::write(&files[*next], bytes)?;
                *next += 1;
            }
            _ => panic!("the frames of a single file have no bytes of their own"),
        }
        Ok(())
    }

    /// Ends the film and gives the file its name.
    pub fn finish(mut self) -> Result<()> {
        if let Self::Mp4 { child, pipe, .. } = &mut self {
            drop(pipe.take());
            if !child.wait().is_ok_and(|s| s.success()) {
                return Err(self.ffmpeg_messages());
            }
        }
        match self {
            Self::Mp4 { output, work, .. } => {
                let film = work.path().join(FILES[0]);
                std::fs::rename(film, output.path()).map_err(|e| cannot_write(output.path(), e))?;
                output.keep()?;
            }
            Self::Apng { output, writer } => {
                writer.finish().map_err(|e| full(output.path(), e))?;
                output.keep()?;
            }
            Self::Folder { .. } | Self::Files { .. } => {}
        }
        Ok(())
    }

    fn ffmpeg_messages(&mut self) -> Error {
        let Self::Mp4 { child, pipe, words, .. } = self else {
            unreachable!("only ffmpeg's films have words of ffmpeg");
        };
        drop(pipe.take());
        let _ = child.wait();
        let said = words.take().and_then(|w| w.join().ok()).unwrap_or_default();
        let said = String::from_utf8_lossy(&said);
        let last: Vec<&str> = said.lines().rev().take(3).collect();
        let last: Vec<&str> = last.into_iter().rev().collect();
        if said.contains("No space left") {
            let error = std::io::Error::from(std::io::ErrorKind::StorageFull);
            return Error::environment("the film cannot be written", error).remedy(files::WRITE_REMEDY);
        }
        let words = if last.is_empty() { "it printed nothing".into() } else { last.join("; ") };
        Error::environment("ffmpeg could not write the film", std::io::Error::other(words)).remedy(INSTEAD)
    }
}

/// An error of the PNG encoder: nearly always the disk.
fn full(path: &Path, error: png::EncodingError) -> Error {
    match error {
        png::EncodingError::IoError(e) => cannot_write(path, e),
        other => Error::environment("the image could not be encoded", std::io::Error::other(other)).at(path.display()),
    }
}

/// Checks that the film's ending can be written before hours are spent on it.
pub fn check(path: &Path) -> Result<()> {
    let ending = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default();
    if matches!(ending.as_str(), "mp4" | "mkv" | "mov") && !have_ffmpeg() {
        return Err(Error::input("the program ffmpeg, which writes films, was not found")
            .at(path.display())
            .remedy(INSTEAD));
    }
    if !matches!(ending.as_str(), "" | "png" | "apng" | "exr" | "mp4" | "mkv" | "mov")
        || Pattern::of(path).is_some() && !matches!(ending.as_str(), "png" | "exr")
    {
        return Err(Error::input(format!("films cannot be written as .{ending}")).at(path.display()).remedy(ENDINGS));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture(shade: u8, width: usize, height: usize) -> Rgb {
        let data = (0..width * height * 3).map(|i| shade.wrapping_add((i % 7) as u8)).collect();
        Rgb { width, height, data }
    }

    #[test]
    fn an_animated_png_holds_its_frames() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("film.png");
        let mut film = Film::create(&path, [9, 5], 24.0, 3, None).unwrap();
        for shade in [10, 90, 200] {
            film.frame(&picture(shade, 9, 5)).unwrap();
        }
        film.finish().unwrap();
        let decoder = png::Decoder::new(std::io::BufReader::new(File::open(&path).unwrap()));
        let mut reader = decoder.read_info().unwrap();
        assert_eq!(reader.info().animation_control().unwrap().num_frames, 3);
        let mut frame = vec![0; reader.output_buffer_size().unwrap()];
        for shade in [10, 90, 200] {
            reader.next_frame(&mut frame).unwrap();
            assert_eq!(frame, picture(shade, 9, 5).data);
        }
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "no temporary file stays");
    }

    #[test]
    fn a_folder_holds_numbered_images() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("frames");
        let mut film = Film::create(&path, [4, 4], 24.0, 2, None).unwrap();
        film.frame(&picture(1, 4, 4)).unwrap();
        film.frame(&picture(2, 4, 4)).unwrap();
        film.finish().unwrap();
        let second = image::open(path.join("00001.png")).unwrap().to_rgb8();
        assert_eq!(second.into_raw(), picture(2, 4, 4).data);
    }

    #[test]
    fn odd_sizes_become_films_where_ffmpeg_is_found() {
        if !have_ffmpeg() {
            println!("skipped: there is no ffmpeg");
            return;
        }
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("film.mp4");
        let mut film = Film::create(&path, [33, 17], 24.0, 4, None).unwrap();
        for shade in 0..4 {
            film.frame(&picture(shade * 60, 33, 17)).unwrap();
        }
        film.finish().unwrap();
        let bytes = std::fs::read(&path).unwrap();
        assert_eq!(&bytes[4..8], b"ftyp", "an mp4 begins with its type box");
    }

    #[test]
    fn a_program_that_outlives_ours_leaves_no_film() {
        if !have_ffmpeg() {
            println!("skipped: there is no ffmpeg");
            return;
        }
        let folder = tempfile::tempdir().unwrap();
        let mut film = Film::create(&folder.path().join("film.mp4"), [16, 16], 24.0, 2, None).unwrap();
        let Film::Mp4 { work, child, pipe, .. } = &mut film else { panic!("an mp4 is written by ffmpeg") };
        // As the next command does where this one was killed.
        std::fs::remove_dir_all(work.path()).unwrap();
        pipe.as_mut().unwrap().write_all(&picture(3, 16, 16).data).unwrap();
        drop(pipe.take());
        child.wait().unwrap();
        drop(film);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    }

    #[test]
    fn unknown_endings_and_missing_folders_are_explained() {
        let message = check(Path::new("film.gif")).unwrap_err().to_string();
        assert!(message.contains(".gif") && message.contains(".mp4"));
        assert!(Film::create(Path::new("/nonexistent/film.png"), [4, 4], 24.0, 2, None).is_err());
    }
}
