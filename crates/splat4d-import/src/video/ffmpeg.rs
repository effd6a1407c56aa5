//! Videos through the ffmpeg program: images and their times through two pipes, sound through one.

use super::filters::{self, Chain};
use super::probe::{self, Probe};
use super::program::{Running, Said, Stamp, Tools};
use super::{Frame, Info, Reader, SOUND_RATE, Selection, Source, fingerprint_of_file, fnv1a, stem};
use splat4d::{Error, ErrorKind, Result};
use std::path::{Path, PathBuf};

/// Seconds before the first requested frame where reading begins, so that rounding does not lose it.
const SEEK_MARGIN: f64 = 1e-3;
/// A time stamp is this exact: a tick of the coarsest usual clocks (Matroska's) is a millisecond.
const STAMP_ERROR: f64 = 0.6e-3;
/// Frames that may be missing at the end before a file is called truncated.
const END_FRAMES: f64 = 3.0;
/// The same in seconds, where the duration may be that of the sound.
const END_SECONDS: f64 = 1.0;
/// Frames per second where neither file nor frames give them.
const GUESSED_RATE: f64 = 30.0;
/// Most seconds of sound that are read: two hours are 460 MB.
const MAX_SOUND: f64 = 7200.0;

/// A video file.
pub(super) struct Video {
    path: PathBuf,
    tools: Tools,
    probe: Probe,
}

impl Video {
    /// Probes it with ffprobe.
    pub(super) fn open(path: &Path, tools: Tools) -> Result<Self> {
        let json = tools.probe(path)?;
        let mut probe = probe::parse(&json, stem(path)).map_err(|e| e.at(path.display()))?;
        if let Some(decoder) = probe.alpha_decoder.filter(|d| !tools.decodes(d)) {
            (probe.alpha_decoder, probe.info.alpha) = (None, false);
            probe.info.warnings.push(format!(
                "Its pixels may be transparent, but this ffmpeg lacks {decoder}, which reads that: they are taken for opaque."
            ));
        }
        Ok(Self { path: path.to_owned(), tools, probe })
    }

    /// The interval between frames that the file promises.
    fn interval(&self) -> f64 {
        let info = &self.probe.info;
        1.0 / info.average_rate.or(info.nominal_rate).unwrap_or(GUESSED_RATE)
    }
}

impl Source for Video {
    fn info(&self) -> &Info {
        &self.probe.info
    }

    fn frames(&self, selection: &Selection) -> Result<Box<dyn Reader + '_>> {
        selection.check_for(self.info())?;
        let info = &self.probe.info;
        if info.interlaced && !selection.deinterlace {
            let what = "it is interlaced: each frame contains two fields of different times";
            return Err(Error::new(ErrorKind::Unsupported, what).at(self.path.display()).remedy(
                "Film progressively (50p, not 50i). To convert existing video: ffmpeg -i IN -vf yadif=1 -crf 12 \
                 OUT.mp4 makes a frame of every field.",
            ));
        }
        let Chain { text, size, mut warnings } = filters::chain(info, selection, self.tools.tone_mapping);
        warnings.splice(0..0, info.warnings.iter().cloned());
        let mut input = Vec::new();
        if let Some(decoder) = self.probe.alpha_decoder {
            input.extend(["-c:v".into(), decoder.into()]);
        }
        let seek = selection.from.map_or(0.0, |from| (from - SEEK_MARGIN).max(0.0));
        if seek > 0.0 {
            // Its own clock is kept: shifted to the position that was sought, time stamps are rounded to ticks of the
            // file, and those of AVI are whole frames.
            input.extend(["-copyts".into(), "-start_at_zero".into(), "-ss".into(), format!("{seek:.6}")]);
        }
        if let Some(to) = selection.to {
            // The program rounds this end to ticks of the file too; surplus frames are left out below.
            input.extend(["-t".into(), format!("{:.6}", to - seek + END_FRAMES * self.interval())]);
        }
        let mut output = vec!["-map".into(), format!("0:{}", self.probe.picture), "-vf".into(), text];
        output.extend(self.tools.passthrough().map(String::from));
        let pixels = if info.alpha { "rgba" } else { "rgb24" };
        output.extend(["-f", "rawvideo", "-pix_fmt", pixels].map(String::from));
        let running = self.tools.start(&self.path, &input, &output)?;
        let selection = selection.clone();
        Ok(Box::new(Pictures {
            video: self,
            running,
            selection,
            size,
            seek,
            times: Vec::new(),
            told: 0,
            given: 0,
            raw: Vec::new(),
            warnings,
            done: false,
            guessed: false,
        }))
    }

    fn sound(&self) -> Result<Option<Vec<f32>>> {
        self.probe.sound.map_or(Ok(None), |stream| samples(&self.tools, &self.path, stream))
    }

    fn sounds(&self) -> Vec<(PathBuf, Option<usize>, f64)> {
        let part = |stream| (self.path.clone(), Some(stream), f64::INFINITY);
        self.probe.sound.map(part).into_iter().collect()
    }

    fn fingerprint(&self) -> Result<String> {
        let hash = fingerprint_of_file(&self.path)?;
        Ok(format!("{:016x}", fnv1a(&hash.to_le_bytes())))
    }
}

