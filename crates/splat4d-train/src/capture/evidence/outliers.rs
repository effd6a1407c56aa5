//! Single wrong poses among right ones: the identity, the pose of another image, a jump out of a path. Each is compared
//! with matches between its image and others; nothing else raises a warning.

use super::super::account::Severity;
use super::super::account::first_names;
use super::super::pose::same_pose;
use super::super::preflight::Finding;
use super::super::{Aspect, Capture, Frame};
use super::look::{self, SmallImage};
use super::pairs::{self, Match};
use super::points;
use super::zooms;
use rayon::prelude::*;
use splat4d::math::Se3;
use splat4d::math::se3::{dot, norm, sub};
use std::collections::{BTreeMap, BTreeSet};

/// Captures of at most this many places are compared image by image; of larger ones the conspicuous poses.
pub(super) const ALL: usize = 24;
/// Conspicuous poses that are looked into at most, and of all places: where more are so, it is how the capture is.
const SUSPECTS: usize = 4;
const FEW: f64 = 0.2;
/// Images before and after that an image is compared with: in most captures they overlap.
const BESIDE: usize = 2;
/// Matches of two images that show one scene: chance makes fewer.
const OVERLAP: usize = 20;
/// Share of these that fit right poses at least, and wrong ones at most: what moves and repeats itself leaves right
/// poses less than all, and a wrong pose fits what is near its lines by chance. Between them nothing is reported.
const FITS: [f64; 2] = [0.4, 0.15];
/// Gain of the colours of initial points from which an image alone shows that its pose is right: exchanged images of
/// one scene gain 0.14 (see `points`). Feature detection takes forty times as long.
const VOUCHED: f64 = 0.3;
/// Gain of an image below which it does not fit the points, where the images in the middle gain so much.
const STRANGE: (f64, f64) = (0.1, 0.35);
/// Images that are compared with points for that, evenly chosen, and their pixels: a tenth of a second.
const SEEN: (usize, usize) = (64, 8_000_000);
/// A jump is this many times as far as usual steps and as the step over it, to and from; and a turn is this many
/// degrees.
const JUMP: f64 = 8.0;
const TURN: f64 = 30.0;
/// Entries of an axis-parallel rotation are this near to 0 or 1.
const EXACT: f64 = 1e-9;

/// Why a pose is conspicuous.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Sign {
    /// The camera is at the origin and images along an axis.
    Identity,
    /// Another image has exactly this pose.
    Repeated,
    /// It is far from those before and after, which are near each other.
    Jump,
}

impl Sign {
    fn in_words(self) -> &'static str {
        match self {
            Self::Identity => "its pose is the identity",
            Self::Repeated => "another image has exactly this pose",
            Self::Jump => "it is far from the poses before and after",
        }
    }
}

