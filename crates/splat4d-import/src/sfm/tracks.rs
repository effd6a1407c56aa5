//! Features of many images that show one point: matched without any pose, verified two images at a time, joined.

use super::pictures::{CameraView, Feature};
use super::two_view::{Pair, fundamental, unlike_focal};
use rayon::prelude::*;
use splat4d::math::Rng;
use splat4d::math::se3::dot;
use splat4d::nn::matmul::{Matrix, product};
use splat4d::scene::Camera;
use splat4d_train::event::Progress;
use splat4d_train::vision::features::NUMBERS;
use splat4d_train::vision::triangulate::Transfer;

/// The second best match must be this many times farther away (Lowe 2004; measured on the hall of `Look`).
const RATIO: f32 = 0.8;
/// Features nearer than this to each other show one point: no rivals, pixels.
const SAME: f64 = 1.5;
/// Pairs of images with fewer verified matches carry no information: seven always agree.
const LEAST: usize = 14;
/// Of the matches the least share that is verified: by chance more agree only among few.
const LEAST_SHARE: f64 = 0.15;
/// Epipolar distance of verified matches, pixels of images of [`super::mapper::UNIT`] across.
const TOLERANCE: f64 = 3.0;

/// Two sights and the features that they share.
#[derive(Clone, Debug)]
pub(crate) struct Link {
    /// Numbers of the sights, the lower one first.
    pub sights: [usize; 2],
    /// Numbers of the features and how sure: the smaller the ratio of the best to the second best the better.
    pub matches: Vec<([usize; 2], f32)>,
    /// From pixels (about the middle of the first image) to lines of the second; zero where poses led to the matches.
    pub fundamental: [[f64; 3]; 3],
    /// All matches, whether they agree with one motion or not; empty if the matches were guided by poses.
    pub alike: Vec<[usize; 2]>,
}

/// A point that several sights see.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Track {
    /// Numbers of the sights, ascending without duplicates, and of their features.
    pub seen: Vec<(usize, usize)>,
}

/// Which images are compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Pairing {
    /// All with all.
    All,
    /// Frames of a walk: with this many that follow, and every one of these many with all others of them.
    Sequence {
        /// How many that follow.
        near: usize,
        /// Every n-th is compared with all others of that kind: loops.
        every: usize,
    },
}

impl Pairing {
    pub(super) fn pairs(self, count: usize) -> Vec<[usize; 2]> {
        let wanted = |a: usize, b: usize| match self {
            Self::All => true,
            Self::Sequence { near, every } => b - a <= near || (a.is_multiple_of(every) && b.is_multiple_of(every)),
        };
        (0..count).flat_map(|a| (a + 1..count).map(move |b| [a, b])).filter(|&[a, b]| wanted(a, b)).collect()
    }
}

/// The features of one time of a sight as rows of a matrix.
struct Rows {
    /// Numbers of the features.
    features: std::ops::Range<usize>,
    /// Descriptors, row by row.
    data: Vec<f32>,
    /// Their squared lengths.
    squares: Vec<f32>,
}

fn rows(features: &[Feature]) -> Vec<Rows> {
    let last = features.iter().map(|f| f.moment).max().unwrap_or(0);
    assert!(features.is_sorted_by_key(|f| f.moment), "features are ordered by time");
    let of = |m: usize| {
        let from = features.partition_point(|f| f.moment < m);
        let to = features.partition_point(|f| f.moment <= m);
        let data: Vec<f32> =
            features[from..to].iter().flat_map(|f| f.descriptor.iter().map(|v| f32::from(*v))).collect();
        let squares = data.chunks(NUMBERS).map(|d| d.iter().map(|v| v * v).sum()).collect();
        Rows { features: from..to, data, squares }
    };
    (0..=last).map(of).collect()
}

/// Rows that are multiplied at once: what they make stays in the cache.
const BLOCK: usize = 128;
/// Pairs of images that are compared between two reports of progress.
const TOGETHER: usize = 16;

