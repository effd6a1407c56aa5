//! The axes of a file: an extension names them, and without it those of .ply are assumed.
//!
//! The SPZ library states "right, up, back" where no extension states otherwise, but five other converters
//! (splat-transform 3.7, gaussforge 0.6, gsply 0.4, NVIDIA's usd-convert-gsplat 0.1, GaussianSplats3D 0.4) copy the
//! axes of the .ply, so that most files that people exchange have these. Source of the extension:
//! github.com/nianticlabs/spz (MIT), extensions/README.

use crate::format::bytes::Cursor;
use crate::format::dialect::Y_DOWN;
use crate::format::warnings::Warnings;
use crate::layers::mirror;
use crate::scene::Params;

/// Extension that names the axes of the numbers (Adobe): one u32, the number of a coordinate system.
const EXTENSION: u32 = 0xADBE_0003;
/// The coordinate systems by number: where x, y and z point (Left, Right, Up, Down, Front, Back).
const SYSTEMS: [&str; 17] = [
    "", "LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF", "LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU",
];
/// Cosine from which a direction counts as an axis.
const ALONG: f64 = 1.0 - 1e-6;

/// Beginning of the remark that a file does not name its axes.
pub(crate) const ASSUMED: &str = "the file does not name its axes";

/// A coordinate system, by its number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Axes(usize);

impl Axes {
    fn of_number(number: u32) -> Option<Self> {
        let number = usize::try_from(number).ok()?;
        (1..SYSTEMS.len()).contains(&number).then_some(Self(number))
    }

    /// The right-handed system of a world with this direction up whose x points right. `None`: no such system.
    pub(super) fn of_up(up: [f64; 3]) -> Option<Self> {
        (1..SYSTEMS.len()).map(Self).find(|a| {
            let cosine: f64 = a.up().iter().zip(up).map(|(a, b)| a * b).sum();
            a.name().starts_with('R') && !a.is_mirrored() && cosine >= ALONG
        })
    }

    /// Its three letters.
    pub(super) fn name(self) -> &'static str {
        SYSTEMS[self.0]
    }

    /// The direction of each axis as (right, up, back).
    fn directions(self) -> [[f64; 3]; 3] {
        let mut directions = self.name().chars().map(|c| match c {
            'L' => [-1.0, 0.0, 0.0],
            'R' => [1.0, 0.0, 0.0],
            'D' => [0.0, -1.0, 0.0],
            'U' => [0.0, 1.0, 0.0],
            'F' => [0.0, 0.0, -1.0],
            _ => [0.0, 0.0, 1.0],
        });
        std::array::from_fn(|_| directions.next().expect("names have three letters"))
    }

    /// The direction of up in the file's numbers.
    pub(super) fn up(self) -> [f64; 3] {
        self.directions().map(|axis| axis[1])
    }

    /// Whether the system is left-handed.
    fn is_mirrored(self) -> bool {
        let [a, b, c] = self.directions();
        let cross = crate::math::se3::cross(a, b);
        cross.iter().zip(c).map(|(x, y)| x * y).sum::<f64>() < 0.0
    }

    /// The extension's record.
    pub(super) fn record(self) -> Vec<u8> {
        [EXTENSION, 4, self.0 as u32].iter().flat_map(|x| x.to_le_bytes()).collect()
    }
}

/// Reads the extensions' records, u32 type, u32 length and that many bytes: the axes. Reports what is not read.
pub(super) fn read(bytes: &[u8], warnings: &mut Warnings) -> Option<Axes> {
    let (mut c, mut axes) = (Cursor::new(bytes, "extensions"), None);
    while let (Ok(kind), Ok(length)) = (c.u32(), c.u32()) {
        let Ok(payload) = c.take(length as usize) else {
            warnings.add("the file's extensions are cut short");
            break;
        };
        if kind != EXTENSION {
            warnings.add(format!("extension {kind:#010X} is not read"));
            continue;
        }
        let number = payload.first_chunk().map(|b| u32::from_le_bytes(*b));
        axes = number.and_then(Axes::of_number);
        if axes.is_none() {
            warnings.add("the file's extension for axes (0xADBE0003) names none of the 16 coordinate systems");
        }
    }
    axes
}

