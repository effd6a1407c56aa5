//! Lags by geometry: a moving point is on the epipolar line of its sighting in the other camera at the same time, and
//! leaves the line at any other.

use super::tracks::Track;
use super::{NORMAL_MAD, Refusal, median};
use rayon::prelude::*;
use splat4d::math::se3::{mat_mul, mat_vec, norm, sub, transpose};
use splat4d::scene::Camera;

/// Pixels off the epipolar line from which on a match at some lag is rejected: a few times what corners and poses are
/// exact to.
const TOLERANCE: f64 = 3.0;
/// Pixels that corners and poses are usually off, together, in the search.
const USUAL: f64 = 1.0;
/// This many times of a track count as independent of each other: what is wrong with a corner is wrong for some frames.
const INDEPENDENT: f64 = 5.0;
/// Likelihood that a track has no match, of that of a perfect one.
const NO_MATCH: f64 = 0.05;
/// Steps of the search in median intervals between frames.
const GRID: f64 = 0.5;
/// Pixels that a track must move to be informative.
const MOVES: f64 = 2.0;
/// Matches that a lag needs.
const MATCHES: usize = 8;
/// Times that a match must have in common.
const COMMON: usize = 3;
/// By how much the best lag's log-likelihood must exceed the median over lags, in median absolute deviations of lags.
/// All of 22 pairs of a real hall with 2.5 to 12 were right; of tracks without anything in common the other bound
/// decides.
const STANDS_OUT: f64 = 2.5;
/// And by how much for every track: tracks without anything in common reach 0.02 by chance, pairs of the hall
/// 0.23 to 1.05.
const STANDS_OUT_EACH: f64 = 0.2;
/// From this part of the best lag's height on another lag is as good.
const AS_GOOD: f64 = 0.75;
/// Intervals around the best lag that belong to it.
const LOBE: f64 = 1.5;
/// The largest uncertainty that is a lag, in intervals.
const VAGUE: f64 = 0.35;
/// Rounds of matching and refining the lag.
const ROUNDS: usize = 3;
/// The least that a corner is off, pixels: uncertainties must not vanish with noise-free data.
const EXACT: f64 = 0.02;
/// Golden section stops at this part of an interval.
const RESOLUTION: f64 = 1e-3;

/// A lag that the geometry demands.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct EpipolarLag {
    /// Seconds that the second camera is late.
    pub seconds: f64,
    /// Its standard deviation, seconds, from the bend of the cost.
    pub sigma: f64,
    /// Tracks of the one and the other camera that show the same point.
    pub matches: Vec<[usize; 2]>,
    /// The median distance from the epipolar line at this lag, pixels.
    pub error: f64,
}

/// Range of the search.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Range {
    /// The middle, seconds.
    pub around: f64,
    /// This many seconds to either side.
    pub within: f64,
}

