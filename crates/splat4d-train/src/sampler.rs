//! The frames of a step: a pure function of (seed, stage, step), so that nothing has to be saved for a resume.

use crate::capture::frames::Frames;
use splat4d::math::Rng;
use std::sync::{Arc, Mutex};

/// Selection of a stage's frames.
#[derive(Clone, Debug, Default, PartialEq)]
#[non_exhaustive]
pub enum Sampler {
    /// Every frame once an epoch, in random order; those at the ends of a clip with one image per time more often.
    #[default]
    Uniform,
    /// As `Uniform`, but all views of a step at one time (Spacetime Gaussians).
    SameTime,
    /// Four of five from a window of this many distinct times that slides over the clip as the stage proceeds, the rest
    /// from the whole capture (long captures).
    Window(usize),
    /// Only frames at the k-th distinct time (per-frame tracking).
    Frame(usize),
    /// The step's views at this many consecutive distinct times, one each.
    Tuple(usize),
}

/// A step, as samplers see it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Draw {
    /// Seed of the run.
    pub seed: u64,
    /// Number of the stage.
    pub stage: usize,
    /// Steps taken in it: they address the random numbers.
    pub taken: usize,
    /// Steps of its schedule that are behind it.
    pub place: usize,
    /// Steps of its schedule.
    pub steps: usize,
}

/// Share of a window sampler's frames that come from its window; the rest replays the capture.
const WINDOW_SHARE: f64 = 0.8;

/// Fewest times of a clip with one image per time whose ends are shown more often.
const CLIP: usize = 12;
/// How often an epoch shows the frames at the outermost times of such a clip, and those next to them, in addition: they have neighbours on one side
/// only. With several cameras the frames between them lose as much as the ends gain (studies/records/2026-11-27-ends.md).
const ENDS: [usize; 2] = [2, 1];

/// Frame numbers sorted by distinct time.
#[derive(Clone, Debug)]
pub(crate) struct Timeline {
    frames: Vec<Vec<u32>>,
    count: usize,
    /// What an epoch shows in addition, by [`ENDS`].
    ends: Vec<u32>,
    /// The permutation used last: seed, address, length and the order itself. Without it every step would shuffle all
    /// frames of the capture to learn of one.
    order: Arc<Mutex<(u64, u64, Vec<u32>)>>,
}

impl Timeline {
    /// Groups the frames by time.
    pub(crate) fn new(frames: &dyn Frames) -> Self {
        let mut order: Vec<usize> = (0..frames.len()).collect();
        order.sort_by(|&a, &b| frames.time(a).0.total_cmp(&frames.time(b).0).then(a.cmp(&b)));
        let mut groups: Vec<Vec<u32>> = Vec::new();
        let mut last = f64::NAN;
        for i in order {
            if frames.time(i).0 != last {
                groups.push(Vec::new());
                last = frames.time(i).0;
            }
            groups.last_mut().expect("a group was just pushed").push(i as u32);
        }
        let mut ends = Vec::new();
        if groups.len() >= CLIP && groups.len() == frames.len() {
            for (k, &copies) in ENDS.iter().enumerate() {
                (0..copies).for_each(|_| ends.extend(groups[k].iter().chain(&groups[groups.len() - 1 - k])));
            }
        }
        Self { frames: groups, count: frames.len(), ends, order: Arc::default() }
    }

    /// Number of distinct times.
    pub(crate) fn times(&self) -> usize {
        self.frames.len()
    }

    /// The frames at the k-th time.
    pub(crate) fn at(&self, k: usize) -> &[u32] {
        &self.frames[k]
    }

    /// Element i of the permutation of n items at an address.
    fn shuffled(&self, seed: u64, address: u64, n: usize, i: usize) -> usize {
        let mut last = self.order.lock().unwrap_or_else(|e| e.into_inner());
        if (last.0, last.1, last.2.len()) != (seed, address, n) {
            *last = (seed, address, Rng::new(seed, "epoch", address).permutation(n));
        }
        last.2[i] as usize
    }

