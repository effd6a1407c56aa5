//! Initial point clouds.

use super::json::read_bytes;
use super::pose::FARTHEST;
use rayon::prelude::*;
use splat4d::format::npy::Npy;
use splat4d::format::ply;
use splat4d::{Error, Result};
use std::borrow::Cow;
use std::path::Path;

/// Colour of points that have none.
const GREY: f32 = 0.5;

/// Arrays of an .npz archive that hold points: Luiten's own name first.
const ARRAYS: [&str; 3] = ["data", "points", "xyz"];
/// How point clouds begin that are not read, and what they are called.
const UNREAD: [(&[u8], &str); 6] = [
    (b"LASF", "a .las or .laz file"),
    (b"# .PCD", "a .pcd file"),
    (b"VERSION .", "a .pcd file"),
    (b"ASTM-E57", "an .e57 file"),
    (b"glTF", "a .glb file"),
    (b"\x89HDF", "an HDF5 file"),
];

/// Reads the points of a .ply, .npy or .npz file, whatever its name, with their colours and, where a .ply states them, their times.
pub(super) fn read_cloud(path: &Path) -> Result<PointCloud> {
    surface(&read_bytes(path)?, path).map(|read| read.0).map_err(|e| e.at(path.display()))
}

/// The same of a file's bytes, and the triangles between the points of a mesh.
pub(super) fn surface(bytes: &[u8], path: &Path) -> Result<(PointCloud, Vec<[u32; 3]>)> {
    let of_cloud = |cloud| (cloud, Vec::new());
    match bytes {
        [0x93, b'N', b'U', b'M', b'P', b'Y', ..] => Npy::read(bytes).and_then(|array| of_array(&array)).map(of_cloud),
        [b'P', b'K', 3 | 5, ..] => of_archive(bytes).map(of_cloud),
        _ if bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes).starts_with(b"ply")
            || path.extension().is_some_and(|e| e.eq_ignore_ascii_case("ply")) =>
        {
            of_ply(bytes)
        }
        _ => Err(unread(bytes)),
    }
}

/// Why a file of points is not read.
fn unread(bytes: &[u8]) -> Error {
    let known = UNREAD.iter().find(|(start, _)| bytes.starts_with(start)).map(|(_, what)| *what);
    let text = || std::str::from_utf8(&bytes[..bytes.len().min(1 << 10)]).is_ok();
    let what = known.unwrap_or_else(|| if text() { "text" } else { "a file of another kind" });
    Error::input(format!("expected points as .ply, .npy or .npz, found {what}")).remedy(
        "Convert it to .ply with CloudCompare or MeshLab, or save an array of shape [points, 3], or [points, 6] with colours, with \
         numpy.save. Scans as .las, .pcd or .e57 are read as \"geometry\" of capture.json (docs/priors.md)",
    )
}

/// The points of an archive of arrays.
fn of_archive(bytes: &[u8]) -> Result<PointCloud> {
    let mut read = ARRAYS.iter().map(|name| Npy::read_member(bytes, name));
    // Of several errors the one that names the arrays of the archive and asks for `points`.
    let found = read.find(Result::is_ok).unwrap_or_else(|| Npy::read_member(bytes, ARRAYS[1]));
    of_array(&found?)
}

/// The points of an array with a row of 3 coordinates each, then perhaps 3 colours and other columns.
fn of_array(array: &Npy) -> Result<PointCloud> {
    let (columns, colored) = match array.shape[..] {
        [_, 3] => (3, false),
        [_, columns] if columns >= 6 => (columns, true),
        _ => {
            let what = format!("expected an array of shape [points, 3] or [points, 6], found {:?}", array.shape);
            return Err(Error::input(what)
                .remedy("Save positions, or positions and colours; or remove the file to start without it"));
        }
    };
    let numbers = array.to_f64();
    let rows = || numbers.chunks_exact(columns);
    let colors = |row: &[f64]| if colored { [row[3], row[4], row[5]].map(|v| v as f32) } else { [GREY; 3] };
    let white = white_of(rows().flat_map(colors));
    let mut cloud = PointCloud::default();
    rows().for_each(|row| cloud.push([row[0], row[1], row[2]], colors(row).map(|v| v / white), None));
    Ok(cloud)
}

