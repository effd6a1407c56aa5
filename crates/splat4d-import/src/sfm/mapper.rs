//! Cameras one after another: starts with a pair, then always adds the one that sees most known points.

mod overlaid;
mod strays;

use super::adjust::{Bundle, Free, Priors, Settings, Sighting, View, adjust};
use super::lens::{Lens, off, unit};
use super::pictures::{CameraView, Feature};
use super::resection::{Known, Placed, place, polish};
use super::tracks::{self, Link, Track, about_middle};
use super::two_view::{Pair, Relative, relative};
use rayon::prelude::*;
use splat4d::math::{Rng, Se3};
use splat4d::scene::Camera;
use splat4d_train::event::Progress;
use splat4d_train::vision::triangulate::{PixelObservation as Ray, Transfer, angle_at, triangulate};

/// How cameras are placed.
#[derive(Clone, Debug, PartialEq)]
pub struct Mapping {
    /// Seed of the random numbers.
    pub seed: u64,
    /// Pairs to start with that are tried, at most.
    pub starts: usize,
    /// Whether clocks are adjusted.
    pub clocks: bool,
    /// Farthest that a point is seen from where it should be, pixels of an image 1920 across.
    pub tolerance: f64,
    /// Least angle between the outermost rays of a point, degrees.
    pub angle: f64,
    /// Standard deviation of principal points about the images' middles, of the larger side.
    pub center: f64,
    /// Standard deviation of k1 about zero.
    pub k1: f64,
    /// Robust loss, pixels of an image 1920 across.
    pub scale: f64,
}

impl Default for Mapping {
    fn default() -> Self {
        // Schönberger and Frahm 2016 (COLMAP) filter at 4 pixels and 1.5 degrees. The rest is measured: most sightings
        // are exact to 0.16 pixels, so that a loss of 0.6 halves the errors of focal lengths against one of 2;
        // principal points kept within 0.3 % are best for the bundled capture, whose true ones are in the middle (0.28
        // degrees, 0.43 with 1 %), and 1 % for the hall (0.73 degrees, 0.91 with 0.3 %).
        Self { seed: 0, starts: 6, clocks: true, tolerance: 4.0, angle: 1.5, center: 0.005, k1: 0.01, scale: 0.6 }
    }
}

/// Focal lengths that are tried where nothing is known, of the image's larger side: from wide phones to short
/// telephoto lenses.
pub(crate) const FOCALS: [f64; 12] = [0.6, 0.66, 0.72, 0.79, 0.86, 0.94, 1.03, 1.12, 1.22, 1.33, 1.45, 1.6];
/// Median angle of a pair to start with, degrees.
const START_ANGLE: f64 = 8.0;
/// Links, those of most matches, among which it is searched for.
const START_AMONG: usize = 40;
/// Known points that a camera must see, and must see where they are.
const SEES: usize = 15;
const FITS: usize = 12;
/// Of the known points that it sees, the share that must fit.
const FITS_SHARE: f64 = 0.2;
/// A camera is placed within this many tolerances: points and lenses are not final.
const PLACED_WITHIN: f64 = 2.0;
/// Views from which on focal lengths are adjusted, and from which on all else is: few views do not separate them from
/// poses.
const FOCAL_FROM: usize = 3;
const ALL_FROM: usize = 7;
/// Small rigs have no more: then from all of them, and at least this many.
const FEWEST: usize = 4;
/// Everything is adjusted again once there are this many times as many views.
const GROWTH: f64 = 1.08;
/// Standard deviations: of log f where it is guessed and where it is known; of k1; of the principal point, of the
/// larger side; of clocks, frames (measured on the hall: 6 pixels of 640, 2 frames).
const GUESSED: f64 = 0.3;
const GIVEN: f64 = 0.1;
const CLOCK: f64 = 2.0;
/// Epipolar distance of matches that are searched for once cameras are placed, of the tolerance.
const GUIDED_WITHIN: f64 = 0.5;
/// Lenses whose focal lengths are found to differ by no more than this share are taken for equal ones, from this many
/// on; they then differ by this share (standard deviation). Of two phones of one model focal lengths differ by some
/// tenths of a per cent.
const ALIKE: f64 = 0.06;
const FAMILY_FROM: usize = 4;
const FAMILY: f64 = 0.003;
/// Difference of lenses that images contradict, as a share: of phones of several models, some per cent.
const STRANGERS: f64 = 0.05;
/// Twice the loss of treating lenses as equal, of the variance of a sighting and for each lens: more contradicts it.
/// Were sightings' errors independent, 1 would be usual (Wilks 1938).
const CONTRADICTS: f64 = 8.0;
/// Rounds of adjusting, leaving out and finding again at the end.
const ROUNDS: usize = 4;

