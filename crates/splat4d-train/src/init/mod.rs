//! Initial Gaussians: from the capture's points or depth maps, the visual hulls of masks or of dynamic regions at
//! several times, or random points in the cameras' common volume; and a far shell behind them.

mod depth;
pub(crate) mod fill;
pub(crate) mod hull;
mod map;
pub(crate) mod scan;
mod scene_flow;
mod shell;
pub(crate) mod sky;
pub(crate) mod volume;

use crate::capture::PointCloud;
use crate::capture::frames::Frames;
use crate::methods::{InitialMotion, Method, TrainContext};
use crate::settings::{Value, among, settings};
use crate::{Error, Result};
pub use shell::FarShell;
use splat4d::layers::{Head, Layer, Scene};
use splat4d::math::Rng;
use splat4d::math::knn::mean_square_distance;
use splat4d::math::se3::{norm, sub};
use splat4d::math::sh::rgb_to_dc;
use splat4d::scene::params::{LOG_SCALE, OPACITY, QUAT};
use splat4d::scene::{GEOMETRY, HeadKeys, LIFE, LifeKind, Params, SH};
use std::path::{Path, PathBuf};

/// Points to start from.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Seeds {
    /// Positions, world.
    pub points: Vec<[f64; 3]>,
    /// Colours in [0, 1].
    pub colors: Vec<[f32; 3]>,
    /// When the point was seen, seconds; `None`: during the whole clip.
    pub times: Vec<Option<f64>>,
    /// Velocity, scene units per second; zero where unknown.
    pub velocities: Vec<[f64; 3]>,
    /// Width of the lifespans of points with a time, seconds; `None`: the recipe's.
    pub life: Option<f64>,
    /// The far shell, without points where there is none.
    pub(crate) shell: shell::Shell,
}

impl Seeds {
    /// Points of a cloud, which carries no information of velocities.
    pub(crate) fn of(cloud: &PointCloud) -> Self {
        let velocities = vec![[0.0; 3]; cloud.points.len()];
        let (points, colors, times) = (cloud.points.clone(), cloud.colors.clone(), cloud.times.clone());
        Self { points, colors, times, velocities, ..Self::default() }
    }

    /// Number of points.
    pub(crate) fn len(&self) -> usize {
        self.points.len()
    }

    /// Whether there is none.
    pub(crate) fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// Adds one.
    pub fn push(&mut self, point: [f64; 3], color: [f32; 3], time: Option<f64>) {
        self.points.push(point);
        self.colors.push(color);
        self.times.push(time);
        self.velocities.push([0.0; 3]);
    }

    /// Adds all of another set.
    pub(crate) fn append(&mut self, mut other: Self) {
        self.points.append(&mut other.points);
        self.colors.append(&mut other.colors);
        self.times.append(&mut other.times);
        self.velocities.append(&mut other.velocities);
        self.life = self.life.or(other.life);
    }

    /// At most `count` of them, evenly chosen.
    pub(crate) fn truncate_evenly(&mut self, count: usize, rng: Rng) {
        if self.len() <= count {
            return;
        }
        let mut keep = vec![false; self.len()];
        rng.permutation(self.len()).into_iter().take(count).for_each(|i| keep[i as usize] = true);
        self.retain(|i, _| keep[i]);
    }

    /// Keeps those that the rule selects.
    fn retain(&mut self, rule: impl Fn(usize, &Self) -> bool) {
        let mut old = std::mem::take(self);
        (self.life, self.shell) = (old.life, std::mem::take(&mut old.shell));
        for i in (0..old.len()).filter(|&i| rule(i, &old)) {
            self.push(old.points[i], old.colors[i], old.times[i]);
            self.velocities[self.points.len() - 1] = old.velocities[i];
        }
    }
}

