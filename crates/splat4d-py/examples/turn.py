"""An orbit around a playing scene, as images."""
import sys
from math import cos, sin, tau

import splat4d

scene = splat4d.open(sys.argv[1])
first, last = scene.clip
middle = scene.at(first).means.mean(axis=0)
for i in range(8):
    angle = tau * i / 8
    eye = middle + [4 * cos(angle), 4 * sin(angle), 1.5]
    camera = splat4d.Camera.look_at(eye, middle, scene.up, width=320, height=240)
    image = scene.render(camera, first + (last - first) * i / 7)
    with open(f"turn{i}.ppm", "wb") as file:
        file.write(b"P6 320 240 255\n" + (255 * image.clip(0, 1) + 0.5).astype("u1").tobytes())