/// Samples of a sound stream, see [`Source::sound`].
pub(crate) fn samples(tools: &Tools, path: &Path, stream: usize) -> Result<Option<Vec<f32>>> {
    // Sound that begins later than the images is preceded by silence; gaps are filled with it.
    let filter = format!("aresample={SOUND_RATE}:async=1:first_pts=0");
    let output = ["-map", &format!("0:{stream}"), "-vn", "-af", &filter, "-ac", "1", "-t", &MAX_SOUND.to_string()];
    let mut output: Vec<String> = output.map(String::from).to_vec();
    output.extend(["-f", "f32le"].map(String::from));
    let mut running = tools.start(path, &[], &output)?;
    let mut samples = Vec::new();
    let mut buffer = vec![0; 1 << 16];
    loop {
        let filled = running.fill(&mut buffer);
        let whole = buffer[..filled].chunks_exact(4);
        samples.extend(whole.map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])));
        if filled < buffer.len() {
            break;
        }
    }
    let (well, said) = running.finish();
    if samples.is_empty() && !well {
        let what = format!("its sound cannot be decoded{}", said.bracketed());
        return Err(Error::input(what).at(path.display()).remedy("Synchronise without its sound."));
    }
    // Damaged files hold what is not finite.
    samples.iter_mut().filter(|s| !s.is_finite()).for_each(|s| *s = 0.0);
    Ok((!samples.is_empty()).then_some(samples))
}

/// The frames of a video as ffmpeg gives them.
struct Pictures<'a> {
    video: &'a Video,
    running: Running,
    selection: Selection,
    size: [usize; 2],
    /// The second where reading began.
    seek: f64,
    times: Vec<f64>,
    /// How many frames ffmpeg kept and printed the time of.
    told: usize,
    /// How many were given away.
    given: usize,
    /// Raw pixels with alpha.
    raw: Vec<u8>,
    warnings: Vec<String>,
    done: bool,
    /// Whether a time had to be synthetic.
    guessed: bool,
}