settings! {
    /// Initial Gaussians.
    pub struct InitSettings {
        /// Source of initial Gaussians: `auto`, `points`, `pictures` (found in the images), `hull`, `random`, or a file
        /// of points (.ply, .npy, .npz).
        source: Source = Source::Auto;
        /// Number of initial Gaussians; 0: 10,000, and for static scenes half of what exceeds 30,000 in addition. If
        /// a capture has fewer points, more are placed between them along surfaces; hulls of masks and of
        /// dynamic regions, and random points, add as many.
        count: usize = 0 => any().when(IsNot("init.source", &["points"]));
        /// Initial opacity.
        opacity: f64 = 0.1 => inside_share();
        /// Number of times at which initial points are placed over the clip; 0: about every 5 frames.
        keyframes: usize = 0;
        /// Initial lifespan width of moving points, clips; 0: twice the gap between keyframes, and from depth maps by
        /// the coverage of dynamic regions.
        life: f64 = 0.0
            => any().unit("clips").when(Any(&[Is("run.motion", &["spacetime", "native4d"]), Is("life.kind", &["gauss-half", "gauss-one", "interval"])]));
        /// Static Gaussians on a far sphere where cameras see beyond the points (a sky, a horizon): auto, on or off.
        shell: FarShell = FarShell::Auto
            => any().when(All(&[IsNot("run.motion", &["tracked"]), IsNot("densify.strategy", &["mcmc"])]));
        /// Distance of the far shell from the cameras' centre; 0: where the images agree best.
        shell_distance: f64 = 0.0 => any().unit("extents").when(Is("init.shell", &["auto", "on"]));
    }
}

/// Initial Gaussians where [`InitSettings::count`] is 0: the number that small captures are tuned for (docs/suite.md).
/// A static scene of more than 30,000 Gaussians starts with half of the others in addition: an object photographed in
/// 600 steps gains 0.3 to 0.45 dB by it, a room and a toy as much as by the same time in steps, a walk nothing
/// (studies/records/2026-11-28-drawn-at-full-size.md).
pub(crate) const COUNT: usize = 10_000;

/// Source of the first Gaussians.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Source {
    /// The capture's points and those of its depth maps; without maps, where points are few or leave out a part of what
    /// cameras see, those that its images show, and more between them; the hull of masks, or of dynamic regions before
    /// fixed cameras; else at random.
    Auto,
    /// The capture's points.
    Points,
    /// Points that the images show, whatever the capture brings, and more between them.
    Pictures,
    /// The visual hull of masks.
    Hull,
    /// At random in the cameras' common volume.
    Random,
    /// The points of a .ply, .npy or .npz file.
    File(PathBuf),
}

