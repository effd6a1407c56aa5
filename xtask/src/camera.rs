//! The rig: static pinhole cameras with OpenCV axes (x right, y down, z forward), pixel centres at +0.5.

use crate::vector::{V3, v3};

/// A posed pinhole camera.
#[derive(Clone, Debug)]
pub(crate) struct Camera {
    /// File and folder name.
    pub name: String,
    /// Pixels across.
    pub width: usize,
    /// Pixels down.
    pub height: usize,
    /// Focal length, pixels, both directions.
    pub focal: f64,
    /// Rows of the rotation: the camera's x, y, z axes in the world.
    pub axes: [V3; 3],
    /// Its position.
    pub position: V3,
}

impl Camera {
    /// A camera at `position` that looks at `target`, world +y up.
    pub(crate) fn look_at(name: String, position: V3, target: V3, focal: f64, width: usize, height: usize) -> Camera {
        let forward = (target - position).unit();
        let right = forward.cross(v3(0.0, 1.0, 0.0)).unit();
        Camera { name, width, height, focal, axes: [right, forward.cross(right), forward], position }
    }

    /// A world point in camera axes.
    pub(crate) fn to_camera_axes(&self, point: V3) -> V3 {
        let d = point - self.position;
        v3(self.axes[0].dot(d), self.axes[1].dot(d), self.axes[2].dot(d))
    }

    /// Pixel position and depth of a world point; the point must be in front of the camera.
    pub(crate) fn project(&self, point: V3) -> ([f64; 2], f64) {
        let c = self.to_camera_axes(point);
        ([self.focal * c.x / c.z + 0.5 * self.width as f64, self.focal * c.y / c.z + 0.5 * self.height as f64], c.z)
    }

    /// `world_to_camera`, row-major 4x4.
    pub(crate) fn matrix(&self) -> [[f64; 4]; 4] {
        let row = |axis: V3| [axis.x, axis.y, axis.z, -axis.dot(self.position)];
        [row(self.axes[0]), row(self.axes[1]), row(self.axes[2]), [0.0, 0.0, 0.0, 1.0]]
    }
}