fn of_ply(bytes: &[u8]) -> Result<(PointCloud, Vec<[u32; 3]>)> {
    let read = ply::read_points(&plain_names(bytes))?;
    let white = white_of(read.colors.iter().flatten().copied());
    let mut cloud = PointCloud::default();
    for (i, point) in read.positions.iter().enumerate() {
        let seen = read.times.get(i).copied();
        // No number: the point was not seen at one time.
        let seen = seen.filter(|t| !t.is_nan());
        cloud.push(*point, read.colors.get(i).map_or([GREY; 3], |c| c.map(|v| v / white)), seen);
    }
    Ok((cloud, read.triangles))
}

/// The number that represents full colour in colours of floating point: 1, or 255 where most are above 1.
fn white_of(colors: impl Iterator<Item = f32>) -> f32 {
    let (above, all) = colors.fold((0usize, 0usize), |(above, all), c| (above + usize::from(c > 1.0), all + 1));
    if 2 * above > all { 255.0 } else { 1.0 }
}

/// Names that MeshLab, VisualSFM and others give to colours, and the usual names.
const COLOR_PREFIX: &[u8] = b" diffuse_";
/// Bytes in which the header of a cloud ends: few properties are usual.
const HEADER: usize = 1 << 14;

/// The file with colours under their usual names.
fn plain_names(bytes: &[u8]) -> Cow<'_, [u8]> {
    let head = &bytes[..bytes.len().min(HEADER)];
    let find = |what: &[u8], from: &[u8]| from.windows(what.len()).position(|w| w == what);
    let Some(end) = find(b"end_header", head).filter(|&end| find(COLOR_PREFIX, &head[..end]).is_some()) else {
        return Cow::Borrowed(bytes);
    };
    let mut out = Vec::with_capacity(bytes.len());
    let mut header = &head[..end];
    while let Some(at) = find(COLOR_PREFIX, header) {
        out.extend_from_slice(&header[..=at]);
        header = &header[at + COLOR_PREFIX.len()..];
    }
    out.extend_from_slice(header);
    out.extend_from_slice(&bytes[end..]);
    Cow::Owned(out)
}

/// Coloured points, some with the time at which they were seen.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PointCloud {
    /// World positions.
    pub points: Vec<[f64; 3]>,
    /// sRGB from 0 to 1, one per point.
    pub colors: Vec<[f32; 3]>,
    /// Seconds, one per point; `None` where the point was not seen at one time.
    pub times: Vec<Option<f64>>,
    /// Points of the file that were left out: with coordinates that are not finite, or too far away to compute with.
    pub left_out: usize,
}

/// Cells along the longest side of the finest voxel grid that is tried: finer than any cloud resolves, and three cell
/// numbers still fit one 64-bit key.
const MAX_CELLS: f64 = (1u64 << 20) as f64;
/// Bisection steps for the voxel size; each halves an interval of 20 octaves.
const STEPS: usize = 16;

impl PointCloud {
    /// Adds a point that a file holds, or counts it as left out.
    pub(super) fn push(&mut self, point: [f64; 3], color: [f32; 3], time: Option<f64>) {
        if !point.iter().all(|v| v.abs() <= FARTHEST) || time.is_some_and(|t| !t.is_finite()) {
            self.left_out += 1;
            return;
        }
        self.points.push(point);
        // A colour that is not a number must not spread.
        self.colors.push(color.map(|v| if v.is_nan() { GREY } else { v.clamp(0.0, 1.0) }));
        self.times.push(time);
    }

    /// Points left out of the file, for a warning.
    pub(crate) fn loss(&self) -> Option<String> {
        let all = self.points.len() + self.left_out;
        (self.left_out > 0).then(|| {
            format!(
                "{} of {all} initial points are left out: their coordinates are not finite, or beyond {FARTHEST:.0e} units.",
                self.left_out
            )
        })
    }

    /// Makes positions relative to `offset`.
    pub(crate) fn subtract(&mut self, offset: [f64; 3]) {
        if offset != [0.0; 3] {
            self.points.iter_mut().for_each(|p| *p = std::array::from_fn(|k| p[k] - offset[k]));
        }
    }

