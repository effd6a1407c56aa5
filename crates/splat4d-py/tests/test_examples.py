"""Examples and notebooks run as they stand, and examples stay short."""

import contextlib
import importlib.util
import io
import json
import os
import pathlib
import subprocess
import sys
import unittest

import splat4d
from common import KNIGHT, PLAYABLE, ROOT, InFolder

FOLDER = ROOT / "crates/splat4d-py/examples"
# Lines of an example, at most, but for those that say all archetypes of Rerun, or hold a network.
LINES = 20
LONG = ["to_rerun.py", "torch_motion.py"]
# Bytes of a notebook with its outputs, at most: GitHub shows small ones at once.
NOTEBOOK_BYTES = 300_000


class Examples(InFolder):
    def run_example(self, name, given, *written, further=()):
        done = subprocess.run(
            [sys.executable, FOLDER / name, given, *further], cwd=self.folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        self.assertEqual(done.returncode, 0, done.stdout)
        for file in written:
            self.assertTrue((self.folder / file).exists(), f"{name} writes {file}")
        return done.stdout

    def test_examples_are_short_and_all_are_run(self):
        here = pathlib.Path(__file__).read_text()
        for example in FOLDER.glob("*.py"):
            self.assertIn(f'"{example.name}"', here)
            self.assertTrue(len(example.read_text().splitlines()) <= LINES or example.name in LONG, example.name)

    def test_gaussians(self):
        self.assertIn("alive", self.run_example("gaussians.py", PLAYABLE, "moment.npz"))

    def test_turn(self):
        self.run_example("turn.py", PLAYABLE, "turn0.ppm", "turn7.ppm")

    def test_learn(self):
        self.assertIn("dB", self.run_example("learn.py", KNIGHT, "learnt.s4d", "learnt.html"))

    def test_own_loss(self):
        self.assertIn("50 steps", self.run_example("own_loss.py", KNIGHT))

    def test_from_arrays(self):
        self.run_example("from_arrays.py", PLAYABLE, "again/results.json")

    @unittest.skipUnless(importlib.util.find_spec("torch"), "PyTorch is not installed")
    def test_torch_loss(self):
        self.assertIn("50 steps", self.run_example("torch_loss.py", KNIGHT))

    @unittest.skipUnless(importlib.util.find_spec("torch"), "PyTorch is not installed")
    def test_torch_motion(self):
        told = self.run_example("torch_motion.py", KNIGHT, "out/run/scene.s4d", further=["out", "20"])
        self.assertIn("plays without Python", told)

    @unittest.skipUnless(importlib.util.find_spec("rerun"), "Rerun is not installed")
    def test_to_rerun(self):
        self.run_example("to_rerun.py", PLAYABLE, "scene.rrd")

    def run_notebook(self, name):
        """Runs the code cells in order and returns their names; figures need matplotlib, which is optional."""
        book = json.loads((FOLDER / name).read_text(encoding="utf-8"))
        code = ["".join(cell["source"]) for cell in book["cells"] if cell["cell_type"] == "code"]
        before = os.getcwd()
        os.chdir(self.folder)
        self.addCleanup(os.chdir, before)
        os.symlink(KNIGHT.parent, "examples")
        os.environ.setdefault("MPLBACKEND", "Agg")
        names = {"__name__": "__main__"}
        with contextlib.redirect_stdout(io.StringIO()):
            for number, cell in enumerate(code):
                exec(compile(cell, f"{name}, cell {number}", "exec"), names)
        return names

    def test_all_notebooks_are_run(self):
        here = pathlib.Path(__file__).read_text()
        for book in FOLDER.glob("*.ipynb"):
            self.assertIn(f'"{book.name}"', here)
            self.assertLess(book.stat().st_size, NOTEBOOK_BYTES, book.name)

    def test_notebook(self):
        names = self.run_notebook("knight.ipynb")
        self.assertTrue(names["run"].finished and names["losses"])
        self.assertIsInstance(names["scene"], splat4d.Scene)

    def test_notebook_of_motion(self):
        names = self.run_notebook("from_scratch_motion.ipynb")
        results = names["results"]
        self.assertLess(max(results["gradient"], results["splat_gradient"]), 1e-6)
        # Measured: 89 % in position, 84 % in L1, 15 dB.
        self.assertTrue(names["always"], "dynamic is better at every timestep")
        self.assertGreater(results["position_better"], 80)
        self.assertGreater(results["pixels_better"], 75)
        self.assertGreater(results["gain_db"], 10)
        # The classic figure of 39 % lies between encodings in time alone and in space alone.
        self.assertLess(max(results["better_0_0"], results["better_0_2"]), 39)
        self.assertGreater(results["better_4_0"], 39)
        self.assertLess(results["spread"][0], 0.1 * results["spread"][1], "the cosine schedule comes to rest")
        self.assertEqual(sorted(results["jerk"], reverse=True), results["jerk"])
        self.assertEqual(sorted(results["fidelity"]), results["fidelity"])
        self.assertLess(results["wall_0.15"][2], 0.1, "followed past a narrow wall")
        self.assertGreater(results["wall_0.45"][2], 0.2, "lost behind a wide wall")
        slow, _, fast = (results[f"tear_{duration}"] for duration in names["TEARS"])
        self.assertGreater(fast[0], 5 * slow[0])
        self.assertGreater(fast[2], fast[0], "the velocity penalty makes it worse")
        self.assertIn("<iframe", names["sliders"]._repr_html_())

    def test_notebook_of_video(self):
        names = self.run_notebook("from_scratch_video.ipynb")
        results = names["results"]
        self.assertLess(results["flow_moving"], 0.15)
        self.assertGreater(results["flow_edge"], 1.5 * results["flow_moving"])
        # One camera sees no difference between scenes that differ by two units; the second one does.
        self.assertLess(results["ambiguity_a"][1], 1e-3)
        self.assertGreater(results["ambiguity_b"][1], 0.3)
        self.assertGreater(results["ambiguity_3d"], 1)
        self.assertLess(results["exact"], 1e-9)
        self.assertLess(results["stereo_moving"], 0.1)
        for wide, narrow in zip(results["baselines"][1:], results["baselines"]):
            self.assertAlmostEqual(narrow / wide, 2, delta=0.2)
        self.assertLess(results["known depth"][0], 0.15)
        self.assertLess(results["known depth"][0], results["two cameras"][0])
        self.assertLess(results["fit"], 0.5 * results["difference"])
        self.assertIn("<iframe", names["slider"]._repr_html_())
