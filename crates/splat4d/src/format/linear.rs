//! Numbers that a program stored unconverted, where the format has logarithms, logits and coefficients.

use super::bytes::SH_C0;
use super::mend::{FLAT, OPAQUE};
use super::warnings::Warnings;
use crate::layers::Layer;
use crate::math::se3::{norm, sub};
use crate::math::{median, median_by};
use crate::scene::params::{LOG_SCALE, OPACITY};
use crate::scene::{GEOMETRY, Params, SH};

/// Values that a program stored unconverted, where the format has logarithms, logits and coefficients.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Linear {
    /// Scales are lengths.
    Scales,
    /// Opacities are alphas from 0 to 1, 100 or 255.
    Opacities,
    /// Base colours are RGB from 0 to 1 or 255.
    Colours,
}

impl Linear {
    /// Its name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Linear::Scales => "scales",
            Linear::Opacities => "opacities",
            Linear::Colours => "colours",
        }
    }
}

/// Fewer Gaussians are no evidence.
const FEW: usize = 20;
/// Share of the Gaussians that is most of them.
const MOST: f64 = 0.5;
/// Of scenes of logarithms, hardly a Gaussian is as large as a quarter of the inner half of the scene; of lengths read
/// as logarithms, e^s ≥ 1, most are wherever the scene is not far larger than a unit.
const LARGE: f64 = 0.25;
/// In larger scenes: lengths below a unit, read as logarithms, would all be between 1 and e units in every direction.
/// No trained scene has such sizes.
const UNIT: f32 = 1.0;
/// White in opacities and colours that are bytes, and in opacities that are percent.
const BYTE: f32 = 255.0;
const PERCENT: f32 = 100.0;
/// Base colours of trained scenes seldom exceed this coefficient, which is more than twice as bright as white.
const BRIGHTEST: f32 = 6.0;

/// Which values of a layer appear to be stored unconverted. Evidence, not proof: nothing is converted.
pub(super) fn doubts(params: &Params) -> Vec<(Linear, String)> {
    let (geometry, sh) = (&params[GEOMETRY], &params[SH]);
    let finite = |&r: &usize| {
        geometry.read::<11>(r, 0).iter().all(|x| x.is_finite()) && sh.read::<3>(r, 0).iter().all(|x| x.is_finite())
    };
    let rows: Vec<usize> = (0..params.len()).filter(finite).collect();
    if rows.len() < FEW {
        return Vec::new();
    }
    let opacities = Spread::of(rows.iter().map(|&r| geometry.get(r, OPACITY)));
    let colours = Spread::of(rows.iter().flat_map(|&r| sh.read::<3>(r, 0)));
    let found = [
        lengths(params, &rows).map(|what| (Linear::Scales, what)),
        alphas(&opacities).map(|what| (Linear::Opacities, what)),
        rgb(&colours).map(|what| (Linear::Colours, what)),
    ];
    found.into_iter().flatten().collect()
}

/// Smallest, middle and largest of some numbers.
struct Spread {
    low: f32,
    middle: f32,
    high: f32,
}

impl Spread {
    fn of(values: impl Iterator<Item = f32>) -> Self {
        let mut values: Vec<f32> = values.collect();
        let middle = median_by(&mut values, f32::total_cmp).unwrap_or(0.0);
        let (low, high) = values.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(l, h), v| (l.min(*v), h.max(*v)));
        Self { low, middle, high }
    }
}

/// Evidence that scales are lengths.
fn lengths(params: &Params, rows: &[usize]) -> Option<String> {
    let table = &params[GEOMETRY];
    let scales = Spread::of(rows.iter().flat_map(|&r| table.read::<3>(r, LOG_SCALE)));
    // Where most are 0, they are logarithms of one unit: lengths of 0 are nothing.
    if scales.low < 0.0 || scales.middle == 0.0 {
        return None;
    }
    let radius = radius(params, rows);
    let largest = |r: usize| f64::from(table.read::<3>(r, LOG_SCALE).into_iter().fold(f32::NEG_INFINITY, f32::max));
    let count = |is: &dyn Fn(f64) -> bool| rows.iter().filter(|&&r| is(largest(r))).count();
    let (huge, fitting) = (count(&|s| s.exp() > LARGE * radius), count(&|s| s < radius));
    let most = |count: usize| count as f64 > MOST * rows.len() as f64;
    let around_a_unit = scales.high < UNIT;
    if !most(fitting) || !most(huge) && !around_a_unit {
        return None;
    }
    Some(format!(
        "scales are all above zero: as logarithms, {huge} of {} Gaussians would be larger than a quarter of the scene and none \
         smaller than a unit. They look like lengths",
        rows.len()
    ))
}