/// Searches for single wrong poses among the places `order`; `images` are images that are read already.
pub(super) fn check(capture: &Capture, order: &[usize], images: Vec<SmallImage>, pixels: usize) -> Vec<Finding> {
    let signs = signs(capture, order);
    let size = capture.frames.first().map_or(1, |f| f.source.width * f.source.height).max(1);
    let (chosen, compared) = chosen(order, &signs, (pixels / size).max(2 * BESIDE + 1));
    let frames: Vec<usize> = chosen.iter().map(|&k| order[k]).collect();
    let (mut images, first): (Vec<SmallImage>, Vec<SmallImage>) =
        images.into_iter().partition(|l| frames.contains(&l.frame));
    let missing: Vec<usize> = frames.iter().copied().filter(|f| images.iter().all(|l| l.frame != *f)).collect();
    images.extend(look::take(capture, &missing, look::COARSE));
    images.sort_by_key(|l| frames.iter().position(|f| *f == l.frame));
    let pose = |l: &SmallImage| capture.frames[l.frame].source.cam_from_world;
    let gain = |l: &SmallImage| points::gain_of(capture, std::slice::from_ref(l), &[pose(l)]);
    let others = sampled(capture, order, &images);
    let all: Vec<&SmallImage> = images.iter().chain(&others).collect();
    let twice = |l: &&SmallImage| others.iter().all(|o| o.frame != l.frame);
    let looked_at: Vec<&SmallImage> = all.iter().copied().chain(first.iter().filter(twice)).collect();
    let zoomed = zooms::check(capture, &looked_at);
    let strange = strange(capture, order, &all, &gain);
    let vouched = |l: &SmallImage| gain(l).is_some_and(|gain| gain >= VOUCHED);
    let place = |l: &SmallImage| order.iter().position(|f| *f == l.frame).unwrap_or(0);
    let doubtful: Vec<usize> = images.par_iter().filter(|l| !vouched(l)).map(place).collect();
    images.retain(|l| doubtful.iter().any(|k| k.abs_diff(place(l)) <= BESIDE));
    // Positions of the images in the order; unreadable ones have none.
    let at: Vec<usize> = images.iter().filter_map(|l| order.iter().position(|f| *f == l.frame)).collect();
    let mut bare: Vec<&mut SmallImage> = images.iter_mut().filter(|l| l.marks.is_empty()).collect();
    look::describe_each(&mut bare, look::COARSE);
    let suspect = |k: usize| signs.contains_key(&at[k]);
    let mut wanted = Vec::new();
    for a in 0..images.len() {
        for b in a + 1..images.len() {
            if at[b].abs_diff(at[a]) <= BESIDE || suspect(a) || suspect(b) {
                wanted.push([a, b]);
            }
        }
    }
    let poses: Vec<Se3> = images.iter().map(|l| capture.frames[l.frame].source.cam_from_world).collect();
    let measured: Vec<Pair> = wanted
        .into_par_iter()
        .filter_map(|[a, b]| {
            let matches: Vec<Match> = pairs::between([a, b], &images[a].marks, &images[b].marks, pairs::STRICT);
            (matches.len() >= OVERLAP).then(|| Pair {
                images: [a, b],
                matches: matches.len(),
                fitting: pairs::fitting(&matches, &images, &poses),
            })
        })
        .collect();
    let described =
        |k: usize| (capture.frames[images[k].frame].image.display().to_string(), signs.get(&at[k]).copied());
    let wrong = wrong(images.len(), &measured);
    let mut findings = Vec::new();
    let known: Vec<usize> = wrong.iter().map(|&k| images[k].frame).collect();
    findings.extend(warning(&wrong, &measured, &described));
    let (zoomed, other_zoom) = zoomed.unzip();
    let known: Vec<usize> = known.into_iter().chain(other_zoom.into_iter().flatten()).collect();
    findings.extend(zoomed);
    let strange = strange.filter(|s| !s.frames.iter().any(|f| known.contains(f)));
    let named: Vec<usize> = strange.iter().flat_map(|s| s.frames.clone()).chain(known).collect();
    findings.extend(strange.map(|s| s.finding(capture)));
    let good = |k: usize| measured.iter().any(|p| p.has(k) && p.share() >= FITS[0]);
    let open: Vec<String> = (0..images.len())
        .filter(|&k| signs.get(&at[k]) == Some(&Sign::Identity) && !good(k) && !wrong.contains(&k))
        .map(|k| described(k).0)
        .collect();
    let note = |what: String| Finding {
        severity: Severity::Note,
        aspect: Some(Aspect::NotChecked),
        what,
        remedy: String::new(),
    };
    if !open.is_empty() {
        findings.push(note(format!(
            "The identity is the pose of {} of {} images, as of images without a pose ({}); too few matches with others show \
             whether it is right.",
            open.len(),
            order.len(),
            first_names(&open)
        )));
    }
    // Neither points nor matches show that these are right or wrong.
    let silent: Vec<String> = (0..images.len())
        .filter(|&k| doubtful.contains(&at[k]) && !good(k) && !named.contains(&images[k].frame))
        .map(|k| described(k).0)
        .filter(|name| !open.contains(name))
        .collect();
    if !silent.is_empty() {
        findings.push(note(format!(
            "The poses of {} of {} images: neither initial points nor matches with the images around them decide ({}).",
            silent.len(),
            order.len(),
            first_names(&silent)
        )));
    }
    if compared < order.len() {
        findings.push(note(format!(
            "The poses of single images: {compared} of {} are conspicuous (the identity, a copy, a jump) and were compared with the \
             images around them, the others were not. info --doctor compares all cameras.",
            order.len()
        )));
    }
    findings
}

/// Images that do not fit the initial points, while the others do.
struct Strange {
    frames: Vec<usize>,
    /// Their best gain, and that of the image in the middle.
    gains: [f64; 2],
}

impl Strange {
    fn finding(&self, capture: &Capture) -> Finding {
        let names: Vec<String> = self.frames.iter().map(|&f| capture.frames[f].image.display().to_string()).collect();
        let what = format!(
            "{} of the images do not fit the initial points: {}. Colours of points fit these by {:.0} %, and those of other images \
             by {:.0} %.",
            names.len(),
            first_names(&names),
            100.0 * self.gains[0].max(0.0),
            100.0 * self.gains[1]
        );
        let remedy =
            "Check that the image matches its name, that it is not turned or black, and that its pose is right.";
        Finding { severity: Severity::Warning, aspect: Some(Aspect::Assumed), what, remedy: remedy.into() }
    }
}

