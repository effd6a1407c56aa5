//! Effects of the steps on a scene.

use super::clock::{retime, seen_in, window};
use super::limits::{Size, check_clip, check_room};
use super::parts::{each_part, parts, pruned, wrap};
use super::{Context, Expr, Place, PlaceKey, Selected, Step, drag, select};
use crate::layers::{ALWAYS, Layer, Scene};
use crate::math::se3::{add, norm, sub};
use crate::math::{Sim3, quat};
use crate::motion::edited::{Change, ColorMap, FadeKey, PathKey};
use crate::scene::params::OPACITY;
use crate::scene::{GEOMETRY, HeadKeys, SH, labels};
use crate::{Error, Result};

/// Weights of red, green and blue in brightness (ITU-R BT.709).
const LUMA: [f64; 3] = [0.2126, 0.7152, 0.0722];
/// Most that colours are multiplied by: 20 stops, beyond any display, and far from what f32 holds.
const BRIGHTEST: f64 = 1e6;
/// Opacities are kept this far from 0 and 1, where logits are infinite.
const MARGIN: f64 = 1e-6;

/// Runs one step; returns how many Gaussians it was about.
pub(super) fn run(step: &Step, scene: &mut Scene<f32>, context: &dyn Context) -> Result<usize> {
    let find = |text: &str, scene: &Scene<f32>| -> Result<(Selected, usize)> {
        let selected = select(&Expr::parse(text)?, scene, context)?;
        let count = selected.iter().flatten().filter(|s| **s).count();
        match count {
            0 => {
                Err(Error::input(format!("the selection `{text}` is empty")).remedy("Count its Gaussians with --count"))
            }
            _ => Ok((selected, count)),
        }
    };
    match step {
        Step::Delete { select } => {
            let (selected, count) = find(select, scene)?;
            keep(scene, &selected, false);
            Ok(count)
        }
        Step::Crop { select } => {
            let (selected, count) = find(select, scene)?;
            keep(scene, &selected, true);
            Ok(count)
        }
        Step::Hide { select, from, to } => {
            span(*from, *to)?;
            let (selected, count) = find(select, scene)?;
            let shown = |layer: &Layer<f32>| {
                let parts = [[f64::NEG_INFINITY, *from], [*to, f64::INFINITY]];
                parts.into_iter().filter_map(|part| window(layer, part)).collect()
            };
            each_part(scene, &selected, None, &shown);
            Ok(count)
        }
        Step::Recolor { select, exposure, tint, saturation, curve } => {
            let map = color_map(*exposure, *tint, *saturation, curve)?;
            scene.without_head("an edit of colours")?;
            let (selected, count) = find(select, scene)?;
            recolor(scene, &selected, &map)?;
            Ok(count)
        }
        Step::Opacity { select, factor, keys } => {
            let (selected, count) = find(select, scene)?;
            match (factor, keys.as_slice()) {
                (Some(factor), []) if (0.0..=1.0).contains(factor) => fade(scene, &selected, *factor)?,
                (None, [_, ..]) => wrap(scene, &selected, &|_| Change::Fade { keys: keys.clone() })?,
                _ => {
                    return Err(Error::input("opacity needs either a factor from 0 to 1 or keys")
                        .remedy("Write factor = 0.5, or keys = [{ t = 0.0, factor = 1.0 }, ...]"));
                }
            }
            Ok(count)
        }
        Step::Move { select, to, keys, about } => {
            scene.without_head("an edit of positions")?;
            let (selected, count) = find(select, scene)?;
            match (to, keys.as_slice()) {
                (Some(place), []) => put(scene, &selected, &similarity(place)?),
                (None, [_, ..]) => {
                    let keys = keys.iter().map(path_key).collect::<Result<Vec<_>>>()?;
                    let about = about.unwrap_or_default();
                    wrap(scene, &selected, &|_| Change::Path { about, keys: keys.clone() })?;
                }
                _ => {
                    return Err(Error::input("a move needs either `to` or keys")
                        .remedy("Write to = { shift = [0, 0, 1] }, or keys = [{ t = 0.0, shift = [0, 0, 0] }, ...]"));
                }
            }
            Ok(count)
        }
        Step::Duplicate { select, name } => {
            let (selected, count) = find(select, scene)?;
            let chosen = scene.layers.iter().zip(&selected);
            let copied = chosen.map(|(layer, s)| Size::part(layer, s.iter().filter(|s| **s).count()));
            check_room(copied.fold(Size::of_all(&scene.layers), Size::plus), context)?;
            let copies: Vec<Layer<f32>> = scene
                .layers
                .iter()
                .zip(&selected)
                .filter(|(_, s)| s.contains(&true))
                .map(|(layer, s)| Layer { name: name.clone(), ..pruned(layer, s.iter().copied()) })
                .collect();
            scene.layers.extend(copies);
            Ok(count)
        }
        Step::Split { select, name } => {
            let (selected, count) = find(select, scene)?;
            each_part(scene, &selected, Some(name), &|layer| vec![layer.clone()]);
            Ok(count)
        }
        Step::Cut { from, to } => {
            span(*from, *to)?;
            let clip = [scene.clip[0].max(*from), scene.clip[1].min(*to)];
            if clip[0] > clip[1] {
                return Err(Error::input(format!("the clip does not overlap {from} to {to} s"))
                    .remedy(format!("It goes from {} to {} s", scene.clip[0], scene.clip[1])));
            }
            let before = scene.len();
            // The clip's last time is seen, a window's end is not.
            let part = [clip[0], clip[1].next_up()];
            let open = |layer: Layer<f32>, own: [f64; 2]| Layer { span: own, ..layer };
            let cut = |layer: &Layer<f32>| window(layer, part).map(|w| open(w, layer.span));
            scene.layers = scene.layers.iter().filter_map(cut).collect();
            scene.clip = clip;
            Ok(before - scene.len())
        }
        Step::Retime { rate, from, to } => {
            let [start, end] = scene.clip;
            retime_part(scene, *rate, [from.unwrap_or(start), to.unwrap_or(end)], context)?;
            Ok(scene.len())
        }
        Step::Merge { scene: file, name, at, to } => {
            let other = context.scene(file)?;
            let count = other.len();
            check_room(Size::of_all(&scene.layers).plus(Size::of_all(&other.layers)), context)?;
            merge(scene, other, name, *at, &similarity(to)?)?;
            Ok(count)
        }
        Step::Drag { select, at, nodes, handles, pins } => {
            let (selected, count) = find(select, scene)?;
            drag::run(scene, &selected, &drag::DragRequest { at: *at, nodes: *nodes, handles, pins }, context)?;
            Ok(count)
        }
        Step::Floaters { strength } => {
            if !(0.0..=1.0).contains(strength) {
                return Err(Error::input(format!("invalid strength {strength}")).remedy("Give 0 to 1"));
            }
            let selected = context.floaters(scene, *strength)?;
            keep(scene, &selected, false);
            Ok(selected.iter().flatten().filter(|s| **s).count())
        }
    }
}

