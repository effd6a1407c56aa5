//! People as correspondences: who is who in the cameras of a rig, by geometry.
//!
//! Keypoints of a person are the same physical points for cameras at any angle. Detections are linked over time in each
//! camera. Which of its people are the same is not known: every choice of one of each camera is tried, and the rig that
//! fits best decides. Further people are then those whose keypoints meet in space.

use super::keypoints::{Frames, Person};
use super::solve::{Camera, Point, Sight, Solution, solve};
use splat4d::math::median;

/// Keypoints below this confidence are not used: what a detector is unsure of is mostly the other side or hidden.
const CONFIDENT: f64 = 0.4;
/// Largest distance of a person in two frames, of its size, and longest gap, frames.
const STEP: f64 = 0.3;
const GAP: usize = 15;
/// People of a camera that are distinguished at most, and the share of the longest's frames that the others have at least.
const PEOPLE: usize = 3;
const LASTING: f64 = 0.25;
/// Choices of people that are tried at most.
const CHOICES: usize = 81;
/// Times in bursts, and seconds between the times of a burst: three give velocities, from which time offsets follow.
const BURSTS: [usize; 2] = [2, 6];
const BURST: usize = 3;
const APART: f64 = 0.1;
/// Keypoints of a time: the most confident ones; fewer in trials.
const KEYPOINTS: [usize; 2] = [5, 14];
/// Frames of one time are within this many intervals of it.
const NEAR: f64 = 0.75;
/// Keypoints of one person meet within this many pixels of an image 1920 across (median).
const MEETS: f64 = 20.0;

/// A person in the images of one camera: by frame its keypoints.
type Track = Vec<(usize, Person)>;

/// The people of a rig: for each the number of its track in every camera that shows it.
pub(crate) type Identity = Vec<Option<usize>>;

/// People of the cameras, linked over time.
pub(crate) struct People {
    tracks: Vec<Vec<Track>>,
}

/// A point at a time, with the name of its person and keypoint.
pub(crate) struct Named {
    pub person: usize,
    pub keypoint: usize,
    pub moment: f64,
    pub sights: Vec<Sight>,
}

impl People {
    /// Links detections over time.
    pub(crate) fn new(cameras: &[Frames]) -> Self {
        Self { tracks: cameras.iter().map(linked).collect() }
    }

    /// Cameras without people.
    pub(crate) fn missing(&self) -> impl Iterator<Item = usize> {
        (0..self.tracks.len()).filter(|&c| self.tracks[c].is_empty())
    }

    /// Who is who, the person that determined the rig first. `None`: no choice gives a rig.
    pub(crate) fn identities(&self, cameras: &[Camera]) -> Option<Vec<Identity>> {
        let mut best: Option<((usize, f64), Identity, Solution)> = None;
        for choice in self.choices() {
            let named = self.points(cameras, &[choice.clone()], BURSTS[0], KEYPOINTS[0]);
            let points = points_of(&named);
            let found = solve(cameras, &points);
            let placed = found.cameras.iter().filter(|c| c.is_ok()).count();
            let Some(error) = found.error.filter(|_| placed > 1) else { continue };
            let rank = (cameras.len() - placed, error);
            if best.as_ref().is_none_or(|(b, ..)| rank.0 < b.0 || rank.0 == b.0 && rank.1 < b.1) {
                best = Some((rank, choice, found));
            }
        }
        let (_, first, rig) = best?;
        let mut all = vec![first];
        while let Some(next) = self.next(cameras, &rig, &all) {
            all.push(next);
        }
        Some(all)
    }

    /// All choices of one person of each camera, those of people who are seen longest first.
    fn choices(&self) -> Vec<Identity> {
        let mut all: Vec<Identity> = vec![Vec::new()];
        for tracks in &self.tracks {
            let with = |head: &Identity, k: Option<usize>| head.iter().copied().chain([k]).collect::<Identity>();
            all = match tracks.len() {
                0 => all.iter().map(|head| with(head, None)).collect(),
                n => all.iter().flat_map(|head| (0..n).map(|k| with(head, Some(k))).collect::<Vec<_>>()).collect(),
            };
        }
        all.sort_by_key(|choice| choice.iter().flatten().sum::<usize>());
        all.truncate(CHOICES);
        all
    }

