#!/usr/bin/env python3
"""Draws the moving picture of README.md with the Python package: a scene and its time line, as an animated PNG.

    pip install splat4d numpy
    python xtask/readme_loop.py examples/knight.s4d docs/images/knight-loop.png
"""

import struct
import sys
import zlib

import numpy as np

import splat4d

WIDTH, HEIGHT, FPS = 400, 300, 15
# The take is played this many times, slower by this factor, while the camera swings once.
ROUNDS, SLOWER = 2, 2.5
# Degrees to either side.
SWING = 22
# Degrees from top to bottom.
FOV = 40
# Each pixel is the mean of this many samples across and down.
FINER = 2
COLOURS = 256
# Rounds of the search for these colours.
SEARCH = 12


def frames(scene):
    """Pictures of one loop, [h, w, 3] bytes."""
    first, last = scene.clip
    # From the middle of the rig to the middle of what is seen.
    camera = scene.cameras[len(scene.cameras) // 2 + 1][1]
    now = scene.at(first)
    middle = np.median(now.means[now.opacities > 0.5], axis=0)
    up = np.array(scene.up)
    arm = np.array(camera.position) - middle
    count = round(ROUNDS * (last - first) * SLOWER * FPS)
    for i in range(count):
        angle = np.radians(SWING) * np.sin(2 * np.pi * i / count)
        turned = arm * np.cos(angle) + np.cross(up, arm) * np.sin(angle) + up * (up @ arm) * (1 - np.cos(angle))
        share = ROUNDS * i / count % 1
        view = splat4d.Camera.look_at(middle + turned, middle, up, width=FINER * WIDTH, height=FINER * HEIGHT, fov_y=FOV)
        fine = scene.render(view, first + share * (last - first)).clip(0, 1)
        picture = fine.reshape(HEIGHT, FINER, WIDTH, FINER, 3).mean(axis=(1, 3))
        yield time_line((255 * picture + 0.5).astype(np.uint8), share)


def time_line(picture, share):
    """A line along the bottom, and a handle where time is."""
    left, right, y = 16, WIDTH - 16, HEIGHT - 14
    at = left + share * (right - left)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    line = (np.abs(rows - y) < 1.5) & (columns > left) & (columns < right)
    picture[line] = np.where(columns[line][:, None] < at, [46, 110, 230], [150, 150, 155])
    picture[(rows - y) ** 2 + (columns - at) ** 2 < 5.5**2] = [46, 110, 230]
    return picture


def palette(pictures):
    """Few colours that stand for all: k-means on a sample, with a seed of its own."""
    rng = np.random.default_rng(7)
    pixels = np.concatenate([p.reshape(-1, 3) for p in pictures[::6]]).astype(np.float32)
    sample = pixels[rng.choice(len(pixels), 40_000, replace=False)]
    centers = sample[rng.choice(len(sample), COLOURS, replace=False)]
    for _ in range(SEARCH):
        near = nearest(sample, centers)
        sums = np.stack([np.bincount(near, sample[:, c], COLOURS) for c in range(3)], axis=1)
        counts = np.bincount(near, minlength=COLOURS)[:, None]
        centers = np.where(counts > 0, sums / np.maximum(counts, 1), centers).astype(np.float32)
    return centers.round().astype(np.float32)


def nearest(pixels, centers):
    squares = (centers**2).sum(axis=1)
    parts = np.array_split(pixels, max(len(pixels) // 20_000, 1))
    return np.concatenate([(squares - 2 * part @ centers.T).argmin(axis=1) for part in parts])


def chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def main(scene, out):
    pictures = list(frames(splat4d.open(scene)))
    colours = palette(pictures)
    parts = [
        chunk(b"IHDR", struct.pack(">IIBBBBB", WIDTH, HEIGHT, 8, 3, 0, 0, 0)),
        chunk(b"acTL", struct.pack(">II", len(pictures), 0)),
        chunk(b"PLTE", colours.astype(np.uint8).tobytes()),
    ]
    number = 0
    for i, picture in enumerate(pictures):
        codes = nearest(picture.reshape(-1, 3).astype(np.float32), colours).astype(np.uint8).reshape(HEIGHT, WIDTH)
        rows = np.pad(codes, ((0, 0), (1, 0)))  # each row begins with its filter: none
        data = zlib.compress(rows.tobytes(), 9)
        parts.append(chunk(b"fcTL", struct.pack(">IIIIIHHBB", number, WIDTH, HEIGHT, 0, 0, 1, FPS, 0, 0)))
        number += 1
        if i == 0:
            parts.append(chunk(b"IDAT", data))
        else:
            parts.append(chunk(b"fdAT", struct.pack(">I", number) + data))
            number += 1
    parts.append(chunk(b"IEND", b""))
    with open(out, "wb") as file:
        file.write(b"\x89PNG\r\n\x1a\n" + b"".join(parts))
    print(f"{out}: {len(pictures)} pictures, {sum(map(len, parts)) / 1e6:.2f} MB")


if __name__ == "__main__":
    main(*sys.argv[1:])
