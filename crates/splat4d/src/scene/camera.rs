//! Cameras: OpenCV axes (x right, y down, z forward), pixel centres at +0.5, poses named `cam_from_world`.

use crate::math::Se3;

/// Focal lengths and principal point, pixels (the centre of the first pixel is at 0.5).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Intrinsics {
    /// Horizontal focal length.
    pub fx: f64,
    /// Vertical focal length.
    pub fy: f64,
    /// Principal point, x.
    pub cx: f64,
    /// Principal point, y.
    pub cy: f64,
}

/// How the lens bends rays. The renderer renders pinhole images; captures are undistorted on load.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub enum Lens {
    /// No distortion.
    Pinhole,
    /// OpenCV's rational model: radial k1..k6, tangential p1 p2, thin prism s1..s4.
    Brown {
        /// k1..k6
        k: [f64; 6],
        /// p1, p2
        p: [f64; 2],
        /// s1..s4
        s: [f64; 4],
    },
    /// Kannala-Brandt fisheye: r = θ(1 + k1θ² + k2θ⁴ + k3θ⁶ + k4θ⁸).
    Fisheye {
        /// k1..k4
        k: [f64; 4],
    },
    /// Field-of-view model (Devernay and Faugeras 2001): r_d = atan(2 r tan(ω/2))/ω.
    Fov {
        /// ω, radians
        omega: f64,
    },
    /// Division model (Fitzgibbon 2001): r = r_d/(1 + k r_d²).
    Division {
        /// k
        k: f64,
    },
    /// Enhanced unified camera model (Khomutenko 2016): (x, y)/(α √(β r² + 1) + 1 − α).
    Eucm {
        /// α
        alpha: f64,
        /// β
        beta: f64,
    },
    /// Fisheye with tangential and thin-prism terms, all in the plane of angles (COLMAP's THIN_PRISM_FISHEYE).
    ThinPrismFisheye {
        /// k1..k4, as of a fisheye
        k: [f64; 4],
        /// p1, p2
        p: [f64; 2],
        /// sx1, sy1
        s: [f64; 2],
    },
    /// Fisheye whose tangential and thin-prism terms act after the radial ones (Project Aria, COLMAP's
    /// RAD_TAN_THIN_PRISM_FISHEYE).
    RadTanThinPrismFisheye {
        /// k0..k5: r = θ(1 + Σ kᵢ θ^(2i+2))
        k: [f64; 6],
        /// p0, p1
        p: [f64; 2],
        /// s0..s3
        s: [f64; 4],
    },
    /// A pinhole view of an equirectangular panorama: longitude across, latitude down, its centre straight ahead. The
    /// camera's intrinsics are the view's.
    Equirectangular {
        /// The panorama's axes from the view's, row-major rotation.
        turn: [[f64; 3]; 3],
        /// Pixels of the panorama across and down.
        size: [usize; 2],
    },
}