/// Evidence that opacities are alphas. Logits of trained scenes spread far to both sides of zero, and seldom beyond
/// those of opaque Gaussians; a single value may be anything, but for 1, which scripts write for opaque.
fn alphas(of: &Spread) -> Option<String> {
    let opaque = of.low == 1.0 && of.high == 1.0;
    let parts = of.high <= 1.0 && of.low < of.high || opaque;
    let bytes = of.middle > OPAQUE && of.high <= BYTE;
    (of.low >= 0.0 && (parts || bytes)).then(|| {
        let up_to = if bytes { format!(" from 0 to {}", white_of_alphas(of)) } else { String::new() };
        format!("opacities lie between {:.3} and {:.3}: they look like alphas{up_to}, not logits", of.low, of.high)
    })
}

/// Evidence that base colours are RGB. Coefficients of trained scenes are on both sides of zero, which is grey.
fn rgb(of: &Spread) -> Option<String> {
    let parts = of.high <= 1.0 && of.low < of.high;
    let bytes = of.high > BRIGHTEST && of.high <= BYTE && of.middle > 1.0;
    (of.low >= 0.0 && (parts || bytes)).then(|| {
        let white = white_of_colours(of);
        format!(
            "base colours (f_dc) lie between {:.3} and {:.3}, and none is darker than grey: they look like RGB from 0 to \
             {white}, not coefficients",
            of.low, of.high
        )
    })
}

/// The number that represents an alpha of 1.
fn white_of_alphas(of: &Spread) -> f32 {
    match () {
        () if of.middle <= 1.0 => 1.0,
        () if of.high <= PERCENT => PERCENT,
        () => BYTE,
    }
}

/// The number that represents full colour.
fn white_of_colours(of: &Spread) -> f32 {
    if of.middle <= 1.0 { 1.0 } else { BYTE }
}

/// The median distance of the means from their median.
fn radius(params: &Params, rows: &[usize]) -> f64 {
    let table = &params[GEOMETRY];
    let means: Vec<[f64; 3]> = rows.iter().map(|&r| table.read::<3>(r, 0).map(f64::from)).collect();
    let of = |mut values: Vec<f64>| median(&mut values).expect("there are rows");
    let middle = std::array::from_fn(|k| of(means.iter().map(|m| m[k]).collect()));
    of(means.iter().map(|m| norm(sub(*m, middle))).collect())
}

