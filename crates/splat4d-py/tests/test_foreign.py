"""Files that other libraries read and write: safetensors, plyfile, pygltflib, Pillow, zipfile, NumPy, usd-core, json, csv.

Tests of a library that is not installed are skipped, unless REQUIRE_FOREIGN=1.
"""

import csv
import importlib.util
import io
import json
import os
import unittest
import warnings
import zipfile

import numpy as np

import splat4d
from common import KNIGHT, InFolder

REQUIRED = os.environ.get("REQUIRE_FOREIGN") == "1"
COUNT = 300


def needs(module):
    """Skip a test without this library. Where libraries are required, its import fails instead."""
    return unittest.skipUnless(REQUIRED or importlib.util.find_spec(module), f"needs {module}")


def logit(p):
    return np.log(p / (1 - p))


def sigmoid(x):
    return 1 / (1 + np.exp(-np.asarray(x, np.float64)))


def ordered(positions):
    """The order of rows by position: formats may sort Gaussians."""
    return np.lexsort(np.round(np.asarray(positions, np.float64), 2).T)


class Foreign(InFolder):
    def setUp(self):
        super().setUp()
        random = np.random.default_rng(5)
        quats = random.normal(size=(COUNT, 4))
        # Positions on a shuffled grid, so that rounding keeps their order.
        grid = np.stack(np.meshgrid(*[np.arange(7.0)] * 3), -1).reshape(-1, 3)
        self.given = dict(
            means=0.3 * random.permutation(grid)[:COUNT] - 0.9,
            quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
            scales=random.uniform(0.02, 0.2, (COUNT, 3)),
            opacities=random.uniform(0.2, 0.9, COUNT),
            sh=random.normal(0, 0.2, (COUNT, 4, 3)),
        )
        self.scene = splat4d.Scene.from_arrays(**self.given, up=[0, 1, 0])

    def written(self, name, scene=None, t=0.0):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # what a format clips
            (scene or self.scene).export(self.folder / name, t)
        return self.folder / name

    def assert_same(self, means, opacities, atol=1e-5, expected=None):
        """Compares positions and activated opacities with those of the scene, in any order."""
        expected = expected or self.given
        self.assertEqual(len(means), len(expected["means"]))
        a, b = ordered(means), ordered(expected["means"])
        np.testing.assert_allclose(np.asarray(means)[a], np.asarray(expected["means"])[b], atol=atol)
        np.testing.assert_allclose(np.asarray(opacities)[a], np.asarray(expected["opacities"])[b], atol=max(atol, 1e-5))

    def assert_opens(self, file, atol=1e-5, expected=None):
        now = splat4d.open(file).at(0.0)
        self.assert_same(now.means, now.opacities, atol, expected)
        return now


