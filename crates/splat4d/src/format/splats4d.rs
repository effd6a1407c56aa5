//! `.splat4d` of splats4D (another program than this one), read: the frames of a series of .splat with one count and order.
//!
//! `SP4D`, version, flags, a JSON of counts, steps and places, then streams as in [`fourdgs`](super::fourdgs): bytes of symbols in
//! planes, zstd. A base holds what does not change; groups of frames hold bins of the rest, the first frame absolute, the others
//! as differences. Gaussians whose colour, opacity and scale stay become `tracked`; the others have a row for every frame.
//! Source: adamraudonis/splats4D (MIT), docs/FORMAT.md, version 1.

use super::bytes::{Cursor, dc_of_byte, logit_of_byte};
use super::dialect::{Dialect, Opened, Writer, Y_DOWN};
use super::inflate::zstd;
use super::sequence;
use super::warnings::Warnings;
use crate::layers::{Layer, Scene};
use crate::motion::tracked::{POSE, Tracked, TrackedSpec};
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use crate::scene::{GEOMETRY, LifeKind, Params, SH};
use crate::{Error, ErrorKind, Result};
use serde_json::Value;
use std::sync::Arc;

/// splats4D's files. Their ending `.splat4d` was that of our own playback files; they are known by their first bytes.
pub(crate) const DIALECT: Dialect = Dialect {
    name: ".splat4d of splats4D",
    ending: ".sp4d",
    up: Y_DOWN,
    moves: true,
    mark: Some(|bytes| bytes.starts_with(MAGIC)),
    read: |bytes| read(bytes).map(Opened::from),
    writer: Writer::None("Write numbered .splat files (--frames --constant), which that program encodes."),
    world: false,
    fixed_axes: false,
    states_up: false,
};

const MAGIC: &[u8] = b"SP4D";
/// Attributes in the order of their codes, and their channels.
const POSITION: usize = 0;
const ROTATION: usize = 1;
const COLOR: usize = 2;
const ALPHA: usize = 3;
const SCALE: usize = 4;
const CHANNELS: [usize; 5] = [3, 4, 3, 1, 3];
/// Most bytes of a scene in memory: these, and times the bytes of the file.
const MOST_SMALL: usize = 256 << 20;
const MOST_RATIO: usize = 256;
/// Bytes of a Gaussian in memory, about.
const ROW: usize = 96;

fn damaged(what: impl std::fmt::Display) -> Error {
    Error::input(format!("this .splat4d of splats4D is damaged: {what}")).remedy("Copy or encode it again.")
}

/// Unsigned symbols of `count` numbers.
fn symbols(packed: &[u8], width: u8, count: usize) -> Result<Vec<u32>> {
    let width = usize::from(width);
    if ![1, 2, 4].contains(&width) {
        return Err(damaged(format!("symbols of {width} bytes")));
    }
    let plain = zstd(packed, count * width).map_err(damaged)?;
    let symbol = |i: usize| (0..width).fold(0, |u, plane| u | u32::from(plain[plane * count + i]) << (8 * plane));
    Ok((0..count).map(symbol).collect())
}

fn signed(symbol: u32) -> i32 {
    (symbol >> 1) as i32 ^ -((symbol & 1) as i32)
}

/// Content of the JSON.
struct Header {
    rows: usize,
    frames: usize,
    fps: f64,
    /// Steps of the changing attributes, by code, and of the base's positions and log scales.
    steps: [f64; 5],
    base_steps: [f64; 2],
    base: usize,
    /// First byte, first and last frame of every group.
    groups: Vec<[usize; 3]>,
}