    /// All of it as a binary .ply file, which restores it exactly; `comment`: lines for its header.
    pub fn to_ply(&self, comment: &str) -> Vec<u8> {
        let mut out = format!(
            "ply\nformat binary_little_endian 1.0\n{comment}\nelement vertex {}\nproperty double x\nproperty double y\n\
             property double z\nproperty float r\nproperty float g\nproperty float b\nproperty double time\nend_header\n",
            self.points.len()
        )
        .into_bytes();
        for ((point, color), time) in self.points.iter().zip(&self.colors).zip(&self.times) {
            point.iter().for_each(|v| out.extend(v.to_le_bytes()));
            color.iter().for_each(|v| out.extend(v.to_le_bytes()));
            out.extend(time.unwrap_or(f64::NAN).to_le_bytes());
        }
        out
    }

    /// Thins the cloud to at most `max_points`: the finest voxel grid that leaves few enough cells, and the mean of
    /// position and colour in each. The same cloud always gives the same result; small clouds are returned unchanged.
    /// Points of different time stay apart (a cell holds one time, taken from its first point, per time value).
    pub(crate) fn voxel_downsample(&self, max_points: usize) -> Self {
        let n = self.points.len();
        if n <= max_points || max_points == 0 {
            return if max_points == 0 { Self::default() } else { self.clone() };
        }
        let mut low = [f64::INFINITY; 3];
        let mut high = [f64::NEG_INFINITY; 3];
        for p in &self.points {
            for k in 0..3 {
                low[k] = low[k].min(p[k]);
                high[k] = high[k].max(p[k]);
            }
        }
        let side = (0..3).map(|k| high[k] - low[k]).fold(0.0, f64::max).max(f64::MIN_POSITIVE);
        // log2 of the number of cells along the longest side. At 0 one cell per time is left.
        let (mut coarse, mut fine) = (0.0, MAX_CELLS.log2());
        for _ in 0..STEPS {
            let middle: f64 = 0.5 * (coarse + fine);
            let count = self.count_cells(low, middle.exp2() / side);
            *(if count <= max_points { &mut coarse } else { &mut fine }) = middle;
        }
        let sorted = self.cells(low, f64::exp2(coarse) / side);
        let cells: Vec<&[(Cell, usize)]> = sorted.chunk_by(|a, b| a.0 == b.0).collect();
        let mut out = Self::default();
        // More distinct times than points are requested: no voxel size helps, so every n-th cell is kept.
        let stride = cells.len().div_ceil(max_points);
        for members in cells.iter().step_by(stride) {
            let weight = 1.0 / members.len() as f64;
            let mut point = [0.0; 3];
            let mut color = [0.0; 3];
            for &(_, i) in *members {
                for k in 0..3 {
                    point[k] += weight * self.points[i][k];
                    color[k] += weight * f64::from(self.colors[i][k]);
                }
            }
            out.points.push(point);
            out.colors.push(color.map(|c| c as f32));
            out.times.push(self.times[members[0].1]);
        }
        out
    }

    /// The cell of every point, sorted by cell and then by point.
    fn cells(&self, low: [f64; 3], per_unit: f64) -> Vec<(Cell, usize)> {
        let cell_of = |(i, p): (usize, &[f64; 3])| ((place(p, low, per_unit), self.times[i].map(f64::to_bits)), i);
        let mut cells: Vec<(Cell, usize)> = self.points.par_iter().enumerate().map(cell_of).collect();
        cells.par_sort_unstable();
        cells
    }

    /// How many cells have points. Without times only a fifth of the bytes of [`Self::cells`] is sorted.
    fn count_cells(&self, low: [f64; 3], per_unit: f64) -> usize {
        if self.times.iter().any(Option::is_some) {
            return self.cells(low, per_unit).chunk_by(|a, b| a.0 == b.0).count();
        }
        let mut places: Vec<u64> = self.points.par_iter().map(|p| place(p, low, per_unit)).collect();
        places.par_sort_unstable();
        places.chunk_by(|a, b| a == b).count()
    }
}

/// The voxel of a point: its three numbers in one key.
fn place(p: &[f64; 3], low: [f64; 3], per_unit: f64) -> u64 {
    let cell = |k: usize| ((p[k] - low[k]) * per_unit).clamp(0.0, MAX_CELLS) as u64;
    (cell(0) << 42) | (cell(1) << 21) | cell(2)
}

/// A voxel, and the bits of a time.
type Cell = (u64, Option<u64>);

#[cfg(test)]
mod tests {
    use super::*;

    fn cloud(bytes: &[u8]) -> Result<PointCloud> {
        of_ply(bytes).map(|read| read.0)
    }

