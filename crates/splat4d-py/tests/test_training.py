"""Training: the command's bits, interruptions, functions of the caller's."""

import csv
import os
import pathlib
import signal
import subprocess
import sys
import unittest

import numpy as np

import splat4d
from common import KNIGHT, SHORT, InFolder


def darker(picture, truth, view):
    """Mean of the picture, and its gradient."""
    return float(picture.mean()), np.full(picture.shape, 1 / picture.size, np.float32)


class Training(InFolder):
    def train(self, name, **more):
        return splat4d.train(KNIGHT, self.folder / name, **{**SHORT, **more})

    def test_training_gives_the_bits_of_the_command(self):
        events = []
        run = self.train("python", progress=events.append)
        sets = [word for key, value in SHORT.items() for word in ("--set", f"{key}={value}")]
        out = self.folder / "command"
        program = [sys.executable, "-m", "splat4d", "train", KNIGHT, "-o", out, "--no-eval", "-q", *sets]
        subprocess.run(program, check=True, cwd=self.folder)
        self.assertEqual(self.scene_bytes(run), self.scene_bytes(splat4d.Run(out)))
        self.assertEqual({"started", "progress", "finished"} - {e["type"] for e in events}, set())
        self.assertTrue(run.finished and run.iteration == 60)
        scores = run.evaluate()
        self.assertEqual(scores["PSNR"], run.results["PSNR"])
        self.assertGreater(scores["PSNR"], 10)
        self.assertTrue(run.status()["finished"])
        self.assertIn("PSNR", pathlib.Path(run.report()).read_text())
        rows = splat4d.compare([run.path], [self.folder / "table.csv"])
        self.assertEqual(rows[0]["scores"]["PSNR"], run.results["PSNR"])
        self.assertTrue((self.folder / "table.csv").is_file())

    def test_a_run_is_compressed_and_only_a_cut_one_predicted(self):
        run = self.train("whole")
        small = run.compress(self.folder / "small", prune=0.5, fine_tune=4, evaluate=False)
        self.assertTrue((small.path / "scene.s4d").is_file())
        self.assertLess(len(small.scene()), len(run.scene()))
        for work in (lambda: run.compress(self.folder / "x", prune=0.5, level=1), run.predict, run.label):
            with self.assertRaises(splat4d.Error) as raised:
                work()
            self.assertEqual(raised.exception.kind, "bad_input")

    def test_a_capture_is_trained_with_its_options_unless_overridden(self):
        capture = splat4d.Capture(KNIGHT, downscale=8, hold_out="camera=0")
        few = dict(iterations=50, max_frames=2, motion="still")
        recipe = lambda run: (run.path / "recipe.toml").read_text()
        same = splat4d.train(capture, self.folder / "same", **few)
        self.assertRegex(recipe(same), r"downscale = 8\n(.*\n)*hold_out = \"camera=0\"|hold_out = .*\n(.*\n)*downscale = 8")
        other = splat4d.train(capture, self.folder / "other", downscale=16, **{**few, "motion": "deform-mlp"})
        self.assertIn("downscale = 16", recipe(other))
        # Another reader of CSV: the first stage of this model has a comma in its name.
        with open(other.path / "metrics.csv", newline="") as table:
            rows = list(csv.DictReader(table))
        self.assertIn("deform-mlp, still", {row["stage"] for row in rows})
        self.assertTrue(all(None not in row and float(row["psnr"]) > 0 for row in rows))

    def test_an_interruption_saves_and_the_rest_is_the_same(self):
        whole = self.train("whole")
        steps = []

        def interrupt(event):
            if event["type"] == "checkpoint" and event["iteration"] == 20:
                os.kill(os.getpid(), signal.SIGINT)

        with self.assertRaises(KeyboardInterrupt) as caught:
            self.train("stopped", progress=interrupt)
        if sys.version_info >= (3, 11):
            self.assertIn("resume", "".join(caught.exception.__notes__))
        stopped = splat4d.Run(self.folder / "stopped")
        self.assertTrue(not stopped.finished and 20 <= stopped.iteration < 60)
        done = splat4d.resume(stopped, progress=lambda event: steps.append(event))
        self.assertTrue(done.finished and steps)
        self.assertEqual(self.scene_bytes(done), self.scene_bytes(whole))

    def test_an_exception_in_progress_is_raised_and_the_run_continues(self):
        def fail(event):
            if event["type"] == "checkpoint":
                raise ValueError("no more")

        with self.assertRaisesRegex(ValueError, "no more"):
            self.train("stopped", progress=fail)
        self.assertTrue(splat4d.resume(self.folder / "stopped").finished)

    def test_a_loss_is_applied_and_a_failing_one_changes_no_bit(self):
        plain, whole = self.train("plain"), self.train("whole", loss=darker)
        self.assertNotEqual(self.scene_bytes(plain), self.scene_bytes(whole))

        def fails(picture, truth, view):
            self.assertEqual((picture.shape, picture.dtype), (truth.shape, np.float32))
            if view.iteration == 30:
                raise ZeroDivisionError("in the loss")
            return darker(picture, truth, view)

        with self.assertRaisesRegex(ZeroDivisionError, "in the loss"):
            self.train("failed", loss=fails)
        with self.assertRaisesRegex(splat4d.Error, "loss"):
            splat4d.resume(self.folder / "failed")
        done = splat4d.resume(self.folder / "failed", loss=darker)
        self.assertEqual(self.scene_bytes(done), self.scene_bytes(whole))

    def test_invalid_results_of_a_loss_are_errors(self):
        for name, answer, words in [
            ("none", lambda p: None, "did not return"),
            ("shape", lambda p: (0.0, p[:-1]), "shape"),
            ("nan", lambda p: (float("nan"), p), "NaN"),
            ("text", lambda p: (0.0, "gradient"), "array of numbers"),
        ]:
            with self.subTest(name), self.assertRaisesRegex(splat4d.Error, words):
                self.train(name, loss=lambda p, t, v, answer=answer: answer(p))
            self.assertFalse(splat4d.Run(self.folder / name).finished)

    def test_images_in_memory_become_a_capture_and_a_run_that_resumes(self):
        scene = splat4d.open(KNIGHT.parent / "knight.s4d")
        cameras = [camera.downscaled(8) for _, camera in scene.cameras[:4]]
        times = [0.0, 0.3, 0.6]
        images = [[scene.render(camera, t).clip(0, 1) for t in times] for camera in cameras]
        folder = self.folder / "take"
        capture = splat4d.Capture.from_arrays(
            images, cameras, times, scene.at(0.0).means[::20], up=scene.up, hold_out=["cam03"], folder=folder
        )
        self.assertEqual((len(capture), capture.times, capture.cameras[0]), (12, times, "cam00"))
        np.testing.assert_allclose(capture.image(4), images[1][1], atol=1e-5)
        self.assertEqual([capture[i].split for i in (0, -1)], ["train", "test"])
        stopped = self.folder / "run"

        def stop(event):
            if event["type"] == "checkpoint" and event["iteration"] > 0:
                raise InterruptedError

        with self.assertRaises(InterruptedError):
            splat4d.train(capture, stopped, iterations=60, checkpoint_interval=20, progress=stop)
        run = splat4d.resume(stopped)
        self.assertGreater(run.evaluate()["PSNR"], 10)
        # Bytes stay bytes, and a temporary capture leaves nothing.
        eight = [[(255 * i + 0.5).astype(np.uint8) for i in of] for of in images]
        temporary = splat4d.Capture.from_arrays(np.array(eight), cameras, times)
        np.testing.assert_array_equal(temporary.image(0), np.float32(eight[0][0]) / np.float32(255))
        path = pathlib.Path(temporary.path)
        self.assertTrue(path.is_dir())
        del temporary
        self.assertFalse(path.exists())