impl Lens {
    /// The models of `capture.json`: their names, and the most coefficients k, p and s that they have.
    pub const MODELS: [(&'static str, [usize; 3]); 8] = [
        ("pinhole", [0, 0, 0]),
        ("opencv", [6, 2, 4]),
        ("fisheye", [4, 0, 0]),
        ("fov", [1, 0, 0]),
        ("division", [1, 0, 0]),
        ("eucm", [2, 0, 0]),
        ("thin_prism_fisheye", [4, 2, 2]),
        ("rad_tan_thin_prism_fisheye", [6, 2, 4]),
    ];

    /// The model's name in `capture.json` and its coefficients k, p and s; `None`: panoramas, which have none.
    pub fn terms(&self) -> Option<(&'static str, [Vec<f64>; 3])> {
        let none = Vec::new;
        Some(match *self {
            Lens::Pinhole => ("pinhole", [none(), none(), none()]),
            Lens::Brown { k, p, s } => ("opencv", [k.to_vec(), p.to_vec(), s.to_vec()]),
            Lens::Fisheye { k } => ("fisheye", [k.to_vec(), none(), none()]),
            Lens::Fov { omega } => ("fov", [vec![omega], none(), none()]),
            Lens::Division { k } => ("division", [vec![k], none(), none()]),
            Lens::Eucm { alpha, beta } => ("eucm", [vec![alpha, beta], none(), none()]),
            Lens::ThinPrismFisheye { k, p, s } => ("thin_prism_fisheye", [k.to_vec(), p.to_vec(), s.to_vec()]),
            Lens::RadTanThinPrismFisheye { k, p, s } => {
                ("rad_tan_thin_prism_fisheye", [k.to_vec(), p.to_vec(), s.to_vec()])
            }
            Lens::Equirectangular { .. } => return None,
        })
    }

    /// The lens of a model's name and coefficients; those left out are 0. `None`: no such model.
    pub fn of_terms(name: &str, [k, p, s]: [&[f64]; 3]) -> Option<Self> {
        fn fill<const N: usize>(values: &[f64]) -> [f64; N] {
            std::array::from_fn(|i| values.get(i).copied().unwrap_or(0.0))
        }
        Some(match name {
            "pinhole" => Lens::Pinhole,
            "opencv" => Lens::Brown { k: fill(k), p: fill(p), s: fill(s) },
            "fisheye" => Lens::Fisheye { k: fill(k) },
            // Without an angle the model bends nothing, and its formula divides by it.
            "fov" => match fill::<1>(k) {
                [omega] if omega.abs() > SMALLEST_OMEGA => Lens::Fov { omega },
                _ => Lens::Pinhole,
            },
            "division" => Lens::Division { k: fill::<1>(k)[0] },
            "eucm" => {
                let [alpha, beta] = fill(k);
                Lens::Eucm { alpha, beta }
            }
            "thin_prism_fisheye" => Lens::ThinPrismFisheye { k: fill(k), p: fill(p), s: fill(s) },
            "rad_tan_thin_prism_fisheye" => Lens::RadTanThinPrismFisheye { k: fill(k), p: fill(p), s: fill(s) },
            _ => return None,
        })
    }
}

/// Angles of the field-of-view model below this bend a ray by less than 10⁻⁹.
const SMALLEST_OMEGA: f64 = 1e-5;

/// A posed camera.
#[derive(Clone, Debug, PartialEq)]
pub struct Camera {
    /// Takes world points into the camera's axes. (In other systems: viewmat, w2c, extrinsic.)
    #[doc(alias = "viewmat")]
    pub cam_from_world: Se3,
    /// Focal lengths and principal point.
    pub intrinsics: Intrinsics,
    /// Lens distortion of the original image.
    pub lens: Lens,
    /// Pixels across.
    pub width: usize,
    /// Pixels down.
    pub height: usize,
    /// Splats with z ≤ near are not rendered, scene units.
    pub near: f64,
}

impl Camera {
    /// Where nothing else is known, splats nearer than this are not rendered (as gsplat).
    pub const NEAR: f64 = 0.01;

    /// A pinhole camera with square pixels, its principal point in the middle. `fov_y` in radians.
    pub fn with_fov_y(cam_from_world: Se3, fov_y: f64, width: usize, height: usize) -> Self {
        let f = 0.5 * height as f64 / (0.5 * fov_y).tan();
        let intrinsics = Intrinsics { fx: f, fy: f, cx: 0.5 * width as f64, cy: 0.5 * height as f64 };
        Self { cam_from_world, intrinsics, lens: Lens::Pinhole, width, height, near: Self::NEAR }
    }

    /// The camera's centre in the world.
    pub fn center(&self) -> [f64; 3] {
        self.cam_from_world.inverse().translation
    }

    /// The viewing direction in the world (unit).
    pub fn forward(&self) -> [f64; 3] {
        self.cam_from_world.rotation[2]
    }

    /// Pixel position and depth z of a world point (pinhole); `None` at or behind the camera.
    pub fn project(&self, x: [f64; 3]) -> Option<([f64; 2], f64)> {
        let p = self.cam_from_world.apply(x);
        let k = &self.intrinsics;
        (p[2] > 1e-9).then(|| ([k.fx * p[0] / p[2] + k.cx, k.fy * p[1] / p[2] + k.cy], p[2]))
    }

    /// The world point at depth z behind pixel position (u, v) (pinhole).
    pub fn unproject(&self, [u, v]: [f64; 2], z: f64) -> [f64; 3] {
        let k = &self.intrinsics;
        self.cam_from_world.inverse().apply([(u - k.cx) / k.fx * z, (v - k.cy) / k.fy * z, z])
    }

    /// The same view on a raster `k` times smaller: intrinsics divided, size rounded down.
    pub fn downscaled(&self, k: usize) -> Self {
        let f = k as f64;
        let i = &self.intrinsics;
        Self {
            intrinsics: Intrinsics { fx: i.fx / f, fy: i.fy / f, cx: i.cx / f, cy: i.cy / f },
            width: self.width / k,
            height: self.height / k,
            ..self.clone()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unproject_inverts_project() {
        let pose = Se3::look_at([1.0, 2.0, 5.0], [0.0; 3], [0.0, 1.0, 0.0]);
        let camera = Camera::with_fov_y(pose, 0.8, 40, 30);
        let x = [0.3, -0.2, 0.4];
        let (uv, z) = camera.project(x).unwrap();
        let back = camera.unproject(uv, z);
        assert!((0..3).all(|k| (back[k] - x[k]).abs() < 1e-12));
        assert!(camera.project([2.0, 4.0, 10.0]).is_none(), "a point behind the camera has no pixel");
    }
}