fn span(from: f64, to: f64) -> Result<()> {
    if from < to {
        return Ok(());
    }
    Err(Error::input(format!("invalid time range: start ({from} s) is not before end ({to} s)"))
        .remedy("Swap `from` and `to`, or correct them"))
}

/// Keeps the selected Gaussians, or all others.
fn keep(scene: &mut Scene<f32>, selected: &Selected, wanted: bool) {
    for (layer, selected) in scene.layers.iter_mut().zip(selected) {
        if selected.contains(&!wanted) {
            *layer = pruned(layer, selected.iter().map(|s| *s == wanted));
        }
    }
    // The layer with a head's weights is needed even when it shows nothing.
    scene.layers.retain(|l| !l.params.is_empty() || HeadKeys::of(&l.params).is_some());
}

/// Whether opacity and colour at all times equal geometry and spherical harmonics times the lifespan.
fn tables_suffice(layer: &Layer<f32>) -> bool {
    layer.motion.polynomial().is_some()
}

fn recolor(scene: &mut Scene<f32>, selected: &Selected, map: &ColorMap) -> Result<()> {
    let mut others = selected.clone();
    for (layer, selected) in scene.layers.iter_mut().zip(&mut others) {
        if !tables_suffice(layer) {
            continue;
        }
        let table = &mut layer.params[SH];
        let mut row = vec![0.0; table.width()];
        for id in (0..table.rows()).filter(|&id| selected[id]) {
            row.iter_mut().enumerate().for_each(|(k, x)| *x = table.get(id, k));
            map.harmonics(&mut row);
            row.iter().enumerate().for_each(|(k, x)| table.set(id, k, *x));
        }
        selected.fill(false);
    }
    wrap(scene, &others, &|_| Change::Color { map: map.clone() })
}