/// How much later camera b notes what camera a notes, by tracks in undistorted pixels and the fundamental matrix
/// (`x_bᵀ F x_a = 0`). `matches` are pairs of tracks that may show the same point, some of them wrongly; without them
/// all pairs are tried.
pub(crate) fn lag(
    f: &[[f64; 3]; 3],
    [a, b]: [&[Track]; 2],
    matches: Option<&[[usize; 2]]>,
    range: Range,
) -> Result<EpipolarLag, Refusal> {
    let moves = |t: &&Track| t.extent() >= MOVES && t.samples.len() >= COMMON;
    if [a, b].iter().any(|tracks| tracks.iter().filter(moves).count() < MATCHES.min(tracks.len().max(1))) {
        return Err(Refusal::Still);
    }
    let interval = interval(a).max(interval(b));
    let given: Vec<[usize; 2]> = match matches {
        Some(pairs) => pairs.to_vec(),
        None => (0..a.len()).flat_map(|i| (0..b.len()).map(move |j| [i, j])).collect(),
    };
    let alive = |p: &[usize; 2]| [&a[p[0]], &b[p[1]]].iter().all(moves);
    let given: Vec<[usize; 2]> = given.into_iter().filter(alive).collect();
    if given.len() < MATCHES {
        return Err(Refusal::Still);
    }
    let problem = Problem { f, a, b };
    let steps = (range.within / (GRID * interval)).ceil() as isize;
    let grid: Vec<f64> = (-steps..=steps).map(|k| range.around + GRID * interval * k as f64).collect();
    let costs = problem.costs(&given, &grid);
    if costs.len() < MATCHES {
        return Err(Refusal::Unrelated);
    }
    let best = is_prominent(&grid, &likelihoods(&costs, a.len(), grid.len()), costs.len().min(a.len()), interval)?;
    let mut lag = grid[best];
    let mut matched = Vec::new();
    for _ in 0..ROUNDS {
        let pairs = problem.choose(costs.iter().map(|c| c.0), lag, [a.len(), b.len()], matches.is_some());
        // The same times at all lags that are compared, or the cost would jump where one comes or goes.
        let ends = [lag - GRID * interval, lag + GRID * interval];
        matched = problem.sightings(&pairs, ends);
        if matched.len() < MATCHES {
            return Err(Refusal::Unrelated);
        }
        let scale = problem.scale(&matched, lag);
        lag = golden(|l| problem.robust(&matched, l, scale), ends[0], ends[1], RESOLUTION * interval);
    }
    let scale = problem.scale(&matched, lag);
    let told = matched.iter().map(|m| problem.information(m, lag, 0.25 * interval, scale));
    let (pull, information) = told.fold((0.0, 0.0), |(p, i), (pull, own)| (p + pull * pull, i + own));
    let sigma = (pull.max(scale * scale * information)).sqrt() / information;
    if sigma.is_nan() || sigma >= VAGUE * interval {
        return Err(Refusal::Vague(if sigma.is_finite() { sigma } else { range.within }));
    }
    let error = scale / NORMAL_MAD;
    Ok(EpipolarLag { seconds: lag, sigma, matches: matched.iter().map(|m| m.pair).collect(), error })
}

/// The fundamental matrix of two cameras (pinhole): `x_bᵀ F x_a = 0`.
pub(crate) fn fundamental(a: &Camera, b: &Camera) -> [[f64; 3]; 3] {
    let rotation = mat_mul(&b.cam_from_world.rotation, &transpose(&a.cam_from_world.rotation));
    let t = sub(b.cam_from_world.translation, mat_vec(&rotation, a.cam_from_world.translation));
    let cross = [[0.0, -t[2], t[1]], [t[2], 0.0, -t[0]], [-t[1], t[0], 0.0]];
    let inverse = |c: &Camera| {
        let k = &c.intrinsics;
        [[1.0 / k.fx, 0.0, -k.cx / k.fx], [0.0, 1.0 / k.fy, -k.cy / k.fy], [0.0, 0.0, 1.0]]
    };
    mat_mul(&transpose(&inverse(b)), &mat_mul(&mat_mul(&cross, &rotation), &inverse(a)))
}

/// Pairs of cameras, each with this many that are nearest to it, in order; None: a camera that takes no part.
pub fn neighbours(centers: &[Option<[f64; 3]>], count: usize) -> Vec<[usize; 2]> {
    let mut pairs = Vec::new();
    for (a, own) in centers.iter().enumerate() {
        let Some(own) = own else { continue };
        let far = |(b, c): (usize, &Option<[f64; 3]>)| c.filter(|_| b != a).map(|c| (norm(sub(*own, c)), b));
        let mut others: Vec<(f64, usize)> = centers.iter().enumerate().filter_map(far).collect();
        others.sort_by(|x, y| x.0.total_cmp(&y.0).then(x.1.cmp(&y.1)));
        pairs.extend(others.iter().take(count).map(|&(_, b)| [a.min(b), a.max(b)]));
    }
    pairs.sort_unstable();
    pairs.dedup();
    pairs
}