    /// A further person: tracks without a person yet whose keypoints meet, in as many cameras as do.
    fn next(&self, cameras: &[Camera], rig: &Solution, known: &[Identity]) -> Option<Identity> {
        let free = |c: usize| -> Vec<usize> {
            (0..self.tracks[c].len()).filter(|&k| known.iter().all(|id| id[c] != Some(k))).collect()
        };
        let open: Vec<Vec<usize>> = (0..self.tracks.len()).map(free).collect();
        let mut best: Option<(f64, Identity)> = None;
        for a in 0..open.len() {
            for b in a + 1..open.len() {
                for (&i, &j) in open[a].iter().flat_map(|i| open[b].iter().map(move |j| (i, j))) {
                    let mut pair: Identity = vec![None; open.len()];
                    (pair[a], pair[b]) = (Some(i), Some(j));
                    let off = self.off(cameras, rig, &pair);
                    if off.is_some_and(|off| off < MEETS && best.as_ref().is_none_or(|(least, _)| off < *least)) {
                        best = Some((off.expect("just seen"), pair));
                    }
                }
            }
        }
        let (_, mut person) = best?;
        for c in 0..open.len() {
            if person[c].is_some() {
                continue;
            }
            let with = |k: usize| {
                let mut wider = person.clone();
                wider[c] = Some(k);
                wider
            };
            let fits = open[c].iter().filter_map(|&k| Some((self.off(cameras, rig, &with(k))?, k)));
            if let Some((_, k)) = fits.filter(|f| f.0 < MEETS).min_by(|x, y| x.0.total_cmp(&y.0)) {
                person[c] = Some(k);
            }
        }
        Some(person)
    }

    /// The median distance of a person's keypoints from where they meet, pixels of an image 1920 across.
    fn off(&self, cameras: &[Camera], rig: &Solution, person: &Identity) -> Option<f64> {
        let moved: Vec<Camera> =
            cameras.iter().zip(&rig.offsets).map(|(c, &offset)| Camera { offset: Some(offset), ..c.clone() }).collect();
        let mut all = Vec::new();
        for named in self.points(&moved, &[person.clone()], BURSTS[1], KEYPOINTS[1]) {
            let views = named.sights.iter().filter_map(|s| Some((s, rig.cameras[s.camera].as_ref().ok()?)));
            let views: Vec<_> = views.collect();
            let rays: Vec<([f64; 3], [f64; 3])> = views
                .iter()
                .map(|(s, (pose, lens))| {
                    let inverse = pose.inverse();
                    (inverse.translation, splat4d::math::se3::mat_vec(&inverse.rotation, lens.ray(s.pixel)))
                })
                .collect();
            let Some(x) = meeting(&rays) else { continue };
            for (s, (pose, lens)) in &views {
                let size = cameras[s.camera].size;
                let scale = 1920.0 / size[0].max(size[1]) as f64;
                let [u, v] = lens.project(pose.apply(x))?;
                all.push(scale * (u - s.pixel[0]).hypot(v - s.pixel[1]));
            }
        }
        median(&mut all)
    }

    /// Keypoints of people at times of bursts, evenly over what cameras have in common.
    pub(crate) fn all(&self, cameras: &[Camera], people: &[Identity]) -> Vec<Named> {
        self.points(cameras, people, BURSTS[1], KEYPOINTS[1])
    }

    fn points(&self, cameras: &[Camera], people: &[Identity], bursts: usize, most: usize) -> Vec<Named> {
        let offset = |c: usize| cameras[c].offset.unwrap_or(0.0);
        let mut out = Vec::new();
        for (p, person) in people.iter().enumerate() {
            let tracks: Vec<(usize, &Track)> =
                person.iter().enumerate().filter_map(|(c, k)| Some((c, &self.tracks[c][(*k)?]))).collect();
            let time = |c: usize, frame: usize| frame as f64 * cameras[c].interval + offset(c);
            let ends = tracks.iter().map(|(c, t)| [t[0].0, t[t.len() - 1].0].map(|f| time(*c, f)));
            let [from, to] = ends.fold([f64::NEG_INFINITY, f64::INFINITY], |a, b| [a[0].max(b[0]), a[1].min(b[1])]);
            if tracks.len() < 2 || from > to {
                continue;
            }
            for k in 0..bursts * BURST {
                let (burst, step) = (k / BURST, (k % BURST) as f64 - 0.5 * (BURST - 1) as f64);
                let moment = from + (to - from) * (burst as f64 + 0.5) / bursts as f64 + APART * step;
                if moment < from || moment > to {
                    continue;
                }
                let mut found: Vec<(f64, Named)> = Vec::new();
                let keypoints =
                    tracks.iter().flat_map(|(_, t)| t.iter()).map(|(_, person)| person.len()).max().unwrap_or(0);
                for keypoint in 0..keypoints {
                    let (mut sights, mut sure) = (Vec::new(), 0.0);
                    for &(camera, track) in &tracks {
                        let interval = cameras[camera].interval;
                        let number = ((moment - offset(camera)) / interval).round();
                        let at = track.partition_point(|(f, _)| (*f as f64) < number - 0.5);
                        let Some((frame, person)) = track.get(at) else { continue };
                        let Some(&[x, y, confidence]) = person.get(keypoint) else { continue };
                        if (*frame as f64 - number).abs() > NEAR || confidence < CONFIDENT {
                            continue;
                        }
                        sights.push(Sight { camera, pixel: [x, y], time: *frame as f64 * interval });
                        sure += confidence;
                    }
                    if sights.len() > 1 {
                        found.push((sure, Named { person: p, keypoint, moment, sights }));
                    }
                }
                found.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.keypoint.cmp(&b.1.keypoint)));
                out.extend(found.into_iter().take(most).map(|(_, named)| named));
            }
        }
        out
    }
}