    /// The frames of a step. Panics: no frames; a frame number beyond the clip.
    pub(crate) fn draw(&self, sampler: &Sampler, batch: usize, draw: Draw) -> Vec<usize> {
        let Draw { seed, stage, taken: step, place, steps } = draw;
        assert!(self.count > 0, "a capture without frames cannot be trained on");
        let rng = Rng::new(seed, "frames", stage as u64);
        let step_rng = rng.fork(step as u64 + 1);
        let (times, n) = (self.frames.len(), self.count);
        let flat = |i: usize| {
            // The i-th sample without replacement: which epoch, and where in its permutation.
            let all = n + self.ends.len();
            let frame = self.shuffled(seed, (stage * 1_000_003 + i / all) as u64, all, i % all);
            frame.checked_sub(n).map_or(frame, |end| self.ends[end] as usize)
        };
        let any_of = |group: &[u32], draw: u64| group[step_rng.below(draw, group.len())] as usize;
        match *sampler {
            Sampler::Uniform => (0..batch).map(|b| flat(step * batch + b)).collect(),
            Sampler::SameTime => {
                let epoch = (stage * 1_000_003 + step / times) as u64;
                let group = &self.frames[self.shuffled(seed, epoch, times, step % times)];
                let offset = step_rng.below(0, group.len());
                (0..batch.min(group.len())).map(|b| group[(offset + b) % group.len()] as usize).collect()
            }
            Sampler::Window(width) => {
                let width = width.clamp(1, times);
                let first = ((times - width) as f64 * place as f64 / steps.max(1) as f64) as usize;
                (0..batch as u64)
                    .map(|b| {
                        let inside = step_rng.uniform(3 * b) < WINDOW_SHARE;
                        let k = if inside {
                            first + step_rng.below(3 * b + 1, width)
                        } else {
                            step_rng.below(3 * b + 1, times)
                        };
                        any_of(&self.frames[k], 3 * b + 2)
                    })
                    .collect()
            }
            Sampler::Frame(k) => {
                assert!(k < times, "the clip has {times} distinct times, frame {k} was requested");
                let group = &self.frames[k];
                (0..batch).map(|b| group[(step * batch + b + step_rng.below(0, 2)) % group.len()] as usize).collect()
            }
            Sampler::Tuple(count) => {
                let count = count.clamp(1, times);
                let first = step_rng.below(0, times - count + 1);
                (0..count).map(|k| any_of(&self.frames[first + k], k as u64 + 1)).collect()
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::step::tests::Made;

    #[test]
    fn ends_of_a_clip_with_one_image_per_time_are_sampled_more_often() {
        let counts = |cameras: usize, times: usize| {
            let line = Timeline::new(&Made::new(cameras, times, 4));
            let steps = cameras * times + line.ends.len();
            let mut counts = vec![0; times];
            for step in 0..steps {
                let draw = Draw { seed: 7, stage: 0, taken: step, place: step, steps };
                let [frame] = line.draw(&Sampler::Uniform, 1, draw)[..] else { panic!("one view per step") };
                counts[line.frames.iter().position(|f| f.contains(&(frame as u32))).unwrap()] += 1;
            }
            counts
        };
        assert_eq!(counts(2, 12), [2; 12], "several cameras");
        assert_eq!(counts(1, 12), [3, 2, 1, 1, 1, 1, 1, 1, 1, 1, 2, 3]);
        assert_eq!(counts(1, 5), [1; 5], "too short to have a middle");
    }

    #[test]
    fn every_frame_is_sampled_once_an_epoch_by_a_pure_function() {
        let frames = Made::new(3, 5, 4);
        let line = Timeline::new(&frames);
        assert_eq!(line.times(), 5);
        let at = |seed, step, steps| Draw { seed, stage: 0, taken: step, place: step, steps };
        let mut seen: Vec<usize> = (0..15).flat_map(|s| line.draw(&Sampler::Uniform, 1, at(7, s, 100))).collect();
        seen.sort_unstable();
        assert_eq!(seen, (0..15).collect::<Vec<_>>());
        let again = |s| line.draw(&Sampler::Window(2), 4, at(7, s, 100));
        assert_eq!(again(13), again(13));
        assert_ne!(again(13), again(14));
    }

    #[test]
    fn samplers_keep_to_their_times() {
        let frames = Made::new(3, 5, 4);
        let line = Timeline::new(&frames);
        for step in 0..50 {
            let at = Draw { seed: 1, stage: 0, taken: step, place: step, steps: 50 };
            let time = |i: &usize| frames.time(*i).0;
            let same = line.draw(&Sampler::SameTime, 2, at);
            assert!(same.len() == 2 && time(&same[0]) == time(&same[1]) && same[0] != same[1]);
            assert!(line.draw(&Sampler::Frame(3), 2, at).iter().all(|i| line.at(3).contains(&(*i as u32))));
            let tuple = line.draw(&Sampler::Tuple(3), 1, at);
            assert!(tuple.len() == 3 && time(&tuple[0]) < time(&tuple[1]) && time(&tuple[1]) < time(&tuple[2]));
        }
    }
}