/// Mutual best matches of two sets of descriptors whose second best is clearly worse, by the first one's numbers.
fn mutual(a: &Rows, b: &Rows, from: &[Feature], to: &[Feature]) -> Vec<([usize; 2], f32)> {
    let (n, m) = (a.features.len(), b.features.len());
    if n == 0 || m == 0 {
        return Vec::new();
    }
    let other = Matrix::new(&b.data, m, NUMBERS, NUMBERS).t();
    let mut back = vec![(f32::INFINITY, 0usize); m];
    let mut forth = Vec::with_capacity(n);
    let mut products = vec![0.0f32; BLOCK * m];
    for first in (0..n).step_by(BLOCK) {
        let count = BLOCK.min(n - first);
        // Whole numbers below 2^24: exact in any order.
        let block = Matrix::new(&a.data[first * NUMBERS..(first + count) * NUMBERS], count, NUMBERS, NUMBERS);
        product(block, other, &mut products[..count * m], m, false);
        for i in first..first + count {
            let row = &products[(i - first) * m..(i - first + 1) * m];
            let (mut best, mut second) = ((f32::INFINITY, 0), f32::INFINITY);
            for (j, p) in row.iter().enumerate() {
                let d = b.squares[j] - 2.0 * p;
                let whole = d + a.squares[i];
                if whole < back[j].0 {
                    back[j] = (whole, i);
                }
                if d < best.0 {
                    best = (d, j);
                }
            }
            let place = to[b.features.start + best.1].pixel;
            for (j, p) in row.iter().enumerate() {
                let d = b.squares[j] - 2.0 * p;
                if d < second {
                    let q = to[b.features.start + j].pixel;
                    if (q[0] - place[0]).abs().max((q[1] - place[1]).abs()) > SAME {
                        second = d;
                    }
                }
            }
            let of = |d: f32| (d + a.squares[i]).max(0.0);
            let ratio = if second.is_finite() { (of(best.0) / of(second).max(1.0)).sqrt() } else { 1.0 };
            forth.push((best.1, ratio));
        }
    }
    let places = |k: usize| from[a.features.start + k].pixel;
    let mut out = Vec::new();
    for (i, (j, ratio)) in forth.into_iter().enumerate() {
        // Another feature of the same point may be the best one back.
        let (p, q) = (places(back[j].1), places(i));
        let agree = back[j].1 == i || (p[0] - q[0]).abs().max((p[1] - q[1]).abs()) < SAME;
        if ratio < RATIO && agree {
            out.push(([a.features.start + i, b.features.start + j], ratio));
        }
    }
    out
}

/// Compares images and keeps what agrees with one motion between them, in the order of pairs.
pub(crate) fn links(sights: &[CameraView], pairing: Pairing, seed: u64, progress: &mut Progress<'_>) -> Vec<Link> {
    let all: Vec<Vec<Rows>> = sights.par_iter().map(|s| rows(s.described())).collect();
    let pairs = pairing.pairs(sights.len());
    let mut out = Vec::new();
    for (part, chunk) in pairs.chunks(TOGETHER).enumerate() {
        progress.phase("matching", part * TOGETHER, pairs.len());
        let found: Vec<Option<Link>> = chunk
            .par_iter()
            .map(|&[a, b]| {
                let (from, to) = (&sights[a], &sights[b]);
                let matches: Vec<([usize; 2], f32)> =
                    all[a].iter().zip(&all[b]).flat_map(|(p, q)| mutual(p, q, &from.features, &to.features)).collect();
                verified(sights, [a, b], matches, Rng::new(seed, "two views", (a * sights.len() + b) as u64))
            })
            .collect();
        out.extend(found.into_iter().flatten());
    }
    out
}

/// Data of a placed sight: its undistorted features, at the common time.
pub(crate) struct Known {
    /// Without distortion.
    pub camera: Camera,
    /// Of every feature, pixels.
    pub pixels: Vec<[f64; 2]>,
}

/// Second-best matches are searched for along the epipolar line alone, where there are few: they must be farther away.
const GUIDED_RATIO: f32 = 0.75;
/// A match without a competitor on its line must beat an unlike one: squared distance of descriptors, an eighth of the
/// largest there is.
const FAR: f32 = 65_536.0;
/// Cameras whose axes are farther apart see other sides of objects, degrees.
const WIDEST: f64 = 80.0;