/// Reads values that are stored unconverted: lengths become logarithms, alphas logits, RGB coefficients. Returns what
/// was out of range.
pub fn from_linear(layer: &mut Layer<f32>, what: Linear) -> Warnings {
    let [geometry, sh] = layer.params.get_mut([GEOMETRY, SH]);
    let (mut outside, rows) = (0, geometry.rows());
    let white = match what {
        Linear::Scales => 1.0,
        Linear::Opacities => white_of_alphas(&Spread::of((0..rows).map(|r| geometry.get(r, OPACITY)))),
        Linear::Colours => white_of_colours(&Spread::of((0..rows).flat_map(|r| sh.read::<3>(r, 0)))),
    };
    for row in 0..rows {
        match what {
            Linear::Scales => {
                let lengths = geometry.read::<3>(row, LOG_SCALE);
                outside += usize::from(lengths.iter().any(|s| *s < 0.0));
                geometry.write(row, LOG_SCALE, lengths.map(|s| s.max(0.0).ln().max(FLAT)));
            }
            Linear::Opacities => {
                let alpha = geometry.get(row, OPACITY) / white;
                outside += usize::from(!(0.0..=1.0).contains(&alpha));
                let alpha = alpha.clamp(0.0, 1.0);
                geometry.set(row, OPACITY, (alpha / (1.0 - alpha)).ln().clamp(-OPAQUE, OPAQUE));
            }
            Linear::Colours => {
                let rgb = sh.read::<3>(row, 0).map(|c| c / white);
                outside += usize::from(rgb.iter().any(|c| !(0.0..=1.0).contains(c)));
                sh.write(row, 0, rgb.map(|c| (c - 0.5) / SH_C0));
            }
        }
    }
    let range = match what {
        Linear::Scales => "have a scale below 0, which is read as 0".to_owned(),
        Linear::Opacities => format!("have an opacity outside 0 to {white}, which is clamped"),
        Linear::Colours => format!("have a colour outside 0 to {white}"),
    };
    let mut warnings = Warnings::default();
    if white != 1.0 {
        warnings.add(format!("{} are read from 0 to {white}", what.name()));
    }
    warnings.counted(outside, rows, &range);
    warnings
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::format::dialect::still;
    use crate::format::samples::gaussians;

    /// Every value of trained Gaussians unconverted: opacities up to `alpha`, colours up to `white`.
    fn stored(logs: &Params, alpha: f32, white: f32) -> Params {
        let mut linear = logs.clone();
        for row in 0..logs.len() {
            let scale = logs[GEOMETRY].read::<3>(row, LOG_SCALE).map(f32::exp);
            linear[GEOMETRY].write(row, LOG_SCALE, scale);
            linear[GEOMETRY].set(row, OPACITY, alpha / (1.0 + (-logs[GEOMETRY].get(row, OPACITY)).exp()));
            linear[SH].write(row, 0, logs[SH].read::<3>(row, 0).map(|c| white * (0.5 + SH_C0 * c)));
        }
        linear
    }

    #[test]
    fn linear_values_are_warned_of_and_read_on_request() {
        let mut logs = gaussians(200, 4);
        let within = |c: f32| c.clamp(-1.7, 1.7);
        (0..200).for_each(|row| {
            let inside = logs[SH].read::<3>(row, 0).map(within);
            logs[SH].write(row, 0, inside);
        });
        assert!(doubts(&logs).is_empty(), "{:?}", doubts(&logs));
        for (alpha, white) in [(1.0, 1.0), (255.0, 255.0), (100.0, 255.0)] {
            let linear = stored(&logs, alpha, white);
            let found: Vec<Linear> = doubts(&linear).into_iter().map(|d| d.0).collect();
            assert_eq!(found, [Linear::Scales, Linear::Opacities, Linear::Colours], "{alpha} {white}");
            let mut layer = still(linear).layers.remove(0);
            for what in found {
                let said = from_linear(&mut layer, what);
                let whites = [("opacities", alpha), ("colours", white)];
                let white = whites.iter().find(|(name, white)| *name == what.name() && *white > 1.0);
                let expected = white.map(|(name, white)| format!("{name} are read from 0 to {white}"));
                assert_eq!(said.lines(), expected.as_slice());
            }
            for row in 0..200 {
                let (a, b) = (logs[GEOMETRY].read::<11>(row, 0), layer.params[GEOMETRY].read::<11>(row, 0));
                assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 2e-3 * (1.0 + a.abs())), "{a:?} {b:?}");
                let (a, b) = (logs[SH].read::<3>(row, 0), layer.params[SH].read::<3>(row, 0));
                assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-3), "{a:?} {b:?}");
            }
            assert!(doubts(&layer.params).is_empty());
            layer.params[GEOMETRY].set(0, OPACITY, 1.5);
            assert!(from_linear(&mut layer, Linear::Opacities).lines()[0].contains("outside 0 to 1"));
        }
    }

    #[test]
    fn opacities_that_are_all_one_are_warned_of() {
        let mut p = gaussians(60, 1);
        let mut found = |opacity: f32| {
            (0..60).for_each(|row| p[GEOMETRY].set(row, OPACITY, opacity));
            doubts(&p).into_iter().map(|d| d.0).collect::<Vec<_>>()
        };
        assert_eq!([found(1.0), found(0.9), found(-1.0)], [vec![Linear::Opacities], vec![], vec![]]);
    }

    #[test]
    fn uniform_lengths_are_warned_of_at_any_scale() {
        // The radius of these Gaussians is about 3 units.
        for (stretch, length) in [(1.0, 0.01), (1.0, 0.3), (1.0, 1.0), (20.0, 0.05), (20.0, 0.9), (20.0, 4.0)] {
            let mut p = gaussians(60, 1);
            for row in 0..60 {
                let mean = p[GEOMETRY].read::<3>(row, 0).map(|x| stretch * x);
                p[GEOMETRY].write(row, 0, mean);
                p[GEOMETRY].write(row, LOG_SCALE, [length; 3]);
            }
            let found: Vec<Linear> = doubts(&p).into_iter().map(|d| d.0).collect();
            assert_eq!(found, [Linear::Scales], "{stretch} {length}");
            (0..60).for_each(|row| p[GEOMETRY].write(row, LOG_SCALE, [length.ln(); 3]));
            assert!(length > 1.0 || doubts(&p).is_empty(), "{stretch} {length}: {:?}", doubts(&p));
        }
        // A scene in millimetres, whose Gaussians are all larger than a unit.
        let mut p = gaussians(60, 1);
        for row in 0..60 {
            let mean = p[GEOMETRY].read::<3>(row, 0).map(|x| 1000.0 * x);
            p[GEOMETRY].write(row, 0, mean);
            p[GEOMETRY].write(row, LOG_SCALE, [2.0 + (row % 7) as f32 * 0.3, 1.5, 0.5]);
        }
        assert!(doubts(&p).is_empty(), "{:?}", doubts(&p));
    }
}