impl Source {
    /// Endings of files of points.
    const ENDINGS: [&'static str; 3] = ["ply", "npy", "npz"];
    const WORDS: [(&'static str, Self); 5] = [
        ("auto", Self::Auto),
        ("points", Self::Points),
        ("pictures", Self::Pictures),
        ("hull", Self::Hull),
        ("random", Self::Random),
    ];
}

impl Value for Source {
    fn to_toml(&self) -> toml::Value {
        let word = || Self::WORDS.iter().find(|(_, source)| source == self).map_or("", |(word, _)| word);
        toml::Value::String(match self {
            Self::File(path) => path.to_string_lossy().into_owned(),
            _ => word().to_owned(),
        })
    }

    fn from_toml(value: &toml::Value) -> std::result::Result<Self, String> {
        let word = value.as_str().unwrap_or_default();
        if Path::new(word).extension().is_some_and(|e| Self::ENDINGS.iter().any(|v| e.eq_ignore_ascii_case(v))) {
            return Ok(Self::File(word.into()));
        }
        let known = Self::WORDS.into_iter().find(|(name, _)| *name == word);
        known.map(|(_, source)| source).ok_or_else(|| {
            among(value, &[&Self::WORDS.map(|(word, _)| word)[..], &["a .ply, .npy or .npz file"]].concat())
        })
    }
}

/// A random colour would have to be unlearnt; grey is the least wrong.
const UNKNOWN_COLOR: [f32; 3] = [0.5; 3];
/// A lifespan this many clips wide is practically infinite: at the clip's ends σ is still above 0.96.
const LONG_LIFE_CLIPS: f64 = 2.0;
/// One keyframe of initial points about every n frames.
const FRAMES_PER_KEYFRAME: usize = 5;
/// Initial scales are clamped to this share of the extent, or of the distance from the cameras where that is more: a
/// lone point would otherwise hide the scene, and a far background of points that are a pixel wide would have to grow
/// first.
const LARGEST_SCALE: f64 = 0.05;
/// Smallest initial scale, of the extent.
const SMALLEST_SCALE: f64 = 1e-5;
/// Softness of an interval life's ends at the start, frames.
const INITIAL_SOFTNESS_FRAMES: f64 = 1.0;

/// Half-width and softness of an interval life at the start where the point's time is not known, clips: alive in the
/// middle, three quarters there at the ends, and free to move both.
const OPEN_LIFE: (f64, f64) = (0.3, 0.25);

/// The keyframe times of the plan: evenly over the clip, at least one.
pub(crate) fn keyframes(plan: &TrainContext, settings: &InitSettings) -> Vec<f64> {
    let count = match settings.keyframes {
        0 => plan.times.div_ceil(FRAMES_PER_KEYFRAME).max(1),
        k => k.min(plan.times.max(1)),
    };
    (0..count).map(|k| plan.clip[0] + (plan.clip[1] - plan.clip[0]) * (k as f64 + 0.5) / count as f64).collect()
}

/// Chooses initial points. `points`: the capture's own.
pub fn seeds(
    plan: &TrainContext,
    settings: &InitSettings,
    frames: &dyn Frames,
    points: Option<Seeds>,
    moving: bool,
) -> Result<Seeds> {
    let rng = Rng::new(plan.seed, "init", 0);
    let count = if settings.count == 0 { COUNT } else { settings.count };
    let volume = volume::common(frames);
    let times = if moving { keyframes(plan, settings) } else { vec![0.5 * (plan.clip[0] + plan.clip[1])] };
    let have_points = points.as_ref().is_some_and(|p| !p.is_empty());
    let mut out = Seeds::default();
    match settings.source {
        Source::Points if !have_points => {
            return Err(Error::input("the capture has no points to start from")
                .remedy("Add a points file to the capture, or use --set init=random"));
        }
        Source::Pictures if !have_points => {
            return Err(Error::input("no points were found in the images")
                .remedy("Check the poses with `splat4d info CAPTURE`, or use --set init=random"));
        }
        Source::Hull if !frames.has_masks() => {
            return Err(Error::input("the visual hull needs masks, and the capture has none")
                .remedy("Add masks to the capture, or use --set init=random"));
        }
        _ => {}
    }
    let use_hull =
        frames.has_masks() && matches!(settings.source, Source::Auto | Source::Hull) && (moving || !have_points);
    let seen = match settings.source {
        Source::Auto if frames.has_depth() => depth::points(frames, count, moving, rng.fork(4))?,
        _ => Seeds::default(),
    };
    let have_depth = !seen.is_empty();
    out.append(seen);
    let points = points.filter(|p| !p.is_empty() && !matches!(settings.source, Source::Random | Source::Hull));
    let use_points = points.is_some();
    out.append(points.unwrap_or_default());
    let sky = shell::before(plan, frames, &mut out)?;
    if use_points {
        let filled = matches!(settings.source, Source::Auto | Source::Pictures);
        if filled && !have_depth && out.len() < count {
            // Surfaces that move are elsewhere at other times.
            let still = (0..out.len()).filter(|&i| out.times[i].is_none());
            let known: Vec<[f64; 3]> = still.map(|i| out.points[i]).collect();
            out.append(fill::between(frames, &known, count - out.len(), sky.as_ref())?);
        }
    }
    if have_depth {
        // Depth maps are more accurate than hulls.
    } else if use_hull {
        out.append(hull::carve(frames, &volume, &times, count, moving, rng.fork(1))?);
    } else if settings.source == Source::Auto && have_points && moving {
        out.append(hull::carve_moving(frames, &volume, &times, count, rng.fork(1))?);
    } else if settings.source == Source::Random || !have_points {
        out.append(volume::random(frames, &volume, count, moving.then_some(plan.clip), rng.fork(2)));
    }
    let cap = plan.common.densify.max_cap;
    if let Some(sky) = sky {
        out.shell = shell::Shell::new(&sky, count, cap);
    }
    out.truncate_evenly(cap.saturating_sub(out.shell.len()).max(1), rng.fork(3));
    Ok(out)
}

/// Initial points for Gaussians that are alive during the whole clip: those of its middle, where moving objects are on
/// average nearest to where it will be.
pub(crate) fn one_time(
    plan: &TrainContext,
    settings: &InitSettings,
    frames: &dyn Frames,
    points: Option<Seeds>,
) -> Result<Seeds> {
    let single = InitSettings { keyframes: settings.keyframes.max(1), ..settings.clone() };
    let mut out = seeds(plan, &single, frames, points, true)?;
    if out.life.take().is_some() {
        // Depth maps show every time: of dynamic regions only one is needed.
        let middle = 0.5 * (plan.clip[0] + plan.clip[1]);
        let nearest =
            out.times.iter().flatten().copied().min_by(|a, b| (a - middle).abs().total_cmp(&(b - middle).abs()));
        out.retain(|i, s| s.times[i].is_none() || s.times[i] == nearest);
    }
    out.times.fill(None);
    Ok(out)
}

/// A layer of Gaussians at the seeds: isotropic, as large as the distance to their neighbours of the same time. Behind it
/// the far shell, where the seeds have one.
pub fn scene(
    plan: &TrainContext,
    settings: &InitSettings,
    program: &dyn Method,
    seeds: &Seeds,
    background: [f32; 3],
    up: [f64; 3],
) -> Result<Scene<f32>> {
    let degree = plan.common.appearance.sh_degree;
    let life = program.life(plan);
    let n = seeds.len();
    let mut params = Params::<f32>::new(n, (degree + 1) * (degree + 1), life.columns());
    let scales = scales(seeds, plan);
    let begin = |i: usize| InitialMotion { life: first_life(plan, settings, seeds, i), velocity: seeds.velocities[i] };
    let beginnings: Vec<InitialMotion> = (0..n).map(begin).collect();
    let logit = (settings.opacity / (1.0 - settings.opacity)).ln() as f32;
    for i in 0..n {
        let geometry = &mut params[GEOMETRY];
        geometry.write(i, 0, seeds.points[i].map(|x| x as f32));
        geometry.write(i, QUAT, [1.0, 0.0, 0.0, 0.0]);
        geometry.write(i, LOG_SCALE, [scales[i].ln() as f32; 3]);
        geometry.set(i, OPACITY, logit);
        params[SH].write(i, 0, seeds.colors[i].map(rgb_to_dc));
        if life != LifeKind::Infinite {
            let (center, mut width) = beginnings[i].life;
            let mut softness = INITIAL_SOFTNESS_FRAMES / plan.fps;
            if life == LifeKind::Interval && seeds.times[i].is_none() {
                // Flat ends outside the clip would have no gradient: no Gaussian could learn to appear or vanish.
                (width, softness) = (OPEN_LIFE.0 * plan.seconds(), OPEN_LIFE.1 * plan.seconds());
            }
            params[LIFE].write(i, 0, [center as f32, width.ln() as f32]);
            if life == LifeKind::Interval {
                params[LIFE].write(i, 2, [softness.ln() as f32]);
            }
        }
    }
    let motion = program.build(plan, &mut params)?;
    program.init(plan, &beginnings, &mut params);
    let head = if HeadKeys::of(&params).is_some() { Head::Features } else { Head::Identity };
    let mut layers = vec![Layer::new("scene", params, motion, life)];
    if seeds.shell.len() > 0 {
        layers.push(seeds.shell.layer(plan));
    }
    let (clip, fps) = (plan.clip, plan.fps);
    Ok(Scene { layers, background, clip, fps, up, head, ..Scene::default() })
}

/// Centre and width (seconds) of the lifespan that a Gaussian at a seed starts with.
fn first_life(plan: &TrainContext, settings: &InitSettings, seeds: &Seeds, i: usize) -> (f64, f64) {
    let gap = plan.seconds() / keyframes(plan, settings).len() as f64;
    let short = match seeds.life {
        _ if settings.life > 0.0 => settings.life * plan.seconds(),
        Some(width) => width,
        None => 2.0 * gap,
    };
    match seeds.times[i] {
        Some(t) => (t, short),
        None => (0.5 * (plan.clip[0] + plan.clip[1]), LONG_LIFE_CLIPS * plan.seconds()),
    }
}

/// Root mean square distance to the three nearest seeds of the same time (Kerbl et al. 2023), clamped.
fn scales(seeds: &Seeds, plan: &TrainContext) -> Vec<f64> {
    let mut order: Vec<usize> = (0..seeds.len()).collect();
    let key = |i: usize| seeds.times[i].unwrap_or(f64::NEG_INFINITY);
    order.sort_by(|&a, &b| key(a).total_cmp(&key(b)).then(a.cmp(&b)));
    let mut out = vec![0.0; seeds.len()];
    let mut rest = order.as_slice();
    while let Some(&first) = rest.first() {
        let count = rest.partition_point(|&i| key(i) == key(first));
        let (group, tail) = rest.split_at(count);
        // Random points have a time each; then all of them are one group.
        let group = if count < 8 { rest } else { group };
        let points: Vec<[f32; 3]> = group.iter().map(|&i| seeds.points[i].map(|x| x as f32)).collect();
        for (&i, d) in group.iter().zip(mean_square_distance(&points)) {
            let reach = plan.extent.max(norm(sub(seeds.points[i], plan.center)));
            out[i] = f64::from(d).sqrt().clamp(SMALLEST_SCALE * plan.extent, LARGEST_SCALE * reach);
        }
        rest = if count < 8 { &[] } else { tail };
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recipe::{MotionName, Recipe};
    use splat4d::layers::Evaluation;
    use splat4d::scene::{Rows, Space, Time};

    /// Far Gaussians are as wide as the distance to their neighbours, seen from the cameras.
    #[test]
    fn first_sizes_are_bounded_by_the_distance_from_the_cameras() {
        let plan = TrainContext { extent: 2.0, center: [0.0, 0.0, -1.0], ..TrainContext::default() };
        let mut seeds = Seeds::default();
        for at in [1.0, 99.0] {
            (0..5).for_each(|k| seeds.push([0.3 * at * f64::from(k), 0.0, at], [0.5; 3], None));
        }
        let sizes = scales(&seeds, &plan);
        let bound = |i: usize| LARGEST_SCALE * norm(sub(seeds.points[i], plan.center)).max(2.0);
        assert!((0..10).all(|i| (sizes[i] - bound(i)).abs() < 1e-9), "all lie further apart than that: {sizes:?}");
        assert!(sizes[0] == LARGEST_SCALE * 2.0 && sizes[5] == LARGEST_SCALE * 100.0);
    }

    #[test]
    fn a_moving_initial_point_makes_a_moving_gaussian() {
        for motion in ["spacetime", "native4d"] {
            let recipe = Recipe::default().with(|r| r.run.motion = MotionName::of(motion));
            let plan = TrainContext { extent: 2.0, clip: [0.0, 1.0], times: 11, fps: 10.0, ..recipe.plan() };
            let mut seeds = Seeds { life: Some(0.2), ..Seeds::default() };
            for k in 0..6 {
                seeds.push([0.1 * k as f64, 0.0, 1.0], [0.5; 3], Some(0.5));
                seeds.velocities[k] = [0.3 * k as f64, -0.4, 0.7];
            }
            let made =
                scene(&plan, &recipe.init, recipe.program().unwrap().as_ref(), &seeds, [0.0; 3], [0.0, 1.0, 0.0])
                    .unwrap();
            for t in [0.5, 0.6] {
                let answer = Evaluation::of_layer(&made.layers[0], Space::Gaussians, Rows::All, Time(t));
                for k in 0..6 {
                    let there = std::array::from_fn(|i| seeds.points[k][i] + (t - 0.5) * seeds.velocities[k][i]);
                    let off = norm(sub(answer.tape(0).out().read::<3>(k, 0).map(f64::from), there));
                    assert!(off < 1e-5, "{motion}, {k} at {t}: {off}");
                }
            }
        }
    }
}