/// A point among the placed cameras.
#[derive(Clone, Debug)]
struct Spot {
    place: [f64; 3],
    /// The sights of its track that see it there.
    seen: Vec<usize>,
}

/// The present state of the map.
#[derive(Clone)]
pub(crate) struct Map<'a> {
    sights: &'a [CameraView],
    tracks: &'a [Track],
    /// For each sight its tracks and its index in them.
    shows: &'a [Vec<(usize, usize)>],
    how: &'a Mapping,
    /// Placed sights in the order of placement.
    order: Vec<usize>,
    poses: Vec<Option<Se3>>,
    taus: Vec<f64>,
    /// By lens number, compact.
    lenses: Vec<Lens>,
    guesses: Vec<Lens>,
    told: Vec<bool>,
    /// Lenses that are known exactly.
    exact: Vec<bool>,
    lens_of: &'a [usize],
    spots: Vec<Option<Spot>>,
    /// Why sights could not be placed.
    reasons: Vec<String>,
    /// Lenses with similar values were found to be of different models.
    strangers: bool,
}

/// Shared data of all starts.
pub(crate) struct Ground<'a> {
    pub sights: &'a [CameraView],
    pub tracks: &'a [Track],
    pub links: &'a [Link],
    pub how: &'a Mapping,
    pub(super) shows: Vec<Vec<(usize, usize)>>,
    lens_of: Vec<usize>,
    lens_count: usize,
}

impl<'a> Ground<'a> {
    pub(crate) fn new(sights: &'a [CameraView], tracks: &'a [Track], links: &'a [Link], how: &'a Mapping) -> Self {
        let mut shows = vec![Vec::new(); sights.len()];
        for (t, track) in tracks.iter().enumerate() {
            track.seen.iter().enumerate().for_each(|(k, (s, _))| shows[*s].push((t, k)));
        }
        let mut numbers: Vec<usize> = sights.iter().map(|s| s.lens).collect();
        numbers.sort_unstable();
        numbers.dedup();
        let of = |s: &CameraView| numbers.binary_search(&s.lens).expect("all numbers are there");
        Self { sights, tracks, links, how, shows, lens_of: sights.iter().map(of).collect(), lens_count: numbers.len() }
    }

    fn size(&self, sight: usize) -> f64 {
        self.sights[sight].size[0].max(self.sights[sight].size[1]) as f64
    }

    /// Pairs to start with at this focal length (of the larger side), the best first.
    pub(crate) fn starts(&self, focal: f64) -> Vec<(usize, Relative)> {
        let mut among: Vec<usize> = (0..self.links.len()).collect();
        among.sort_by_key(|&k| (std::cmp::Reverse(self.links[k].matches.len()), k));
        among.truncate(START_AMONG);
        let of = |k: usize| -> Option<(f64, usize, Relative)> {
            let [a, b] = self.links[k].sights;
            let lens = |s: usize| self.sights[s].focal.unwrap_or(focal * self.size(s));
            let rays: Vec<Pair> = self.rays(k, [lens(a), lens(b)]);
            let tolerance = 0.5 * self.how.tolerance * unit(self.size(a));
            let rng = Rng::new(self.how.seed, "start", k as u64);
            let found = relative(&rays, 0.5 * (lens(a) + lens(b)), tolerance, rng)?;
            let wide = (found.angle.to_degrees() / START_ANGLE).min(1.0);
            // Narrow pairs measure no depth: they count little.
            Some((found.inliers.len() as f64 * wide * wide, k, found))
        };
        let mut found: Vec<(f64, usize, Relative)> = among.par_iter().filter_map(|&k| of(k)).collect();
        found.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        found.into_iter().map(|(_, k, r)| (k, r)).collect()
    }

    /// A link's matches as rays of cameras without distortion.
    fn rays(&self, link: usize, focal: [f64; 2]) -> Vec<Pair> {
        let link = &self.links[link];
        let [a, b] = link.sights.map(|s| &self.sights[s]);
        let ray = |s: &CameraView, f: f64, k: usize| about_middle(s, s.features[k].pixel).map(|v| v / f);
        link.matches.iter().map(|&([i, j], _)| [ray(a, focal[0], i), ray(b, focal[1], j)]).collect()
    }

