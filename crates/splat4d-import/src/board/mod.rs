//! Square tags in images: AprilTag 36h11 and the markers of ArUco and ChArUco boards.
//!
//! A tag is a dark square with bits inside on a bright background. Dark regions whose outline has four corners are
//! found (`quads.rs`), their edges are fitted, and their bits are looked up in the family. (Olson 2011, "AprilTag: a
//! robust and flexible visual fiducial system"; Garrido-Jurado et al. 2014, "Automatic generation and detection of
//! highly reliable fiducial markers under occlusion".)

mod quads;
#[cfg(test)]
pub(crate) mod tests;

use crate::{Error, Result};
use splat4d::scene::Planes;
use splat4d_train::vision::raster::sample;
use std::str::FromStr;

/// A kind of tags: how many bits they have, and which patterns are among them. Dictionaries of fewer tags are
/// beginnings of these.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Family {
    /// Its name.
    pub name: &'static str,
    /// Bits along a side, without the dark border, which is one bit wide.
    side: usize,
    /// Bits that may be wrong: fewer than half of the least distance of two patterns, and so few that noise makes none.
    wrong: u32,
    /// Patterns row by row, white 1, the first bit highest, as OpenCV renders them; hexadecimal.
    codes: &'static str,
}

/// Supported families. Least distances of two patterns, turned or not: 11, 3, 6, 11 bits.
const FAMILIES: [Family; 4] = [
    Family { name: "36h11", side: 6, wrong: 2, codes: include_str!("36h11.txt") },
    Family { name: "4x4", side: 4, wrong: 0, codes: include_str!("4x4.txt") },
    Family { name: "5x5", side: 5, wrong: 1, codes: include_str!("5x5.txt") },
    Family { name: "6x6", side: 6, wrong: 2, codes: include_str!("6x6.txt") },
];

/// How the board was put up.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Lies {
    /// Flat on the floor, face up.
    Floor,
    /// Upright against a wall or on a stand, one edge level.
    Wall,
}

/// Tags of one size, of which every one counts for itself: where they are on the board does not matter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Board {
    /// Their family.
    pub family: Family,
    /// Metres along a tag's dark square.
    pub side: f64,
    /// Defines what is up.
    pub lies: Option<Lies>,
}

impl FromStr for Board {
    type Err = Error;

    /// `36h11:0.16`, `4x4:0.03:floor`.
    fn from_str(text: &str) -> Result<Self> {
        let wrong = |what: String| {
            Err(Error::input(format!("the board \"{text:.80}\" {what}")).remedy(format!(
                "Write FAMILY:METRES, the length of a tag's dark square, and :floor or :wall if it is flat or upright: \
                 36h11:0.16:floor. Families are {}.",
                FAMILIES.map(|f| f.name).join(", ")
            )))
        };
        let parts: Vec<&str> = text.split(':').map(str::trim).collect();
        let (Some(name), Some(side)) = (parts.first(), parts.get(1)) else { return wrong("has no length".into()) };
        let Some(family) = FAMILIES.into_iter().find(|f| f.name.eq_ignore_ascii_case(name)) else {
            return wrong(format!("is of no family that is known (\"{name:.40}\")"));
        };
        let Some(side) = side.parse::<f64>().ok().filter(|s| s.is_finite() && *s > 0.0) else {
            return wrong(format!("has a side of \"{side:.40}\" metres"));
        };
        let lies = match parts.get(2).map(|l| l.to_ascii_lowercase()).as_deref() {
            None => None,
            Some("floor") => Some(Lies::Floor),
            Some("wall") => Some(Lies::Wall),
            Some(other) => return wrong(format!("has an unknown orientation, \"{other:.40}\"")),
        };
        if parts.len() > 3 {
            return wrong("has too many parts".into());
        }
        Ok(Self { family, side, lies })
    }
}

/// A tag in an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Tag {
    /// Its number in its family.
    pub id: usize,
    /// Pixels of the dark square's corners: from the first bit's on, clockwise when the tag is examined.
    pub corners: [[f64; 2]; 4],
}

/// The tags of a family in a grey image, by number; duplicates are left out.
pub(crate) fn tags(picture: &Planes<f32>, family: &Family) -> Vec<Tag> {
    let codes = family.codes();
    let mut found: Vec<Tag> =
        quads::quads(picture).iter().filter_map(|corners| family.read(picture, corners, &codes)).collect();
    found.sort_by(|a, b| a.id.cmp(&b.id).then(a.corners[0][0].total_cmp(&b.corners[0][0])));
    let twice = |tag: &Tag| found.iter().filter(|o| o.id == tag.id).count() > 1;
    found.iter().filter(|t| !twice(t)).copied().collect()
}