class Scenes(Foreign):
    @needs("safetensors")
    def test_safetensors(self):
        from safetensors import safe_open
        from safetensors.numpy import save_file

        with safe_open(self.written("ours.safetensors"), "np") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}
            metadata = file.metadata()
        self.assertIn("splat4d", metadata)
        self.assert_same(tensors["layers.0.means"], sigmoid(tensors["layers.0.opacity_logits"]))
        np.testing.assert_allclose(np.exp(tensors["layers.0.log_scales"]).prod(1), self.given["scales"].prod(1), rtol=1e-4)
        theirs = self.folder / "theirs.safetensors"
        save_file(tensors, theirs, metadata)
        self.assert_opens(theirs)
        # Checksums of tensors are ours: a changed number is found.
        save_file(tensors | {"layers.0.means": tensors["layers.0.means"] + 1}, theirs, metadata)
        with self.assertRaises(splat4d.Error):
            splat4d.open(theirs)

    @needs("plyfile")
    def test_ply(self):
        from plyfile import PlyData, PlyElement

        vertex = PlyData.read(str(self.written("ours.ply")))["vertex"]
        self.assert_same(np.stack([vertex[k] for k in "xyz"], 1), sigmoid(vertex["opacity"]))
        names = ["x", "y", "z", *(f"f_dc_{k}" for k in range(3)), *(f"f_rest_{k}" for k in range(9)), "opacity"]
        names += [*(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4))]
        g = self.given
        # f_rest is channel-major.
        rest = g["sh"][:, 1:].transpose(0, 2, 1).reshape(COUNT, 9)
        columns = [g["means"], g["sh"][:, 0], rest, logit(g["opacities"])[:, None], np.log(g["scales"]), g["quats"]]
        rows = np.array(list(map(tuple, np.concatenate(columns, 1))), [(name, "f4") for name in names])
        for text, order in [(False, "<"), (False, ">"), (True, "=")]:
            file = self.folder / f"theirs{order if order != '=' else 'text'}.ply"
            PlyData([PlyElement.describe(rows, "vertex")], text=text, byte_order=order).write(str(file))
            now = self.assert_opens(file)
            a, b = ordered(now.means), ordered(g["means"])
            np.testing.assert_allclose(now.sh[a], g["sh"][b], atol=1e-5)
            np.testing.assert_allclose(now.scales.prod(1)[a], g["scales"].prod(1)[b], rtol=1e-4)

    @needs("pygltflib")
    def test_glb(self):
        from pygltflib import GLTF2

        file = GLTF2().load(str(self.written("ours.glb")))
        self.assertIn("KHR_gaussian_splatting", file.extensionsUsed)
        attributes = file.meshes[0].primitives[0].attributes.__dict__

        def array(name, width):
            accessor = file.accessors[attributes[name]]
            view = file.bufferViews[accessor.bufferView]
            self.assertEqual((accessor.componentType, view.byteStride), (5126, None))
            start = (view.byteOffset or 0) + (accessor.byteOffset or 0)
            return np.frombuffer(file.binary_blob(), "<f4", accessor.count * width, start).reshape(-1, width)

        means = array("POSITION", 3)
        self.assert_same(means, array("KHR_gaussian_splatting:OPACITY", 1)[:, 0])
        np.testing.assert_allclose(means.min(0), file.accessors[attributes["POSITION"]].min, atol=1e-6)
        file.save(str(self.folder / "theirs.glb"))
        self.assert_opens(self.folder / "theirs.glb")

    @needs("PIL")
    def test_sog(self):
        from PIL import Image

        file = self.written("ours.sog")
        with zipfile.ZipFile(file) as archive:
            self.assertIsNone(archive.testzip())
            parts = {name: archive.read(name) for name in archive.namelist()}
        meta = json.loads(parts["meta.json"])
        self.assertEqual(meta["count"], COUNT)

        def pixels(name):
            return np.asarray(Image.open(io.BytesIO(parts[name])).convert("RGBA")).reshape(-1, 4)[:COUNT].astype(np.float64)

        low, high = (pixels(name)[:, :3] for name in meta["means"]["files"])
        mins, maxs = (np.array(meta["means"][k]) for k in ("mins", "maxs"))
        stored = mins + (low + 256 * high) / 65535 * (maxs - mins)
        # Positions are stored as sign(x) log(1 + |x|), opacity as the alpha of sh0.
        means = np.sign(stored) * np.expm1(np.abs(stored))
        # -y is up in .sog.
        turned = self.given | {"means": self.given["means"] * [1, -1, -1]}
        self.assert_same(means, pixels(meta["sh0"]["files"][0])[:, 3] / 255, 4e-3, turned)
        for name, method in [("stored", zipfile.ZIP_STORED), ("deflated", zipfile.ZIP_DEFLATED)]:
            theirs = self.folder / f"{name}.sog"
            with zipfile.ZipFile(theirs, "w", method) as archive:
                for part, data in parts.items():
                    archive.writestr(part, data)
            self.assert_opens(theirs, 4e-3, turned)

    @needs("pxr")
    def test_usd(self):
        from pxr import Usd

        for name in ("ours.usda", "ours.usdz"):
            stage = Usd.Stage.Open(str(self.written(name)))
            splats = [p for p in stage.Traverse() if p.GetTypeName() == "ParticleField3DGaussianSplat"]
            self.assertEqual(len(splats), 1, name)
            self.assertTrue(splats[0].IsDefined())

            def values(attribute):
                attribute = splats[0].GetAttribute(attribute)
                times = attribute.GetTimeSamples()
                return np.array(attribute.Get(times[0]) if times else attribute.Get())

            self.assert_same(values("positions"), values("opacities"))

    def test_npz_of_dynamic_gaussians(self):
        g = self.given
        paths = np.stack([g["means"], g["means"] + [0.5, 0, 0]]).astype(np.float32)
        np.savez(
            self.folder / "params.npz",
            means3D=paths,
            rgb_colors=np.full((2, COUNT, 3), 0.5, np.float32),
            unnorm_rotations=np.stack([g["quats"]] * 2).astype(np.float32),
            logit_opacities=logit(g["opacities"])[:, None].astype(np.float32),
            log_scales=np.log(g["scales"]).astype(np.float32),
        )
        with self.assertWarnsRegex(UserWarning, "30 frames per second"):
            scene = splat4d.open(self.folder / "params.npz")
        for k, t in enumerate([0.0, 1 / scene.fps]):
            now = scene.at(t)
            self.assert_same(now.means, now.opacities, expected=g | {"means": paths[k]})

    def test_tracks(self):
        moving = splat4d.Scene.from_arrays(**self.given, velocities=np.full((COUNT, 3), [0.3, 0, 0]))
        moving.export(self.folder / "scene.safetensors")
        for name in ("tracks.csv", "tracks.json"):
            moving.export_tracks(self.folder / name, near=[0, 0, 0], count=1, fps=2)
        with open(self.folder / "tracks.csv", newline="") as file:
            rows = list(csv.DictReader(file))
        self.assertTrue({"x", "y", "z"} <= set(rows[0]), rows[0])
        first = np.array([float(rows[0][k]) for k in "xyz"])
        self.assertLess(np.abs(moving.at(0.0).means - first).max(1).min(), 1e-4)
        self.assertIsInstance(json.loads((self.folder / "tracks.json").read_text()), (dict, list))


