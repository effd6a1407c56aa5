//! Selections evaluated over time: every Gaussian is examined at some times of its own lifespan.

use super::select::Expr;
use super::{Context, Mask};
use crate::layers::{Evaluation, Layer, Scene, sweep};
use crate::math::se3::{norm, sub};
use crate::math::sh::dc_to_rgb;
use crate::math::{Real, sym3};
use crate::scene::params::OPACITY;
use crate::scene::splats::{COV, SPLAT_OPACITY};
use crate::scene::{Camera, Color, GEOMETRY, Rows, Space, Table, Time, features, labels};
use crate::{Error, Result};

/// Times at which a Gaussian is examined, at most, evenly over its lifespan: a bit each.
const SAMPLES: usize = 8;
/// Times of the clip at which neighbours are sought.
const NEIGHBOUR_LOOKS: usize = 8;
/// Share of the images that have a Gaussian in them in which it must be on the subject: others may hide it, whose
/// masks
/// then leave it out.
const ON_SUBJECT: f32 = 0.75;

/// By layer and Gaussian: whether it is meant.
pub type Selected = Vec<Vec<bool>>;

/// Selects in a scene. A predicate of positions holds for a Gaussian where it holds at more than half of the times of
/// its life that are examined; `ever`, `always` and `at` differ.
///
/// Errors: names of cameras, layers or masks that there are not; masks of another size than their camera.
pub fn select(expr: &Expr, scene: &Scene<f32>, context: &dyn Context) -> Result<Selected> {
    let samples = SceneSamples::over_lifespans(scene, expr);
    let bits = evaluate(expr, scene, &samples, context)?;
    Ok(most(&bits, &samples))
}

/// Samples of one layer: [`SAMPLES`] entries for row i from `SAMPLES · i` on, of which `count[i]` are used.
struct LayerSamples {
    count: Vec<u8>,
    means: Vec<[f32; 3]>,
    sizes: Vec<f32>,
    speeds: Vec<f32>,
    colors: Vec<[f32; 3]>,
    /// [from, to] in seconds within the clip; from > to: never.
    seen: Vec<[f64; 2]>,
}

struct SceneSamples(Vec<LayerSamples>);

/// A time, the rows that are examined then, and the index of each row's sample.
type Query<'a> = (Time, &'a (Vec<u32>, Vec<u8>));

/// By layer and row: bit i represents time i of the row.
type Bits = Vec<Vec<u8>>;

impl SceneSamples {
    /// Samples spread over lifespans, on frames.
    fn over_lifespans(scene: &Scene<f32>, expr: &Expr) -> Self {
        let fps = if scene.fps > 0.0 && scene.fps.is_finite() { scene.fps } else { crate::scene::time::DEFAULT_FPS };
        let [start, end] = scene.clip;
        let frames = ((end - start) * fps).round().max(0.0) as usize + 1;
        let time = |k: usize| (start + k as f64 / fps).min(end);
        let of = |layer: &Layer<f32>| {
            let seen: Vec<[f64; 2]> = layer.spans().iter().map(|[from, to]| [from.max(start), to.min(end)]).collect();
            let frame = |t: f64| ((t - start) * fps).clamp(0.0, (frames - 1) as f64);
            // By frame: the rows that are examined then, and the index of that sample.
            let mut asked: Vec<(Vec<u32>, Vec<u8>)> = vec![Default::default(); frames];
            // A Gaussian that is never seen is examined nowhere: no predicate of positions holds, and its negation
            // does.
            let mut count = vec![1; seen.len()];
            for (row, [from, to]) in seen.iter().enumerate().filter(|(_, [from, to])| from <= to) {
                let (first, last) = (frame(*from).ceil() as usize, frame(*to).floor() as usize);
                // A lifespan between two frames is examined at the nearer one.
                let (first, last) =
                    if first > last { [frame(0.5 * (from + to)).round() as usize; 2].into() } else { (first, last) };
                let samples = SAMPLES.min(last - first + 1);
                count[row] = samples as u8;
                for i in 0..samples {
                    let k = first + (last - first) * i / (samples - 1).max(1);
                    asked[k].0.push(row as u32);
                    asked[k].1.push(i as u8);
                }
            }
            let asked: Vec<_> = asked.into_iter().enumerate().filter(|(_, a)| !a.0.is_empty()).collect();
            let queries: Vec<Query<'_>> = asked.iter().map(|(k, a)| (Time(time(*k)), a)).collect();
            LayerSamples::of(layer, expr, seen, count, &queries)
        };
        Self(scene.layers.iter().map(of).collect())
    }

