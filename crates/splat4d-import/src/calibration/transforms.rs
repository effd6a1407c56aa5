//! Nerfstudio's, instant-ngp's and Blender's `transforms.json`.

use super::tree::Tree;
use super::{Dialect, Part, Said, Text};
use splat4d::Result;
use splat4d_train::capture::transforms_cameras;

pub(super) const DIALECT: Dialect = Dialect { name: "transforms.json (Nerfstudio, NeRF)", reads, read };

fn reads(text: &Text) -> bool {
    let frames = text.tree.get("frames").and_then(Tree::list).unwrap_or_default();
    frames.first().is_some_and(|f| f.get("transform_matrix").is_some())
}

fn read(text: &Text) -> Result<Said> {
    let part = |c: splat4d_train::capture::PosedCamera| Part {
        names: vec![c.name],
        size: Some([c.camera.width, c.camera.height]),
        optics: Some((c.camera.intrinsics, c.camera.lens)),
        pose: Some(c.camera.cam_from_world),
    };
    Ok(Said { parts: transforms_cameras(&text.path)?.into_iter().map(part).collect(), ..Said::default() })
}