    /// The map of no camera, with focal lengths (of the larger side) as given or guessed.
    fn empty(&self, focal: f64) -> Map<'_> {
        let mut lenses: Vec<Option<Lens>> = vec![None; self.lens_count];
        let mut told = vec![false; self.lens_count];
        let mut exact = vec![false; self.lens_count];
        for (k, s) in self.sights.iter().enumerate() {
            let guess = s.focal.unwrap_or(focal * self.size(k));
            lenses[self.lens_of[k]].get_or_insert(Lens::plain(guess, s.size[0], s.size[1]));
            told[self.lens_of[k]] |= s.focal.is_some();
            exact[self.lens_of[k]] |= s.exact;
        }
        let lenses: Vec<Lens> = lenses.into_iter().map(|l| l.expect("every lens has a sight")).collect();
        let n = self.sights.len();
        Map {
            sights: self.sights,
            tracks: self.tracks,
            shows: &self.shows,
            how: self.how,
            order: Vec::new(),
            poses: vec![None; n],
            taus: vec![0.0; n],
            guesses: lenses.clone(),
            lenses,
            told,
            exact,
            lens_of: &self.lens_of,
            spots: vec![None; self.tracks.len()],
            reasons: vec![String::new(); n],
            strangers: false,
        }
    }

    /// The map of two cameras.
    pub(crate) fn begin(&self, link: usize, start: &Relative, focal: f64) -> Map<'_> {
        let mut map = self.empty(focal);
        let [a, b] = self.links[link].sights;
        map.poses[a] = Some(Se3::IDENTITY);
        map.poses[b] = Some(start.motion);
        map.order = vec![a, b];
        map.renew();
        map.adjust(8);
        map.renew();
        map
    }

    /// The map of cameras at their stated positions, with the clocks that were found before.
    pub(super) fn given(&self, before: Option<&Mapped>) -> Map<'_> {
        let mut map = self.empty(1.0);
        map.order = (0..self.sights.len()).collect();
        map.poses = self.sights.iter().map(|s| s.pose).collect();
        if let Some(before) = before {
            map.taus = before.cameras.iter().map(|c| c.as_ref().map_or(0.0, |c| c.tau)).collect();
        }
        map
    }

    /// The map of cameras from another map.
    fn again(&self, from: &Map<'_>) -> Map<'_> {
        let mut map = self.empty(1.0);
        map.order.clone_from(&from.order);
        map.poses.clone_from(&from.poses);
        map.taus.clone_from(&from.taus);
        map.lenses.clone_from(&from.lenses);
        map.guesses.clone_from(&from.guesses);
        map.reasons.clone_from(&from.reasons);
        map.strangers = from.strangers;
        map.renew();
        map
    }
}