/// More images to compare with points than those that were read already, evenly chosen.
fn sampled(capture: &Capture, order: &[usize], images: &[SmallImage]) -> Vec<SmallImage> {
    if capture.points.is_none() {
        return Vec::new();
    }
    let size = capture.frames.first().map_or(1, |f| f.source.width * f.source.height).max(1);
    let most = SEEN.0.min(SEEN.1 / size).max(1);
    let more = order.iter().step_by(order.len().div_ceil(most).max(1)).copied();
    let more: Vec<usize> = more.filter(|f| images.iter().all(|l| l.frame != *f)).collect();
    look::take(capture, &more, look::COARSE)
}

/// Searches for such images among these.
fn strange(
    capture: &Capture,
    order: &[usize],
    images: &[&SmallImage],
    gain: &(dyn Fn(&SmallImage) -> Option<f64> + Sync),
) -> Option<Strange> {
    capture.points.as_ref()?;
    let mut gains: Vec<(f64, usize)> = images.par_iter().filter_map(|l| Some((gain(l)?, l.frame))).collect();
    gains.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    let middle = gains.get(gains.len() / 2)?.0;
    let low: Vec<(f64, usize)> = gains.iter().copied().take_while(|(g, _)| *g < STRANGE.0).collect();
    let few = low.len() as f64 <= (FEW * gains.len() as f64).max(1.0);
    if !few || middle < STRANGE.1 {
        return None;
    }
    let strange: Vec<(f64, usize)> = low.into_iter().filter(|(_, f)| !matched(capture, order, *f)).collect();
    let (best, _) = *strange.last()?;
    Some(Strange { frames: strange.iter().map(|(_, f)| *f).collect(), gains: [best, middle] })
}

/// Whether matches with the images around it show that an image has the right pose: points may be hidden from it.
fn matched(capture: &Capture, order: &[usize], frame: usize) -> bool {
    let Some(k) = order.iter().position(|&f| f == frame) else { return false };
    let mut around = order[k.saturating_sub(BESIDE)..(k + BESIDE + 1).min(order.len())].to_vec();
    // Photos of an object are in no order.
    let place = |&f: &usize| capture.frames[f].source.center();
    let mut nearest: Vec<usize> = order.iter().copied().filter(|f| !around.contains(f)).collect();
    let far = |f: &usize| norm(sub(place(f), place(&frame)));
    nearest.sort_by(|a, b| far(a).total_cmp(&far(b)).then(a.cmp(b)));
    around.extend(nearest.into_iter().take(2 * BESIDE));
    let mut images = look::take(capture, &around, look::COARSE);
    look::describe(&mut images, look::COARSE);
    let Some(own) = images.iter().position(|l| l.frame == frame) else { return false };
    let poses: Vec<Se3> = images.iter().map(|l| capture.frames[l.frame].source.cam_from_world).collect();
    (0..images.len()).filter(|&other| other != own).any(|other| {
        let matches = pairs::between([own, other], &images[own].marks, &images[other].marks, pairs::STRICT);
        let fitting = pairs::fitting(&matches, &images, &poses);
        matches.len() >= OVERLAP && fitting as f64 >= FITS[0] * matches.len() as f64
    })
}

/// Matches of two images.
struct Pair {
    images: [usize; 2],
    matches: usize,
    fitting: usize,
}

impl Pair {
    fn share(&self) -> f64 {
        self.fitting as f64 / self.matches as f64
    }

    fn has(&self, look: usize) -> bool {
        self.images.contains(&look)
    }
}

/// The images whose pose is wrong: pairs with images whose own pose fits others do not fit, and none does.
fn wrong(count: usize, pairs: &[Pair]) -> Vec<usize> {
    let good = |k: usize| pairs.iter().any(|p| p.has(k) && p.share() >= FITS[0]);
    let is_wrong = |&k: &usize| {
        let mut bad = pairs.iter().filter(|p| p.has(k) && p.share() < FITS[1]);
        !good(k) && bad.any(|p| good(p.images[0] + p.images[1] - k))
    };
    let wrong: Vec<usize> = (0..count).filter(is_wrong).collect();
    let compared = (0..count).filter(|&k| pairs.iter().any(|p| p.has(k))).count();
    // Where many do not fit, something else is wrong, or the scene moves.
    if wrong.len() as f64 > (FEW * compared as f64).max(1.0) { Vec::new() } else { wrong }
}