/// Reports what is assumed, makes a left-handed world right-handed, and returns which way is up.
pub(super) fn settle(axes: Option<Axes>, params: &mut Params, warnings: &mut Warnings) -> [f64; 3] {
    let Some(axes) = axes else {
        warnings.add(format!("{ASSUMED}: those of .ply are assumed (y down); --up y or z corrects that"));
        return Y_DOWN;
    };
    if axes.is_mirrored() {
        warnings.add(format!("the file's axes are left-handed ({}): x is mirrored", axes.name()));
        mirror(params, 0);
    }
    axes.up()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::format::samples::gaussians;
    use crate::math::{quat, sh};
    use crate::scene::params::QUAT;
    use crate::scene::{GEOMETRY, SH};

    #[test]
    fn every_up_along_an_axis_has_a_right_handed_system() {
        for (up, name) in
            [([0.0, -1.0, 0.0], "RDF"), ([0.0, 1.0, 0.0], "RUB"), ([0.0, 0.0, 1.0], "RFU"), ([0.0, 0.0, -1.0], "RBD")]
        {
            let axes = Axes::of_up(up).unwrap();
            assert_eq!((axes.name(), axes.up()), (name, up));
            let mut warnings = Warnings::default();
            assert_eq!(read(&axes.record(), &mut warnings), Some(axes));
            assert!(warnings.lines().is_empty());
        }
        assert_eq!((Axes::of_up([1.0, 0.0, 0.0]), Axes::of_up([0.0; 3])), (None, None));
        assert_eq!((1..17).filter(|&n| Axes(n).is_mirrored()).count(), 8);
    }

    #[test]
    fn a_left_handed_world_is_mirrored_whole() {
        let before = gaussians(40, 16);
        let (mut after, mut warnings) = (before.clone(), Warnings::default());
        let axes = Axes::of_number(8);
        assert_eq!(settle(axes, &mut after, &mut warnings), [0.0, 1.0, 0.0]);
        assert!(warnings.lines()[0].contains("RUF"));
        let direction = [0.48, -0.6, 0.64];
        let mirrored = [-direction[0], direction[1], direction[2]];
        for row in 0..40 {
            let [a, b] = [&before, &after].map(|p| p[GEOMETRY].read::<3>(row, 0));
            assert_eq!([-a[0], a[1], a[2]], b);
            let rotation = |q: [f64; 4]| quat::to_rotation(quat::normalize(q).0);
            // The axes of both shapes are mirror images.
            let [r, s] = [&before, &after].map(|p| rotation(p[GEOMETRY].read::<4>(row, QUAT).map(f64::from)));
            for k in 0..3 {
                let [a, b] = [r, s].map(|m| [m[0][k], m[1][k], m[2][k]]);
                let dot = -a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
                assert!((dot.abs() - 1.0).abs() < 1e-5, "{a:?} {b:?}");
            }
            let seen = |p: &Params, d: [f64; 3]| {
                let basis = sh::basis(d);
                let f: [f32; 48] = p[SH].read(row, 0);
                (0..16).map(|k| basis[k] * f64::from(f[3 * k])).sum::<f64>()
            };
            assert!((seen(&before, direction) - seen(&after, mirrored)).abs() < 1e-5);
        }
    }

    #[test]
    fn damaged_extensions_are_reported() {
        let say = |bytes: &[u8]| {
            let mut warnings = Warnings::default();
            assert_eq!(read(bytes, &mut warnings), None);
            warnings.lines().join("\n")
        };
        let record = Axes(6).record();
        assert!(say(&record[..10]).contains("cut short"));
        let none = [&record[..8], &[99, 0, 0, 0]].concat();
        assert!(say(&none).contains("16 coordinate systems"));
    }
}