impl Map<'_> {
    fn size(&self, sight: usize) -> f64 {
        self.sights[sight].size[0].max(self.sights[sight].size[1]) as f64
    }

    fn tolerance(&self, sight: usize) -> f64 {
        self.how.tolerance * unit(self.size(sight))
    }

    fn lens(&self, sight: usize) -> &Lens {
        &self.lenses[self.lens_of[sight]]
    }

    /// The sighting of a track in a sight, at the common time.
    fn pixel(&self, track: usize, k: usize) -> [f64; 2] {
        let (sight, feature) = self.tracks[track].seen[k];
        let f = &self.sights[sight].features[feature];
        std::array::from_fn(|a| f.pixel[a] + f.velocity[a] * self.taus[sight])
    }

    /// How far from there a position is seen, of the tolerance.
    fn off(&self, track: usize, k: usize, x: [f64; 3]) -> f64 {
        let sight = self.tracks[track].seen[k].0;
        let pose = self.poses[sight].as_ref().expect("only placed sights are queried");
        off(self.lens(sight), pose, x, self.pixel(track, k)) / self.tolerance(sight)
    }

    fn placed(&self, track: usize) -> Vec<usize> {
        let seen = &self.tracks[track].seen;
        (0..seen.len()).filter(|&k| self.poses[seen[k].0].is_some()).collect()
    }

    fn center(&self, sight: usize) -> [f64; 3] {
        self.poses[sight].as_ref().expect("only placed sights are queried").inverse().translation
    }

    /// The largest angle between the rays of these sights of a track at a point, degrees.
    fn angle(&self, track: usize, seen: &[usize], x: [f64; 3]) -> f64 {
        let centers: Vec<[f64; 3]> = seen.iter().map(|&k| self.center(self.tracks[track].seen[k].0)).collect();
        let pairs = (0..centers.len()).flat_map(|i| (0..i).map(move |j| (i, j)));
        pairs.map(|(i, j)| angle_at(x, centers[i], centers[j])).fold(0.0, f64::max).to_degrees()
    }

    /// The position of a track that most of its placed sights agree with.
    fn triangulated(&self, track: usize, cameras: &[Option<Camera>]) -> Option<Spot> {
        /// Pairs of sights for trial positions, at most.
        const PAIRS: usize = 40;
        let placed = self.placed(track);
        if placed.len() < 2 {
            return None;
        }
        let straight = |k: usize| {
            let sight = self.tracks[track].seen[k].0;
            let camera = cameras[sight].as_ref().expect("placed sights have cameras");
            Ray { camera, pixel: self.lens(sight).straight(self.pixel(track, k)) }
        };
        let rays: Vec<Ray<'_>> = placed.iter().map(|&k| straight(k)).collect();
        let settled = |x: [f64; 3]| {
            let seen: Vec<usize> = placed.iter().copied().filter(|&k| self.off(track, k, x) < 1.0).collect();
            let wide = seen.len() >= 2 && self.angle(track, &seen, x) >= self.how.angle;
            wide.then_some(Spot { place: x, seen })
        };
        let all = triangulate(&rays).and_then(settled);
        if all.as_ref().is_some_and(|s| s.seen.len() == placed.len()) {
            return all;
        }
        let mut best = all;
        let pairs = (0..rays.len()).flat_map(|i| (0..i).map(move |j| (i, j)));
        for (i, j) in pairs.take(PAIRS) {
            let Some(spot) = triangulate(&[rays[i], rays[j]]).and_then(settled) else { continue };
            if best.as_ref().is_none_or(|b| spot.seen.len() > b.seen.len()) {
                best = Some(spot);
            }
        }
        let best = best?;
        let among: Vec<Ray<'_>> = best.seen.iter().map(|&k| straight(k)).collect();
        let better = triangulate(&among).and_then(settled);
        Some(better.filter(|b| b.seen.len() >= best.seen.len()).unwrap_or(best))
    }

    fn cameras(&self) -> Vec<Option<Camera>> {
        let of = |s: usize| {
            let [w, h] = self.sights[s].size;
            Some(self.lens(s).pinhole(self.poses[s]?, w, h))
        };
        (0..self.sights.len()).map(of).collect()
    }

    /// Leaves out what does not fit, takes in what fits, and finds positions for tracks that have none.
    pub(super) fn renew(&mut self) {
        let cameras = self.cameras();
        let next = |t: usize| -> Option<Spot> {
            if let Some(spot) = &self.spots[t] {
                let seen: Vec<usize> =
                    self.placed(t).into_iter().filter(|&k| self.off(t, k, spot.place) < 1.0).collect();
                let stays = seen.len() >= 2
                    && 2 * seen.len() >= spot.seen.len()
                    && self.angle(t, &seen, spot.place) >= self.how.angle;
                if stays {
                    return Some(Spot { place: spot.place, seen });
                }
            }
            self.triangulated(t, &cameras)
        };
        self.spots = (0..self.tracks.len()).into_par_iter().map(next).collect();
    }

    fn free(&self) -> Free {
        let n = self.order.len();
        if self.placed_before() {
            // Given poses separate clocks from positions, from two cameras on.
            let moves = self.how.clocks && self.sights.iter().all(|s| s.frame > 0.0);
            return Free { pose: false, focal: false, k1: false, center: false, tau: moves };
        }
        let rest = n >= ALL_FROM.min(self.sights.len()).max(FEWEST);
        let moves = self.how.clocks && self.sights.iter().all(|s| s.frame > 0.0);
        Free { pose: true, focal: n >= FOCAL_FROM, k1: rest, center: rest, tau: rest && moves }
    }

    /// Whether poses were given, and are not to be found.
    fn placed_before(&self) -> bool {
        self.sights.iter().all(|s| s.pose.is_some())
    }

    /// Adjusts everything with this many evaluations; the loss and how many sightings it is of.
    fn adjust(&mut self, steps: usize) -> Option<(f64, usize)> {
        let mut bundle = Bundle::default();
        let mut number = vec![usize::MAX; self.sights.len()];
        let mut lens_number = vec![usize::MAX; self.lenses.len()];
        let mut lens_back = Vec::new();
        for (k, &s) in self.order.iter().enumerate() {
            number[s] = k;
            let lens = self.lens_of[s];
            if lens_number[lens] == usize::MAX {
                lens_number[lens] = lens_back.len();
                lens_back.push(lens);
            }
            let pose = self.poses[s].expect("it was placed");
            bundle.views.push(View { pose, lens: lens_number[lens], tau: self.taus[s] });
        }
        bundle.lenses = lens_back.iter().map(|&l| self.lenses[l]).collect();
        let mut back = Vec::new();
        for (t, spot) in self.spots.iter().enumerate() {
            let Some(spot) = spot else { continue };
            for &k in &spot.seen {
                let (sight, feature) = self.tracks[t].seen[k];
                let f = &self.sights[sight].features[feature];
                bundle.sightings.push(Sighting {
                    view: number[sight],
                    point: back.len(),
                    pixel: f.pixel,
                    velocity: f.velocity,
                });
            }
            bundle.points.push(spot.place);
            back.push(t);
        }
        if bundle.sightings.len() < SEES {
            return None;
        }
        let size = self.order.iter().map(|&s| self.size(s)).fold(0.0, f64::max);
        let frame = self.order.iter().map(|&s| self.sights[s].frame).fold(0.0, f64::max);
        let told = lens_back.iter().all(|&l| self.told[l]);
        let family = !told && self.family(&lens_back);
        let settings = Settings {
            scale: self.how.scale * unit(size),
            free: self.free(),
            exact: lens_back.iter().map(|&l| self.exact[l]).collect(),
            priors: Priors {
                lenses: lens_back.iter().map(|&l| self.guesses[l]).collect(),
                focal: if told { GIVEN } else { GUESSED },
                family: match family {
                    true if self.strangers => STRANGERS,
                    true => FAMILY,
                    false => f64::INFINITY,
                },
                k1: self.how.k1,
                center: self.how.center * size,
                tau: (CLOCK * frame).max(f64::MIN_POSITIVE),
            },
            steps,
            gain: 1e-8,
        };
        let report = adjust(&mut bundle, &settings);
        for (&s, view) in self.order.iter().zip(&bundle.views) {
            self.poses[s] = Some(view.pose);
            self.taus[s] = view.tau;
        }
        lens_back.iter().zip(&bundle.lenses).for_each(|(&l, lens)| self.lenses[l] = *lens);
        for (&t, place) in back.iter().zip(&bundle.points) {
            self.spots[t].as_mut().expect("it has a place").place = *place;
        }
        Some((report.after, bundle.sightings.len()))
    }

    /// Whether the images contradict that all lenses are of one model, where that was assumed: the likelihood ratio
    /// of both.
    fn are_strangers(&self) -> bool {
        const STEPS: usize = 30;
        let lenses: std::collections::BTreeSet<usize> = self.order.iter().map(|&s| self.lens_of[s]).collect();
        let lenses: Vec<usize> = lenses.into_iter().collect();
        if self.strangers || !self.family(&lenses) || lenses.iter().all(|&l| self.told[l]) {
            return false;
        }
        let loss = |strangers: bool| {
            let mut map = Self { strangers, ..self.clone() };
            map.adjust(STEPS)
        };
        let (Some((alike, _)), Some((strangers, sightings))) = (loss(false), loss(true)) else { return false };
        let variance = strangers / sightings as f64;
        2.0 * (alike - strangers) > CONTRADICTS * variance * lenses.len() as f64
    }

    /// Whether all lenses seem to be of one model: rigs are often made of equal cameras, and what differs between them
    /// is then the error of each. It is skipped for too few, or for images of several sizes.
    fn family(&self, lenses: &[usize]) -> bool {
        if lenses.len() < FAMILY_FROM || self.order.len() < ALL_FROM {
            return false;
        }
        let mut focals: Vec<f64> = lenses.iter().map(|&l| self.lenses[l].focal).collect();
        focals.sort_by(f64::total_cmp);
        let middle = focals[focals.len() / 2];
        let size = self.sights[self.order[0]].size;
        self.order.iter().all(|&s| self.sights[s].size == size)
            && focals.iter().all(|f| (f / middle).ln().abs() < ALIKE)
    }

    /// Known points that a sight shows.
    fn known(&self, sight: usize) -> Vec<Known> {
        let known = |&(t, k): &(usize, usize)| {
            let spot = self.spots[t].as_ref()?;
            Some(Known { point: spot.place, pixel: self.pixel(t, k) })
        };
        self.shows[sight].iter().filter_map(known).collect()
    }

    /// Places a sight; states why where it cannot be.
    fn place(&mut self, sight: usize) -> bool {
        let known = self.known(sight);
        if known.len() < SEES {
            self.reasons[sight] = format!(
                "it shares {} points with the others, {SEES} are needed: the overlap is small, or its images look \
                 different",
                known.len()
            );
            return false;
        }
        let lens = self.lens_of[sight];
        let used = self.exact[lens] || self.order.iter().any(|&s| self.lens_of[s] == lens);
        let guess = self.guesses[lens];
        let lenses: Vec<Lens> = if used {
            vec![self.lenses[lens]]
        } else if self.told[lens] {
            vec![guess]
        } else {
            let mut focals: Vec<f64> = self.order.iter().map(|&s| self.lens(s).focal / self.size(s)).collect();
            focals.sort_by(f64::total_cmp);
            let size = self.size(sight);
            let mut all = vec![Lens { focal: focals[focals.len() / 2] * size, ..guess }];
            all.extend(FOCALS.iter().map(|f| Lens { focal: f * size, ..guess }));
            all
        };
        let tolerance = PLACED_WITHIN * self.tolerance(sight);
        let rng = Rng::new(self.how.seed, "resection", sight as u64);
        let Some(found) = place(&known, &lenses, !used, tolerance, rng) else { return false };
        let fits = found.inliers.len();
        if fits < FITS || (fits as f64) < FITS_SHARE * known.len() as f64 {
            self.reasons[sight] =
                format!("of {} points that it shares with the others only {fits} fit any position", known.len());
            return false;
        }
        let among: Vec<Known> = found.inliers.iter().map(|&k| known[k]).collect();
        let start = Placed { pose: found.model.pose, lens: found.model.lens };
        let fine = polish(&start, &among, !used, tolerance);
        self.poses[sight] = Some(fine.pose);
        if !used {
            self.lenses[lens] = fine.lens;
            if !self.told[lens] {
                self.guesses[lens].focal = fine.lens.focal;
            }
        }
        self.order.push(sight);
        self.reasons[sight].clear();
        true
    }

    /// Places as many sights as possible.
    pub(crate) fn grow(&mut self, tell: &mut dyn FnMut(usize)) {
        const STEPS: usize = 10;
        let mut adjusted = self.order.len() as f64;
        let mut fresh = true;
        loop {
            let mut left: Vec<(usize, usize)> =
                (0..self.sights.len()).filter(|&s| self.poses[s].is_none()).map(|s| (self.known(s).len(), s)).collect();
            left.sort_by_key(|&(count, s)| (std::cmp::Reverse(count), s));
            let next = left.iter().find(|&&(_, s)| self.place(s)).copied();
            if next.is_none() {
                // Again with points and lenses at their best.
                if left.is_empty() || fresh {
                    break;
                }
                self.adjust(3 * STEPS);
                self.renew();
                fresh = true;
                continue;
            }
            fresh = false;
            tell(self.order.len());
            self.renew();
            if self.order.len() as f64 >= (GROWTH * adjusted).min(adjusted + 8.0) {
                self.adjust(STEPS);
                self.renew();
                adjusted = self.order.len() as f64;
            }
        }
    }

    /// Adjusts, removes outliers and matches again; all sights stay.
    pub(super) fn settle(&mut self) {
        const STEPS: usize = 50;
        for _ in 0..ROUNDS {
            self.adjust(STEPS);
            self.renew();
        }
    }

    /// Adjusts, removes outliers and matches again until convergence; sights with too few points are removed.
    pub(crate) fn finish(&mut self) {
        const STEPS: usize = 50;
        for _ in 0..ROUNDS {
            self.adjust(STEPS);
            self.strangers |= self.are_strangers();
            self.renew();
            let weak: Vec<usize> = self.order.iter().copied().filter(|&s| self.fits(s) < FITS).collect();
            if !weak.is_empty() && self.order.len() - weak.len() >= 2 {
                for s in weak {
                    self.reasons[s] = format!("only {} points fit it in the end", self.fits(s));
                    self.poses[s] = None;
                    self.order.retain(|&o| o != s);
                }
                self.spots.iter_mut().for_each(|s| *s = None);
                self.renew();
            }
        }
        self.adjust(STEPS);
    }

    /// A placed camera without distortion, and where it saw its features by the clock that all share.
    fn undistorted(&self, sight: usize) -> Option<tracks::Known> {
        let [w, h] = self.sights[sight].size;
        let camera = self.lens(sight).pinhole(self.poses[sight]?, w, h);
        let straight = |f: &Feature| {
            self.lens(sight).straight(std::array::from_fn(|a| f.pixel[a] + f.velocity[a] * self.taus[sight]))
        };
        Some(tracks::Known { camera, pixels: self.sights[sight].features.iter().map(straight).collect() })
    }

    /// Matches of placed cameras along epipolar lines, and those of `links` that are on them.
    pub(super) fn guided(&self, links: &[Link], progress: &mut Progress<'_>) -> Vec<Link> {
        let known: Vec<Option<tracks::Known>> =
            (0..self.sights.len()).into_par_iter().map(|s| self.undistorted(s)).collect();
        let mut out = tracks::guided(self.sights, &known, GUIDED_WITHIN * self.how.tolerance, progress);
        for link in links {
            let [a, b] = link.sights;
            let mut link = link.clone();
            if let (Some(p), Some(q)) = (&known[a], &known[b]) {
                let transfer = Transfer::new(&p.camera, &q.camera);
                link.matches.retain(|&([i, j], _)| {
                    let [u, v] = q.pixels[j];
                    let off = transfer.line(p.pixels[i]).map_or(f64::INFINITY, |l| l[0] * u + l[1] * v + l[2]);
                    off.abs() < self.tolerance(b)
                });
            }
            out.push(link);
        }
        out
    }

    /// Points that a sight sees consistently.
    fn fits(&self, sight: usize) -> usize {
        let of = |&&(t, k): &&(usize, usize)| self.spots[t].as_ref().is_some_and(|s| s.seen.contains(&k));
        self.shows[sight].iter().filter(of).count()
    }

    /// Of these, what moves.
    pub(super) fn moving(&self, sight: usize) -> usize {
        let of = |&&(t, k): &&(usize, usize)| {
            let feature = self.tracks[t].seen[k].1;
            let moves = self.sights[sight].features[feature].moment > 0;
            moves && self.spots[t].as_ref().is_some_and(|s| s.seen.contains(&k))
        };
        self.shows[sight].iter().filter(of).count()
    }

    /// Whether this map is better: more cameras, then more sightings.
    pub(crate) fn score(&self) -> (usize, usize) {
        (self.order.len(), self.spots.iter().flatten().map(|s| s.seen.len()).sum())
    }

    /// Puts a camera's distances from where its points are seen together, pixels.
    fn errors(&self, sight: usize) -> Vec<f64> {
        let of = |&(t, k): &(usize, usize)| {
            let spot = self.spots[t].as_ref().filter(|s| s.seen.contains(&k))?;
            Some(self.off(t, k, spot.place) * self.tolerance(sight))
        };
        self.shows[sight].iter().filter_map(of).collect()
    }

    pub(crate) fn result(&self) -> Mapped {
        let median = |mut v: Vec<f64>| {
            let at = v.len() / 2;
            if v.is_empty() { 0.0 } else { *v.select_nth_unstable_by(at, f64::total_cmp).1 }
        };
        let of = |s: usize| match self.poses[s] {
            Some(pose) => Ok(PlacedCamera {
                pose,
                lens: *self.lens(s),
                tau: self.taus[s],
                sightings: self.fits(s),
                error: median(self.errors(s)),
            }),
            None if self.reasons[s].is_empty() => Err("nothing links it with the others".to_owned()),
            None => Err(self.reasons[s].clone()),
        };
        let point = |(t, spot): (usize, &Option<Spot>)| {
            let spot = spot.as_ref()?;
            let seen: Vec<(usize, usize)> = spot.seen.iter().map(|&k| self.tracks[t].seen[k]).collect();
            let off = spot.seen.iter().map(|&k| self.off(t, k, spot.place) * self.tolerance(self.tracks[t].seen[k].0));
            let error = off.sum::<f64>() / spot.seen.len() as f64;
            let first = &self.sights[seen[0].0].features[seen[0].1];
            let (color, moment) = (first.color, first.moment);
            Some(MapPoint { place: spot.place, color, moment, seen: seen.into_iter().map(|(s, _)| s).collect(), error })
        };
        Mapped {
            cameras: (0..self.sights.len()).map(of).collect(),
            points: self.spots.iter().enumerate().filter_map(point).collect(),
            contradiction: vec![None; self.sights.len()],
            moving: (0..self.sights.len()).map(|s| self.moving(s)).collect(),
            stray: vec![false; self.sights.len()],
        }
    }
}

