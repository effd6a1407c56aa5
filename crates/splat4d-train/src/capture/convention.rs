//! Conventions of poses: direction, camera axes, order of rows and of quaternions; and poses that are written in
//! another convention than their layout states (`capture.poses`).

use crate::settings::Value;
use splat4d::math::se3::transpose;
use splat4d::math::{Se3, quat};
use splat4d::{Error, Result};
use std::str::FromStr;

/// The convention that a layout, or a capture.json, states.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Convention {
    /// Whether poses lead from the world to the camera; else from the camera to the world.
    pub world_to_camera: bool,
    /// Whether the camera's axes are OpenGL's (x right, y up, z backward); else OpenCV's (x right, y down, z forward).
    pub opengl: bool,
    /// Whether rotations are quaternions (COLMAP's text and binary files); else matrices.
    pub quaternions: bool,
}

impl Convention {
    /// COLMAP: world to camera, OpenCV axes, quaternions.
    pub(crate) const COLMAP: Self = Self { world_to_camera: true, opengl: false, quaternions: true };
    /// World to camera, OpenCV axes, matrices.
    pub const OPENCV: Self = Self { quaternions: false, ..Self::COLMAP };
    /// Nerfies: the rotation of world to camera and the camera's position, OpenCV axes: what is mistaken there is the
    /// rotation's direction, as with camera to world.
    pub(crate) const NERFIES: Self = Self { world_to_camera: false, opengl: false, quaternions: false };
    /// NeRF's files: camera to world, OpenGL axes.
    pub(crate) const NERF: Self = Self { world_to_camera: false, opengl: true, quaternions: false };

    /// `cam_from_world` in OpenCV axes of a pose as written.
    fn read(self, mut pose: Se3) -> Se3 {
        if self.world_to_camera {
            if self.opengl {
                flip_rows(&mut pose);
            }
            return pose;
        }
        if self.opengl {
            flip_columns(&mut pose);
        }
        pose.inverse()
    }

    /// The pose as it would be written: the inverse of [`Self::read`].
    fn write(self, cam_from_world: &Se3) -> Se3 {
        let mut pose = if self.world_to_camera { *cam_from_world } else { cam_from_world.inverse() };
        match (self.opengl, self.world_to_camera) {
            (true, true) => flip_rows(&mut pose),
            (true, false) => flip_columns(&mut pose),
            (false, _) => {}
        }
        pose
    }

    /// `cam_from_world` in OpenCV axes of a pose that is written as `poses` specify.
    pub(super) fn read_as(self, mut pose: Se3, poses: Poses) -> Result<Se3> {
        if poses.xyzw {
            if !self.quaternions {
                return Err(Error::input("the poses of this layout are matrices, not quaternions")
                    .at("capture.poses")
                    .remedy("Leave xyzw out of --poses."));
            }
            let [a, b, c, d] = quat::from_rotation(&pose.rotation);
            pose.rotation = quat::to_rotation([d, a, b, c]);
        }
        if poses.transposed {
            pose.rotation = transpose(&pose.rotation);
        }
        if poses.inverse {
            pose = pose.inverse();
        }
        Ok(Self { opengl: poses.opengl.unwrap_or(self.opengl), ..self }.read(pose))
    }

    /// A pose that was read as this convention, reinterpreted as written in `poses`.
    /// Errors: quaternions in a layout that has none.
    pub(crate) fn reread(self, cam_from_world: &Se3, poses: Poses) -> Result<Se3> {
        self.read_as(self.write(cam_from_world), poses)
    }

    /// The pose read under this convention from one written as `poses` specify.
    #[cfg(test)]
    pub(crate) fn misread(self, truth: &Se3, poses: Poses) -> Se3 {
        let mut raw = Self { opengl: poses.opengl.unwrap_or(self.opengl), ..self }.write(truth);
        if poses.inverse {
            raw = raw.inverse();
        }
        if poses.transposed {
            raw.rotation = transpose(&raw.rotation);
        }
        if poses.xyzw {
            let [w, x, y, z] = quat::from_rotation(&raw.rotation);
            raw.rotation = quat::to_rotation([x, y, z, w]);
        }
        self.read(raw)
    }

    /// The other conventions in which poses are found in files of this layout, the likelier first.
    pub(crate) fn others(self) -> Vec<Poses> {
        let flipped = Some(!self.opengl);
        let mut out = Vec::new();
        for (inverse, transposed) in [(false, false), (true, false), (false, true), (true, true)] {
            for opengl in [None, flipped] {
                out.push(Poses { opengl, inverse, transposed, xyzw: false });
            }
        }
        if self.quaternions {
            out.extend([false, true].map(|inverse| Poses { inverse, xyzw: true, ..Poses::STATED }));
        }
        out.retain(|p| *p != Poses::STATED);
        // Few changes are likelier than many.
        out.sort_by_key(|p| [p.opengl.is_some(), p.inverse, p.transposed, p.xyzw].iter().filter(|x| **x).count());
        out
    }
}

fn flip_rows(pose: &mut Se3) {
    for i in [1, 2] {
        pose.rotation[i] = pose.rotation[i].map(|v| -v);
        pose.translation[i] = -pose.translation[i];
    }
}

