"""Captures rendered from Blender scenes (clients/blender/capture.py), compared with exact geometry. Needs `bpy`, which no requirement
installs (300 MB); `SPLAT4D` names the command that reads the captures."""

import hashlib
import importlib.util
import json
import math
import os
import shutil
import signal
import struct
import subprocess
import sys
import time
import unittest
import zlib

import numpy as np
from common import ROOT, InFolder, module

SCRIPT = ROOT / "clients/blender/capture.py"
SMALL = ["--size", "64", "48", "--samples", "4"]
COMMAND = os.environ.get("SPLAT4D") or shutil.which("splat4d")
# Rays at the centre of a pixel and around it have to hit one surface, in pixels: others see an edge.
AROUND = 0.02
MOST_DEPTH_ERROR = 1e-3
MOST_FLOW_ERROR = 0.1


def capture(*args, code=0):
    """Runs the script in a process of its own: its standard error."""
    done = subprocess.run([sys.executable, SCRIPT, *map(str, args)], capture_output=True, text=True, timeout=600)
    assert done.returncode == code, f"exit {done.returncode}\n{done.stdout}\n{done.stderr}"
    return done.stderr


def png(path):
    """A PNG with the filter Up, as the script writes it."""
    data = path.read_bytes()
    width, height, depth, kind = struct.unpack(">IIBB", data[16:26])
    at, packed = 8, b""
    while at < len(data):
        size, = struct.unpack_from(">I", data, at)
        if data[at + 4:at + 8] == b"IDAT":
            packed += data[at + 8:at + 8 + size]
        at += size + 12
    rows = np.frombuffer(zlib.decompress(packed), np.uint8).reshape(height, -1)
    assert (rows[:, 0] == 2).all()
    values = np.cumsum(rows[:, 1:], axis=0, dtype=np.uint8)
    values = np.ascontiguousarray(values).view(">u2" if depth == 16 else np.uint8)
    return values.reshape(height, width, {0: 1, 2: 3, 4: 2, 6: 4}[kind])