/// The median interval between samples, seconds.
fn interval(tracks: &[Track]) -> f64 {
    let steps = tracks.iter().flat_map(|t| t.samples.windows(2).map(|w| w[1].0 - w[0].0));
    median(&mut steps.collect::<Vec<_>>())
}

/// Position of a track and the squared slope of the line there; none: outside the track.
type TrackPoint = Option<([f64; 2], f64)>;

/// A pair of tracks and its mean squared distance at every lag.
type Costs = ([usize; 2], Vec<f32>);

/// The log-likelihood of every lag: a track of the first camera matches one of its pairs, or none.
fn likelihoods(costs: &[Costs], tracks: usize, lags: usize) -> Vec<f64> {
    let mut sums = vec![0.0; tracks * lags];
    for ([i, _], cost) in costs {
        for (sum, c) in sums[i * lags..][..lags].iter_mut().zip(cost) {
            *sum += (-0.5 * INDEPENDENT * f64::from(*c) / (USUAL * USUAL)).exp();
        }
    }
    let known: Vec<&[f64]> = sums.chunks_exact(lags).filter(|s| s.iter().any(|v| *v > 0.0)).collect();
    (0..lags).map(|k| known.iter().map(|s| (NO_MATCH + s[k]).ln()).sum()).collect()
}

/// The position of the highest likelihood, if it is much higher than elsewhere.
fn is_prominent(grid: &[f64], heights: &[f64], tracks: usize, interval: f64) -> Result<usize, Refusal> {
    let highest = |of: &mut dyn Iterator<Item = usize>| of.max_by(|&i, &j| heights[i].total_cmp(&heights[j]));
    let best = highest(&mut (0..grid.len())).expect("the grid is not empty");
    let usual = median(&mut heights.to_vec());
    let spread = median(&mut heights.iter().map(|h| (h - usual).abs()).collect::<Vec<_>>());
    let height = heights[best] - usual;
    if height < STANDS_OUT * spread || height < STANDS_OUT_EACH * tracks as f64 {
        return Err(Refusal::Unrelated);
    }
    let far = |i: &usize| (grid[*i] - grid[best]).abs() > LOBE * interval;
    // A slope towards the best one is no peak of its own.
    let peaks = |i: &usize| {
        let left = i.checked_sub(1).is_none_or(|k| heights[k] <= heights[*i]);
        left && heights.get(i + 1).is_none_or(|h| *h <= heights[*i])
    };
    if let Some(other) = highest(&mut (0..grid.len()).filter(far).filter(peaks))
        && heights[other] - usual > AS_GOOD * height
    {
        return Err(Refusal::Repeating([grid[best], grid[other]]));
    }
    Ok(best)
}

/// A track's places at its own times, smoothed like those between the times of the other.
fn smoothed(track: &Track) -> impl Iterator<Item = (f64, [f64; 2])> {
    track.samples.iter().filter_map(|s| Some((s.0, track.smooth(s.0)?)))
}

/// The largest squared distance that counts.
const MOST: f64 = TOLERANCE * TOLERANCE;

/// A pair of tracks, and when and where the first one was.
struct Sightings {
    pair: [usize; 2],
    places: Vec<(f64, [f64; 2])>,
}

struct Problem<'a> {
    f: &'a [[f64; 3]; 3],
    a: &'a [Track],
    b: &'a [Track],
}