/// Compares placed images along epipolar lines, within `tolerance` pixels of [`super::lens::unit`].
pub(crate) fn guided(
    sights: &[CameraView],
    known: &[Option<Known>],
    tolerance: f64,
    progress: &mut Progress<'_>,
) -> Vec<Link> {
    let all: Vec<Vec<Rows>> = sights.par_iter().map(|s| rows(s.described())).collect();
    let near = |&[a, b]: &[usize; 2]| match (&known[a], &known[b]) {
        (Some(p), Some(q)) => dot(p.camera.forward(), q.camera.forward()) > WIDEST.to_radians().cos(),
        _ => false,
    };
    let pairs: Vec<[usize; 2]> = Pairing::All.pairs(sights.len()).into_iter().filter(near).collect();
    let mut out = Vec::new();
    for (part, chunk) in pairs.chunks(TOGETHER).enumerate() {
        progress.phase("matching along epipolar lines", part * TOGETHER, pairs.len());
        let found: Vec<Option<Link>> = chunk
            .par_iter()
            .map(|&[a, b]| {
                let (p, q) = (known[a].as_ref()?, known[b].as_ref()?);
                let size = sights[b].size[0].max(sights[b].size[1]) as f64;
                let limit = tolerance * super::lens::unit(size);
                let transfer = Transfer::new(&p.camera, &q.camera);
                let lines: Vec<[f32; 3]> = p
                    .pixels
                    .iter()
                    // A feature without a line has one that is infinitely far away.
                    .map(|&x| transfer.line(x).map_or([0.0, 0.0, f32::INFINITY], |l| l.map(|v| (v / limit) as f32)))
                    .collect();
                let matches: Vec<([usize; 2], f32)> =
                    all[a].iter().zip(&all[b]).flat_map(|(r, s)| along(r, s, &lines, &q.pixels)).collect();
                (!matches.is_empty()).then_some(Link {
                    sights: [a, b],
                    matches,
                    fundamental: [[0.0; 3]; 3],
                    alike: Vec::new(),
                })
            })
            .collect();
        out.extend(found.into_iter().flatten());
    }
    out
}

/// Mutual best matches within 1 of the lines, by the first one's numbers.
fn along(a: &Rows, b: &Rows, lines: &[[f32; 3]], pixels: &[[f64; 2]]) -> Vec<([usize; 2], f32)> {
    let (n, m) = (a.features.len(), b.features.len());
    if n == 0 || m == 0 {
        return Vec::new();
    }
    let to: Vec<[f32; 2]> = b.features.clone().map(|j| pixels[j].map(|v| v as f32)).collect();
    let other = Matrix::new(&b.data, m, NUMBERS, NUMBERS).t();
    let mut back = vec![(f32::INFINITY, 0usize); m];
    let mut forth: Vec<Option<(usize, f32)>> = Vec::with_capacity(n);
    let mut products = vec![0.0f32; BLOCK * m];
    for first in (0..n).step_by(BLOCK) {
        let count = BLOCK.min(n - first);
        let block = Matrix::new(&a.data[first * NUMBERS..(first + count) * NUMBERS], count, NUMBERS, NUMBERS);
        product(block, other, &mut products[..count * m], m, false);
        for i in first..first + count {
            let row = &products[(i - first) * m..(i - first + 1) * m];
            let l = lines[a.features.start + i];
            let (mut best, mut second) = ((f32::INFINITY, usize::MAX), f32::INFINITY);
            for (j, p) in row.iter().enumerate() {
                let q = to[j];
                let off = l[0] * q[0] + l[1] * q[1] + l[2];
                if off.is_nan() || off.abs() > 1.0 {
                    continue;
                }
                let d = (a.squares[i] + b.squares[j] - 2.0 * p).max(0.0);
                if d < back[j].0 {
                    back[j] = (d, i);
                }
                let same = |k: usize| (to[k][0] - q[0]).abs().max((to[k][1] - q[1]).abs()) < SAME as f32;
                if d < best.0 {
                    if best.1 < usize::MAX && !same(best.1) {
                        second = best.0;
                    }
                    best = (d, j);
                } else if d < second && !same(best.1) {
                    second = d;
                }
            }
            let ratio = (best.0 / second.clamp(1.0, FAR)).sqrt();
            forth.push((best.0 < FAR && ratio < GUIDED_RATIO).then_some((best.1, ratio)));
        }
    }
    let mutual = |(i, found): (usize, &Option<(usize, f32)>)| {
        let (j, ratio) = (*found)?;
        (back[j].1 == i).then_some(([a.features.start + i, b.features.start + j], ratio))
    };
    forth.iter().enumerate().filter_map(mutual).collect()
}

