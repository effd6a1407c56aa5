//! The binary tree of time spans that a clip is cut into.

use crate::scene::time::DEFAULT_FPS;
use crate::{Error, Result};

/// Frames [from, to) of the clip.
pub(super) type Span = [usize; 2];

/// Most frames of a clip: nine hours at 30 frames a second; more is a damaged clock.
const MAX_FRAMES: f64 = 1_000_000.0;
/// Most parts of a frame: enough for a clip of one frame a second, and a bound on the work for a slower one.
const MAX_PARTS: f64 = 32.0;

/// Borders of spans are on frames, so that a frame is shown by one node a level and by no two. Where the clip has few
/// frames per second, a frame here is a part of one: a player also shows the times between them, and a model need not
/// be straight there.
///
/// The tree halves the clip at the borders of segments, and a segment, where motion demands it, frame by frame. Its
/// last border is one frame of the clip behind the clip's last second, so that this second is inside.
#[derive(Clone, Debug)]
pub(super) struct Tree {
    clip: [f64; 2],
    step: f64,
    /// Seconds from the clip's last to the end.
    after: f64,
    frames: usize,
    /// Frames at which segments begin, and the end.
    grid: Vec<usize>,
}

impl Tree {
    /// At least `rate` frames per second, but at most `most` of them (and at least two, where the clip has a length).
    /// Errors: the clip or the segment's length is out of range.
    pub(super) fn new(clip: [f64; 2], fps: f64, rate: f64, segment: f64, most: usize) -> Result<Self> {
        let fps = if fps > 0.0 && fps.is_finite() { fps } else { DEFAULT_FPS };
        let after = 1.0 / fps;
        // 30 frames per second are enough where 29.97 are.
        let fps = fps * (rate / fps - 0.1).ceil().clamp(1.0, MAX_PARTS);
        let frames = ((clip[1] - clip[0]) * fps).round() + 1.0;
        if !(1.0..=MAX_FRAMES).contains(&frames) || clip.iter().any(|t| !t.is_finite()) {
            return Err(Error::input(format!("the clip from {} to {} s at {fps} frames/s", clip[0], clip[1]))
                .remedy(format!("A scene lasts from 1 to {MAX_FRAMES} frames; correct its clip or its frame rate.")));
        }
        if !(segment > 0.0 && segment.is_finite()) {
            return Err(Error::input(format!("segments of {segment} s")).remedy("Give seconds above zero, such as 1."));
        }
        let (mut frames, mut step) = (frames as usize, 1.0 / fps);
        let most = most.max(2);
        if frames > most {
            (frames, step) = (most, (clip[1] - clip[0]) / (most - 1) as f64);
        }
        let segments = ((frames as f64 * step / segment).round() as usize).clamp(1, frames);
        let grid = (0..=segments).map(|i| (i * frames + segments / 2) / segments).collect();
        Ok(Self { clip, step, after, frames, grid })
    }

    /// Frames of the clip.
    pub(super) fn frames(&self) -> usize {
        self.frames
    }

    /// Frames a second.
    pub(super) fn rate(&self) -> f64 {
        1.0 / self.step
    }

    /// First and last second.
    pub(super) fn clip(&self) -> [f64; 2] {
        self.clip
    }

    /// All frames.
    pub(super) fn root(&self) -> Span {
        [0, self.frames]
    }

    /// The second of frame k.
    pub(super) fn time(&self, k: usize) -> f64 {
        (self.clip[0] + k as f64 * self.step).min(self.clip[1])
    }

    /// The second at which a span that ends (or begins) at frame k ends (or begins).
    pub(super) fn border(&self, k: usize) -> f64 {
        if k >= self.frames { self.clip[1] + self.after } else { self.time(k) }
    }

    /// The frames that surround the seconds [from, to] within the clip.
    pub(super) fn around(&self, [from, to]: [f64; 2]) -> Span {
        let place = |t: f64| ((t - self.clip[0]) / self.step).clamp(0.0, (self.frames - 1) as f64);
        [place(from).floor() as usize, place(to).ceil() as usize]
    }

    /// Whether the span holds more than one segment.
    pub(super) fn is_coarse(&self, span: Span) -> bool {
        let [from, to] = self.cells(span);
        to - from > 1
    }