/// A placed camera.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PlacedCamera {
    /// Takes world points into the camera's axes.
    pub pose: Se3,
    /// Of images of the sight's size.
    pub lens: Lens,
    /// How far its clock is ahead, seconds.
    pub tau: f64,
    /// Points that it sees consistently.
    pub sightings: usize,
    /// Their median distance from where they are seen, pixels of the sight's size.
    pub error: f64,
}

/// A point.
#[derive(Clone, Debug)]
pub(crate) struct MapPoint {
    /// In the world.
    pub place: [f64; 3],
    /// sRGB.
    pub color: [u8; 3],
    /// As of its features.
    pub moment: usize,
    /// Sights that see it.
    pub seen: Vec<usize>,
    /// Mean distance from where it is seen, pixels.
    pub error: f64,
}

/// Cameras (or why they could not be placed) and points.
#[derive(Clone, Debug)]
pub(crate) struct Mapped {
    /// One for each sight.
    pub cameras: Vec<Result<PlacedCamera, String>>,
    /// In the order of tracks.
    pub points: Vec<MapPoint>,
    /// Of cameras whose poses were given; see [`super::Solution::contradiction`].
    pub contradiction: Vec<Option<f64>>,
    /// Of each camera, the points that move by which its clock was found.
    pub moving: Vec<usize>,
    /// Of each camera, whether motion in it contradicts the others: it shows another time.
    pub stray: Vec<bool>,
}

