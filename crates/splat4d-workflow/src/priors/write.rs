//! Maps of networks as the files that training reads.

use crate::models::{Kind, Map, Model};
use splat4d::format::npy;
use splat4d_train::encode::{Pixels, png};
use std::collections::BTreeMap;
use std::fmt::Write;

/// Codes of KITTI's flow: per pixel, and that of no motion.
const PER_PIXEL: f32 = 64.0;
const ZERO: f32 = 32768.0;
/// Values of a map that vary by less than this share of the largest are constant.
const CONSTANT: f32 = 1e-4;
/// Both directions of flow agree where the squared round trip is below this share of the squared lengths, plus half a pixel²
/// (Sundaram et al. 2010).
const ROUND_TRIP: [f32; 2] = [0.01, 0.5];
/// Positions of a point in two pairs of images, at most this many pixels apart, are one track's.
const SAME_POINT: f32 = 0.25;
/// Fewest frames of a track.
const SHORTEST: usize = 3;

/// A file's bytes, or why there is none.
pub(super) enum Encoded {
    File(Vec<u8>),
    Broken(&'static str),
}

/// The ending of a network's files.
pub(super) fn ending(model: &Model) -> &'static str {
    match model.description().output.kind {
        Kind::Depth if model.description().output.metric => "npy",
        Kind::Matches => "csv",
        _ => "png",
    }
}

/// A map in the size of its image, reduced by the whole number that its own resolution allows.
pub(super) fn sized(map: &Map, [width, height]: [usize; 2]) -> Map {
    let k = (width / map.width.max(1)).min(height / map.height.max(1)).max(1);
    map.resized((width / k).max(1), (height / k).max(1))
}

