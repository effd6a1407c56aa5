//! Placement of a prim by its transforms and those of its parents.

use super::lexer::Value;
use super::stage::{Prim, Stage};
use super::unsupported;
use crate::Result;
use crate::math::se3::{mat_mul, transpose};
use crate::math::{Sim3, quat};

/// Relative difference of the scales of axes that count as one.
const UNIFORM: f64 = 1e-4;
/// Word of an order that leaves the parents out.
const RESET: &str = "!resetXformStack!";
/// Beginning of an operation that is undone: pivots.
const INVERSE: &str = "!invert!";

impl Stage {
    /// The position of a prim in the world; whether a transform has time samples, of which the first counts.
    pub(super) fn place(&self, prim: usize) -> Result<(Sim3, bool)> {
        let (mut frame, mut moves, mut at) = (Sim3::IDENTITY, false, Some(prim));
        while let Some(i) = at {
            let prim = &self.prims[i];
            let (own, reset) = local(prim, &mut moves).map_err(|e| e.at(format!("prim {}", prim.name)))?;
            frame = own.after(&frame);
            at = prim.parent.filter(|_| !reset);
        }
        if frame.is_sound() {
            Ok((frame, moves))
        } else {
            Err(unsupported("a transform is not a rotation with a scale"))
        }
    }
}

/// The transform of one prim, and whether it leaves those above out.
fn local(prim: &Prim, moves: &mut bool) -> Result<(Sim3, bool)> {
    let Some(Value::Words(order)) = prim.attributes.get("xformOpOrder").and_then(|a| a.value.as_ref()) else {
        return Ok((Sim3::IDENTITY, false));
    };
    let mut frame = Sim3::IDENTITY;
    for name in order.iter().filter(|name| *name != RESET) {
        let (name, inverse) = name.strip_prefix(INVERSE).map_or((name.as_str(), false), |name| (name, true));
        let Some(attribute) = prim.attributes.get(name) else { continue };
        *moves |= attribute.samples.len() > 1;
        let value = attribute.samples.first().map(|(_, v)| v).or(attribute.value.as_ref());
        let Some(Value::Numbers(values)) = value else { continue };
        let step = operation(name, values)?;
        let step = if inverse { step.inverse() } else { step };
        frame = frame.after(&step);
    }
    Ok((frame, order.iter().any(|name| name == RESET)))
}

/// One operation, `xformOp:KIND` or `xformOp:KIND:suffix`.
fn operation(name: &str, v: &[f64]) -> Result<Sim3> {
    let kind = name.split(':').nth(1).unwrap_or_default();
    let bad = || unsupported(format!("the transform {name} is not read"));
    let radians = |degrees: f64| degrees.to_radians();
    let turn = |axis: usize, degrees: f64| {
        let (sin, cos) = (0.5 * radians(degrees)).sin_cos();
        let mut q = [cos, 0.0, 0.0, 0.0];
        q[1 + axis] = sin;
        quat::to_rotation(q)
    };
    match (kind, v) {
        ("translate", &[x, y, z]) => Ok(Sim3 { translation: [x, y, z], ..Sim3::IDENTITY }),
        ("scale", &[x, y, z]) => {
            if [y, z].iter().any(|s| (s - x).abs() > UNIFORM * x.abs()) || x <= 0.0 {
                return Err(unsupported(format!("{name} scales axes differently, or mirrors")));
            }
            Ok(Sim3 { scale: x, ..Sim3::IDENTITY })
        }
        ("orient", &[w, x, y, z]) => Ok(Sim3::from_rotation(quat::to_rotation(quat::normalize([w, x, y, z]).0))),
        ("rotateX" | "rotateY" | "rotateZ", &[angle]) => {
            Ok(Sim3::from_rotation(turn(usize::from(kind.as_bytes()[6] - b'X'), angle)))
        }
        (_, &[_, _, _]) if kind.len() == 9 && kind.starts_with("rotate") => {
            // The first letter's axis turns first.
            let mut rotation = Sim3::IDENTITY.rotation;
            for letter in kind[6..].bytes() {
                let axis = usize::from(letter.wrapping_sub(b'X'));
                rotation = mat_mul(&turn(axis.min(2), *v.get(axis).ok_or_else(bad)?), &rotation);
            }
            Ok(Sim3::from_rotation(rotation))
        }
        ("transform", m) if m.len() == 16 => {
            // Row vectors: rows are the axes, the last one the position.
            let lengths: Vec<f64> = (0..3).map(|r| (0..3).map(|c| m[4 * r + c].powi(2)).sum::<f64>().sqrt()).collect();
            if lengths.iter().any(|l| (l - lengths[0]).abs() > UNIFORM * lengths[0]) {
                return Err(unsupported(format!("{name} scales axes differently")));
            }
            let rows = std::array::from_fn(|r| std::array::from_fn(|c| m[4 * r + c] / lengths[0]));
            Ok(Sim3 { scale: lengths[0], rotation: transpose(&rows), translation: [m[12], m[13], m[14]] })
        }
        _ => Err(bad()),
    }
}