impl Header {
    fn read(bytes: &[u8]) -> Result<Self> {
        let mut c = Cursor::new(bytes, ".splat4d of splats4D");
        c.take(MAGIC.len())?;
        let (version, _flags) = (c.u16()?, c.u16()?);
        if version != 1 {
            return Err(Error::new(ErrorKind::Unsupported, format!("version {version} of .splat4d of splats4D"))
                .remedy("Decode its frames with that program and open the numbered .splat files."));
        }
        let length = c.u32()? as usize;
        let json: Value = serde_json::from_slice(c.take(length)?).map_err(|e| damaged(format!("its header: {e}")))?;
        let count = |v: &Value, name: &str| {
            let n = v[name].as_u64().and_then(|n| usize::try_from(n).ok());
            n.ok_or_else(|| damaged(format!("its header states no `{name}`")))
        };
        let step = |name: &str| {
            let step = json["steps"][name].as_f64().filter(|s| *s > 0.0 && s.is_finite());
            step.ok_or_else(|| damaged(format!("its header states no step `{name}`")))
        };
        let groups = json["gops"].as_array().map_or(&[][..], Vec::as_slice);
        let groups = groups.iter().map(|g| Ok([count(g, "offset")?, count(g, "f0")?, count(g, "f1")?]));
        let header = Self {
            rows: count(&json, "n")?,
            frames: count(&json, "t")?,
            fps: json["fps"]
                .as_f64()
                .filter(|f| (0.01..=1000.0).contains(f))
                .ok_or_else(|| damaged("its frame rate"))?,
            steps: [step("pos")?, step("rot")?, step("rgb")?, step("alpha")?, step("scale_log")?],
            base_steps: [step("base_pos")?, step("base_scale_log")?],
            base: count(&json["static_section"], "offset")?,
            groups: groups.collect::<Result<_>>()?,
        };
        let most = MOST_SMALL + MOST_RATIO.saturating_mul(bytes.len());
        let poses = header.rows.saturating_mul(header.frames).saturating_mul(4 * POSE);
        if header.rows.saturating_mul(ROW).saturating_add(poses) > most {
            let what =
                format!("{} Gaussians in {} frames take more memory than is granted", header.rows, header.frames);
            return Err(Error::new(ErrorKind::Memory, what).remedy("Encode a part of the frames."));
        }
        if header.rows == 0 || header.frames == 0 {
            return Err(damaged("it holds no Gaussians"));
        }
        Ok(header)
    }
}

/// Bins or numbers of all Gaussians at a frame, by attribute.
struct State {
    numbers: [Vec<f32>; 5],
    /// Gaussians that change, by attribute.
    changing: [Vec<usize>; 5],
}

impl State {
    fn base(header: &Header, bytes: &[u8]) -> Result<Self> {
        let n = header.rows;
        let section = bytes.get(header.base..).ok_or_else(|| damaged("its base lies outside the file"))?;
        let mut c = Cursor::new(section, "base of .splat4d");
        let mut stream = |count: usize| {
            // Attribute and kind stand here as well, which the page of the format leaves out.
            c.take(2)?;
            let (width, found, length) = (c.u8()?, c.u32()? as usize, c.u32()? as usize);
            if found != count {
                return Err(damaged(format!("a stream of {found} symbols, expected {count}")));
            }
            symbols(c.take(length)?, width, count)
        };
        let mut changing: [Vec<usize>; 5] = Default::default();
        for rows in &mut changing {
            let mask = stream(n.div_ceil(8))?;
            *rows = (0..n).filter(|i| mask[i / 8] & (128 >> (i % 8)) == 0).collect();
        }
        let mut summed = |step: f64| -> Result<Vec<f32>> {
            let mut at = [0i64; 3];
            let bins = stream(3 * n)?;
            Ok(bins
                .iter()
                .enumerate()
                .map(|(i, z)| {
                    at[i % 3] += i64::from(signed(*z));
                    (at[i % 3] as f64 * step) as f32
                })
                .collect())
        };
        let (positions, scales) = (summed(header.base_steps[0])?, summed(header.base_steps[1])?);
        let colors = stream(3 * n)?.iter().map(|x| *x as f32).collect();
        let alphas = stream(n)?.iter().map(|x| *x as f32).collect();
        let quats = stream(4 * n)?.iter().map(|x| *x as f32 - 128.0).collect();
        Ok(Self { numbers: [positions, quats, colors, alphas, scales], changing })
    }

    fn byte(&self, attribute: usize, i: usize) -> u8 {
        self.numbers[attribute][i].clamp(0.0, 255.0).round() as u8
    }

    fn pose(&self, row: usize) -> [f32; POSE] {
        std::array::from_fn(|k| {
            if k < 3 { self.numbers[POSITION][3 * row + k] } else { self.numbers[ROTATION][4 * row + k - 3] / 128.0 }
        })
    }