class Captures(Foreign):
    def capture(self, image, points="points.npy", **camera):
        """A capture of one camera with one image."""
        pose = np.eye(4)
        pose[2, 3] = 4
        entry = dict(name="cam", width=32, height=24, fx=30, fy=30, cx=16, cy=12, images=image, **camera)
        entry |= dict(world_to_camera=pose.tolist(), frames=1)
        text = dict(version=1, fps=10, cameras=[entry], points=points, hold_out="none", up=[0, -1, 0])
        (self.folder / "capture.json").write_text(json.dumps(text))
        return splat4d.Capture(self.folder)

    def setUp(self):
        super().setUp()
        rows, columns = np.mgrid[:24, :32]
        self.pixels = np.stack([8 * columns, 10 * rows, 128 + 4 * (columns - rows)], -1).clip(0, 255).astype(np.uint8)
        self.points = np.random.default_rng(2).uniform(-1, 1, (50, 3))
        np.save(self.folder / "points.npy", self.points)

    @needs("PIL")
    def test_images_and_masks_of_pillow(self):
        from PIL import Image

        image = Image.fromarray(self.pixels)
        mask = Image.fromarray(np.where(self.pixels[..., 0] > 100, 255, 0).astype(np.uint8))
        mask.save(self.folder / "mask_0.png")
        written = [
            ("progressive_0.jpg", image, dict(progressive=True, quality=92), 4),
            ("baseline_0.jpg", image, dict(quality=92, subsampling=0), 4),
            ("palette_0.png", image.quantize(64), {}, 0),
            ("rgb_0.png", image, dict(optimize=True), 0),
            ("lossless_0.webp", image, dict(lossless=True), 0),
            ("lossy_0.webp", image, dict(quality=90), 8),
        ]
        for name, source, options, atol in written:
            with self.subTest(name):
                source.save(self.folder / name, **options)
                capture = self.capture(name.replace("_0", "_%d"), masks="mask_%d.png")
                expected = np.asarray(Image.open(self.folder / name).convert("RGB")) / 255
                np.testing.assert_allclose(capture.image(0), expected, atol=atol / 255 + 1e-6)
                np.testing.assert_array_equal(capture.mask(0) > 0.5, np.asarray(mask) > 127)

    def test_points_of_numpy(self):
        from_colors = np.concatenate([self.points, np.full((50, 3), 0.25)], 1)
        np.save(self.folder / "colors.npy", from_colors)
        np.savez(self.folder / "stored.npz", points=self.points.astype(np.float32))
        np.savez_compressed(self.folder / "deflated.npz", points=self.points)
        (self.folder / "image_0.png").write_bytes(PNG)
        for name in ("points.npy", "colors.npy", "stored.npz", "deflated.npz"):
            positions, _ = self.capture("image_%d.png", name).points
            np.testing.assert_allclose(positions, self.points, atol=1e-6, err_msg=name)

    @needs("plyfile")
    def test_points_of_plyfile(self):
        from plyfile import PlyData, PlyElement

        fields = [(k, "f8") for k in "xyz"] + [(k, "u1") for k in ("red", "green", "blue")]
        rows = np.array([(*p, 255, 0, 51) for p in self.points], fields)
        PlyData([PlyElement.describe(rows, "vertex")], byte_order=">").write(str(self.folder / "points.ply"))
        (self.folder / "image_0.png").write_bytes(PNG)
        positions, colors = self.capture("image_%d.png", "points.ply").points
        np.testing.assert_allclose(positions, self.points, atol=1e-6)
        np.testing.assert_allclose(colors, np.tile([1, 0, 0.2], (50, 1)), atol=1e-6)
        bundled = PlyData.read(str(KNIGHT / "points.ply"))["vertex"]
        np.testing.assert_allclose(splat4d.Capture(KNIGHT).points[0], np.stack([bundled[k] for k in "xyz"], 1), atol=1e-6)

    @needs("PIL")
    def test_a_written_capture(self):
        from PIL import Image

        cameras = [splat4d.Camera.look_at([x, 0, -4], [0, 0, 0], [0, 1, 0], width=32, height=24) for x in (0, 1)]
        images = [np.stack([self.pixels, self.pixels[::-1]])] * 2
        splat4d.Capture.from_arrays(images, cameras, points=self.points, fps=10, folder=self.folder / "ours")
        text = json.loads((self.folder / "ours" / "capture.json").read_text())
        self.assertEqual((text["fps"], len(text["cameras"])), (10, 2))
        for entry, camera in zip(text["cameras"], cameras, strict=True):
            np.testing.assert_allclose(entry["world_to_camera"], camera.world_to_camera, atol=1e-9)
            for name, expected in zip(entry["images"], images[0], strict=True):
                file = self.folder / "ours" / name
                np.testing.assert_array_equal(np.asarray(Image.open(file).convert("RGB")), expected)

    @needs("PIL")
    def test_films(self):
        from PIL import Image

        self.scene.film(self.folder / "film", size=(32, 24), fps=1, seconds=1)
        frame = Image.open(self.folder / "film" / "00000.png")
        self.assertEqual((frame.size, frame.format), ((32, 24), "PNG"))
        self.assertGreater(np.asarray(frame).std(), 5, "something is seen")


# One grey image, 32x24.
PNG = bytes()


def setUpModule():
    """Writes the image of tests that only need points, without Pillow."""
    import struct
    import zlib

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    global PNG
    head = struct.pack(">IIBBBBB", 32, 24, 8, 0, 0, 0, 0)
    PNG = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head)
    PNG += chunk(b"IDAT", zlib.compress((b"\0" + b"\x80" * 32) * 24)) + chunk(b"IEND", b"")


if __name__ == "__main__":
    unittest.main()
