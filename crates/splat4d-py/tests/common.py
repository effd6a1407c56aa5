"""What the tests share: where the repository is, and short settings of training."""

import importlib.util
import pathlib
import shutil
import sys
import tempfile
import unittest

ROOT = pathlib.Path(__file__).resolve().parents[3]
KNIGHT = ROOT / "examples/knight"
PLAYABLE = ROOT / "examples/knight.s4d"
# A few seconds of training: the images are small and few.
SHORT = dict(iterations=60, downscale=8, max_frames=3, checkpoint_interval=20, motion="spacetime")


def module(path, name):
    """The module in a file that is in no package."""
    spec = importlib.util.spec_from_file_location(name, path)
    made = importlib.util.module_from_spec(spec)
    sys.modules[name] = made
    spec.loader.exec_module(made)
    return made


class InFolder(unittest.TestCase):
    """A test with a folder of its own."""

    def setUp(self):
        self.folder = pathlib.Path(tempfile.mkdtemp())
        self.addCleanup(shutil.rmtree, self.folder)

    def scene_bytes(self, run):
        return (pathlib.Path(run.path) / "scene.safetensors").read_bytes()