impl Problem<'_> {
    /// Signed distances off the epipolar lines of a pair at all times that it has at this lag.
    fn distances(&self, [i, j]: [usize; 2], lag: f64) -> impl Iterator<Item = f64> {
        let other = &self.b[j];
        smoothed(&self.a[i]).filter_map(move |(t, x)| Some(sampson(self.f, x, other.smooth(t + lag)?)))
    }

    /// Mean squared distances of pairs at every lag, none more than the tolerance's; only pairs that fit somewhere.
    fn costs(&self, pairs: &[[usize; 2]], grid: &[f64]) -> Vec<Costs> {
        // Everything that does not depend on the pair comes first: lines of the one's positions, positions of the other
        // and their lines, by time.
        let mut times: Vec<f64> = self.a.iter().flat_map(|t| t.samples.iter().map(|s| s.0)).collect();
        times.sort_by(f64::total_cmp);
        times.dedup();
        let place = |t: f64| times.partition_point(|u| *u < t);
        let lines: Vec<Vec<(usize, [f64; 3])>> =
            (self.a.iter()).map(|t| smoothed(t).map(|(time, x)| (place(time), line(self.f, x))).collect()).collect();
        let mut out: Vec<Costs> = pairs.iter().map(|&p| (p, vec![MOST as f32; grid.len()])).collect();
        for (k, &lag) in grid.iter().enumerate() {
            let others: Vec<Vec<TrackPoint>> = (self.b.par_iter())
                .map(|track| {
                    let at = |t: &f64| track.smooth(t + lag).map(|y| (y, back(self.f, y)));
                    times.iter().map(at).collect()
                })
                .collect();
            out.par_iter_mut().for_each(|([i, j], costs)| {
                let (mut sum, mut count) = (0.0, 0);
                for &(time, l) in &lines[*i] {
                    let Some((y, size)) = others[*j][time] else { continue };
                    let off = y[0] * l[0] + y[1] * l[1] + l[2];
                    let size = size + l[0] * l[0] + l[1] * l[1];
                    sum += if size > 0.0 { (off * off / size).min(MOST) } else { 0.0 };
                    count += 1;
                }
                if count >= COMMON {
                    costs[k] = (sum / count as f64) as f32;
                }
            });
        }
        out.retain(|(_, costs)| costs.iter().any(|c| f64::from(*c) < 0.5 * MOST));
        out
    }

    /// The mean of the squared distances, none more than the tolerance's; that of the tolerance where there are too
    /// few.
    fn cost(&self, pair: [usize; 2], lag: f64) -> f64 {
        let (mut sum, mut count) = (0.0, 0);
        for d in self.distances(pair, lag) {
            sum += (d * d).min(MOST);
            count += 1;
        }
        if count < COMMON { MOST } else { sum / f64::from(count as u32) }
    }

    /// The pairs that fit at a lag; of pairs without given lags, those that fit each other best.
    fn choose(
        &self,
        pairs: impl Iterator<Item = [usize; 2]>,
        lag: f64,
        [n, m]: [usize; 2],
        matched: bool,
    ) -> Vec<[usize; 2]> {
        let fits: Vec<([usize; 2], f64)> =
            pairs.map(|p| (p, self.cost(p, lag))).filter(|(_, cost)| *cost < 0.5 * MOST).collect();
        let (mut of_a, mut of_b) = (vec![f64::INFINITY; n], vec![f64::INFINITY; m]);
        for ([i, j], cost) in &fits {
            of_a[*i] = of_a[*i].min(*cost);
            of_b[*j] = of_b[*j].min(*cost);
        }
        let best = |(p, cost): &([usize; 2], f64)| matched || (*cost <= of_a[p[0]] && *cost <= of_b[p[1]]);
        fits.into_iter().filter(best).map(|f| f.0).collect()
    }

    /// Positions of the pairs in the first camera at the second one's times, at all lags between two.
    fn sightings(&self, pairs: &[[usize; 2]], ends: [f64; 2]) -> Vec<Sightings> {
        let of = |&pair: &[usize; 2]| {
            let other = &self.b[pair[1]];
            let there = |&(t, _): &(f64, [f64; 2])| ends.iter().all(|l| other.smooth(t + l).is_some());
            Sightings { pair, places: smoothed(&self.a[pair[0]]).filter(there).collect() }
        };
        pairs.iter().map(of).filter(|m| m.places.len() >= COMMON).collect()
    }

    /// Signed distances off the epipolar lines.
    fn off(&self, m: &Sightings, lag: f64) -> impl Iterator<Item = f64> {
        let other = &self.b[m.pair[1]];
        m.places.iter().filter_map(move |&(t, x)| Some(sampson(self.f, x, other.smooth(t + lag)?)))
    }

    /// How far off matches usually are, pixels: a robust standard deviation.
    fn scale(&self, matched: &[Sightings], lag: f64) -> f64 {
        let mut off: Vec<f64> = matched.iter().flat_map(|m| self.off(m, lag).map(f64::abs)).collect();
        (NORMAL_MAD * median(&mut off)).max(EXACT)
    }

    /// The mean over matches of Cauchy's cost.
    fn robust(&self, matched: &[Sightings], lag: f64, scale: f64) -> f64 {
        let of =
            |m: &Sightings| self.off(m, lag).map(|d| (d / scale).powi(2).ln_1p()).sum::<f64>() / m.places.len() as f64;
        matched.iter().map(of).sum::<f64>() / matched.len() as f64
    }

    /// How much a match pulls at the lag (px²/s), and its information on it (px²/s²): the mean square of how fast it
    /// leaves the line. Its times count as one, for what is wrong with a track is wrong at all of them. The variance of
    /// the lag is the sum of the squared pulls over the squared sum of the information (White 1980).
    fn information(&self, m: &Sightings, lag: f64, step: f64, scale: f64) -> (f64, f64) {
        let (mut pull, mut sum, mut count) = (0.0, 0.0, 0.0f64);
        for &(t, x) in &m.places {
            let at = |l: f64| self.b[m.pair[1]].smooth(t + l).map(|y| sampson(self.f, x, y));
            let (Some(before), Some(now), Some(after)) = (at(lag - step), at(lag), at(lag + step)) else { continue };
            // Cauchy's weight: what is far off states little.
            let weight = 1.0 / (1.0 + (now / scale).powi(2));
            let speed = (after - before) / (2.0 * step);
            pull += weight * now * speed;
            sum += weight * speed * speed;
            count += 1.0;
        }
        let count = count.max(1.0);
        (pull / count, sum / count)
    }
}

