"""The Gaussians at one time as NumPy arrays, as gsplat's rasterization takes them."""
import sys

import numpy as np

import splat4d

scene = splat4d.open(sys.argv[1])  # a run, a .s4d, .ply, .spz, .splatv, ...
first, last = scene.clip
now = scene.at(0.5 * (first + last))
print(f"{len(now)} of {len(scene)} Gaussians are alive at {now.time:.2f} s")
print("they reach from", now.means.min(axis=0), "to", now.means.max(axis=0))
np.savez("moment.npz", means=now.means, quats=now.quats, scales=now.scales, opacities=now.opacities, sh=now.sh)