    /// These Gaussians, unchanged.
    fn params(&self, rows: &[usize]) -> Params {
        let mut params = Params::new(rows.len(), 1, &[]);
        const { assert!(QUAT == 3, "a pose is position and rotation") };
        for (to, &row) in rows.iter().enumerate() {
            params[GEOMETRY].write(to, 0, self.pose(row));
            params[GEOMETRY].write(
                to,
                LOG_SCALE,
                std::array::from_fn::<f32, 3, _>(|k| self.numbers[SCALE][3 * row + k]),
            );
            params[GEOMETRY].set(to, OPACITY, logit_of_byte(self.byte(ALPHA, row)));
            params[SH].write(to, 0, std::array::from_fn::<f32, 3, _>(|k| dc_of_byte(self.byte(COLOR, 3 * row + k))));
        }
        params
    }
}

/// Signed bins of a group's frames, by attribute: [frame, Gaussian, channel], the first frame absolute.
fn group(bytes: &[u8], [at, from, to]: [usize; 3], state: &State) -> Result<[Vec<i32>; 5]> {
    let mut c =
        Cursor::new(bytes.get(at..).ok_or_else(|| damaged("a group lies outside the file"))?, "group of .splat4d");
    let streams = c.u16()?;
    let entries = (0..streams).map(|_| Ok((c.u8()?, c.u8()?, c.u8()?, c.u32()? as usize, c.u32()? as usize)));
    let entries = entries.collect::<Result<Vec<_>>>()?;
    let mut keys: [Vec<i32>; 5] = Default::default();
    let mut steps: [Vec<i32>; 5] = Default::default();
    for (attribute, kind, width, count, length) in entries {
        let packed = c.take(length)?;
        let i = usize::from(attribute);
        let place = if kind == 0 { &mut keys } else { &mut steps };
        let (Some(place), Some(channels)) = (place.get_mut(i), CHANNELS.get(i)) else { continue };
        let frames = if kind == 0 { 1 } else { to - from };
        if count != state.changing[i].len() * channels * frames {
            return Err(damaged(format!("a group has {count} symbols of attribute {attribute}")));
        }
        *place = symbols(packed, width, count)?.into_iter().map(signed).collect();
    }
    for (i, key) in keys.iter_mut().enumerate() {
        let each = state.changing[i].len() * CHANNELS[i];
        if key.len() != each || steps[i].len() != each * (to - from) {
            return Err(damaged(format!("a group lacks attribute {i}")));
        }
        key.append(&mut steps[i]);
        for at in each..key.len() {
            key[at] = key[at].wrapping_add(key[at - each]);
        }
    }
    Ok(keys)
}