/// A depth map: metric as numbers, others as 16 bits, which keep all that a scale and a shift leave. 0: not known.
pub(super) fn depth(map: &Map, metric: bool) -> Encoded {
    let finite = || map.values.iter().copied().filter(|v| v.is_finite());
    let (low, high) = finite().fold((f32::INFINITY, f32::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
    if finite().count() < map.values.len() / 2 {
        return Encoded::Broken("most values are not finite");
    }
    if high - low <= CONSTANT * high.abs().max(low.abs()) {
        return Encoded::Broken("all values are equal");
    }
    let size = [map.width, map.height];
    if metric {
        let values: Vec<f32> = map.values.iter().map(|&v| if v.is_finite() && v > 0.0 { v } else { 0.0 }).collect();
        let mut bytes = Vec::new();
        npy::write_f32(&[map.height, map.width], &values, &mut bytes).expect("memory takes all bytes");
        return Encoded::File(bytes);
    }
    let code = |&v: &f32| match v.is_finite() {
        true => 1 + (f64::from(v - low) / f64::from(high - low) * 65534.0).round() as u16,
        false => 0,
    };
    let codes: Vec<u16> = map.values.iter().map(code).collect();
    Encoded::File(png(Pixels::Sixteen(&codes), size, 1))
}

/// A mask: white where values reach the threshold.
pub(super) fn mask(map: &Map, threshold: f32) -> Encoded {
    if map.values.iter().any(|v| !v.is_finite()) {
        return Encoded::Broken("values are not finite");
    }
    let pixels: Vec<u8> = map.values.iter().map(|&v| if v >= threshold { 255 } else { 0 }).collect();
    Encoded::File(png(Pixels::Eight(&pixels), [map.width, map.height], 1))
}

/// Flow in KITTI's code, known where the flow back agrees.
pub(super) fn flow(forth: &Map, back: &Map) -> Encoded {
    let (width, height) = (forth.width, forth.height);
    let agrees = |p: usize| {
        let [u, v] = [forth.plane(0)[p], forth.plane(1)[p]];
        let (x, y) = ((p % width) as f32 + 0.5 + u, (p / width) as f32 + 0.5 + v);
        if !(0.0..width as f32).contains(&x) || !(0.0..height as f32).contains(&y) {
            return false;
        }
        let q = y as usize * width + x as usize;
        let [a, b] = [back.plane(0)[q], back.plane(1)[q]];
        let lengths = u * u + v * v + a * a + b * b;
        (u + a).powi(2) + (v + b).powi(2) <= ROUND_TRIP[0] * lengths + ROUND_TRIP[1]
    };
    let code = |p: usize| {
        let codes = [0, 1].map(|c| (forth.plane(c)[p] * PER_PIXEL + ZERO).round());
        let fits = codes.iter().all(|c| (0.0..=65535.0).contains(c));
        if fits && agrees(p) { [codes[0] as u16, codes[1] as u16, 1] } else { [0; 3] }
    };
    if forth.values.iter().filter(|v| !v.is_finite()).count() > forth.values.len() / 2 {
        return Encoded::Broken("most vectors are not finite");
    }
    let codes: Vec<u16> = (0..width * height).flat_map(code).collect();
    Encoded::File(png(Pixels::Sixteen(&codes), [width, height], 3))
}

/// Tracks: matches of neighbouring frames that share a key point are linked.
#[derive(Default)]
pub(super) struct Links {
    tracks: Vec<Vec<(usize, [f32; 2])>>,
    /// Tracks that reach the last frame, by the position there.
    open: BTreeMap<[i64; 2], usize>,
    last: Option<usize>,
}

impl Links {
    /// Adds the matches of two neighbouring frames.
    pub(super) fn add(&mut self, [from, to]: [usize; 2], matches: &[[[f32; 2]; 2]]) {
        let cell = |[x, y]: [f32; 2]| [x, y].map(|v| (f64::from(v) / f64::from(SAME_POINT)).round() as i64);
        let mut open = std::mem::take(&mut self.open);
        if self.last != Some(from) {
            open.clear();
        }
        for &[a, b] in matches {
            let track = open.get(&cell(a)).copied().unwrap_or_else(|| {
                self.tracks.push(vec![(from, a)]);
                self.tracks.len() - 1
            });
            // Two key points of one frame may match the same one of the next.
            if self.tracks[track].last().is_some_and(|(frame, _)| *frame == from) && !self.open.contains_key(&cell(b)) {
                self.tracks[track].push((to, b));
                self.open.insert(cell(b), track);
            }
        }
        self.last = Some(to);
    }

    pub(super) fn encoded(self) -> Encoded {
        let long = self.tracks.iter().filter(|t| t.len() >= SHORTEST);
        let mut text = String::from("point,frame,x,y\n");
        let mut count = 0;
        for (point, track) in long.enumerate() {
            for (frame, [x, y]) in track {
                writeln!(text, "{point},{frame},{x:.3},{y:.3}").expect("memory takes all bytes");
            }
            count = point + 1;
        }
        if count == 0 {
            Encoded::Broken("no point is matched over three frames")
        } else {
            Encoded::File(text.into_bytes())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn matches_are_linked_through_shared_key_points() {
        let mut links = Links::default();
        links.add([0, 1], &[[[1.5, 2.5], [3.5, 2.5]], [[9.5, 9.5], [10.5, 9.5]]]);
        links.add([1, 2], &[[[3.5, 2.5], [5.5, 2.5]], [[20.5, 1.5], [21.5, 1.5]]]);
        links.add([2, 3], &[[[5.5, 2.5], [7.5, 2.5]]]);
        let Encoded::File(bytes) = links.encoded() else { panic!("there is a track") };
        let rows = "point,frame,x,y\n0,0,1.500,2.500\n0,1,3.500,2.500\n0,2,5.500,2.500\n0,3,7.500,2.500\n";
        assert_eq!(String::from_utf8(bytes).unwrap(), rows);
        assert!(matches!(Links::default().encoded(), Encoded::Broken(_)));
    }

    #[test]
    fn constant_and_broken_maps_are_refused() {
        let map = |values: Vec<f32>| Map { channels: 1, height: 2, width: 2, values };
        assert!(matches!(depth(&map(vec![3.0; 4]), false), Encoded::Broken("all values are equal")));
        assert!(matches!(depth(&map(vec![f32::NAN, f32::NAN, f32::NAN, 1.0]), true), Encoded::Broken(_)));
        assert!(matches!(mask(&map(vec![f32::NAN, 0.0, 0.0, 1.0]), 0.5), Encoded::Broken(_)));
        assert!(matches!(depth(&map(vec![1.0, 2.0, 3.0, f32::NAN]), false), Encoded::File(_)));
    }

    #[test]
    fn maps_are_written_in_a_size_that_training_reads() {
        let map = Map { channels: 1, height: 392, width: 518, values: vec![0.0; 518 * 392] };
        let size = |w, h| (sized(&map, [w, h]).width, sized(&map, [w, h]).height);
        assert_eq!((size(640, 480), size(1920, 1080), size(160, 120)), ((640, 480), (960, 540), (160, 120)));
    }
}