fn fade(scene: &mut Scene<f32>, selected: &Selected, factor: f64) -> Result<()> {
    let mut others = selected.clone();
    for (layer, selected) in scene.layers.iter_mut().zip(&mut others) {
        if !tables_suffice(layer) {
            continue;
        }
        let table = &mut layer.params[GEOMETRY];
        for id in (0..table.rows()).filter(|&id| selected[id]) {
            let opacity = 1.0 / (1.0 + (-f64::from(table.get(id, OPACITY))).exp());
            let faded = (opacity * factor).clamp(MARGIN, 1.0 - MARGIN);
            if factor != 1.0 {
                table.set(id, OPACITY, (faded / (1.0 - faded)).ln() as f32);
            }
        }
        selected.fill(false);
    }
    wrap(scene, &others, &|_| Change::Fade { keys: vec![FadeKey { t: 0.0, factor, ease: false }] })
}

/// Moves the selected Gaussians by a similarity of the world.
fn put(scene: &mut Scene<f32>, selected: &Selected, by: &Sim3) {
    each_part(scene, selected, None, &|layer| vec![layer.clone()]);
    for (_, index) in parts(selected) {
        let layer = &mut scene.layers[index];
        layer.frame = by.after(&layer.frame);
        layer.apply_transform();
    }
}

fn rotation(turn: Option<[f64; 4]>) -> Result<[f64; 4]> {
    let Some([x, y, z, degrees]) = turn else { return Ok([1.0, 0.0, 0.0, 0.0]) };
    let length = norm([x, y, z]);
    if !(length > 0.0 && length.is_finite() && degrees.is_finite()) {
        return Err(Error::input("a turn has no axis").remedy("Write turn = [0, 0, 1, 90]: axis, then degrees"));
    }
    let (sin, cos) = (0.5 * degrees.to_radians()).sin_cos();
    let axis = [x, y, z].map(|v| v / length * sin);
    Ok([cos, axis[0], axis[1], axis[2]])
}

fn similarity(place: &Place) -> Result<Sim3> {
    let about = place.about.unwrap_or_default();
    let rotation = quat::to_rotation(rotation(place.turn)?);
    let still = Sim3 { scale: place.scale.unwrap_or(1.0), rotation, translation: [0.0; 3] };
    let out = Sim3 { translation: sub(add(about, place.shift), still.apply(about)), ..still };
    if !out.is_sound() {
        return Err(Error::input(
            "a transform is not a similarity: its scale is not above zero, or a number is not finite",
        )
        .remedy("Write to = { shift = [0, 0, 1], turn = [0, 0, 1, 90], scale = 1.2, about = [0, 0, 0] }"));
    }
    Ok(out)
}

fn path_key(key: &PlaceKey) -> Result<PathKey> {
    let (scale, turn) = (key.scale.unwrap_or(1.0), rotation(key.turn)?);
    Ok(PathKey { t: key.t, scale, turn, shift: key.shift, ease: key.ease })
}

fn color_map(exposure: f64, tint: Option<[f64; 3]>, saturation: Option<f64>, curve: &[[f64; 2]]) -> Result<ColorMap> {
    let (gain, tint, s) = (exposure.exp2(), tint.unwrap_or([1.0; 3]), saturation.unwrap_or(1.0));
    let cell = |i: usize, j: usize| {
        let own = if i == j { s } else { 0.0 };
        (own + (1.0 - s) * LUMA[j]) * tint[j] * gain
    };
    let matrix = std::array::from_fn(|i| std::array::from_fn(|j| cell(i, j)));
    let map = ColorMap { matrix, offset: [0.0; 3], curve: curve.to_vec() };
    if map.matrix.as_flattened().iter().any(|x| x.abs() > BRIGHTEST) {
        return Err(Error::input(format!("it makes colours too large: more than {BRIGHTEST:.0e} times as bright"))
            .remedy("Give a smaller exposure, tint or saturation"));
    }
    if !map.is_sound() || curve.len() == 1 {
        return Err(Error::input(
            "the colour map has numbers that are not finite, or a curve whose points are not in ascending order",
        )
        .remedy("Write curve = [[0, 0], [0.5, 0.6], [1, 1]]"));
    }
    Ok(map)
}