/// Pixels about the middle of the image.
pub(crate) fn about_middle(sight: &CameraView, pixel: [f64; 2]) -> [f64; 2] {
    std::array::from_fn(|k| pixel[k] - 0.5 * sight.size[k] as f64)
}

/// What agrees with one motion between two images; `None`: too little.
pub(super) fn verified(
    sights: &[CameraView],
    [a, b]: [usize; 2],
    matches: Vec<([usize; 2], f32)>,
    rng: Rng,
) -> Option<Link> {
    if matches.len() < LEAST {
        return None;
    }
    let (from, to) = (&sights[a], &sights[b]);
    let pair = |&([i, j], _): &([usize; 2], f32)| -> Pair {
        [about_middle(from, from.features[i].pixel), about_middle(to, to.features[j].pixel)]
    };
    let pairs: Vec<Pair> = matches.iter().map(pair).collect();
    let size = from.size.iter().chain(&to.size).copied().max().expect("there are four") as f64;
    let tolerance = TOLERANCE * super::lens::unit(size);
    let found = fundamental(&pairs, size, tolerance, rng)?;
    let few = found.inliers.len() < LEAST || (found.inliers.len() as f64) < LEAST_SHARE * matches.len() as f64;
    (!few).then(|| Link {
        sights: [a, b],
        matches: found.inliers.iter().map(|&k| matches[k]).collect(),
        fundamental: found.model,
        alike: matches.iter().map(|m| m.0).collect(),
    })
}

/// Joins the matches of all links, surest first, so that no track has two features of one sight. Tracks ascend by their
/// first features.
pub(crate) fn join(sights: &[CameraView], links: &[Link]) -> Vec<Track> {
    // Features of exactly one position are one.
    let mut starts = vec![0];
    let mut place_of: Vec<Vec<usize>> = Vec::with_capacity(sights.len());
    let mut first_of: Vec<usize> = Vec::new();
    let mut sight_of: Vec<usize> = Vec::new();
    for (k, s) in sights.iter().enumerate() {
        let mut places = Vec::with_capacity(s.features.len());
        for (i, f) in s.features.iter().enumerate() {
            let same = i > 0 && s.features[i - 1].pixel == f.pixel && s.features[i - 1].moment == f.moment;
            if !same {
                first_of.push(i);
                sight_of.push(k);
            }
            places.push(first_of.len() - 1);
        }
        place_of.push(places);
        starts.push(first_of.len());
    }
    let mut edges: Vec<(f32, usize, usize)> = Vec::new();
    for link in links {
        let [a, b] = link.sights;
        edges.extend(link.matches.iter().map(|&([i, j], ratio)| (ratio, place_of[a][i], place_of[b][j])));
    }
    edges.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)).then(a.2.cmp(&b.2)));
    let mut group: Vec<usize> = (0..first_of.len()).collect();
    let mut members: Vec<Vec<usize>> = (0..first_of.len()).map(|k| vec![k]).collect();
    for (_, a, b) in edges {
        let (a, b) = (group[a], group[b]);
        let clash = || members[a].iter().any(|&p| members[b].iter().any(|&q| sight_of[p] == sight_of[q]));
        if a == b || clash() {
            continue;
        }
        let (low, high) = (a.min(b), a.max(b));
        let moved = std::mem::take(&mut members[high]);
        moved.iter().for_each(|&p| group[p] = low);
        members[low].extend(moved);
    }
    let track = |mut m: Vec<usize>| {
        m.sort_unstable();
        Track { seen: m.into_iter().map(|p| (sight_of[p], first_of[p])).collect() }
    };
    members.into_iter().filter(|m| m.len() > 1).map(track).collect()
}