    /// One sample of all Gaussians alive at t.
    fn at(scene: &Scene<f32>, expr: &Expr, t: f64) -> Self {
        let of = |layer: &Layer<f32>| {
            let mut ids = Vec::new();
            if layer.active(Time(t), &mut ids) {
                ids = (0..layer.params.len() as u32).collect();
            }
            let mut count = vec![0; layer.params.len()];
            ids.iter().for_each(|&i| count[i as usize] = 1);
            let places = vec![0; ids.len()];
            LayerSamples::of(layer, expr, layer.spans(), count, &[(Time(t), &(ids, places))])
        };
        Self(scene.layers.iter().map(of).collect())
    }
}

impl LayerSamples {
    fn of(layer: &Layer<f32>, expr: &Expr, seen: Vec<[f64; 2]>, count: Vec<u8>, queries: &[Query<'_>]) -> Self {
        let wanted = |which: &dyn Fn(&Expr) -> bool| if expr.any(which) { SAMPLES * count.len() } else { 0 };
        let none = f32::NAN;
        let mut out = Self {
            means: vec![[none; 3]; SAMPLES * count.len()],
            sizes: vec![none; wanted(&|e| matches!(e, Expr::Size(..)))],
            speeds: vec![none; wanted(&|e| matches!(e, Expr::Speed(..)))],
            colors: vec![[none; 3]; wanted(&|e| matches!(e, Expr::Color(..)))],
            count,
            seen,
        };
        let asked: Vec<(Rows<'_>, Time)> = queries.iter().map(|(t, (ids, _))| (Rows::Some(ids), *t)).collect();
        let mut velocities = Table::default();
        sweep(layer, &asked, |i, tape| {
            let (ids, places) = queries[i].1;
            let part = layer.part(tape);
            if !out.speeds.is_empty() {
                layer.motion.velocity(&tape.query(&layer.params), &mut velocities);
            }
            for (j, (&id, &place)) in ids.iter().zip(places).enumerate() {
                let at = SAMPLES * id as usize + usize::from(place);
                out.means[at] = part.out.read::<3>(j, 0);
                if !out.sizes.is_empty() {
                    out.sizes[at] = sym3::largest(part.out.read::<6>(j, COV).map(f64::from)).max(0.0).sqrt() as f32;
                }
                if !out.speeds.is_empty() {
                    let v = layer.frame.scale * norm(velocities.read::<3>(j, 0).map(f64::from));
                    out.speeds[at] = v as f32;
                }
                if !out.colors.is_empty() {
                    out.colors[at] = base_color(&part.color, j);
                }
            }
        });
        out
    }
}

/// The colour that does not change with direction, 0 to 1.
fn base_color(color: &Color<'_>, j: usize) -> [f32; 3] {
    match color {
        Color::Sh { table, rows, weights, .. } => {
            let id = rows.id(j);
            let blocks = weights.map_or(1, |w| w.width().max(1));
            let weight = |b: usize| weights.map_or(1.0, |w| w.get(j, b));
            let block = table.width() / blocks;
            std::array::from_fn(|c| dc_to_rgb((0..blocks).map(|b| weight(b) * table.get(id, b * block + c)).sum()))
        }
        Color::Direct { table } => std::array::from_fn(|c| table.get(j, c)),
    }
}

/// All bits of this many samples.
fn all(count: u8) -> u8 {
    ((1u16 << count) - 1) as u8
}

/// The rows whose features are like those of the Gaussian that is nearest to a position at any time that is examined.
///
/// Errors: the scene has no features.
fn alike(scene: &Scene<f32>, samples: &SceneSamples, place: [f64; 3], least: f64) -> Result<Selected> {
    let of = |layer: usize, row: usize| {
        let params = &scene.layers[layer].params;
        features::key(params).map(|key| features::row(params, key, row)).filter(|f| f.iter().any(|x| *x != 0.0))
    };
    let mut nearest: Option<(f64, Vec<f32>)> = None;
    for (layer, l) in samples.0.iter().enumerate() {
        for row in 0..l.count.len() {
            let far = |i: u8| norm(sub(l.means[SAMPLES * row + usize::from(i)].map(f64::from), place));
            let far = (0..l.count[row]).map(far).fold(f64::INFINITY, f64::min);
            if far < nearest.as_ref().map_or(f64::INFINITY, |n| n.0)
                && let Some(features) = of(layer, row)
            {
                nearest = Some((far, features));
            }
        }
    }
    let (_, wanted) = nearest.ok_or_else(|| {
        Error::input("the scene has no features").remedy(
            "Give the capture's cameras images of features, then: splat4d label RUN (docs/labels.md, \"Features\").",
        )
    })?;
    let like = |layer: usize, row: usize| of(layer, row).is_some_and(|f| features::likeness(&f, &wanted) >= least);
    Ok((0..scene.layers.len()).map(|l| (0..scene.layers[l].params.len()).map(|r| like(l, r)).collect()).collect())
}

/// The rows for which a selection holds at most times.
fn most(bits: &Bits, samples: &SceneSamples) -> Selected {
    let of = |(bits, samples): (&Vec<u8>, &LayerSamples)| {
        bits.iter().zip(&samples.count).map(|(b, n)| 2 * (b & all(*n)).count_ones() > u32::from(*n)).collect()
    };
    bits.iter().zip(&samples.0).map(of).collect()
}

fn evaluate(expr: &Expr, scene: &Scene<f32>, samples: &SceneSamples, context: &dyn Context) -> Result<Bits> {
    let again = |e: &Expr| evaluate(e, scene, samples, context);
    // Of a row's numbers that do not change.
    let rows = |holds: &dyn Fn(usize, usize) -> bool| -> Bits {
        let of = |(layer, samples): (usize, &LayerSamples)| {
            (0..samples.count.len()).map(|row| if holds(layer, row) { all(samples.count[row]) } else { 0 }).collect()
        };
        samples.0.iter().enumerate().map(of).collect()
    };
    let chosen = |selected: &Selected| rows(&|layer, row| selected[layer][row]);
    let moments = |holds: &dyn Fn(&LayerSamples, usize) -> bool| -> Bits {
        let bit = |samples: &LayerSamples, row: usize| {
            let one = |i: &u8| holds(samples, SAMPLES * row + usize::from(*i));
            (0..samples.count[row]).filter(one).map(|i| 1 << i).sum()
        };
        samples.0.iter().map(|l| (0..l.count.len()).map(|row| bit(l, row)).collect()).collect()
    };
    let places = |holds: &dyn Fn([f64; 3]) -> bool| moments(&|l, i| holds(l.means[i].map(f64::from)));
    let pair = |a: &Expr, b: &Expr, of: &dyn Fn(u8, u8) -> u8| -> Result<Bits> {
        let (a, b) = (again(a)?, again(b)?);
        Ok(a.iter().zip(&b).map(|(a, b)| a.iter().zip(b).map(|(a, b)| of(*a, *b)).collect()).collect())
    };
    Ok(match expr {
        Expr::All => rows(&|_, _| true),
        Expr::Box(low, high) => places(&|x| (0..3).all(|k| (low[k]..=high[k]).contains(&x[k]))),
        Expr::Sphere(center, radius) => places(&|x| norm(sub(x, *center)) <= *radius),
        Expr::Lasso(lasso) => {
            let turn = lasso.cam_from_world();
            places(&|x| lasso.holds(&turn, x))
        }
        Expr::Visible(surface) => {
            let turn = surface.cam_from_world();
            places(&|x| surface.holds(&turn, x))
        }
        Expr::Frustum(name, [near, far]) => {
            let camera = context.camera(name)?;
            places(&|x| pixel(&camera, x).is_some_and(|(_, z)| z >= near.max(camera.near) && z <= *far))
        }
        Expr::Mask(file, name) => {
            let camera = context.camera(name)?;
            let mask = context.mask(file, &camera)?;
            fits(&mask, &camera, file)?;
            places(&|x| on(&camera, &mask, x) == Some(true))
        }
        Expr::Subject => chosen(&subject(scene, context)?),
        Expr::Color(rgb, near) => moments(&|l, i| norm(sub(l.colors[i].map(f64::from), *rgb)) <= *near),
        Expr::Size(from, to) => moments(&|l, i| (*from..=*to).contains(&f64::from(l.sizes[i]))),
        Expr::Speed(from, to) => moments(&|l, i| (*from..=*to).contains(&f64::from(l.speeds[i]))),
        Expr::Opacity(from, to) => rows(&|layer, row| {
            (*from..=*to).contains(&scene.layers[layer].params[GEOMETRY].get(row, OPACITY).sigmoid().f64())
        }),
        Expr::Life(from, to) => rows(&|layer, row| {
            let [first, last] = samples.0[layer].seen[row];
            (*from..=*to).contains(&(last - first).max(0.0))
        }),
        Expr::Layer(name) => {
            if !scene.layers.iter().any(|l| l.name == *name) {
                let mut names: Vec<&str> = scene.layers.iter().map(|l| l.name.as_str()).collect();
                names.dedup();
                return Err(Error::input(format!("the scene has no layer `{name}`"))
                    .remedy(format!("It has: {}", names.join(", "))));
            }
            rows(&|layer, _| scene.layers[layer].name == *name)
        }
        Expr::Label(name) => {
            let wanted = Some(labels::named(&scene.labels, name)?);
            let of: Vec<Vec<Option<usize>>> = scene.layers.iter().map(|l| labels::of(&l.params)).collect();
            rows(&|layer, row| of[layer][row] == wanted)
        }
        Expr::Like(place, least) => chosen(&alike(scene, samples, *place, *least)?),
        Expr::At(t, inner) => {
            if !(scene.clip[0]..=scene.clip[1]).contains(t) {
                return Err(Error::input(format!("{t} s is outside the scene's clip"))
                    .remedy(format!("It goes from {} to {} s", scene.clip[0], scene.clip[1])));
            }
            let then = SceneSamples::at(scene, inner, *t);
            let bits = evaluate(inner, scene, &then, context)?;
            chosen(&most(&bits, &then))
        }
        Expr::Ever(inner) => {
            let bits = again(inner)?;
            rows(&|layer, row| bits[layer][row] != 0)
        }
        Expr::Always(inner) => {
            let bits = again(inner)?;
            rows(&|layer, row| bits[layer][row] == all(samples.0[layer].count[row]) && bits[layer][row] != 0)
        }
        Expr::Grow(inner, distance) => {
            let inner = most(&again(inner)?, samples);
            chosen(&grown(scene, inner, *distance))
        }
        Expr::And(a, b) => pair(a, b, &|a, b| a & b)?,
        Expr::Or(a, b) => pair(a, b, &|a, b| a | b)?,
        Expr::Not(inner) => {
            let bits = again(inner)?;
            let of =
                |(bits, l): (&Vec<u8>, &LayerSamples)| bits.iter().zip(&l.count).map(|(b, n)| !b & all(*n)).collect();
            bits.iter().zip(&samples.0).map(of).collect()
        }
    })
}

/// The pixel of a point and its depth, where it is in the image.
fn pixel(camera: &Camera, x: [f64; 3]) -> Option<([usize; 2], f64)> {
    let ([u, v], z) = camera.project(x)?;
    let inside = u >= 0.0 && v >= 0.0 && u < camera.width as f64 && v < camera.height as f64;
    inside.then_some(([u as usize, v as usize], z))
}

/// Whether a point is on the white of a mask; none: not in the image.
fn on(camera: &Camera, mask: &Mask, x: [f64; 3]) -> Option<bool> {
    pixel(camera, x).map(|([u, v], _)| mask.white[v * mask.width + u])
}

/// Errors unless a mask of this size, [width, height], is one for images of `camera`.
pub fn mask_fits([width, height]: [usize; 2], camera: &Camera, name: &str) -> Result<()> {
    if [width, height] == [camera.width, camera.height] {
        return Ok(());
    }
    let what = format!("the mask has {width} x {height} pixels, its camera {} x {}", camera.width, camera.height);
    Err(Error::input(what).at(name).remedy("Give a mask of the size of the camera's images"))
}

fn fits(mask: &Mask, camera: &Camera, name: &str) -> Result<()> {
    assert_eq!(mask.white.len(), mask.width * mask.height, "a mask has a pixel for each place");
    mask_fits([mask.width, mask.height], camera, name)
}

/// The Gaussians that are on the subject in most images that have masks.
fn subject(scene: &Scene<f32>, context: &dyn Context) -> Result<Selected> {
    let views = context.subject()?;
    let mut votes: Vec<Vec<[u32; 2]>> = scene.layers.iter().map(|l| vec![[0; 2]; l.params.len()]).collect();
    let mut seen = Evaluation::default();
    for (camera, t, mask) in &views {
        fits(mask, camera, "the capture's masks")?;
        scene.at(*t, &mut seen);
        for (votes, tape) in votes.iter_mut().zip(seen.tapes()) {
            for j in 0..tape.out().rows() {
                if let Some(white) = on(camera, mask, tape.out().read::<3>(j, 0).map(f64::from)) {
                    let vote = &mut votes[tape.rows().id(j)];
                    *vote = [vote[0] + u32::from(white), vote[1] + 1];
                }
            }
        }
    }
    let inside = |[white, all]: &[u32; 2]| *all > 0 && *white as f32 >= ON_SUBJECT * *all as f32;
    Ok(votes.iter().map(|v| v.iter().map(inside).collect()).collect())
}

/// The selected Gaussians and those that come within `distance` of one of them at some time.
fn grown(scene: &Scene<f32>, mut selected: Selected, distance: f64) -> Selected {
    let [start, end] = scene.clip;
    let moments = if end > start { NEIGHBOUR_LOOKS } else { 1 };
    let seeds = selected.clone();
    let mut seen = Evaluation::default();
    for k in 0..moments {
        scene.at(Time(start + (end - start) * k as f64 / (moments - 1).max(1) as f64), &mut seen);
        let of_tape = |(layer, tape): (usize, &crate::layers::LayerTape<f32>)| -> Vec<(usize, usize, [f64; 3])> {
            let visible = |j: &usize| tape.space() == Space::Gaussians && tape.out().get(*j, SPLAT_OPACITY) > 0.0;
            let place = |j: usize| (layer, tape.rows().id(j), tape.out().read::<3>(j, 0).map(f64::from));
            (0..tape.out().rows()).filter(visible).map(place).filter(|p| p.2.iter().all(|x| x.is_finite())).collect()
        };
        let points: Vec<(usize, usize, [f64; 3])> = seen.tapes().enumerate().flat_map(of_tape).collect();
        let cell = |x: [f64; 3]| x.map(|x| (x / distance).floor() as i64);
        let mut grid: Vec<([i64; 3], [f64; 3])> =
            points.iter().filter(|(l, row, _)| seeds[*l][*row]).map(|(_, _, x)| (cell(*x), *x)).collect();
        grid.sort_by_key(|g| g.0);
        for (layer, row, x) in points.iter().filter(|(l, row, _)| !seeds[*l][*row]) {
            let home = cell(*x);
            let near = (0..27).any(|n| {
                let there = [home[0] + n / 9 - 1, home[1] + n / 3 % 3 - 1, home[2] + n % 3 - 1];
                let first = grid.partition_point(|(c, _)| *c < there);
                grid[first..].iter().take_while(|(c, _)| *c == there).any(|(_, y)| norm(sub(*x, *y)) <= distance)
            });
            selected[*layer][*row] |= near;
        }
    }
    selected
}
