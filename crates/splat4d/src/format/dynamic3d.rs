//! Results of Dynamic3DGaussians (Luiten et al. 2024), read: `params.npz`, Gaussians with a position and a rotation for
//! every frame.
//!
//! means3D [T, N, 3], unnorm_rotations [T, N, 4] (wxyz), rgb_colors [T, N, 3] (colours, not coefficients), log_scales
//! [N, 3], logit_opacities [N, 1]. Others (seg_colors, cam_m, cam_c) are left out. The file states no frame rate: 30 frames
//! a second, those of its captures, are assumed. Source: JonathonLuiten/Dynamic3DGaussians (MIT), README and helpers.py.

use super::bytes::SH_C0;
use super::dialect::{Dialect, Opened, Writer, Y_DOWN};
use super::npy::Npy;
use super::warnings::Warnings;
use super::zip;
use crate::layers::{Layer, Scene};
use crate::motion::tracked::{POSE, Tracked, TrackedSpec};
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use crate::scene::time::DEFAULT_FPS;
use crate::scene::{GEOMETRY, LifeKind, Params, SH};
use crate::{Error, Result};
use std::sync::Arc;

/// params.npz of Dynamic3DGaussians.
pub(crate) const DIALECT: Dialect = Dialect {
    name: "Dynamic3DGaussians .npz",
    ending: ".npz",
    up: Y_DOWN,
    moves: true,
    mark: Some(is_dynamic3d),
    read: |bytes| read(bytes).map(Opened::from),
    writer: Writer::None("Write .stg.ply, .ftgs.ply or .usdz."),
    world: false,
    fixed_axes: false,
    states_up: false,
};

/// The file's usual name.
pub const NAME: &str = "params.npz";
/// Arrays by which it is known.
const KNOWN: [&str; 2] = ["means3D.npy", "unnorm_rotations.npy"];
/// Longest array that is inflated: bytes, and times its packed bytes. Numbers of Gaussians shrink by less than 20:1.
const MOST_SMALL: usize = 1 << 20;
const MOST_RATIO: usize = 64;
/// Change of a colour that counts.
const VISIBLE: f32 = 1.0 / 255.0;

fn is_dynamic3d(bytes: &[u8]) -> bool {
    bytes.starts_with(&zip::MAGIC)
        && zip::Archive::open(bytes).is_ok_and(|a| KNOWN.iter().all(|name| a.packed(name).is_some()))
}

fn read(bytes: &[u8]) -> Result<(Scene<f32>, Warnings)> {
    let mut warnings = Warnings::default();
    let archive = zip::Archive::open(bytes)?;
    let array = |name: &str, shape: &[Option<usize>]| -> Result<Npy> {
        let file = format!("{name}.npy");
        let most = MOST_SMALL + MOST_RATIO * archive.packed(&file).unwrap_or(0);
        let missing = || Error::input(format!("the archive has no array `{name}`")).remedy("Save it again.");
        let array = Npy::read(&archive.file(&file, most).ok_or_else(missing)??).map_err(|e| e.at(name))?;
        let fits =
            array.shape.len() == shape.len() && array.shape.iter().zip(shape).all(|(a, b)| b.is_none_or(|b| b == *a));
        if fits { Ok(array) } else { Err(wrong(name, &array.shape)) }
    };
    let means = array("means3D", &[None, None, Some(3)])?;
    let (frames, rows) = (means.shape[0], means.shape[1]);
    let (t, n) = (Some(frames), Some(rows));
    let quats = array("unnorm_rotations", &[t, n, Some(4)])?.to_f32();
    let colors = array("rgb_colors", &[t, n, Some(3)])?.to_f32();
    let scales = array("log_scales", &[n, Some(3)])?.to_f32();
    let opacities = array("logit_opacities", &[n, Some(1)])?.to_f32();
    let means = means.to_f32();
    if frames == 0 {
        return Err(wrong("means3D", &[0, rows, 3]));
    }
    let mut params = Params::new(rows, 1, &[]);
    let pose = |frame: usize, row: usize| -> [f32; POSE] {
        let at = frame * rows + row;
        std::array::from_fn(|k| if k < 3 { means[3 * at + k] } else { quats[4 * at + k - 3] })
    };
    for row in 0..rows {
        params[GEOMETRY].write(row, 0, pose(0, row));
        params[GEOMETRY].write(row, LOG_SCALE, [scales[3 * row], scales[3 * row + 1], scales[3 * row + 2]]);
        params[GEOMETRY].set(row, OPACITY, opacities[row]);
        params[SH].write(row, 0, std::array::from_fn::<f32, 3, _>(|k| (colors[3 * row + k] - 0.5) / SH_C0));
    }
    const { assert!(QUAT == 3, "a pose is position and rotation") };
    let changes = |row: &usize| {
        (1..frames).any(|f| (0..3).any(|k| (colors[3 * (f * rows + row) + k] - colors[3 * row + k]).abs() > VISIBLE))
    };
    warnings.counted((0..rows).filter(changes).count(), rows, "change their colour: that of the first frame is read");
    warnings.add(format!("the file states no frame rate: {DEFAULT_FPS} frames per second are assumed"));
    let times: Vec<f64> = (0..frames).map(|i| i as f64 / DEFAULT_FPS).collect();
    let clip = [0.0, times[frames - 1]];
    let motion = Tracked::new(&TrackedSpec { times, foreground: false }, &mut params)?;
    for frame in 1..frames {
        let page = &mut params[motion.page(frame)];
        (0..rows).for_each(|row| page.write(row, 0, pose(frame, row)));
    }
    let layer = Layer::new("tracked", params, Arc::new(motion), LifeKind::Infinite);
    Ok((Scene { layers: vec![layer], clip, fps: DEFAULT_FPS, up: Y_DOWN, ..Scene::default() }, warnings))
}