/// F x: the epipolar line of a pixel of the first camera.
fn line(f: &[[f64; 3]; 3], [u, v]: [f64; 2]) -> [f64; 3] {
    [0, 1, 2].map(|k| f[k][0] * u + f[k][1] * v + f[k][2])
}

/// The squared slope of the epipolar line of a pixel of the second camera.
fn back(f: &[[f64; 3]; 3], [x, y]: [f64; 2]) -> f64 {
    let slope = |k: usize| f[0][k] * x + f[1][k] * y + f[2][k];
    slope(0).powi(2) + slope(1).powi(2)
}

/// The distance of two pixels from fitting each other, to first order, with its sign (Sampson 1982).
pub(crate) fn sampson(f: &[[f64; 3]; 3], x: [f64; 2], y: [f64; 2]) -> f64 {
    let l = line(f, x);
    let size = l[0] * l[0] + l[1] * l[1] + back(f, y);
    if size > 0.0 { (y[0] * l[0] + y[1] * l[1] + l[2]) / size.sqrt() } else { 0.0 }
}

/// The least of a function with one minimum between two positions (Kiefer 1953).
fn golden(f: impl Fn(f64) -> f64, mut low: f64, mut high: f64, resolution: f64) -> f64 {
    const PART: f64 = 0.618_033_988_749_894_8;
    let (mut x, mut y) = (high - PART * (high - low), low + PART * (high - low));
    let (mut fx, mut fy) = (f(x), f(y));
    while high - low > resolution {
        if fx < fy {
            (high, y, fy) = (y, x, fx);
            x = high - PART * (high - low);
            fx = f(x);
        } else {
            (low, x, fx) = (x, y, fy);
            y = low + PART * (high - low);
            fy = f(y);
        }
    }
    0.5 * (low + high)
}