impl Family {
    fn codes(&self) -> Vec<u64> {
        let code = |word: &str| u64::from_str_radix(word, 16).expect("codes are hexadecimal");
        self.codes.split_whitespace().map(code).collect()
    }

    /// The tag whose dark square has these corners, if its bits are one of the family's.
    fn read(&self, picture: &Planes<f32>, corners: &[[f64; 2]; 4], codes: &[u64]) -> Option<Tag> {
        /// Of the difference of bright and dark in [0, 1], the least that is one.
        const CONTRAST: f64 = 0.08;
        /// Bits of the border that may be bright, of the border's: glare and dirt.
        const BORDER_WRONG: f64 = 0.1;
        let square = Square::new(corners)?;
        let (n, all) = (self.side, self.side + 2);
        // A bit: the mean of its middle.
        let bit = |row: f64, column: f64| {
            let mut sum = 0.0;
            for dy in [-0.2, 0.0, 0.2] {
                for dx in [-0.2, 0.0, 0.2] {
                    let [u, v] = square.at([(column + 0.5 + dx) / all as f64, (row + 0.5 + dy) / all as f64]);
                    sum += f64::from(sample(picture, u as f32, v as f32));
                }
            }
            sum / 9.0
        };
        // The bright rim outside and the dark border, all round.
        let ring = |at: f64, to: usize, from: f64| -> Vec<f64> {
            let end = to as f64 - 1.0 + from;
            (0..to)
                .flat_map(|k| {
                    [
                        bit(at, k as f64 + from),
                        bit(end, k as f64 + from),
                        bit(k as f64 + from, at),
                        bit(k as f64 + from, end),
                    ]
                })
                .collect()
        };
        let middle = |mut v: Vec<f64>| {
            let half = v.len() / 2;
            *v.select_nth_unstable_by(half, f64::total_cmp).1
        };
        let border = ring(0.0, all, 0.0);
        let (dark, bright) = (middle(border.clone()), middle(ring(-1.0, all + 2, -1.0)));
        let half = 0.5 * (dark + bright);
        let spoilt = border.iter().filter(|v| **v > half).count();
        if bright - dark < CONTRAST || spoilt as f64 > BORDER_WRONG * border.len() as f64 {
            return None;
        }
        let bits: Vec<bool> = (0..n * n).map(|k| bit((k / n + 1) as f64, (k % n + 1) as f64) > half).collect();
        // As it would be read with another corner first.
        let read = |turns: usize| {
            (0..n * n).fold(0u64, |code, k| {
                let (mut row, mut column) = (k / n, k % n);
                for _ in 0..turns {
                    (row, column) = (column, n - 1 - row);
                }
                (code << 1) | u64::from(bits[row * n + column])
            })
        };
        (0..4).find_map(|turns| {
            let own = read(turns);
            let id = codes.iter().position(|c| (c ^ own).count_ones() <= self.wrong)?;
            Some(Tag { id, corners: std::array::from_fn(|k| corners[(k + turns) % 4]) })
        })
    }
}

/// Homography from the unit square to four corners.
struct Square {
    h: [f64; 8],
}

impl Square {
    /// (Heckbert 1989, "Fundamentals of texture mapping and image warping", section 2.2.3.) None: three of them are on
    /// a line.
    fn new(&[a, b, c, d]: &[[f64; 2]; 4]) -> Option<Self> {
        let (e, f) = ([b[0] - c[0], b[1] - c[1]], [d[0] - c[0], d[1] - c[1]]);
        let sum = [a[0] - b[0] + c[0] - d[0], a[1] - b[1] + c[1] - d[1]];
        let det = e[0] * f[1] - f[0] * e[1];
        if det == 0.0 {
            return None;
        }
        let g = (sum[0] * f[1] - f[0] * sum[1]) / det;
        let h = (e[0] * sum[1] - sum[0] * e[1]) / det;
        let (x, y) =
            ([b[0] - a[0] + g * b[0], b[1] - a[1] + g * b[1]], [d[0] - a[0] + h * d[0], d[1] - a[1] + h * d[1]]);
        Some(Self { h: [x[0], y[0], a[0], x[1], y[1], a[1], g, h] })
    }

    fn at(&self, [s, t]: [f64; 2]) -> [f64; 2] {
        let h = &self.h;
        let w = h[6] * s + h[7] * t + 1.0;
        [(h[0] * s + h[1] * t + h[2]) / w, (h[3] * s + h[4] * t + h[5]) / w]
    }
}
