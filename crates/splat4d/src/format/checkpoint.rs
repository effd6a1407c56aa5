//! Checkpoints of PyTorch with Gaussians in them, read: gsplat's trainer, nerfstudio's splatfacto, FreeTimeGsVanilla, and by
//! `rotors` 3DGS and 4d-gaussian-splatting.
//!
//! gsplat: `splats` with means, quats (wxyz), scales (logarithms), opacities (logits), sh0 [N, 1, 3], shN [N, K, 3];
//! FreeTimeGsVanilla adds times, durations and velocities (`freetime`). splatfacto: `pipeline` with
//! `_model.gauss_params.` and the same names, but features_dc [N, 3], features_rest [N, K, 3].
//! Sources: nerfstudio-project/gsplat, examples/simple_trainer.py; nerfstudio, models/splatfacto.py.

use super::dialect::{Dialect, Opened, Writer, Y_DOWN};
use super::freetime::{self, Moves};
use super::rotors;
use super::torch::{Tensor, Torch, Value, is_torch};
use super::warnings::Warnings;
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use crate::scene::{GEOMETRY, Params, SH};
use crate::{Error, ErrorKind, Result};

/// Files of torch.save.
pub(crate) const DIALECT: Dialect = Dialect {
    name: "checkpoint of PyTorch",
    ending: ".pt",
    up: Y_DOWN,
    moves: false,
    mark: Some(is_torch),
    read,
    writer: Writer::None("Write .ply, which gsplat and others load."),
    world: false,
    fixed_axes: false,
    states_up: false,
};

/// Up in the world of nerfstudio.
const NERFSTUDIO_UP: [f64; 3] = [0.0, 0.0, 1.0];
/// Beginning of the names of splatfacto's tensors.
const SPLATFACTO: &str = "_model.gauss_params.";
/// Keys that are named in errors.
const NAMED: usize = 8;

fn read(bytes: &[u8]) -> Result<Opened> {
    read_on(bytes, None)
}

/// Reads a checkpoint; of 4d-gaussian-splatting, whose clock has no seconds, with these as the first and last one.
pub(super) fn open_on(bytes: &[u8], clip: Option<[f64; 2]>) -> Result<Opened> {
    read_on(bytes, clip).map(finish)
}

/// What follows reading, of a checkpoint or of Gaussians whose network is one.
pub(super) fn finish(opened: Opened) -> Opened {
    DIALECT.finish(opened)
}

fn read_on(bytes: &[u8], clip: Option<[f64; 2]>) -> Result<Opened> {
    let torch = Torch::open(bytes)?;
    let root = torch.root();
    if let Some(opened) = rotors::read(&torch, clip)? {
        return Ok(opened);
    }
    let mut warnings = Warnings::default();
    if let Some(pipeline) =
        torch.get(root, "pipeline").filter(|p| torch.get(p, &format!("{SPLATFACTO}means")).is_some())
    {
        let file = Tensors { torch: &torch, dict: pipeline, prefix: SPLATFACTO };
        let params = file.gaussians(["features_dc", "features_rest"])?;
        warnings.add("the model is in the world of nerfstudio (z up), which its data parser scaled and centred");
        return Ok(Opened { up: Some(NERFSTUDIO_UP), ..Opened::from((params, warnings)) });
    }
    let splats = [torch.get(root, "splats"), Some(root)].into_iter().flatten();
    let Some(splats) = splats.into_iter().find(|d| torch.get(d, "means").is_some()) else {
        let keys: Vec<&str> = torch.keys(root).into_iter().take(NAMED).collect();
        let what = format!("this checkpoint of PyTorch holds no Gaussians that are read; it has {}", keys.join(", "));
        return Err(Error::new(ErrorKind::Unsupported, what).remedy(
            "Checkpoints of gsplat, splatfacto, FreeTimeGsVanilla, 3DGS and 4d-gaussian-splatting are read. \
             Give the folder of 4DGaussians, Deformable-3D-Gaussians and SC-GS. Export .ply from other programs.",
        ));
    };
    let file = Tensors { torch: &torch, dict: splats, prefix: "" };
    let params = file.gaussians(["sh0", "shN"])?;
    if torch.get(splats, "times").is_none() {
        return Ok(Opened::from((params, warnings)));
    }
    let rows = params.len();
    let still_placed = matches!(torch.get(root, "use_velocity"), Some(Value::Bool(false)));
    let velocities = if still_placed { Vec::new() } else { file.numbers("velocities", rows, 3)? };
    let (times, log_durations) = (file.numbers("times", rows, 1)?, file.numbers("durations", rows, 1)?);
    let frames = match torch.get(root, "n_frames") {
        Some(Value::Int(n)) => usize::try_from(*n).ok(),
        _ => None,
    };
    let seconds = freetime::duration(frames, &mut warnings);
    let scene = freetime::scene(&params, &Moves { times, log_durations, velocities }, seconds)?;
    Ok(Opened::from((scene, warnings)))
}