fn warning(wrong: &[usize], pairs: &[Pair], described: &dyn Fn(usize) -> (String, Option<Sign>)) -> Option<Finding> {
    if wrong.is_empty() {
        return None;
    }
    let of = |with: bool| {
        let some = pairs.iter().filter(|p| wrong.iter().any(|&k| p.has(k)) == with);
        some.fold([0, 0], |[fit, all], p| [fit + p.fitting, all + p.matches])
    };
    let ([fit, all], [others_fit, others]) = (of(true), of(false));
    let name = |&k: &usize| match described(k) {
        (name, Some(sign)) => format!("{name} ({})", sign.in_words()),
        (name, None) => name,
    };
    let names: Vec<String> = wrong.iter().map(name).collect();
    let (count, plural) = (wrong.len(), if wrong.len() == 1 { "" } else { "s" });
    let what = format!(
        "The pose of {count} image{plural} is probably wrong: {}. {fit} of {all} matches with other images fit it, where \
         {others_fit} of {others} between the others do.",
        first_names(&names)
    );
    let remedy =
        "Correct the pose (and focal length), or take the image out; info --doctor compares all cameras.".into();
    Some(Finding { severity: Severity::Warning, aspect: Some(Aspect::Assumed), what, remedy })
}

/// One frame of every place that has a pose of its own: of a fixed camera the one that is nearest to the time of which most is
/// seen, of moving ones all for training; ordered as they were taken.
pub(super) fn places(capture: &Capture) -> Vec<usize> {
    let mut counts: BTreeMap<usize, usize> = BTreeMap::new();
    capture.train.iter().for_each(|&i| *counts.entry(capture.frames[i].index).or_default() += 1);
    let fullest = counts.into_iter().rev().max_by_key(|(_, n)| *n).map_or(0, |(index, _)| index);
    let (mut nearest, mut moving) = (BTreeMap::<usize, usize>::new(), Vec::new());
    for (i, frame) in capture.frames.iter().enumerate() {
        if capture.cameras[frame.camera].fixed {
            let best = nearest.entry(frame.camera).or_insert(i);
            let apart = |i: usize| capture.frames[i].index.abs_diff(fullest);
            if apart(i) < apart(*best) {
                *best = i;
            }
        }
    }
    moving.extend(capture.train.iter().copied().filter(|&i| !capture.cameras[capture.frames[i].camera].fixed));
    let frame = |i: usize| &capture.frames[i];
    moving.sort_by(|&a, &b| {
        (frame(a).camera.cmp(&frame(b).camera)).then(frame(a).time.0.total_cmp(&frame(b).time.0)).then(a.cmp(&b))
    });
    nearest.into_values().chain(moving).collect()
}

/// The conspicuous poses, by position in the order.
fn signs(capture: &Capture, order: &[usize]) -> BTreeMap<usize, Sign> {
    let frame = |k: usize| &capture.frames[order[k]];
    let few = |found: &Vec<usize>| found.len() as f64 <= (FEW * order.len() as f64).max(1.0);
    let identity: Vec<usize> = (0..order.len()).filter(|&k| is_identity(frame(k), capture.offset)).collect();
    // Sorted by one coordinate, equal poses are neighbours.
    let mut sorted: Vec<usize> = (0..order.len()).collect();
    let x = |k: usize| frame(k).source.cam_from_world.translation;
    sorted.sort_by(|&a, &b| {
        let ([p, q, r], [s, t, u]) = (x(a), x(b));
        p.total_cmp(&s).then(q.total_cmp(&t)).then(r.total_cmp(&u)).then(a.cmp(&b))
    });
    let same = |w: &[usize]| same_pose(&frame(w[0]).source, &frame(w[1]).source);
    let repeated: Vec<usize> = sorted.windows(2).filter(|w| same(w)).flat_map(|w| [w[0], w[1]]).collect();
    let repeated: Vec<usize> = repeated.into_iter().collect::<BTreeSet<_>>().into_iter().collect();
    let jumps = jumps(&(0..order.len()).map(|k| frame(k).source.cam_from_world).collect::<Vec<_>>());
    let mut out = BTreeMap::new();
    for (sign, found) in [(Sign::Identity, identity), (Sign::Repeated, repeated), (Sign::Jump, jumps)] {
        for k in Some(found).filter(few).into_iter().flatten() {
            if out.len() < SUSPECTS {
                out.entry(k).or_insert(sign);
            }
        }
    }
    out
}