impl Pictures<'_> {
    /// The time of the next frame that was kept; times of all frames are recorded. None: ffmpeg has ended.
    fn next_stamp(&mut self) -> Option<f64> {
        loop {
            let (which, time) = self.running.stamps.recv().ok()?;
            match which {
                Stamp::All => {
                    let time = time.unwrap_or_else(|| {
                        self.guessed = true;
                        self.times.last().map_or(self.seek, |t| t + self.video.interval())
                    });
                    self.times.push(time);
                }
                Stamp::Kept => {
                    self.told += 1;
                    // A frame is kept right after its time was noted.
                    return time.or(self.times.last().copied());
                }
            }
        }
    }

    /// At the end: an error if there was nothing, else warnings.
    fn end(&mut self) -> Result<()> {
        self.done = true;
        while self.next_stamp().is_some() {}
        let (well, said) = self.running.finish();
        let place = self.video.path.display();
        if self.given == 0 {
            return Err(self.nothing(&said).at(place));
        }
        let info = &self.video.probe.info;
        let last = self.times.last().copied().unwrap_or(0.0);
        let slack = if self.video.probe.own_duration {
            END_FRAMES * self.video.interval()
        } else {
            END_SECONDS + END_FRAMES * self.video.interval()
        };
        let expected = info.duration.map(|d| self.selection.to.map_or(d, |to| to.min(d)));
        let frames = self.times.len();
        if let Some(end) = expected.filter(|&end| last + slack < end) {
            self.warnings.push(format!(
                "It ends after {frames} frames, at {last:.2} s, though its file promises {end:.2} s: truncated or damaged{}. \
                 What there is is used.",
                said.bracketed()
            ));
        } else if !well || said.count > 0 {
            self.warnings.push(format!(
                "ffmpeg complained {} times while it decoded {frames} frames{}: images may be damaged.",
                said.count.max(1),
                said.bracketed()
            ));
        }
        if self.guessed {
            self.warnings.push("Some of its frames have no time stamp; they were spaced evenly.".into());
        }
        Ok(())
    }

    /// Why there is no frame at all.
    fn nothing(&self, said: &Said) -> Error {
        let info = &self.video.probe.info;
        if said.has("Decoder (codec") || said.has("no decoder found") || said.has("Decoder not found") {
            let what = format!("this ffmpeg cannot decode {}{}", info.codec, said.bracketed());
            return Error::new(ErrorKind::Unsupported, what).remedy("Install a full ffmpeg, or convert it to H.264.");
        }
        if let (Some(from), Some(duration)) = (self.selection.from, info.duration)
            && from >= duration
        {
            let what = format!("it ends at {duration:.2} s, before the part that was chosen ({from} s)");
            return Error::input(what).remedy("Choose an earlier part.");
        }
        Error::input(format!("no frame of it can be decoded{}", said.bracketed()))
            .remedy("Play it; if it plays, convert it to mp4, else copy it again from the camera.")
    }
}

impl Reader for Pictures<'_> {
    fn next(&mut self, frame: &mut Frame) -> Result<bool> {
        let [width, height] = self.size;
        while !self.done {
            let picture = &mut frame.picture;
            (picture.width, picture.height) = (width, height);
            picture.data.resize(width * height * 3, 0);
            if self.video.probe.info.alpha {
                self.raw.resize(width * height * 4, 0);
                if self.running.fill(&mut self.raw) < self.raw.len() {
                    break;
                }
                let pixels = picture.data.as_chunks_mut::<3>().0.iter_mut().zip(self.raw.as_chunks::<4>().0);
                pixels.for_each(|(to, [r, g, b, _])| *to = [*r, *g, *b]);
                frame.alpha.clear();
                frame.alpha.extend(self.raw.iter().skip(3).step_by(4));
            } else if self.running.fill(&mut picture.data) < width * height * 3 {
                break;
            }
            let Some(time) = self.next_stamp() else { break };
            // The margin of seeking may let a frame too many through.
            if self.selection.from.is_some_and(|from| time < from - STAMP_ERROR)
                || self.selection.to.is_some_and(|to| time >= to - STAMP_ERROR)
            {
                continue;
            }
            frame.time = time;
            frame.number = self.times.iter().rposition(|&t| t <= time).unwrap_or(0);
            self.given += 1;
            return Ok(true);
        }
        if !self.done {
            self.end()?;
        }
        Ok(false)
    }

    fn times(&self) -> &[f64] {
        &self.times
    }

    fn warnings(&self) -> &[String] {
        &self.warnings
    }
}
