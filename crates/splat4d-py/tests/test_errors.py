"""Bad input: an exception that says what and where, nothing left behind."""

import gc
import os
import pathlib

import numpy as np

import splat4d
from common import KNIGHT, PLAYABLE, SHORT, InFolder

# Rounds that fill caches and the allocator's pools, rounds that are watched, and what one of those may leave, bytes: an image
# that leaked would be 1.4 MB.
WARM, ROUNDS, LEAK = 10, 20, 200_000


class Errors(InFolder):
    def refuses(self, words, call, *args, **options):
        with self.assertRaisesRegex(splat4d.Error, words) as caught:
            call(*args, **options)
        self.assertEqual(caught.exception.kind, "bad_input")

    def test_files(self):
        with self.assertRaisesRegex(splat4d.Error, "nowhere.ply") as caught:
            splat4d.open("nowhere.ply")
        self.assertEqual(caught.exception.kind, "io")
        broken = self.folder / "broken.s4d"
        broken.write_bytes(PLAYABLE.read_bytes()[:1000])
        self.refuses("broken.s4d", splat4d.open, broken)
        self.refuses("first bytes", splat4d.open, __file__)
        gone = self.folder / "gone.s4d"
        gone.write_bytes(PLAYABLE.read_bytes())
        scene = splat4d.open(gone)
        gone.unlink()
        self.assertGreater(len(scene.at(0.1)), 0, "it is in memory")
        with self.assertRaisesRegex(splat4d.Error, "gone.s4d"):
            scene.export(self.folder / "out.ply")
        with self.assertRaisesRegex(splat4d.Error, "ending") as caught:
            splat4d.open(PLAYABLE).export(self.folder / "out.nothing")
        self.assertEqual(caught.exception.kind, "unsupported")
        self.refuses("not a run", splat4d.Run, self.folder)
        self.assertEqual(list(self.folder.iterdir()), [broken])

    def test_numbers(self):
        scene = splat4d.open(PLAYABLE)
        camera = scene.cameras[0][1]
        for t in (float("nan"), float("inf")):
            self.refuses("time", scene.at, t)
            self.refuses("time", scene.render, camera, t)
            self.refuses("time", scene.export, self.folder / "x.ply", t)
        self.refuses("channel", scene.render, camera, 0.1, channel="colour")
        self.refuses("device", scene.render, camera, 0.1, device="tpu")
        self.refuses("background", scene.render, camera, 0.1, background=[1, 2])
        self.refuses("background", scene.render, camera, 0.1, background="red")
        self.refuses("every", scene.tracks, every=0)
        self.refuses("time", scene.tracks, times=[0.1, float("nan")])
        with self.assertRaises(TypeError):
            scene.at("now")
        with self.assertRaises(TypeError):
            scene.render("camera", 0.1)

    def test_cameras(self):
        make = splat4d.Camera
        turned = np.eye(4)[:, [1, 0, 2, 3]]
        self.refuses("mirrored", make, 4, 3, 5.0, world_to_camera=turned)
        self.refuses("rigid", make, 4, 3, 5.0, world_to_camera=np.diag([2, 2, 2, 1]))
        self.refuses("NaN", make, 4, 3, 5.0, world_to_camera=np.where(np.eye(4) > 0, [np.nan, 1, 1, 1], 0))
        self.refuses("shape", make, 4, 3, 5.0, world_to_camera=np.eye(3))
        self.refuses("last row", make, 4, 3, 5.0, world_to_camera=np.ones((4, 4)))
        self.refuses("array of numbers", make, 4, 3, 5.0, world_to_camera=[["a"] * 4] * 4)
        self.refuses("focal", make, 4, 3, 0.0)
        self.refuses("size", make, 0, 3, 5.0)
        self.refuses("near", make, 4, 3, 5.0, near=-1)
        self.refuses("fov_y", make.look_at, [1, 0, 0], [0, 0, 0], [0, 0, 1], fov_y=200)
        self.refuses("position", make.look_at, [1, 0], [0, 0, 0], [0, 0, 1])

    def test_images(self):
        good = np.zeros((30, 40, 3), np.float32)
        bad = good.copy()
        bad[2, 5, 1] = np.nan
        self.refuses("render .* row 2, column 5", splat4d.metrics, bad, good)
        self.refuses("truth .* shape", splat4d.metrics, good, good[..., :2])
        self.refuses("40x30", splat4d.metrics, good, good[:, :20])
        self.refuses("render has the dtype int64", splat4d.metrics, good.astype(np.int64), good)
        self.refuses("render has the dtype complex64", splat4d.metrics, good.astype(np.complex64), good)
        self.refuses("truth has the dtype <U7", splat4d.metrics, good, "picture")
        self.refuses("0x30 pixels", splat4d.metrics, good[:, :0], good[:, :0])
        self.refuses("render .* row 2, column 5", splat4d.photometric, bad, good)
        self.refuses("lambda_dssim is 1.5", splat4d.photometric, good, good, 1.5)

    def test_arrays(self):
        camera = splat4d.Camera(40, 30, 50.0)
        picture = np.zeros((30, 40, 3), np.float32)

        def refuses(words, images, cameras=(camera,), *args, **options):
            self.refuses(words, splat4d.Capture.from_arrays, images, list(cameras), *args, folder=self.folder, **options)

        refuses("images of 2", [[picture], [picture]], times=[0.0])
        refuses(r"images\[0\]\[0\] has the shape \[40, 30, 3\]", [[picture.transpose(1, 0, 2)]], times=[0.0])
        refuses(r"dtype int64", [[picture.astype(np.int64)]], times=[0.0])
        refuses(r"images\[0\]\[0\] is not an array", [["picture"]], times=[0.0])
        refuses(r"is 1.5 at row 0, column 0", [[picture + 1.5]], times=[0.0])
        bad = picture.copy()
        bad[3, 4] = np.nan
        refuses("is NaN at row 3, column 4", [[bad]], times=[0.0])
        refuses("no times", [[picture, picture]])
        refuses("there are 2 images", [[picture, picture]], times=[0.0])
        refuses(r"times\[1\] is NaN", [[picture, picture]], times=[0.0, np.nan])
        refuses("points", [[picture]], times=[0.0], points=[[1, 2]])
        refuses("row 1 of points", [[picture]], times=[0.0], points=[[1, 2, 3], [1, np.inf, 3]])
        refuses("colors", [[picture]], times=[0.0], points=[[1, 2, 3]], colors=[[2, 2, 2]])
        refuses("names", [[picture]], times=[0.0], names=["a", "b"])
        refuses("invalid name", [[picture]], times=[0.0], names=["../a"])
        refuses("2 poses for 1 images", [[picture]], [[camera, camera]], times=[0.0])
        refuses("expected Camera objects", [[picture]], [["camera"]], times=[0.0])
        refuses(r"images\[1\]\[0\]", [[picture], [picture + 2]], [camera, camera], times=[0.0])
        self.assertEqual(list(self.folder.rglob("*")), [], "nothing of it is left")
        mine = self.folder / "images/cam00/000000.png"
        mine.parent.mkdir(parents=True)
        mine.write_bytes(b"mine")
        refuses("exists already", [[picture]], times=[0.0])
        self.assertEqual(mine.read_bytes(), b"mine")
        before = set(pathlib.Path("/tmp").glob("tmp*")) if pathlib.Path("/tmp").is_dir() else set()
        self.refuses("no times", splat4d.Capture.from_arrays, [[picture, picture]], [camera])
        gc.collect()
        if before:
            self.assertLessEqual({p for p in pathlib.Path("/tmp").glob("tmp*") if (p / "capture.json").exists()}, before)

    def test_rounds_of_errors_leave_no_memory(self):
        """Every round makes and drops some megabytes, of which nothing may stay."""
        if not pathlib.Path("/proc/self/statm").exists():
            self.skipTest("needs Linux")
        scene = splat4d.open(PLAYABLE)
        camera = scene.cameras[0][1]
        picture = np.zeros((camera.height, camera.width, 3), np.float32)
        bad = np.full_like(picture, np.nan)

        def round_():
            for call in [
                lambda: splat4d.metrics(bad, picture),
                lambda: splat4d.photometric(picture, bad),
                lambda: splat4d.Capture.from_arrays([[picture, bad]], [camera], times=[0.0, 1.0]),
                lambda: scene.render(camera, 0.1, background=[0, 1]),
                lambda: splat4d.open(__file__),
                lambda: splat4d.train(KNIGHT, self.folder / "never", iteratons=3),
            ]:
                with self.assertRaises(splat4d.Error):
                    call()
            return scene.at(0.3).sh, scene.tracks(every=500, times=[0.2]), splat4d.photometric(picture, picture)

        def resident():
            gc.collect()
            return int(pathlib.Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

        for _ in range(WARM):
            round_()
        before = resident()
        for _ in range(ROUNDS):
            round_()
        self.assertLess(resident() - before, ROUNDS * LEAK)

    def test_missing_images_are_named(self):
        camera = splat4d.Camera(40, 30, 50.0)
        picture = np.zeros((30, 40, 3), np.uint8)
        capture = splat4d.Capture.from_arrays([[picture, picture]], [camera], fps=30, folder=self.folder / "take")
        pathlib.Path(capture[1].file).unlink()
        self.assertEqual(capture.image(0).shape, (30, 40, 3))
        with self.assertRaisesRegex(splat4d.Error, "000001.png") as caught:
            capture.image(1)
        self.assertEqual(caught.exception.kind, "io")
        with self.assertRaises(TypeError):
            with open(capture[0].file, "rb") as file:
                pass
            splat4d.open(file)

    def test_captures(self):
        with self.assertRaises(splat4d.Error):
            splat4d.Capture(self.folder)
        self.refuses("names no capture", splat4d.Capture, KNIGHT, iterations=3)
        capture = splat4d.Capture(KNIGHT, downscale=8)
        self.assertEqual(capture.image(-1).shape, (37, 50, 3))
        with self.assertRaises(IndexError):
            capture[10_000]

    def test_settings(self):
        def refuses(words, **settings):
            self.refuses(words, splat4d.train, KNIGHT, self.folder / "run", **settings)
            self.assertFalse((self.folder / "run").exists(), "nothing is left of what did not begin")

        refuses("iteration", iterations=-3)
        refuses("`iteratons`.*iterations", iteratons=30)
        refuses("None", iterations=None)
        refuses("quality", quality="superb")
        refuses("motion", motion="wobbly")
        refuses("minutes", minutes=-1.0, **SHORT)
        refuses("ssm", motion="spacetime", ssm__layers=2)
        (self.folder / "taken").mkdir()
        (self.folder / "taken/mine.txt").write_text("mine")
        self.refuses("not empty", splat4d.train, KNIGHT, self.folder / "taken", **SHORT)
        with self.assertRaisesRegex(splat4d.Error, "recipe.toml"):
            splat4d.resume(self.folder / "taken")
        self.assertEqual([f.name for f in (self.folder / "taken").iterdir()], ["mine.txt"])

    def test_words_of_the_command(self):
        self.refuses("unrecognized subcommand", splat4d.command, "paint")
        with self.assertRaisesRegex(splat4d.Error, "--fast") as caught:
            splat4d.command("bake", "x", "--fast")
        self.assertNotIn("Usage", str(caught.exception))
        with self.assertRaisesRegex(splat4d.Error, "nowhere"):
            splat4d.command("bake", "nowhere", "-o", self.folder / "x.s4d")
