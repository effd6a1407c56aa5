"""Examples and the notebook run as they stand, and examples stay short."""

import importlib.util
import json
import os
import pathlib
import subprocess
import sys
import unittest

import splat4d
from common import KNIGHT, PLAYABLE, ROOT, InFolder

FOLDER = ROOT / "crates/splat4d-py/examples"
# Lines of an example, at most; the one for Rerun says all of its archetypes.
LINES = 20


class Examples(InFolder):
    def run_example(self, name, given, *written):
        done = subprocess.run(
            [sys.executable, FOLDER / name, given], cwd=self.folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        self.assertEqual(done.returncode, 0, done.stdout)
        for file in written:
            self.assertTrue((self.folder / file).exists(), f"{name} writes {file}")
        return done.stdout

    def test_they_are_short_and_all_are_run(self):
        here = pathlib.Path(__file__).read_text()
        for example in FOLDER.glob("*.py"):
            self.assertIn(f'"{example.name}"', here)
            self.assertTrue(len(example.read_text().splitlines()) <= LINES or example.name == "to_rerun.py", example.name)

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

    @unittest.skipUnless(importlib.util.find_spec("rerun"), "Rerun is not installed")
    def test_to_rerun(self):
        self.run_example("to_rerun.py", PLAYABLE, "scene.rrd")

    def test_notebook(self):
        book = json.loads((FOLDER / "knight.ipynb").read_text())
        code = ["".join(cell["source"]) for cell in book["cells"] if cell["cell_type"] == "code"]
        before = os.getcwd()
        os.chdir(self.folder)
        self.addCleanup(os.chdir, before)
        os.symlink(KNIGHT.parent, "examples")
        names = {"__name__": "__main__"}
        for number, cell in enumerate(code):
            exec(compile(cell, f"cell {number}", "exec"), names)
        self.assertTrue(names["run"].finished and names["losses"])
        self.assertIsInstance(names["scene"], splat4d.Scene)