/// Reads a file.
fn read(bytes: &[u8]) -> Result<(Scene<f32>, Warnings)> {
    let header = Header::read(bytes)?;
    let mut state = State::base(&header, bytes)?;
    let mut changes = vec![false; header.rows];
    [COLOR, ALPHA, SCALE].iter().flat_map(|a| &state.changing[*a]).for_each(|row| changes[*row] = true);
    let [steady, changing] =
        [false, true].map(|wanted| (0..header.rows).filter(|r| changes[*r] == wanted).collect::<Vec<usize>>());
    let moves = [POSITION, ROTATION].iter().any(|a| !state.changing[*a].is_empty());
    let times: Vec<f64> = (0..header.frames).map(|i| i as f64 / header.fps).collect();
    let kept = if moves { times.clone() } else { times[..1].to_vec() };
    let mut tracked: Option<(Params, Tracked)> = None;
    let mut frames = Vec::with_capacity(header.frames);
    for &[at, from, to] in &header.groups {
        if from != frames.len() || to < from || to >= header.frames {
            return Err(damaged(format!("a group of frames {from} to {to} follows {} frames", frames.len())));
        }
        let bins = group(bytes, [at, from, to], &state)?;
        for frame in from..=to {
            for (i, channels) in CHANNELS.into_iter().enumerate() {
                let each = state.changing[i].len() * channels;
                let now = &bins[i][(frame - from) * each..][..each];
                for (row, bins) in state.changing[i].iter().zip(now.chunks_exact(channels)) {
                    for (k, bin) in bins.iter().enumerate() {
                        state.numbers[i][channels * row + k] = (f64::from(*bin) * header.steps[i]) as f32;
                    }
                }
            }
            match &mut tracked {
                None => {
                    let mut params = state.params(&steady);
                    let motion = Tracked::new(&TrackedSpec { times: kept.clone(), foreground: false }, &mut params)?;
                    tracked = Some((params, motion));
                }
                Some((params, motion)) if moves => {
                    let page = &mut params[motion.page(frame)];
                    steady.iter().enumerate().for_each(|(to, row)| page.write(to, 0, state.pose(*row)));
                }
                Some(_) => {}
            }
            // An opacity of 0 is a Gaussian that is not there.
            let there: Vec<usize> = changing.iter().copied().filter(|row| state.byte(ALPHA, *row) > 0).collect();
            frames.push(state.params(&there));
        }
    }
    let Some((params, motion)) = tracked.filter(|_| frames.len() == header.frames) else {
        return Err(damaged(format!("its groups hold {} of {} frames", frames.len(), header.frames)));
    };
    let mut warnings = Warnings::default();
    let all = header.rows;
    warnings.counted(changing.len(), all, "change their colour, opacity or scale: they have a row for every frame");
    let clip = [0.0, times[header.frames - 1]];
    let mut layers = Vec::new();
    if !steady.is_empty() {
        layers.push(Layer::new("tracked", params, Arc::new(motion), LifeKind::Infinite));
    }
    if !changing.is_empty() {
        layers.extend(sequence::join(&frames, header.fps, Y_DOWN)?.layers);
    }
    Ok((Scene { layers, clip, fps: header.fps, up: Y_DOWN, ..Scene::default() }, warnings))
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::format::mutate::mutants;
    use crate::layers::freeze;
    use crate::scene::Time;
    use ruzstd::encoding::{CompressionLevel, compress_to_vec};

    const ROWS: usize = 20;
    const FRAMES: usize = 3;

    fn packed(values: &[i32], zigzag: bool) -> (u8, usize, Vec<u8>) {
        let symbols: Vec<u32> =
            values.iter().map(|v| if zigzag { ((v << 1) ^ (v >> 31)) as u32 } else { *v as u32 }).collect();
        let planes: Vec<u8> = (0..2).flat_map(|p| symbols.iter().map(move |s| (s >> (8 * p)) as u8)).collect();
        (2, symbols.len(), compress_to_vec(&planes[..], CompressionLevel::Fastest))
    }

    /// Gaussian i is at (i, 0, 0) and, where i is a multiple of 4, rises by 0.1 a frame; Gaussian 1 fades from 200 to 0.
    pub(in crate::format) fn sample() -> Vec<u8> {
        let moving: Vec<usize> = (0..ROWS).step_by(4).collect();
        let mut base = Vec::new();
        let put = |out: &mut Vec<u8>, (width, count, bytes): (u8, usize, Vec<u8>)| {
            out.extend([0, 2, width]);
            out.extend((count as u32).to_le_bytes());
            out.extend((bytes.len() as u32).to_le_bytes());
            out.extend(bytes);
        };
        let mask = |changing: &[usize]| -> Vec<i32> {
            let mut out = vec![0xFF; ROWS.div_ceil(8)];
            changing.iter().for_each(|i| out[i / 8] &= !(128 >> (i % 8)));
            out
        };
        for changing in [&moving[..], &[], &[], &[1], &[]] {
            put(&mut base, packed(&mask(changing), false));
        }
        put(
            &mut base,
            packed(&(0..3 * ROWS).map(|i| if i % 3 == 0 && i > 0 { 100 } else { 0 }).collect::<Vec<_>>(), true),
        );
        put(&mut base, packed(&(0..3 * ROWS).map(|i| if i < 3 { -200 } else { 0 }).collect::<Vec<_>>(), true));
        put(&mut base, packed(&[128; 3 * ROWS], false));
        put(&mut base, packed(&[200; ROWS], false));
        put(&mut base, packed(&(0..4 * ROWS).map(|i| if i % 4 == 0 { 255 } else { 128 }).collect::<Vec<_>>(), false));
        let key: Vec<i32> = moving.iter().flat_map(|i| [50 * *i as i32, 0, 0]).collect();
        let step: Vec<i32> = (1..FRAMES).flat_map(|_| moving.iter().flat_map(|_| [0, 5, 0])).collect();
        let streams = [
            (0u8, 0u8, packed(&key, true)),
            (3, 0, packed(&[100], true)),
            (0, 1, packed(&step, true)),
            (3, 1, packed(&[-50, -50], true)),
        ];
        let mut chunk = (streams.len() as u16).to_le_bytes().to_vec();
        for (attribute, kind, (width, count, bytes)) in &streams {
            chunk.extend([*attribute, *kind, *width]);
            chunk.extend((*count as u32).to_le_bytes());
            chunk.extend((bytes.len() as u32).to_le_bytes());
        }
        streams.iter().for_each(|(.., (.., bytes))| chunk.extend(bytes));
        let json = |base_at: usize, chunk_at: usize| {
            format!(
                r#"{{"n": {ROWS}, "t": {FRAMES}, "fps": 10.0, "steps": {{"pos": 0.02, "scale_log": 0.02, "rgb": 1, "alpha": 2,
                "rot": 1, "base_pos": 0.01, "base_scale_log": 0.01}}, "static_section": {{"offset": {base_at:6}, "len": {}}},
                "gops": [{{"offset": {chunk_at:6}, "len": {}, "f0": 0, "f1": {}}}]}}"#,
                base.len(),
                chunk.len(),
                FRAMES - 1
            )
        };
        let start = 12 + json(0, 0).len();
        let json = json(start, start + base.len());
        let mut out = [MAGIC, &[1, 0, 0, 0]].concat();
        out.extend((json.len() as u32).to_le_bytes());
        out.extend(json.as_bytes());
        out.extend(base);
        out.extend(chunk);
        out
    }

    #[test]
    fn steady_gaussians_are_tracked_and_others_live_a_frame() {
        let opened = DIALECT.open(&sample()).unwrap();
        assert_eq!((opened.scene.clip, opened.scene.fps), ([0.0, 0.2], 10.0));
        assert!(opened.warnings.lines()[0].contains("1 of 20"), "{:?}", opened.warnings);
        for frame in 0..FRAMES {
            let now = freeze(&opened.scene, Time(frame as f64 / 10.0)).unwrap();
            // Gaussian 1 has faded in the last frame.
            assert_eq!(now.len(), if frame == 2 { ROWS - 1 } else { ROWS });
            let heights: Vec<f32> = (0..ROWS - 1).map(|row| now[GEOMETRY].get(row, 1)).collect();
            // Row 3 is Gaussian 4: Gaussian 1 is in the other layer.
            assert!((heights[3] - 0.1 * frame as f32).abs() < 1e-6 && heights[2] == 0.0, "{frame}: {heights:?}");
            assert!((now[GEOMETRY].get(3, 0) - 4.0).abs() < 1e-5);
            assert!((now[GEOMETRY].get(3, LOG_SCALE) + 2.0).abs() < 1e-3);
        }
    }

    #[test]
    fn damaged_files_are_refused() {
        let file = sample();
        for cut in (0..file.len()).step_by(7) {
            assert!(read(&file[..cut]).is_err(), "{cut}");
        }
        let mut other = file.clone();
        other[4] = 2;
        assert!(read(&other).unwrap_err().to_string().contains("version 2"));
        let text = |from: &str, to: &str| {
            let at = file.windows(from.len()).position(|w| w == from.as_bytes()).unwrap();
            [&file[..at], to.as_bytes(), &file[at + from.len()..]].concat()
        };
        for (from, to) in [
            ("\"n\": 20", "\"n\": 99"),
            ("\"t\": 3", "\"t\": 4"),
            ("\"f1\": 2", "\"f1\": 9"),
            ("\"pos\": 0.02", "\"pos\": 0.00"),
        ] {
            assert!(read(&text(from, to)).is_err(), "{to}");
        }
        for mutant in mutants(&file, 3000, "splats4d") {
            let _ = read(&mutant);
        }
    }
}