/// As [`solve`] takes them: positions of one keypoint of one person are one moving point.
pub(crate) fn points_of(named: &[Named]) -> Vec<Point> {
    let mut tracks: Vec<(usize, usize)> = named.iter().map(|n| (n.person, n.keypoint)).collect();
    tracks.sort_unstable();
    tracks.dedup();
    let track = |n: &Named| tracks.binary_search(&(n.person, n.keypoint)).ok();
    named.iter().map(|n| Point { track: track(n), sights: n.sights.clone() }).collect()
}

/// The point nearest to all rays (origin, direction); `None`: they are parallel.
fn meeting(rays: &[([f64; 3], [f64; 3])]) -> Option<[f64; 3]> {
    let (mut a, mut b) = ([[0.0; 3]; 3], [0.0; 3]);
    for (origin, direction) in rays {
        let d = splat4d::math::se3::normalize(*direction);
        for r in 0..3 {
            for s in 0..3 {
                let m = f64::from(u8::from(r == s)) - d[r] * d[s];
                a[r][s] += m;
                b[r] += m * origin[s];
            }
        }
    }
    splat4d::math::mat3::solve(a, b).filter(|x| rays.len() > 1 && x.iter().all(|v| v.is_finite()))
}

/// Links the people of one camera over time: each continues the nearest one of the frames before.
fn linked(frames: &Frames) -> Vec<Track> {
    let mut tracks: Vec<Track> = Vec::new();
    for (&number, people) in frames {
        let mut pairs: Vec<(f64, usize, usize)> = Vec::new();
        for (t, track) in tracks.iter().enumerate() {
            let (last, person) = &track[track.len() - 1];
            if number - last > GAP {
                continue;
            }
            let apart = |q: usize| distance(person, &people[q]);
            pairs.extend((0..people.len()).filter_map(|q| Some((apart(q)?, t, q))).filter(|p| p.0 < STEP));
        }
        pairs.sort_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
        let (mut continued, mut taken) = (vec![false; tracks.len()], vec![false; people.len()]);
        for (_, t, q) in pairs {
            if !continued[t] && !taken[q] {
                (continued[t], taken[q]) = (true, true);
                tracks[t].push((number, people[q].clone()));
            }
        }
        let new = (0..people.len()).filter(|&q| !taken[q] && confident(&people[q]).count() > 2);
        tracks.extend(new.map(|q| vec![(number, people[q].clone())]));
    }
    tracks.sort_by_key(|t| std::cmp::Reverse(t.len()));
    let longest = tracks.first().map_or(0, Vec::len);
    tracks.retain(|t| t.len() as f64 >= LASTING * longest as f64);
    tracks.truncate(PEOPLE);
    tracks
}

fn confident(person: &Person) -> impl Iterator<Item = (usize, [f64; 2])> + '_ {
    person.iter().enumerate().filter(|(_, p)| p[2] >= CONFIDENT).map(|(k, p)| (k, [p[0], p[1]]))
}

/// Median distance of keypoints of a person in two frames, of its size; `None`: they share none.
fn distance(a: &Person, b: &Person) -> Option<f64> {
    let corner = |pick: fn(f64, f64) -> f64, start: f64, k: usize| confident(a).map(|(_, p)| p[k]).fold(start, pick);
    let side = |k: usize| corner(f64::max, f64::NEG_INFINITY, k) - corner(f64::min, f64::INFINITY, k);
    let size = side(0).hypot(side(1));
    let both = confident(a).filter_map(|(k, p)| {
        let q = b.get(k).filter(|q| q[2] >= CONFIDENT)?;
        Some((p[0] - q[0]).hypot(p[1] - q[1]))
    });
    median(&mut both.collect::<Vec<_>>()).map(|d| d / size.max(1.0))
}

#[cfg(test)]
mod tests;