    #[test]
    fn ascii_and_binary_agree_whatever_the_order() {
        let ascii = "ply\nformat ascii 1.0\ncomment made up\nelement vertex 3\nproperty uchar red\n\
                     property uchar green\n\
                     property uchar blue\nproperty double x\nproperty float y\nproperty int z\nproperty float time\n\
                     end_header\n255 0 51 1.5 -2 3 0.5\n0 255 0 nan 0 0 0\n9 9 9 0 0 0 inf\n";
        let read = cloud(ascii.as_bytes()).unwrap();
        assert_eq!((read.points.as_slice(), read.times[0]), (&[[1.5, -2.0, 3.0]][..], Some(0.5)));
        assert_eq!((read.colors.as_slice(), read.left_out), (&[[1.0, 0.0, 0.2]][..], 2));
        let mut binary = ascii[..ascii.find("255 0").unwrap()].replace("ascii", "binary_little_endian").into_bytes();
        for (x, time) in [(1.5, 0.5), (f64::NAN, 0.0), (0.0, f32::INFINITY)] {
            binary.extend([255, 0, 51]);
            binary.extend(f64::to_le_bytes(x));
            binary.extend(f32::to_le_bytes(-2.0));
            binary.extend(i32::to_le_bytes(3));
            binary.extend(f32::to_le_bytes(time));
        }
        assert_eq!(cloud(&binary).unwrap(), read);
        // As MeshLab calls colours.
        let diffuse = ["red", "green", "blue"].iter().fold(ascii.to_owned(), |text, color| {
            text.replace(&format!("uchar {color}"), &format!("uchar diffuse_{color}"))
        });
        assert_eq!(cloud(diffuse.as_bytes()).unwrap(), read);
        let message = cloud(&binary[..binary.len() - 1]).unwrap_err().to_string();
        assert!(message.contains("claims 3 rows"), "{message}");
    }

    #[test]
    fn a_cloud_round_trips_bit_for_bit() {
        let cloud = PointCloud {
            points: vec![[0.1, -2e-9, 3e7], [1.0 / 3.0, 0.0, -0.7]],
            colors: vec![[0.1, 0.2, 1.0], [0.0, 0.7, 1.0 / 3.0]],
            times: vec![None, Some(0.3)],
            left_out: 0,
        };
        assert_eq!(of_ply(&cloud.to_ply("comment made up")).unwrap().0, cloud);
        let none = PointCloud::default();
        assert_eq!(of_ply(&none.to_ply("comment made up")).unwrap().0, none);
    }

    #[test]
    fn arrays_are_read_by_their_content_and_other_clouds_are_named() {
        let work = tempfile::tempdir().unwrap();
        let read = |name: &str, bytes: &[u8]| {
            let path = work.path().join(name);
            std::fs::write(&path, bytes).unwrap();
            read_cloud(&path).map_err(|e| e.to_string())
        };
        let array = |shape: &[usize], data: &[f32]| {
            let mut bytes = Vec::new();
            splat4d::format::npy::write_f32(shape, data, &mut bytes).unwrap();
            bytes
        };
        let positions = read("a.npy", &array(&[2, 3], &[1.0, -2.0, 3.0, 0.0, f32::NAN, 0.0])).unwrap();
        assert_eq!(
            (&positions.points[..], positions.colors[0], positions.left_out),
            (&[[1.0, -2.0, 3.0]][..], [GREY; 3], 1)
        );
        for row in [[1.0, -2.0, 3.0, 51.0, 255.0, 102.0], [1.0, -2.0, 3.0, 0.2, 1.0, 0.4]] {
            // The name does not decide.
            let colored = read("a.ply", &array(&[1, 6], &row)).unwrap();
            assert_eq!((colored.points[0], colored.colors[0]), ([1.0, -2.0, 3.0], [0.2, 1.0, 0.4]));
        }
        let text = read("a.npy", &array(&[4], &[0.0; 4])).unwrap_err();
        assert!(text.contains("[points, 3] or [points, 6], found [4]"), "{text}");
        for (bytes, what) in [
            (&b"LASF\x01"[..], "a .las or .laz file"),
            (b"# .PCD v0.7\n", "a .pcd file"),
            (b"1.0 2.0 3.0\n", "text"),
            (&[0xff, 0xfe, 0, 1], "another kind"),
        ] {
            let text = read("a.xyz", bytes).unwrap_err();
            assert!(text.contains(what) && text.contains("numpy.save") && text.contains("a.xyz"), "{text}");
        }
        assert!(read("a.npz", b"PK\x05\x06").is_err());
        assert!(read("a.ply", b"").unwrap_err().contains("PLY"));
    }