fn wrong(name: &str, shape: &[usize]) -> Error {
    Error::input(format!("array `{name}` has shape {shape:?}, which does not fit the others of Dynamic3DGaussians"))
        .remedy("The file is damaged; save it again.")
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::format::npy;
    use crate::layers::freeze;
    use crate::scene::Time;

    /// Three frames of two Gaussians.
    pub(in crate::format) fn sample() -> Vec<u8> {
        let (frames, rows) = (3, 2);
        let numbers = |count: usize| (0..count).map(|i| i as f32 * 0.1).collect::<Vec<f32>>();
        let colors: Vec<f32> = (0..18).map(|i| if i == 17 { 0.9 } else { 0.5 }).collect();
        let arrays: [(&str, &[usize], Vec<f32>); 6] = [
            ("means3D", &[frames, rows, 3], numbers(18)),
            ("unnorm_rotations", &[frames, rows, 4], [2.0, 0.0, 0.0, 0.0].repeat(6)),
            ("rgb_colors", &[frames, rows, 3], colors),
            ("log_scales", &[rows, 3], numbers(6)),
            ("logit_opacities", &[rows, 1], vec![1.0, -1.0]),
            ("cam_m", &[1], vec![0.0]),
        ];
        let files: Vec<(String, Vec<u8>)> = arrays
            .iter()
            .map(|(name, shape, data)| {
                let mut bytes = Vec::new();
                npy::write_f32(shape, data, &mut bytes).unwrap();
                (format!("{name}.npy"), bytes)
            })
            .collect();
        let files: Vec<(&str, &[u8])> = files.iter().map(|(n, b)| (n.as_str(), &b[..])).collect();
        let mut out = Vec::new();
        zip::write(&files, 1, &mut out).unwrap();
        out
    }

    #[test]
    fn gaussians_have_the_positions_of_each_frame() {
        let opened = DIALECT.open(&sample()).unwrap();
        assert_eq!((opened.scene.len(), opened.scene.clip[1]), (2, 2.0 / DEFAULT_FPS));
        let said = opened.warnings.lines().join("\n");
        assert!(said.contains("1 of 2 Gaussians change their colour") && said.contains("30 frames"), "{said}");
        for (frame, x) in [(0.0, 0.3), (1.0, 0.9), (1.5, 1.2), (2.0, 1.5)] {
            let p = freeze(&opened.scene, Time(frame / DEFAULT_FPS)).unwrap();
            assert!((p[GEOMETRY].get(1, 0) - x).abs() < 1e-5, "frame {frame}");
            assert_eq!(p[SH].read::<3>(0, 0), [0.0; 3]);
        }
    }

    #[test]
    fn arrays_that_do_not_fit_are_named() {
        let good = sample();
        let at = good.windows(9).position(|w| w == b"(3, 2, 4)").unwrap();
        let mut bad = good.clone();
        bad[at..at + 9].copy_from_slice(b"(2, 3, 4)");
        assert!(DIALECT.open(&bad).unwrap_err().to_string().contains("`unnorm_rotations` has shape [2, 3, 4]"));
    }
}