fn flip_columns(pose: &mut Se3) {
    for row in &mut pose.rotation {
        row[1] = -row[1];
        row[2] = -row[2];
    }
}

/// Convention of a file's poses, if it is not that of the layout.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct Poses {
    /// Whether the camera's axes are OpenGL's; `None`: as stated.
    opengl: Option<bool>,
    /// Whether they lead the other way.
    inverse: bool,
    /// Whether rotations are written column by column.
    pub(super) transposed: bool,
    /// Whether quaternions are written x y z w.
    xyzw: bool,
}

impl Poses {
    /// As the layout states.
    pub(crate) const STATED: Self = Self { opengl: None, inverse: false, transposed: false, xyzw: false };
    const WORDS: [&str; 5] = ["opencv", "opengl", "inverse", "transposed", "xyzw"];

    /// The convention found for the poses, as text; relative to what `stated` states.
    pub(crate) fn in_words(self, stated: Convention) -> String {
        let mut parts: Vec<&str> = Vec::new();
        match self.opengl {
            Some(true) => parts.push("camera axes are OpenGL's (y up, z backward)"),
            Some(false) => parts.push("camera axes are OpenCV's (y down, z forward)"),
            None => {}
        }
        match (self.inverse, self.transposed, stated.world_to_camera) {
            // A transposed rotation is an inverse one: what is left differs by the translation alone.
            (true, true, true) => parts.push("translations are the cameras' positions"),
            (true, true, false) => parts.push("translations are those of world to camera"),
            (true, false, true) => parts.push("poses are camera to world"),
            (true, false, false) => parts.push("poses are world to camera"),
            (false, true, _) => parts.push("rotations are transposed (written column by column)"),
            (false, false, _) => {}
        }
        if self.xyzw {
            parts.push("quaternions are written x y z w");
        }
        parts.join(" and ")
    }
}

impl std::fmt::Display for Poses {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let given = [self.opengl == Some(false), self.opengl == Some(true), self.inverse, self.transposed, self.xyzw];
        let words: Vec<&str> = Self::WORDS.iter().zip(given).filter(|(_, g)| *g).map(|(w, _)| *w).collect();
        f.write_str(&words.join("+"))
    }
}

impl FromStr for Poses {
    type Err = Error;

    /// Reads `opencv`, `opengl`, `inverse`, `transposed`, `xyzw`, or several joined by `+`; empty: as stated.
    fn from_str(text: &str) -> Result<Self> {
        let mut out = Self::STATED;
        for word in text.split('+').map(str::trim).filter(|w| !w.is_empty()) {
            match word.to_ascii_lowercase().as_str() {
                "opencv" => out.opengl = Some(false),
                "opengl" => out.opengl = Some(true),
                "inverse" => out.inverse = true,
                "transposed" => out.transposed = true,
                "xyzw" => out.xyzw = true,
                _ => {
                    return Err(Error::input(format!("\"{word:.30}\" is not a convention of poses"))
                        .at("capture.poses")
                        .remedy(format!("Give one of {}, or several joined by +.", Self::WORDS.join(", "))));
                }
            }
        }
        Ok(out)
    }
}

impl Value for Poses {
    fn to_toml(&self) -> toml::Value {
        toml::Value::String(self.to_string())
    }

    fn from_toml(value: &toml::Value) -> std::result::Result<Self, String> {
        let words = || format!("one of {}, or several joined by +", Self::WORDS.join(", "));
        value.as_str().and_then(|s| s.parse().ok()).ok_or_else(words)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::math::se3::{norm, sub};

    fn apart(a: &Se3, b: &Se3) -> f64 {
        let turn = a.rotation.iter().flatten().zip(b.rotation.iter().flatten()).map(|(x, y)| (x - y).abs());
        turn.fold(0.0, f64::max) + norm(sub(a.translation, b.translation))
    }

    #[test]
    fn poses_round_trip_in_every_convention() {
        let truth = Se3::look_at([3.0, -2.0, 1.5], [0.2, 0.1, 0.0], [0.0, 0.0, 1.0]);
        for stated in [Convention::COLMAP, Convention::OPENCV, Convention::NERF] {
            assert!(apart(&stated.misread(&truth, Poses::STATED), &truth) < 1e-12);
            for poses in stated.others() {
                let wrong = stated.misread(&truth, poses);
                assert!(apart(&wrong, &truth) > 0.1, "{stated:?} {poses}");
                assert!(apart(&stated.reread(&wrong, poses).unwrap(), &truth) < 1e-9, "{stated:?} {poses}");
                assert_eq!(poses.to_string().parse::<Poses>().unwrap(), poses);
                assert!(!poses.in_words(stated).is_empty());
            }
        }
        assert_eq!("".parse::<Poses>().unwrap(), Poses::STATED);
        assert!("sideways".parse::<Poses>().unwrap_err().to_string().contains("opencv, opengl"));
        assert!(Convention::NERF.read_as(truth, "xyzw".parse().unwrap()).is_err());
    }
}