/// The focal lengths, in units of the images' larger side, that all cameras may share, the likeliest first: each
/// link votes for
/// those with which its fundamental matrix is an essential one.
pub(crate) fn focal_votes(sights: &[CameraView], links: &[Link], candidates: &[f64]) -> Vec<f64> {
    /// Residual of a matrix of noisy matches at the right focal length: the vote falls to 1/e.
    const OFF: f64 = 0.05;
    let vote = |focal: f64| -> f64 {
        let of = |l: &Link| {
            let size = sights[l.sights[0]].size.iter().copied().max().expect("there are two") as f64;
            l.matches.len() as f64 * (-unlike_focal(&l.fundamental, focal * size) / OFF).exp()
        };
        links.iter().map(of).sum()
    };
    let mut ranked: Vec<(f64, f64)> = candidates.iter().map(|&f| (vote(f), f)).collect();
    ranked.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.total_cmp(&b.1)));
    ranked.into_iter().map(|(_, f)| f).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sight(features: Vec<Feature>) -> CameraView {
        CameraView {
            name: String::new(),
            size: [640, 360],
            factor: 1.0,
            focal: None,
            exact: false,
            pose: None,
            lens: 0,
            frame: 0.03,
            features,
            learned: 0,
            shown: Vec::new(),
        }
    }

    fn feature(kind: u64, place: f64, moment: usize) -> Feature {
        let rng = Rng::new(3, "descriptor", kind);
        let descriptor = std::array::from_fn(|k| (80.0 * rng.uniform(k as u64)) as u8);
        Feature { pixel: [place, 20.0], velocity: [0.0; 2], moment, descriptor, color: [0; 3] }
    }

    #[test]
    fn features_of_different_times_never_match() {
        let a = sight(vec![feature(1, 10.0, 0), feature(2, 50.0, 1), feature(3, 90.0, 2)]);
        let b = sight(vec![
            feature(4, 30.0, 0),
            feature(1, 60.0, 0),
            feature(5, 70.0, 1),
            feature(3, 80.0, 1),
            feature(2, 90.0, 2),
            feature(6, 95.0, 2),
        ]);
        let (ra, rb) = (rows(&a.features), rows(&b.features));
        let found: Vec<[usize; 2]> =
            ra.iter().zip(&rb).flat_map(|(p, q)| mutual(p, q, &a.features, &b.features)).map(|m| m.0).collect();
        assert_eq!(found, [[0, 1]]);
    }

    #[test]
    fn tracks_hold_each_sight_once_and_surest_matches_win() {
        let of = |n: usize| sight((0..n).map(|k| feature(k as u64, 10.0 * k as f64, 0)).collect());
        let sights = [of(3), of(3), of(3)];
        let link = |sights, matches: &[([usize; 2], f32)]| Link {
            sights,
            matches: matches.to_vec(),
            fundamental: [[0.0; 3]; 3],
            alike: Vec::new(),
        };
        let links = [
            link([0, 1], &[([0, 0], 0.1), ([1, 1], 0.2)]),
            link([1, 2], &[([0, 0], 0.3), ([1, 2], 0.7)]),
            // Would join places 0 and 1 of the first sight.
            link([0, 2], &[([1, 0], 0.6)]),
        ];
        let tracks = join(&sights, &links);
        let seen: Vec<Vec<(usize, usize)>> = tracks.into_iter().map(|t| t.seen).collect();
        assert_eq!(seen, [vec![(0, 0), (1, 0), (2, 0)], vec![(0, 1), (1, 1), (2, 2)]]);
    }

    #[test]
    fn a_walk_compares_neighbours_and_loops() {
        let pairs = Pairing::Sequence { near: 2, every: 5 }.pairs(11);
        assert!(pairs.contains(&[3, 5]) && !pairs.contains(&[3, 6]) && pairs.contains(&[0, 10]));
        assert_eq!(Pairing::All.pairs(4).len(), 6);
    }
}
