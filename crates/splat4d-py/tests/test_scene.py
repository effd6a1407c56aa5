"""Scenes as arrays and pictures."""

import threading
import time

import numpy as np

import splat4d
from common import PLAYABLE, InFolder


def covariances(now):
    """R S S Rᵀ of every Gaussian, [N, 3, 3]."""
    w, x, y, z = now.quats.T.astype(np.float64)
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    ).transpose(2, 0, 1)
    scaled = turn * now.scales[:, None, :]
    return scaled @ scaled.transpose(0, 2, 1)


class Scenes(InFolder):
    def setUp(self):
        super().setUp()
        self.scene = splat4d.open(PLAYABLE)
        self.camera = self.scene.cameras[0][1].downscaled(2)

    def test_a_time_gives_arrays_of_activated_values(self):
        now = self.scene.at(0.4)
        n = len(now)
        self.assertTrue(0 < n <= len(self.scene))
        shapes = [now.means.shape, now.quats.shape, now.scales.shape, now.opacities.shape, now.sh.shape[::2]]
        self.assertEqual(shapes, [(n, 3), (n, 4), (n, 3), (n,), (n, 3)])
        for array in [now.means, now.quats, now.scales, now.opacities, now.sh]:
            self.assertEqual(array.dtype, np.float32)
            self.assertTrue(np.isfinite(array).all() and array.flags.c_contiguous)
        np.testing.assert_allclose(np.linalg.norm(now.quats, axis=1), 1, atol=1e-5)
        self.assertTrue((now.scales > 0).all() and (now.opacities > 0).all() and (now.opacities < 1).all())
        self.assertIs(now.sh, now.sh, "gathered once")
        later = self.scene.at(0.8)
        self.assertFalse(len(later) == n and np.array_equal(later.means, now.means), "it moves")

    def test_the_arrays_equal_the_exported_gaussians(self):
        now, file = self.scene.at(0.4), self.folder / "now.ply"
        self.scene.export(file, 0.4)
        still = splat4d.open(file).at(0.0)
        np.testing.assert_array_equal(still.means, now.means)
        np.testing.assert_allclose(still.opacities, now.opacities, atol=2e-6)
        np.testing.assert_allclose(covariances(still), covariances(now), rtol=1e-3, atol=1e-9)
        np.testing.assert_array_equal(still.sh, now.sh)

    def test_a_render_equals_the_commands(self):
        picture = self.scene.render(self.camera, 0.4)
        self.assertEqual((picture.shape, picture.dtype), ((150, 200, 3), np.float32))
        self.assertGreater(picture.std(), 0.05, "something is seen")
        alpha = self.scene.render(self.camera, 0.4, channel="alpha")
        depth = self.scene.render(self.camera, 0.4, channel="depth")
        self.assertEqual((alpha.shape, depth.shape), ((150, 200), (150, 200)))
        seen = alpha > 0.9
        self.assertTrue(np.isfinite(depth[seen]).all() and (depth[seen] > self.camera.near).all())
        # Over another background only what is not covered changes: c = c₀ + (1 − α) b.
        black = self.scene.render(self.camera, 0.4, background=[0, 0, 0])
        red = self.scene.render(self.camera, 0.4, background=[1, 0, 0])
        np.testing.assert_allclose(red[..., 0] - black[..., 0], 1 - alpha, atol=1e-5)

    def test_other_channels_are_arrays_of_visible_surfaces(self):
        alpha = self.scene.render(self.camera, 0.4, channel="alpha")
        for channel, shape in [("flow", (2,)), ("velocity", (3,)), ("normal", (3,)), ("life", ()), ("uncertainty", ())]:
            numbers = self.scene.render(self.camera, 0.4, channel=channel)
            self.assertEqual((numbers.shape, numbers.dtype), ((150, 200, *shape), np.float32), channel)
            seen = np.isfinite(numbers).reshape(150, 200, -1).all(axis=2)
            self.assertTrue(seen.mean() > 0.5 and not seen[alpha < 0.05].any(), channel)
        normals = self.scene.render(self.camera, 0.4, channel="normal")
        lengths = np.linalg.norm(normals, axis=2)
        np.testing.assert_allclose(lengths[np.isfinite(lengths)], 1, atol=1e-4)
        self.assertEqual(self.scene.labels, [])

    def test_metrics_are_those_of_eval(self):
        picture = self.scene.render(self.camera, 0.4).clip(0, 1)
        other = (0.9 * picture).astype(np.float32)
        scores = splat4d.metrics(other, picture)
        psnr = -10 * np.log10(np.mean((other.astype(np.float64) - picture) ** 2))
        self.assertAlmostEqual(scores["PSNR"], psnr, places=4)
        self.assertTrue(0.5 < scores["SSIM"] < 1)
        bytes_ = (255 * picture + 0.5).astype(np.uint8)
        self.assertNotIn("PSNR", splat4d.metrics(bytes_, bytes_), "infinite is no number")

    def test_tracks_follow_gaussians_during_their_lifespans(self):
        tracks = self.scene.tracks(every=500, times=[0.2, 0.4])
        self.assertEqual(tracks.points.shape, (len(tracks.rows), 2, 3))
        alive = np.isfinite(tracks.points[:, 1, 0])
        now = {tuple(m) for m in self.scene.at(0.4).means}
        self.assertTrue(alive.any() and all(tuple(p) in now for p in tracks.points[alive, 1]))

    def test_written_files_open_again(self):
        self.scene.export(self.folder / "again.spz", 0.4)
        self.scene.export(self.folder / "again.html")
        self.scene.bake(self.folder / "again.s4d", tolerance=1.0)
        for file in self.folder.iterdir():
            self.assertGreater(file.stat().st_size, 10_000)
        self.assertEqual(len(splat4d.open(self.folder / "again.spz")), len(self.scene.at(0.4)))
        self.assertGreater(len(splat4d.open(self.folder / "again.s4d")), 1000)

    def test_films_sequences_tracks_and_info_need_no_command(self):
        self.assertEqual(splat4d.info(PLAYABLE)["type"], "playback")
        self.scene.film(self.folder / "film", size=(16, 12), fps=1, seconds=1)
        self.assertTrue((self.folder / "film" / "00000.png").is_file())
        self.scene.film(self.folder / "c.%02d.exr", size=(16, 12), fps=1, seconds=2, shutter=180, aperture=0.1, focus=4)
        self.assertTrue((self.folder / "c.01.exr").read_bytes().startswith(b"\x76\x2f\x31\x01"))
        with self.assertRaisesRegex(splat4d.Error, "up to 360"):
            self.scene.film(self.folder / "d.png", shutter=720)
        with self.assertRaisesRegex(splat4d.Error, "over-under"):
            self.scene.film(self.folder / "d.png", stereo="crossed", eye_distance=0.1)
        count = self.scene.export_frames(self.folder / "frames", fps=2)
        self.assertEqual(count, len(list((self.folder / "frames").glob("frame_*.ply"))))
        self.scene.export_tracks(self.folder / "near.csv", near=[0, 0, 1], count=2, fps=1)
        self.assertGreater(len((self.folder / "near.csv").read_text().splitlines()), 2)
        self.assertEqual(self.scene.export_mesh(self.folder / "a.obj", 0.5, voxel=0.1), 1)
        self.assertIn("\nf ", (self.folder / "a.obj").read_text())
        self.assertEqual(self.scene.export_mesh(self.folder / "meshes", voxel=0.1, collision=True, fps=2, end=0.5), 2)
        self.assertTrue((self.folder / "meshes" / "frame_00001.glb").read_bytes().startswith(b"glTF"))
        with self.assertRaisesRegex(splat4d.Error, "option `voxel`"):
            self.scene.export_mesh(self.folder / "b.obj", voxel=0)
        with self.assertRaisesRegex(splat4d.Error, "option `tracks` NAME.csv"):
            self.scene.export_tracks(self.folder / "near.txt")
        with self.assertRaisesRegex(splat4d.Error, "channel"):
            self.scene.film(self.folder / "film.png", channel="heat")

    def test_cameras_round_trip(self):
        _, camera = self.scene.cameras[3]
        same = splat4d.Camera(
            camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, camera.world_to_camera, camera.near
        )
        np.testing.assert_allclose(same.world_to_camera, camera.world_to_camera, atol=1e-12)
        np.testing.assert_array_equal(same.K, camera.K)
        looking = splat4d.Camera.look_at([3, 0, 1], [0, 0, 1], [0, 0, 1], width=40, height=30)
        np.testing.assert_allclose(looking.world_to_camera @ [0, 0, 1, 1], [0, 0, 3, 1], atol=1e-9)

    def test_other_threads_run_during_a_render(self):
        camera = splat4d.Camera.look_at([3, 3, 1.5], [0, 0, 0.8], self.scene.up, width=2000, height=1500)
        thread = threading.Thread(target=self.scene.render, args=(camera, 0.4))
        thread.start()
        ticks = 0
        while thread.is_alive():
            time.sleep(0.001)
            ticks += 1
        self.assertGreater(ticks, 5, "the lock is given up while it draws")