    #[test]
    fn points_that_cannot_be_computed_with_are_left_out_and_counted() {
        let mut cloud = PointCloud::default();
        assert_eq!(cloud.loss(), None);
        for x in [0.0, 5.4e6, -1e12, 1e13, -1e300, f64::INFINITY, f64::NAN] {
            cloud.push([0.0, x, 0.0], [f32::NAN, 2.0, 0.0], None);
        }
        cloud.push([0.0; 3], [0.0; 3], Some(f64::INFINITY));
        assert_eq!((cloud.points.len(), cloud.left_out, cloud.colors[0]), (3, 5, [GREY, 1.0, 0.0]));
        assert!(cloud.loss().unwrap().contains("5 of 8"), "{:?}", cloud.loss());
        let ply = "ply\nformat ascii 1.0\nelement vertex 2\nproperty double x\nproperty double y\nproperty double z\n\
                   end_header\n1e39 0 0\n0 0 0\n";
        assert_eq!(of_ply(ply.as_bytes()).unwrap().0.left_out, 1, "beyond 32-bit floats");
    }

    #[test]
    fn colours_are_grey_where_there_are_none_and_never_outside_their_range() {
        let points = |properties: &str, row: &str| {
            let text = format!(
                "ply\nformat ascii 1.0\nelement vertex 1\nproperty double x\nproperty double y\nproperty double z\n\
                 {properties}end_header\n1e-9 1 2 {row}\n"
            );
            cloud(text.as_bytes()).unwrap()
        };
        let plain = points("", "");
        assert_eq!((plain.points[0][0], plain.colors[0], plain.times[0]), (1e-9, [GREY; 3], None));
        let floats = "property float r\nproperty float g\nproperty float b\nproperty double t\n";
        let seen = points(floats, "nan 1.5 0.25 7");
        assert_eq!((seen.colors[0], seen.times[0]), ([GREY, 1.0, 0.25], Some(7.0)));
        let bytes = points(floats, "51 255 0 7");
        assert_eq!(bytes.colors[0], [0.2, 1.0, 0.0], "bytes that were written as floats");
        let wide = "property ushort red\nproperty ushort green\nproperty ushort blue\n";
        assert_eq!(points(wide, "65535 0 13107").colors[0], [1.0, 0.0, 0.2]);
    }

    #[test]
    fn absurd_counts_are_refused_without_reserving() {
        for format in ["ascii", "binary_little_endian"] {
            let text = format!(
                "ply\nformat {format} 1.0\nelement vertex 18446744073709551615\nproperty float x\nproperty float y\n\
                 property float z\nend_header\n"
            );
            assert!(cloud(text.as_bytes()).unwrap_err().to_string().contains("cut short"));
        }
        assert!(cloud(b"ply\nformat ascii 1.0\n").is_err());
        assert!(cloud(b"").is_err());
    }
    use splat4d::math::Rng;

    #[test]
    fn thinning_keeps_the_cap_and_the_shape() {
        let rng = Rng::new(5, "cloud", 0);
        let mut cloud = PointCloud::default();
        for i in 0..5000u64 {
            cloud.points.push([rng.uniform(3 * i), 2.0 * rng.uniform(3 * i + 1), 0.1 * rng.uniform(3 * i + 2)]);
            cloud.colors.push([0.25; 3]);
            cloud.times.push(None);
        }
        let thin = cloud.voxel_downsample(700);
        assert!((500..=700).contains(&thin.points.len()), "{}", thin.points.len());
        assert!(thin.points.iter().all(|p| (0.0..=1.0).contains(&p[0]) && (0.0..=2.0).contains(&p[1])));
        assert!(thin.colors.iter().all(|c| (c[0] - 0.25).abs() < 1e-6));
        assert_eq!(thin, cloud.voxel_downsample(700));
        assert_eq!(cloud.voxel_downsample(5000), cloud);
        cloud.times = (0..5000).map(|i| Some(f64::from(i))).collect();
        assert!(cloud.voxel_downsample(700).points.len() <= 700, "many times must not break the cap");
    }
}
