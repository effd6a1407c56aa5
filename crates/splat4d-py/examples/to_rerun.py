"""Logs a scene's cameras and Gaussians over time for the Rerun viewer (pip install rerun-sdk)."""
import sys

import numpy as np
import rerun as rr

import splat4d

scene = splat4d.open(sys.argv[1])
rr.init("splat4d")
rr.save("scene.rrd")  # or rr.spawn() to look at once
for name, camera in scene.cameras:
    world = np.linalg.inv(camera.world_to_camera)
    rr.log(f"cameras/{name}", rr.Transform3D(translation=world[:3, 3], mat3x3=world[:3, :3]), static=True)
    lens = rr.Pinhole(image_from_camera=camera.K, width=camera.width, height=camera.height)
    rr.log(f"cameras/{name}", lens, static=True)
for t in np.arange(*scene.clip, 1 / scene.fps):
    now = scene.at(t)
    rr.set_time("time", duration=t)
    colors = np.clip(0.5 + 0.28209479 * now.sh[:, 0], 0, 1)  # spherical harmonics of degree 0
    rgba = np.column_stack([colors, now.opacities])
    turns = now.quats[:, [1, 2, 3, 0]]  # Rerun has xyzw
    rr.log("gaussians", rr.GaussianSplats3D(now.means, scales=now.scales, quaternions=turns, colors=rgba))