def depth_map(path):
    """An OpenEXR depth map of one channel, compressed in blocks of 16 rows."""
    data = path.read_bytes()
    width, height = (n + 1 for n in struct.unpack_from("<2i", data, data.index(b"dataWindow\0box2i\0") + 29))
    at = data.index(b"screenWindowWidth\0float\0") + 33
    out = []
    for place in struct.unpack_from(f"<{-(-height // 16)}Q", data, at):
        top, size = struct.unpack_from("<ii", data, place)
        rows = min(16, height - top)
        raw = data[place + 8:place + 8 + size]
        if size < 4 * width * rows:
            steps = np.frombuffer(zlib.decompress(raw), np.uint8).astype(int)
            steps[1:] -= 128
            halves = (np.cumsum(steps) % 256).astype(np.uint8)
            raw = np.stack([halves[:len(halves) // 2], halves[len(halves) // 2:]], 1).tobytes()
        out.append(np.frombuffer(raw, "<f4").reshape(rows, width))
    return np.concatenate(out)


def flow_map(path):
    stored = png(path).astype(float)
    return (stored[..., :2] - 32768) / 64, stored[..., 2] == 1


def contents(folder):
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(folder.rglob("*")) if p.is_file()}


class Geometry:
    """The demonstration's surfaces at every frame, from Blender's meshes."""

    def __init__(self, demo, frames):
        import bpy

        self.script = module(SCRIPT, "blender_capture")
        sys.path.insert(0, str(SCRIPT.parent))
        import demos

        demos.build(demo, frames[-1])
        self.at = []
        for frame in frames:
            bpy.context.scene.frame_set(frame)
            self.at.append(self.script.surfaces())
        self.trees = [self.script.tree(found) for found in self.at]
        self.vertices = [np.concatenate([s.vertices for s in found.values()]) for found in self.at]
        self.triangles = []
        for found in self.at:
            starts = np.cumsum([0] + [len(s.vertices) for s in found.values()])
            self.triangles.append(np.concatenate([s.triangles + start for s, start in zip(found.values(), starts)]))


    def seen(self, pose, lens, frame, u, v):
        """Number of the triangle at a pixel position and the place, or none."""
        ray = np.array([(u - lens[2]) / lens[0], (v - lens[3]) / lens[1], 1.0])
        place, _, face, _ = self.trees[frame].ray_cast((-pose[:3, :3].T @ pose[:3, 3]).tolist(), (pose[:3, :3].T @ ray).tolist())
        return face, place

    def expected(self, poses, lens, frame, u, v):
        """Depth, position in the next frame, and whether rays around the position see the same triangle."""
        face, place = self.seen(poses[frame], lens, frame, u, v)
        if face is None:
            return 0, (0, 0), False
        sure = all(self.seen(poses[frame], lens, frame, u + dx, v + dy)[0] == face
                   for dx in (-AROUND, AROUND) for dy in (-AROUND, AROUND))
        after = min(frame + 1, len(poses) - 1)
        corners = self.triangles[frame][face]
        a, b, c = self.vertices[frame][corners]
        two = np.linalg.lstsq(np.stack([b - a, c - a], 1), np.array(place) - a, rcond=None)[0]
        moved = np.array([1 - two.sum(), *two]) @ self.vertices[after][corners]
        depth = (poses[frame][:3, :3] @ np.array(place) + poses[frame][:3, 3])[2]
        x, y, z = poses[after][:3, :3] @ moved + poses[after][:3, 3]
        return depth, (lens[0] * x / z + lens[2], lens[1] * y / z + lens[3]), sure


@unittest.skipUnless(importlib.util.find_spec("bpy"), "no bpy: captures from Blender are not tested")
class BlenderCapture(InFolder):
    def compared(self, demo, *options):
        """Largest errors of depth (share), flow (pixels) and of tracks against flow (pixels), with counts."""
        out = self.folder / f"{demo}{len(options)}"
        capture(out, "--demo", demo, *SMALL, "--frames", 1, 4, *(options or ("--count", 3)))
        about = json.loads((out / "capture.json").read_text("utf-8"))
        geometry = Geometry(demo, range(1, 5))
        errors, counts = np.zeros(3), np.zeros(3, int)
        for camera in about["cameras"]:
            poses = np.array(camera["world_to_camera"], float)
            poses = poses if poses.ndim == 3 else np.repeat(poses[None], 4, 0)
            lens = [camera[k] for k in ("fx", "fy", "cx", "cy")]
            tracks = np.load(out / camera["tracks"])
            xy, visible = tracks["tracks"].astype(float), tracks["visibility"]
            for frame in range(4):
                stored = depth_map(out / (camera["depth"] % frame))
                written, known = flow_map(out / (camera["flow"] % frame)) if frame < 3 else (None, None)
                for v in range(48):
                    for u in range(64):
                        depth, moved, sure = geometry.expected(poses, lens, frame, u + 0.5, v + 0.5)
                        if not sure:
                            continue
                        errors[0] = max(errors[0], abs(stored[v, u] - depth) / depth)
                        counts[0] += 1
                        if frame < 3 and known[v, u]:
                            errors[1] = max(errors[1], np.abs(written[v, u] + (u + 0.5, v + 0.5) - moved).max())
                            counts[1] += 1
                for point in np.flatnonzero(visible[frame] & visible[frame + 1]) if frame < 3 else ():
                    _, moved, sure = geometry.expected(poses, lens, frame, *xy[frame, point])
                    if sure:
                        errors[2] = max(errors[2], np.abs(xy[frame + 1, point] - moved).max())
                        counts[2] += 1
        print(f"{demo} {' '.join(map(str, options))}: depth {errors[0]:.2e} of {counts[0]} pixels, flow {errors[1]:.4f} px of {counts[1]}, "
              f"tracks {errors[2]:.4f} px of {counts[2]}", file=sys.stderr)
        self.assertLess(errors[0], MOST_DEPTH_ERROR)
        self.assertLess(errors[1], MOST_FLOW_ERROR)
        self.assertLess(errors[2], MOST_FLOW_ERROR)
        self.assertGreater(counts[1], 0.7 * counts[0])
        self.assertGreater(counts[2], 100)

    def test_depth_flow_and_tracks_are_exact(self):
        self.compared("table")

    def test_an_armature_and_an_arc_are_exact(self):
        self.compared("robot")

    def test_a_moving_camera_is_exact(self):
        self.compared("robot", "--moving", "--rig", "arc")

    def test_two_runs_and_a_continued_one_are_equal(self):
        options = ["--demo", "table", *SMALL, "--frames", 1, 3, "--count", 3, "--labels", "--subject", "cube,ball"]
        once, again, killed = (self.folder / n for n in ("once", "again", "killed"))
        capture(once, *options)
        capture(again, *options)
        # The name of a capture is that of its folder.
        rename = lambda files: {n: h for n, h in files.items() if n != "capture.json"}
        self.assertEqual(rename(contents(once)), rename(contents(again)))
        child = subprocess.Popen([sys.executable, SCRIPT, killed, *map(str, options)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        deadline = time.monotonic() + 60
        while not (killed / "images/cam01/0000.png").exists() and time.monotonic() < deadline and child.poll() is None:
            time.sleep(0.005)
        child.send_signal(signal.SIGKILL)
        child.wait()
        self.assertFalse((killed / "capture.json").exists())
        kept = (killed / "images/cam00/0000.png").stat().st_mtime_ns
        capture(killed, *options)
        self.assertEqual(kept, (killed / "images/cam00/0000.png").stat().st_mtime_ns)
        done = {n: h for n, h in rename(contents(killed)).items() if not n.endswith(".part")}
        self.assertEqual(rename(contents(once)), done)
        capture(killed, *options)
        error = capture(killed, *options, "--opaque", code=2)
        self.assertIn("opaque was False, now True", error)

    def test_ctrl_c_stops_after_the_render(self):
        out = self.folder / "out"
        child = subprocess.Popen([sys.executable, SCRIPT, out, "--demo", "table", *SMALL, "--frames", "1", "40"], stdout=subprocess.DEVNULL,
                                 stderr=subprocess.PIPE, text=True, preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))
        deadline = time.monotonic() + 60
        while not (out / "images/cam01/0000.png").exists() and time.monotonic() < deadline and child.poll() is None:
            time.sleep(0.005)
        child.send_signal(signal.SIGINT)
        _, error = child.communicate(timeout=60)
        self.assertEqual(child.returncode, 130, error)
        self.assertIn("The same command continues", error)
        self.assertEqual(list(out.rglob("*.part")), [])

    def test_masks_and_labels_name_objects(self):
        out = self.folder / "out"
        capture(out, "--demo", "table", *SMALL, "--frames", 1, 2, "--count", 3, "--labels", "--subject", "cube,ball")
        about = json.loads((out / "capture.json").read_text("utf-8"))
        numbers = [about["labels"].index(n) for n in ("cube", "ball")]
        for camera in about["cameras"]:
            mask, labels = png(out / (camera["masks"] % 0)), png(out / (camera["labels"] % 0))
            self.assertTrue(((mask == 255) == np.isin(labels, numbers)).all())
            self.assertGreater((mask == 255).sum(), 15)
            # Where nothing is, images are transparent.
            alpha = png(out / (camera["images"] % 0))[..., 3]
            self.assertTrue((labels[alpha == 0] == 0).all())
            self.assertGreater((alpha == 0).sum(), 100)

    def test_cameras_of_a_scene_with_shift_and_motion(self):
        import bpy
        from bpy_extras.object_utils import world_to_camera_view
        from mathutils import Vector

        bpy.ops.wm.read_factory_settings(use_empty=True)
        scene = bpy.context.scene
        bpy.ops.mesh.primitive_monkey_add(size=1)
        parent = bpy.data.objects.new("parent", None)
        parent.scale = (2, 2, 2)
        scene.collection.objects.link(parent)
        for name, fit in (("A.1", "VERTICAL"), ("B", "AUTO")):
            data = bpy.data.cameras.new(name)
            data.sensor_fit, data.lens, data.shift_x, data.shift_y, data.sensor_height = fit, 40, 0.1, -0.05, 20
            data.dof.use_dof = True
            thing = bpy.data.objects.new(name, data)
            thing.location, thing.rotation_euler, thing.parent = (0.3, -3, 0.6), (1.4, 0.05, 0.1), parent
            scene.collection.objects.link(thing)
        thing.keyframe_insert("location", frame=1)
        thing.location.x = 0.6
        thing.keyframe_insert("location", frame=3)
        scene.frame_end, scene.render.fps = 3, 25
        scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 96, 160, 50
        blend = self.folder / "my scene.blend"
        bpy.ops.wm.save_as_mainfile(filepath=str(blend))
        out = self.folder / "out"
        capture(out, "--blend", blend, "--rig", "scene", "--samples", 1)
        about = json.loads((out / "capture.json").read_text("utf-8"))
        self.assertEqual([c["name"] for c in about["cameras"]], ["A_1", "B"])
        self.assertEqual(about["fps"], 25)
        self.assertEqual(np.array(about["cameras"][0]["world_to_camera"]).shape, (4, 4))
        self.assertEqual(np.array(about["cameras"][1]["world_to_camera"]).shape, (3, 4, 4))
        for frame in range(3):
            scene.frame_set(frame + 1)
            scene.render.resolution_x, scene.render.resolution_y = 48, 80
            for camera, name in zip(about["cameras"], ("A.1", "B")):
                poses = np.array(camera["world_to_camera"])
                pose = poses if poses.ndim == 2 else poses[frame]
                for point in ((0, 0, 0), (0.4, 0.2, -0.3)):
                    x, y, z = pose[:3, :3] @ point + pose[:3, 3]
                    mine = camera["fx"] * x / z + camera["cx"], camera["fy"] * y / z + camera["cy"]
                    theirs = world_to_camera_view(scene, bpy.data.objects[name], Vector(point))
                    np.testing.assert_allclose(mine, (48 * theirs.x, 80 * (1 - theirs.y)), atol=1e-3)

    def test_colours_are_srgb_without_a_look(self):
        import bpy

        bpy.ops.wm.read_factory_settings(use_empty=True)
        scene = bpy.context.scene
        scene.frame_end = 1
        bpy.ops.mesh.primitive_cube_add(size=1)
        scene.world = bpy.data.worlds.new("World")
        scene.world.use_nodes = True
        node = next(n for n in scene.world.node_tree.nodes if n.type == "BACKGROUND")
        node.inputs["Color"].default_value = (0.2, 0.5, 0.8, 1)
        scene.view_settings.view_transform, scene.cycles.use_denoising = "AgX", False
        blend = self.folder / "scene.blend"
        bpy.ops.wm.save_as_mainfile(filepath=str(blend))
        capture(self.folder / "out", "--blend", blend, "--count", 1, "--opaque", "--radius", 9, "--tracks", 0, *SMALL)
        image = png(self.folder / "out/images/cam00/0000.png")
        self.assertEqual(image.shape, (48, 64, 3))
        self.assertEqual(image[0, 0].tolist(), [124, 188, 231])

    def test_bad_input_is_refused(self):
        import bpy

        bpy.ops.wm.read_factory_settings(use_empty=True)
        empty = self.folder / "empty.blend"
        bpy.ops.wm.save_as_mainfile(filepath=str(empty))
        bpy.ops.mesh.primitive_cube_add()
        cube = self.folder / "cube.blend"
        bpy.ops.wm.save_as_mainfile(filepath=str(cube))
        (self.folder / "damaged.blend").write_bytes(b"no scene")
        (self.folder / "mine").mkdir()
        (self.folder / "mine/notes.txt").write_text("mine")
        (self.folder / "file").write_text("mine")
        out = self.folder / "out"
        for args, words in (
            ((out,), "no scene is given"),
            ((out, "--blend", self.folder / "none.blend"), "no such file"),
            ((out, "--blend", self.folder / "damaged.blend"), "Blender does not open it"),
            ((out, "--blend", empty), "no surface that a camera can see"),
            ((self.folder / "out2", "--blend", cube, "--rig", "scene"), "the scene has no camera"),
            ((out, "--demo", "desk"), "expected robot or table"),
            ((out, "--demo", "table", "--frames", 5, 4), "no frame is left"),
            ((out, "--demo", "table", "--step", 0), "invalid --step"),
            ((out, "--demo", "table", "--size", 4, 4), "invalid --size"),
            ((out, "--demo", "table", "--radius", -1), "invalid --radius"),
            ((out, "--demo", "table", "--shutter", 2), "invalid --shutter"),
            ((out, "--demo", "table", "--rig", "scene", "--count", 3), "places new cameras"),
            ((self.folder / "mine", "--demo", "table"), "this script did not write it"),
            ((self.folder / "file", "--demo", "table"), "is a file"),
            ((self.folder / "out3", "--demo", "table", "--subject", "cat"), "no object or collection of this name. Objects: ball"),
            ((self.folder / "out4", "--demo", "table", "--hold-out", "cam99"), "--hold-out cam99"),
        ):
            with self.subTest(words=words):
                error = capture(*args, code=2)
                self.assertIn(words, error)
                self.assertEqual(error.count("\n"), 1, error)
        self.assertEqual((self.folder / "mine/notes.txt").read_text(), "mine")
        self.assertEqual(len(list((self.folder / "mine").iterdir())), 1)

    @unittest.skipUnless(COMMAND, "no splat4d: SPLAT4D names the command")
    def test_splat4d_reads_the_capture_without_warnings(self):
        out, run = self.folder / "take", self.folder / "run"
        capture(out, "--demo", "table", *SMALL, "--samples", 16, "--frames", 1, 6, "--count", 8)
        about = subprocess.run([COMMAND, "info", out], capture_output=True, text=True)
        self.assertEqual(about.returncode, 0, about.stderr)
        self.assertIn("looks healthy", about.stdout)
        self.assertNotIn("!", about.stdout)
        self.assertNotIn("not read", about.stdout)
        self.assertNotIn("warning", about.stdout + about.stderr)
        done = subprocess.run([COMMAND, "train", out, "-o", run, "--device", "cpu", "--set", "iterations=200", "--set", "loss.flow=0.1",
                               "--set", "loss.tracks=0.1"], capture_output=True, text=True)
        self.assertEqual(done.returncode, 0, done.stderr)
        self.assertNotIn("warning", done.stdout + done.stderr)


if __name__ == "__main__":
    unittest.main()