/// Whether a camera is at the origin of its capture's world and images along an axis.
fn is_identity(frame: &Frame, offset: [f64; 3]) -> bool {
    let center = frame.source.center();
    let whole = |v: &f64| v.abs() < EXACT || (v.abs() - 1.0).abs() < EXACT;
    let there = (0..3).all(|k| (center[k] + offset[k]).abs() <= EXACT * (1.0 + offset[k].abs()));
    there && frame.source.cam_from_world.rotation.iter().flatten().all(whole)
}

/// Poses that are far from those before and after, which are near each other.
fn jumps(poses: &[Se3]) -> Vec<usize> {
    let centers: Vec<[f64; 3]> = poses.iter().map(|p| p.inverse().translation).collect();
    let far = |a: usize, b: usize| norm(sub(centers[a], centers[b]));
    let turn = |a: usize, b: usize| {
        let (p, q) = (&poses[a].rotation, &poses[b].rotation);
        let trace: f64 = (0..3).map(|r| dot(p[r], q[r])).sum();
        (0.5 * (trace - 1.0)).clamp(-1.0, 1.0).acos().to_degrees()
    };
    let usual = |step: &dyn Fn(usize, usize) -> f64| {
        let mut steps: Vec<f64> = (1..poses.len()).map(|k| step(k - 1, k)).collect();
        let middle = steps.len() / 2;
        if steps.is_empty() { 0.0 } else { *steps.select_nth_unstable_by(middle, f64::total_cmp).1 }
    };
    let (distance, angle) = (usual(&far), usual(&turn));
    let leaps = |k: usize, step: &dyn Fn(usize, usize) -> f64, usual: f64, least: f64| {
        let [to, from, over] = [step(k - 1, k), step(k, k + 1), step(k - 1, k + 1)];
        to.min(from) > JUMP * usual.max(0.5 * over) && to.min(from) > least
    };
    let is_jump = |&k: &usize| leaps(k, &far, distance, 0.0) || leaps(k, &turn, angle, TURN);
    (1..poses.len().saturating_sub(1)).filter(is_jump).collect()
}

/// Positions whose images are compared, and how many of them are so for their own sake.
fn chosen(order: &[usize], signs: &BTreeMap<usize, Sign>, most: usize) -> (Vec<usize>, usize) {
    if order.len() <= ALL.min(most) {
        return ((0..order.len()).collect(), order.len());
    }
    let mut out = BTreeSet::new();
    let mut compared = 0;
    for &k in signs.keys() {
        let beside: Vec<usize> = (k.saturating_sub(BESIDE)..(k + BESIDE + 1).min(order.len())).collect();
        if out.len() + beside.len() > most.max(2 * BESIDE + 1) {
            break;
        }
        out.extend(beside);
        compared += 1;
    }
    (out.into_iter().collect(), compared)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_displaced_camera_is_distinguished_from_a_path() {
        let at = |x: f64| Se3::look_at([x, 4.0, 1.0], [x, 0.0, 0.0], [0.0, 0.0, 1.0]);
        let path: Vec<Se3> = (0..12).map(|k| at(0.1 * f64::from(k))).collect();
        assert!(jumps(&path).is_empty());
        let moved =
            |k: usize, pose: Se3| path.iter().enumerate().map(|(i, p)| if i == k { pose } else { *p }).collect();
        let far: Vec<Se3> = moved(5, at(7.0));
        assert_eq!(jumps(&far), [5]);
        let turned: Vec<Se3> = moved(5, Se3::look_at([0.5, 4.0, 1.0], [0.5, 8.0, 0.0], [0.0, 0.0, 1.0]));
        assert_eq!(jumps(&turned), [5]);
        // A cut to another scene is not a jump out and back.
        let cut: Vec<Se3> =
            path.iter().enumerate().map(|(i, p)| if i < 6 { *p } else { at(9.0 + 0.1 * i as f64) }).collect();
        assert!(jumps(&cut).is_empty());
        assert!(jumps(&path[..2]).is_empty() && jumps(&[]).is_empty());
    }

    #[test]
    fn an_image_whose_matches_fit_no_other_is_reported() {
        let pair = |a: usize, b: usize, fitting: usize| Pair { images: [a, b], matches: 40, fitting };
        let pairs = [pair(0, 1, 30), pair(1, 2, 2), pair(0, 2, 1), pair(2, 3, 0), pair(3, 4, 28), pair(1, 3, 25)];
        assert_eq!(wrong(5, &pairs), [2]);
        // Of two images alone it is not known which is wrong.
        assert!(wrong(2, &pairs[1..2]).is_empty());
        let moving: Vec<Pair> = (0..5).map(|k| pair(k, k + 1, 3)).chain([pair(5, 6, 30)]).collect();
        assert!(wrong(7, &moving).len() <= 1);
    }
}
