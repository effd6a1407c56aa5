"""Readers of `.s4d` that are not splat4d itself: the NumPy reader, libs4d in C, and the Blender add-on where `bpy` is installed."""

import ast
import importlib.util
import json
import os
import pathlib
import shutil
import subprocess
import sys
import tempfile
import unittest
import zipfile

import numpy as np
from common import PLAYABLE, ROOT, InFolder, module

CLIENTS = ROOT / "clients"
SET = CLIENTS / "conformance"
# Longest that the NumPy reader may be: the format has to stay easy to read.
MOST_LINES = 600
# Damaged copies of each file that libs4d reads.
MUTANTS = 20_000
SANITIZE = ["-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
WARN = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Werror"]


s4d = module(CLIENTS / "python/s4d.py", "s4d")


class NumpyReader(unittest.TestCase):
    def test_the_conformance_set(self):
        wrong, count = s4d.conformance(SET)
        self.assertEqual(wrong, [])
        self.assertGreater(count, 30)

    def test_only_numpy_is_imported(self):
        text = (CLIENTS / "python/s4d.py").read_text("utf-8")
        self.assertLessEqual(len(text.splitlines()), MOST_LINES)
        names = set()
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                names.add(node.module)
        self.assertEqual({n for n in names if n.split(".")[0] not in sys.stdlib_module_names}, {"numpy"})

    def test_differences_are_found(self):
        want = json.loads((SET / "sh1.json").read_text("utf-8"))
        scene = s4d.Scene.open(SET / "sh1.s4d")
        self.assertEqual(s4d.compare(scene, want), [])
        want["at"][2]["gaussians"][0][4] += 1e-3
        want["at"][3]["rendered"] += 1
        self.assertEqual(len(s4d.compare(scene, want)), 2)

    def test_it_reads_what_splat4d_reads(self):
        import splat4d

        theirs, ours = splat4d.open(str(PLAYABLE)), s4d.Scene.open(PLAYABLE)
        for t in np.linspace(*ours.clip, 10):
            a, b = theirs.at(float(t)), ours.at(t)
            for have, want in [(b.position, a.means), (b.rotation, a.quats), (b.scale, a.scales)]:
                self.assertLess(np.abs(have - want).max(), 1e-5)
            # splat4d keeps opacities as logits, which end at 0.9999.
            self.assertLess(np.abs(b.opacity - a.opacities).max(), 1.1e-4)


@unittest.skipUnless(shutil.which("cc"), "no C compiler")
class LibS4D(InFolder):
    @classmethod
    def setUpClass(cls):
        build = tempfile.TemporaryDirectory()
        cls.addClassCleanup(build.cleanup)
        cls.tool = pathlib.Path(build.name) / "s4d_tool"
        sources = [str(CLIENTS / "c" / name) for name in ("s4d.c", "s4d_tool.c")]
        done = subprocess.run(["cc", *WARN, *SANITIZE, *sources, "-lm", "-o", cls.tool], capture_output=True, text=True)
        if "sanitize" in done.stderr or "asan" in done.stderr:
            # A compiler without the sanitizers' libraries.
            done = subprocess.run(["cc", *WARN, "-O1", *sources, "-lm", "-o", cls.tool], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr

    def run_tool(self, *arguments):
        return subprocess.run([self.tool, *map(str, arguments)], capture_output=True, text=True, timeout=600)

    def test_the_conformance_set(self):
        for path in sorted(SET.glob("*.json")):
            with self.subTest(path.stem):
                self.compare(json.loads(path.read_text("utf-8")))

    def compare(self, want):
        done = self.run_tool("dump", SET / want["file"], *want["eye"], *[m["time"] for m in want["at"]])
        self.assertEqual((done.returncode, done.stderr), (0, ""))
        moments, extra = [], {}
        for line in done.stdout.splitlines():
            words = line.split()
            if words[0] == "version":
                major, minor = want["version"]
                self.assertEqual(words[1:], [str(major), str(minor), "records", str(want["records"])])
            elif words[0] == "time":
                moments.append({})
                self.assertEqual(int(words[2]), want["at"][len(moments) - 1]["rendered"])
            else:
                key = (int(words[0]), int(words[1]))
                moments[-1][key] = [float(x) for x in words[2:16]]
                extra[key] = (int(words[17]), [float(x) for x in words[18:]])
        for have, moment in zip(moments, want["at"], strict=True):
            self.assertEqual(len(have), moment["rendered"])
            for page, row, *numbers in moment["gaussians"]:
                mine = np.array(have[page, row])
                mine[3:7] *= 1 if mine[3:7] @ numbers[3:7] >= 0 else -1
                self.assertTrue(s4d.close(mine, numbers), f"{page} {row} at {moment['time']}: {mine} {numbers}")
        for (page, row), (label, feature) in extra.items():
            labels = want.get("labels", {}).get(str(page))
            self.assertEqual(None if label == 255 else label, labels[row] if labels else None)
            features = want.get("features", {}).get(str(page))
            expected = (features[row] if features else None) or [0.0] * len(feature)
            self.assertTrue(s4d.close(feature, expected))

    def test_invalid_files_are_refused(self):
        for name in json.loads((SET / "refused/refused.json").read_text("utf-8")):
            done = self.run_tool("verify", SET / "refused" / name)
            self.assertEqual(done.returncode, 2, name)
            self.assertIn("playback file", done.stderr, name)

    def test_damaged_files_are_survived(self):
        for seed, name in enumerate(["sh1", "masks", "names", "growing", "raw"]):
            done = self.run_tool("mutate", SET / f"{name}.s4d", MUTANTS, seed)
            self.assertEqual((done.returncode, done.stderr), (0, ""), name)
            accepted = int(done.stdout.split()[0])
            self.assertTrue(0 < accepted < MUTANTS, f"{name}: {done.stdout}")

    def test_a_file_that_is_cut_short_plays_where_its_pages_are(self):
        whole = (SET / "motion.s4d").read_bytes()
        last = max(s.offset + s.stored for s in s4d.Scene(whole).sections)
        cut = self.folder / "cut.s4d"
        cut.write_bytes(whole[: last - 1])
        self.assertEqual(self.run_tool("verify", cut).returncode, 2)
        self.assertEqual(self.run_tool("dump", cut, 0, 0, 0, 0).returncode, 0, "the first half is there")
        self.assertIn("cut short", self.run_tool("dump", cut, 0, 0, 0, 0.9).stderr)


@unittest.skipUnless(importlib.util.find_spec("bpy"), "no bpy: the Blender add-on is not tested")
class Blender(InFolder):
    def test_attributes_over_time(self):
        done = subprocess.run([sys.executable, __file__, "--blender", str(self.folder)], capture_output=True, text=True)
        self.assertEqual(done.returncode, 0, done.stderr)


def blender(folder):
    """Imports a file with the packed add-on and compares ten times. In a process of its own: bpy holds global state."""
    import bpy
    from mathutils import Vector

    pack = module(CLIENTS / "blender/pack.py", "pack")
    archive = pathlib.Path(folder) / "addon.zip"
    pack.pack(archive)
    zipfile.ZipFile(archive).extractall(pathlib.Path(folder) / "splat4d_addon")
    sys.path.insert(0, folder)
    import splat4d_addon

    bpy.ops.wm.read_factory_settings(use_empty=True)
    splat4d_addon.register()
    assert bpy.ops.import_scene.s4d(filepath=str(PLAYABLE), first_frame=11) == {"FINISHED"}
    (obj,) = bpy.data.objects
    scene, truth = bpy.context.scene, s4d.Scene.open(PLAYABLE)
    assert (scene.frame_start, scene.frame_end) == (11, 40), (scene.frame_start, scene.frame_end)
    up = obj.matrix_world.to_3x3() @ Vector(truth.meta["up"])
    assert (up - Vector((0, 0, 1))).length < 1e-5, up
    counts = set()
    for frame in np.linspace(11, 40, 10).round().astype(int):
        scene.frame_set(int(frame))
        g, mesh = truth.at((frame - 11) / truth.meta["fps"]), obj.data
        counts.add(len(g.row))
        assert len(mesh.vertices) == len(g.row), (frame, len(mesh.vertices), len(g.row))
        wanted = {"position": ("vector", g.position), "rotation": ("value", g.rotation), "scale": ("vector", g.scale),
                  "opacity": ("value", g.opacity), "base_color": ("vector", g.base_color)}
        wanted |= {f"sh_{k + 1}": ("vector", g.sh[:, k]) for k in range(g.sh.shape[1])}
        for name, (field, value) in wanted.items():
            have = np.empty(value.size, np.float32)
            mesh.attributes[name].data.foreach_get(field, have)
            error = np.abs(have - value.ravel()) / np.maximum(1, np.abs(value.ravel()))
            assert error.max() < 1e-5, (name, frame, error.max())
        depsgraph = bpy.context.evaluated_depsgraph_get()
        instances = [i for i in depsgraph.object_instances if i.is_instance]
        assert len(instances) == len(g.row), (len(instances), len(g.row))
    assert len(counts) > 5, "births and deaths"
    missing = pathlib.Path(folder) / "damaged.s4d"
    missing.write_bytes(b"\x89S4D nonsense")
    try:
        bpy.ops.import_scene.s4d(filepath=str(missing))
        raise AssertionError("a damaged file was imported")
    except RuntimeError as e:
        assert "not a playback file" in str(e), e
    splat4d_addon.unregister()


if __name__ == "__main__":
    if sys.argv[1:2] == ["--blender"]:
        blender(sys.argv[2])
        # bpy's own clean-up at exit is not what is tested.
        sys.stdout.flush()
        os._exit(0)
    unittest.main()