/// Places cameras: from several starts, the best of which is kept. `None`: no two images fit together.
pub(crate) fn map(
    sights: &[CameraView],
    tracks: &[Track],
    links: &[Link],
    focals: &[f64],
    how: &Mapping,
    progress: &mut Progress<'_>,
) -> Option<Mapped> {
    let ground = Ground::new(sights, tracks, links, how);
    let mut best: Option<Map<'_>> = None;
    // The likeliest focal length's best pair, its second best, then the next focal length's ...
    let ranked: Vec<(f64, Vec<(usize, Relative)>)> =
        focals.iter().take(how.starts.div_ceil(2)).map(|&f| (f, ground.starts(f))).collect();
    let mut tries: Vec<(usize, f64, usize, &Relative)> = Vec::new();
    for (i, (focal, starts)) in ranked.iter().enumerate() {
        for (k, (link, relative)) in starts.iter().take(how.starts).enumerate() {
            tries.push((k + 2 * i, *focal, *link, relative));
        }
    }
    tries.sort_by_key(|t| t.0);
    for (_, focal, link, relative) in tries.into_iter().take(how.starts) {
        let mut map = ground.begin(link, relative, focal);
        map.grow(&mut |n| progress.phase("placing cameras", n, sights.len()));
        map.finish();
        let better = best.as_ref().is_none_or(|b| map.score() > b.score());
        let all = map.order.len() == sights.len();
        if better {
            best = Some(map);
        }
        if all {
            break;
        }
    }
    let best = best?;
    let more = best.guided(links, progress);
    let joined = tracks::join(sights, &more);
    let ground = Ground::new(sights, &joined, links, how);
    let mut map = ground.again(&best);
    map.finish();
    map.grow(&mut |n| progress.phase("placing cameras", n, sights.len()));
    map.finish();
    if map.order.len() < best.order.len() {
        return Some(best.result());
    }
    let (exact, longer) = map.overlaid();
    let ground = Ground::new(&exact, &longer, links, how);
    let mut map = ground.again(&map);
    map.finish();
    Some(Mapped { stray: strays::of(&map.agreement(links)), ..map.result() })
}