/// Tensors of a dictionary.
struct Tensors<'a> {
    torch: &'a Torch<'a>,
    dict: &'a Value,
    prefix: &'a str,
}

impl Tensors<'_> {
    fn tensor(&self, name: &str) -> Result<&Tensor> {
        match self.torch.get(self.dict, &format!("{}{name}", self.prefix)) {
            Some(Value::Tensor(tensor)) => Ok(tensor),
            _ => Err(Error::input(format!("the checkpoint's Gaussians have no tensor `{name}`"))
                .remedy("Colours by a network (app_opt) are not read; export .ply from the program that trained it.")),
        }
    }

    /// Numbers of `rows` rows of `width`.
    fn numbers(&self, name: &str, rows: usize, width: usize) -> Result<Vec<f32>> {
        let tensor = self.tensor(name)?;
        let shape = &tensor.shape;
        if shape.iter().try_fold(1usize, |n, d| n.checked_mul(*d)) != rows.checked_mul(width)
            || shape.first() != Some(&rows)
        {
            return Err(Error::input(format!("tensor `{name}` has shape {shape:?}, expected {rows} rows of {width}"))
                .remedy("The checkpoint is damaged; save it again."));
        }
        self.torch.numbers(tensor)
    }

    /// Static Gaussians, whose base colours and other colours have these names.
    fn gaussians(&self, [base, rest]: [&str; 2]) -> Result<Params> {
        let rows = self.tensor("means")?.shape.first().copied().unwrap_or(0);
        let means = self.numbers("means", rows, 3)?;
        let (quats, scales) = (self.numbers("quats", rows, 4)?, self.numbers("scales", rows, 3)?);
        let (opacities, dc) = (self.numbers("opacities", rows, 1)?, self.numbers(base, rows, 3)?);
        let further = self.tensor(rest).map_or(0, |t| t.shape.get(1).copied().unwrap_or(0));
        if ![0, 3, 8, 15].contains(&further) {
            return Err(Error::new(
                ErrorKind::Unsupported,
                format!("`{rest}` has {further} coefficients; degree 3 has 15"),
            )
            .remedy("Train with spherical harmonics of degree 3 or less."));
        }
        let colors = if further > 0 { self.numbers(rest, rows, 3 * further)? } else { Vec::new() };
        let mut params = Params::new(rows, 1 + further, &[]);
        let [geometry, sh] = params.get_mut([GEOMETRY, SH]);
        for row in 0..rows {
            let take = |from: &[f32], width: usize, k: usize| from[width * row + k];
            geometry.write(row, 0, std::array::from_fn::<f32, 3, _>(|k| take(&means, 3, k)));
            geometry.write(row, QUAT, std::array::from_fn::<f32, 4, _>(|k| take(&quats, 4, k)));
            geometry.write(row, LOG_SCALE, std::array::from_fn::<f32, 3, _>(|k| take(&scales, 3, k)));
            geometry.set(row, OPACITY, opacities[row]);
            (0..3).for_each(|k| sh.set(row, k, take(&dc, 3, k)));
            (0..3 * further).for_each(|k| sh.set(row, 3 + k, take(&colors, 3 * further, k)));
        }
        Ok(params)
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::format::samples::gaussians;
    use crate::format::torch::tests::saved;
    use crate::layers::freeze;
    use crate::scene::Time;

    /// The tensors of Gaussians with these names of colours.
    fn tensors(p: &Params, [base, rest]: [&'static str; 2], prefix: &str) -> Vec<(String, Vec<usize>, Vec<f32>)> {
        let (n, g, sh) = (p.len(), &p[GEOMETRY], &p[SH]);
        let columns = |t: &crate::scene::Table, first: usize, width: usize| {
            (0..n).flat_map(|r| (0..width).map(move |k| (r, first + k))).map(|(r, c)| t.get(r, c)).collect::<Vec<_>>()
        };
        let rest_width = sh.width() - 3;
        let all = vec![
            ("means", vec![n, 3], columns(g, 0, 3)),
            ("quats", vec![n, 4], columns(g, QUAT, 4)),
            ("scales", vec![n, 3], columns(g, LOG_SCALE, 3)),
            ("opacities", vec![n], columns(g, OPACITY, 1)),
            (base, vec![n, 1, 3], columns(sh, 0, 3)),
            (rest, vec![n, rest_width / 3, 3], columns(sh, 3, rest_width)),
        ];
        all.into_iter().map(|(name, shape, x)| (format!("{prefix}{name}"), shape, x)).collect()
    }

    fn file(inside: &str, all: &[(String, Vec<usize>, Vec<f32>)], more: &[u8]) -> Vec<u8> {
        let all: Vec<(&str, &[usize], Vec<f32>)> =
            all.iter().map(|(n, s, x)| (n.as_str(), &s[..], x.clone())).collect();
        saved(Some(inside), &all, more)
    }

    /// A checkpoint of gsplat's trainer.
    pub(in crate::format) fn sample(p: &Params) -> Vec<u8> {
        file("splats", &tensors(p, ["sh0", "shN"], ""), b"X\x04\0\0\0stepK\x07")
    }

    #[test]
    fn gsplat_and_splatfacto_are_read() {
        let p = gaussians(12, 9);
        let splatfacto = file("pipeline", &tensors(&p, ["features_dc", "features_rest"], SPLATFACTO), b"");
        for (bytes, up) in [(sample(&p), Y_DOWN), (splatfacto, NERFSTUDIO_UP)] {
            let opened = DIALECT.open(&bytes).unwrap();
            assert_eq!((opened.scene.layers[0].params.clone(), opened.scene.up), (p.clone(), up));
        }
        let mut lacking = tensors(&p, ["sh0", "shN"], "");
        lacking.retain(|t| t.0 != "sh0");
        assert!(DIALECT.open(&file("splats", &lacking, b"")).unwrap_err().to_string().contains("`sh0`"));
        let other = file("model", &lacking, b"");
        let said = DIALECT.open(&other).unwrap_err().to_string();
        assert!(said.contains("it has model") && said.contains("gsplat"), "{said}");
        let mut short = tensors(&p, ["sh0", "shN"], "");
        short[1].1 = vec![11, 4];
        assert!(DIALECT.open(&file("splats", &short, b"")).unwrap_err().to_string().contains("expected 12 rows of 4"));
    }

    #[test]
    fn freetime_gaussians_have_velocities_and_lifespans() {
        let p = gaussians(3, 4);
        let mut all = tensors(&p, ["sh0", "shN"], "");
        all.push(("times".into(), vec![3, 1], vec![0.5, 0.0, 1.0]));
        all.push(("durations".into(), vec![3, 1], vec![0.25f32.ln(), -9.0, 0.0]));
        all.push(("velocities".into(), vec![3, 3], vec![2.0, 0.0, 0.0, 0.0, 4.0, 0.0, 0.0, 0.0, 0.0]));
        // 61 frames: two seconds.
        let opened = DIALECT.open(&file("splats", &all, b"X\x08\0\0\0n_framesK\x3d")).unwrap();
        assert_eq!((opened.scene.clip, opened.scene.is_moving()), ([0.0, 2.0], true));
        assert!(opened.warnings.lines()[0].contains("61 frames"), "{:?}", opened.warnings);
        // t = ¾: the first is ¼ behind its centre.
        let now = freeze(&opened.scene, Time(1.5)).unwrap();
        let (a, b) = (p[GEOMETRY].read::<3>(0, 0), now[GEOMETRY].read::<3>(0, 0));
        assert!((b[0] - a[0] - 0.5).abs() < 1e-5 && b[1] == a[1], "{a:?} {b:?}");
        let alpha = |p: &Params, row: usize| 1.0 / (1.0 + (-p[GEOMETRY].get(row, OPACITY)).exp());
        assert!((alpha(&now, 0) / alpha(&p, 0) - (-0.5f32).exp()).abs() < 1e-4);
        // The shortest duration is 0.02: at t = 0.02 it has fallen to e^-½.
        let early = freeze(&opened.scene, Time(0.04)).unwrap();
        let row = (0..early.len())
            .find(|r| (early[GEOMETRY].get(*r, 1) - p[GEOMETRY].get(1, 1) - 0.08).abs() < 1e-4)
            .unwrap();
        assert!((alpha(&early, row) / alpha(&p, 1) - (-0.5f32).exp()).abs() < 1e-3);
    }
}
