//! The transfer function of sRGB: between values as files and displays have them and linear light.
//!
//! Source: IEC 61966-2-1. Above 1 the formula is continued, and below 0 it is mirrored.

use rayon::prelude::*;
use splat4d::scene::Planes;
use std::sync::LazyLock;

/// Pixels of a task.
const CHUNK: usize = 1 << 14;
/// Steps of the table of [`linear`]: its lines are off by less than 10⁻⁷.
const STEPS: usize = 4096;

/// Linear light of 0 to 1 in steps, and one more for lines that begin at 1.
static TABLE: LazyLock<Vec<f32>> =
    LazyLock::new(|| (0..STEPS + 2).map(|i| exact_linear(i as f64 / STEPS as f64) as f32).collect());

/// Values of an image in a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Transfer {
    /// Linear light
    Linear,
    /// sRGB values, as scenes have them
    Srgb,
}

impl Transfer {
    /// All of them.
    pub const ALL: [Self; 2] = [Self::Linear, Self::Srgb];

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Linear => "linear",
            Self::Srgb => "srgb",
        }
    }

    /// Its meaning.
    pub fn about(self) -> &'static str {
        match self {
            Self::Linear => "Linear light, by the sRGB curve (IEC 61966-2-1) with Rec. 709 primaries",
            Self::Srgb => "sRGB values as the scene has them",
        }
    }
}

/// Linear light of an sRGB value.
fn exact_linear(v: f64) -> f64 {
    let x = v.abs();
    let light = if x <= 0.040_45 { x / 12.92 } else { ((x + 0.055) / 1.055).powf(2.4) };
    light.copysign(v)
}

/// Linear light of an sRGB value, by a table where it is usual.
fn linear(v: f32) -> f32 {
    if (0.0..=1.0).contains(&v) {
        let place = v * STEPS as f32;
        let i = place as usize;
        let (a, b) = (TABLE[i], TABLE[i + 1]);
        return a + (b - a) * (place - i as f32);
    }
    exact_linear(f64::from(v)) as f32
}

/// sRGB value of linear light.
fn srgb(light: f32) -> f32 {
    let x = light.abs();
    let v = if x <= 0.003_130_8 { 12.92 * x } else { 1.055 * x.powf(1.0 / 2.4) - 0.055 };
    v.copysign(light)
}

/// Adds `share` of a plane of sRGB values to linear light. `alpha`: the values are those of a surface times it, and so is
/// the light.
pub(super) fn add_light(sum: &mut [f32], values: &[f32], alpha: Option<&[f32]>, share: f32) {
    sum.par_chunks_mut(CHUNK).zip(values.par_chunks(CHUNK)).enumerate().for_each(
        |(chunk, (sum, values))| match alpha {
            None => sum.iter_mut().zip(values).for_each(|(sum, v)| *sum += share * linear(*v)),
            Some(alpha) => {
                let alpha = &alpha[chunk * CHUNK..];
                for ((sum, v), a) in sum.iter_mut().zip(values).zip(alpha).filter(|(_, a)| **a > 0.0) {
                    *sum += share * a * linear(v / a);
                }
            }
        },
    );
}

/// sRGB values of linear light: of the surface alone (not times alpha) where `alpha` is given.
pub(super) fn display(light: &Planes<f32>, alpha: Option<&Planes<f32>>) -> Planes<f32> {
    let mut out = light.clone();
    for c in 0..out.channels {
        let alpha = alpha.map(|a| a.plane(0));
        out.plane_mut(c).par_chunks_mut(CHUNK).enumerate().for_each(|(chunk, values)| match alpha {
            None => values.iter_mut().for_each(|v| *v = srgb(*v)),
            Some(alpha) => {
                let own = values.iter_mut().zip(&alpha[chunk * CHUNK..]);
                own.for_each(|(v, a)| *v = if *a > 0.0 { srgb(*v / a) } else { 0.0 });
            }
        });
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn light_and_values_are_inverse() {
        for i in -50..=150 {
            let v = i as f32 / 100.0;
            assert!((srgb(linear(v)) - v).abs() < 2e-6, "{v}");
            assert!((f64::from(linear(v)) - exact_linear(f64::from(v))).abs() < 2e-7, "{v}");
        }
        assert!((linear(0.5) - 0.214_041).abs() < 1e-6 && linear(1.0) == 1.0 && linear(0.0) == 0.0);
    }

    #[test]
    fn surfaces_keep_their_colour_at_any_opacity() {
        let (values, alpha) = ([0.2, 0.25, 0.0], [0.4, 0.5, 0.0]);
        let mut sum = [0.0; 3];
        add_light(&mut sum, &values, Some(&alpha), 1.0);
        let light = Planes { channels: 1, height: 1, width: 3, data: sum.to_vec() };
        let alpha = Planes { channels: 1, height: 1, width: 3, data: alpha.to_vec() };
        let shown = display(&light, Some(&alpha)).data;
        assert!((shown[0] - 0.5).abs() < 1e-6 && (shown[1] - 0.5).abs() < 1e-6 && shown[2] == 0.0, "{shown:?}");
    }
}