fn retime_part(scene: &mut Scene<f32>, rate: f64, [from, to]: [f64; 2], context: &dyn Context) -> Result<()> {
    span(from, to)?;
    if !(rate != 0.0 && rate.is_finite()) {
        return Err(
            Error::input(format!("a rate of {rate}")).remedy("1 keeps the speed, 0.5 halves it, -1 plays backwards")
        );
    }
    let [start, end] = scene.clip;
    let longer = (to - from) / rate.abs() - (to - from);
    check_clip([start, end + longer], scene.fps)?;
    // Inside it is s = rate·t + offset.
    let offset = if rate > 0.0 { from - rate * from } else { to - rate * from };
    if from <= start && to >= end {
        for layer in &mut scene.layers {
            retime(layer, rate, offset)?;
        }
    } else {
        let parts = [[f64::NEG_INFINITY, from], [from, to], [to, f64::INFINITY]];
        let of = |layer: &Layer<f32>| parts.map(|part| Size::part(layer, seen_in(layer, part)));
        let sizes = scene.layers.iter().flat_map(of);
        check_room(sizes.fold(Size::default(), Size::plus), context)?;
        let mut layers = Vec::new();
        for layer in &scene.layers {
            if layer.span == ALWAYS
                && !layer.motion.capabilities().moves
                && layer.life == crate::scene::LifeKind::Infinite
            {
                layers.push(layer.clone());
                continue;
            }
            layers.extend(window(layer, [f64::NEG_INFINITY, from]));
            if let Some(mut middle) = window(layer, [from, to]) {
                retime(&mut middle, rate, offset)?;
                layers.push(middle);
            }
            if let Some(mut after) = window(layer, [to, f64::INFINITY]) {
                retime(&mut after, 1.0, -longer)?;
                layers.push(after);
            }
        }
        scene.layers = layers;
    }
    scene.clip = [start, end + longer];
    Ok(())
}

fn merge(scene: &mut Scene<f32>, mut other: Scene<f32>, name: &str, at: Option<f64>, to: &Sim3) -> Result<()> {
    scene.without_head("a merged scene")?;
    other.without_head("a merged scene")?;
    let later = at.map_or(0.0, |at| at - other.clip[0]);
    if !later.is_finite() {
        return Err(Error::input("`at` is not a time").remedy("Give seconds"));
    }
    let frame = |s: &Scene<f32>| if s.fps > 0.0 && s.fps.is_finite() { 1.0 / s.fps } else { 0.0 };
    let clip = [scene.clip[0].min(other.clip[0] + later), scene.clip[1].max(other.clip[1] + later)];
    check_clip(clip, scene.fps)?;
    if later != 0.0 {
        for layer in &mut other.layers {
            retime(layer, 1.0, -later)?;
        }
        other.clip = other.clip.map(|t| t + later);
    }
    // Both state their world coordinates, and the worlds are taken as one.
    let mut to = *to;
    if scene.offset != [0.0; 3] && other.offset != [0.0; 3] {
        to.translation = std::array::from_fn(|k| to.translation[k] + other.offset[k] - scene.offset[k]);
    }
    for layer in &mut other.layers {
        layer.name = format!("{name}/{}", layer.name);
        layer.frame = to.after(&layer.frame);
        layer.apply_transform();
    }
    // Beyond its own clip nothing that moves is known.
    for own in [&mut *scene, &mut other] {
        let [from, to] = own.clip;
        if own.is_moving() && (from > clip[0] || to < clip[1]) {
            let from = if from > clip[0] { from } else { f64::NEG_INFINITY };
            let to = if to < clip[1] { to + frame(own) } else { f64::INFINITY };
            own.layers = own.layers.iter().filter_map(|l| window(l, [from, to])).collect();
        }
    }
    let mut names = scene.labels.clone();
    names.extend(other.labels.iter().filter(|n| !scene.labels.contains(n)).cloned());
    if !names.is_empty() {
        labels::check(&names)?;
    }
    for own in [&mut *scene, &mut other] {
        let from: Vec<Option<usize>> = names.iter().map(|n| own.labels.iter().position(|o| o == n)).collect();
        own.layers.iter_mut().for_each(|l| labels::renumber(&mut l.params, &from));
    }
    scene.labels = names;
    scene.layers.append(&mut other.layers);
    scene.clip = clip;
    Ok(())
}