    /// The two halves of a span; a single frame has none.
    pub(super) fn split(&self, span: Span) -> Option<[Span; 2]> {
        if span[1] - span[0] <= 1 {
            return None;
        }
        let [from, to] = self.cells(span);
        let middle = if to - from > 1 { self.grid[(from + to) / 2] } else { (span[0] + span[1]) / 2 };
        Some([[span[0], middle], [middle, span[1]]])
    }

    /// The segments that a span touches, [first, end).
    fn cells(&self, span: Span) -> [usize; 2] {
        let from = self.grid.partition_point(|&g| g <= span[0]) - 1;
        [from, self.grid.partition_point(|&g| g < span[1])]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every span of the tree, depth first.
    fn all(tree: &Tree, span: Span, out: &mut Vec<Span>) {
        out.push(span);
        for half in tree.split(span).into_iter().flatten() {
            all(tree, half, out);
        }
    }

    #[test]
    fn halves_tile_their_parent_down_to_single_frames() {
        for (frames, segment) in [(1usize, 1.0), (2, 1.0), (30, 1.0), (47, 0.3), (301, 1.0), (20, 0.01)] {
            let tree = Tree::new([2.0, 2.0 + (frames - 1) as f64 / 30.0], 30.0, 30.0, segment, usize::MAX).unwrap();
            assert_eq!(tree.frames(), frames);
            let mut spans = Vec::new();
            all(&tree, tree.root(), &mut spans);
            assert_eq!(spans.len(), 2 * frames - 1, "a full binary tree over its frames");
            for span in spans {
                assert!(tree.border(span[0]) < tree.border(span[1]));
                let Some([a, b]) = tree.split(span) else { continue };
                assert!(a[0] == span[0] && a[1] == b[0] && b[1] == span[1] && a[0] < a[1] && b[0] < b[1]);
                if tree.is_coarse(span) {
                    assert!(tree.grid.contains(&a[1]), "long spans are cut at segments");
                }
            }
        }
    }

    #[test]
    fn segments_have_about_the_requested_length() {
        let tree = Tree::new([0.0, 10.0 - 1.0 / 30.0], 30.0, 30.0, 1.0, usize::MAX).unwrap();
        assert_eq!(tree.grid, (0..=10).map(|i| 30 * i).collect::<Vec<_>>());
        assert!((tree.border(300) - 10.0).abs() < 1e-12);
    }

    #[test]
    fn low_frame_rates_are_sampled_between_frames() {
        for (fps, rate, parts) in
            [(10.0, 30.0, 3), (29.97, 30.0, 1), (24.0, 30.0, 2), (60.0, 30.0, 1), (10.0, 0.0, 1), (1e-6, 30.0, 32)]
        {
            let last = 11.0 / fps;
            let tree = Tree::new([0.0, last], fps, rate, 1e9, usize::MAX).unwrap();
            assert_eq!(tree.frames(), 11 * parts + 1, "{fps} frames/s");
            assert!(
                (0..=11).all(|k| (tree.time(k * parts) - k as f64 / fps).abs() <= 1e-12 * last),
                "every frame is looked at"
            );
            assert!(
                (tree.border(tree.frames()) - 12.0 / fps).abs() <= 1e-12 * last,
                "the last frame lasts as long as any"
            );
        }
    }

    #[test]
    fn an_invalid_clip_range_is_refused() {
        for clip in [[0.0, f64::NAN], [1.0, 0.0], [0.0, 1e9], [f64::NEG_INFINITY, 0.0]] {
            assert!(Tree::new(clip, 30.0, 30.0, 1.0, usize::MAX).is_err(), "{clip:?}");
        }
        assert!(Tree::new([0.0, 1.0], 30.0, 30.0, 0.0, usize::MAX).is_err());
        assert_eq!(Tree::new([0.0, 1.0], 0.0, 30.0, 1.0, usize::MAX).unwrap().frames(), 31, "no rate: the default one");
    }

    #[test]
    fn frames_are_as_many_as_are_allowed() {
        let tree = Tree::new([1.0, 11.0], 30.0, 30.0, 1.0, 41).unwrap();
        assert_eq!((tree.frames(), tree.time(40), tree.time(20)), (41, 11.0, 6.0));
        assert!((tree.rate() - 4.0).abs() < 1e-12);
        assert_eq!(Tree::new([0.0, 1.0], 30.0, 30.0, 1.0, 0).unwrap().frames(), 2);
        assert_eq!(Tree::new([0.0, 0.0], 30.0, 30.0, 1.0, 0).unwrap().frames(), 1);
    }
}
