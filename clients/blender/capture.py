#!/usr/bin/env python3
"""Renders a capture for splat4d from a Blender scene, with ground truth: poses, depth, flow, masks, labels, tracks and points.

    blender -b scene.blend -P capture.py -- OUTPUT [options]         in Blender 4.2 or later
    python capture.py OUTPUT --blend scene.blend [options]           with PyPI's bpy, on the CPU
    python capture.py OUTPUT --demo table|robot [options]            two scenes without assets (demos.py)

An interrupted run continues with the same command. docs/blender.md describes options and conventions. Needs bpy and NumPy, which
Blender contains.
"""

import argparse
import hashlib
import json
import math
import os
import pathlib
import re
import signal
import struct
import sys
import zlib

try:
    import bpy
    import numpy as np
    from mathutils import Matrix, Vector
    from mathutils.bvhtree import BVHTree
except ModuleNotFoundError as error:
    sys.exit(f"error: {error.name} is not installed. Run this script in Blender (blender -b scene.blend -P capture.py -- OUTPUT), or "
             "install PyPI's bpy with the Python version that it supports.")

MARKER = "capture.blender.json"
# Cycles' depth of pixels without a surface is 1e10.
NO_SURFACE = 1e9
# Width of the pixel filter in passes, pixels: rays go through the centres of pixels.
CENTRE = 0.01
# KITTI's flow: 64 (u + 512) in 16 bits; the first and last value are left out.
LARGEST_FLOW = 511.9
# Largest value of a label image; 255 means unlabelled.
MOST_LABELS = 254
# A point is hidden if a surface is in front of it by more than this share of its distance.
HIDDEN = 1e-3
# Frames at which moving surfaces are sampled for initial points.
SAMPLED_FRAMES = 12
# Cameras from which an initial point takes its colour.
COLOUR_CAMERAS = 8
# Ctrl-C, which Blender would lose during a render: it is obeyed after the render.
STOPS = []
SURFACES = {"MESH", "CURVE", "SURFACE", "FONT", "META"}


class Problem(Exception):
    """Something that the user can mend."""


# Arguments

def parser():
    made = argparse.ArgumentParser(prog="capture.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("output", help="folder of the capture: new, empty, or one of an interrupted run")
    scene = made.add_argument_group("scene")
    scene.add_argument("--blend", metavar="FILE", help="open this file; by default the scene that is open in Blender")
    scene.add_argument("--demo", metavar="NAME", help="build a scene: table or robot")
    scene.add_argument("--frames", type=int, nargs=2, metavar=("FIRST", "LAST"), help="Blender's frame numbers (default: the scene's)")
    scene.add_argument("--step", type=int, default=1, help="render every STEP-th frame (default: 1; flow needs 1)")
    scene.add_argument("--size", type=int, nargs=2, metavar=("W", "H"), help="pixels (default: the scene's)")
    rig = made.add_argument_group("cameras")
    rig.add_argument("--rig", choices=("sphere", "arc", "scene"), help="where cameras are (default: sphere); scene: its own cameras")
    rig.add_argument("--cameras", metavar="NAMES", help="with --rig scene: these cameras, separated by commas (default: all)")
    rig.add_argument("--count", type=int, help="number of cameras of a sphere or arc (default: 12)")
    rig.add_argument("--target", type=float, nargs=3, metavar=("X", "Y", "Z"), help="centre (default: that of the geometry)")
    rig.add_argument("--radius", type=float, help="distance from the target (default: all geometry is in view)")
    rig.add_argument("--elevation", type=float, nargs=2, metavar=("LOW", "HIGH"), help="degrees (default: sphere 5 60, arc 15 15)")
    rig.add_argument("--span", type=float, help="angle of an arc, degrees (default: 120)")
    rig.add_argument("--fov", type=float, help="horizontal field of view, degrees (default: 50)")
    rig.add_argument("--moving", action="store_true", help="one camera that moves along the sphere or arc, one image a frame")
    rig.add_argument("--hold-out", metavar="NAMES", help="cameras to measure on, or none (default: an inner camera, or every 8th image)")
    image = made.add_argument_group("images")
    image.add_argument("--engine", choices=("cycles", "scene"), default="cycles", help="renderer of the images (default: cycles)")
    image.add_argument("--samples", type=int, help="samples per pixel of Cycles (default: the scene's)")
    image.add_argument("--shutter", type=float, default=0.0, help="motion blur: exposure as a share of a frame, centred (default: 0)")
    image.add_argument("--opaque", action="store_true", help="show the world's background instead of transparency")
    truth = made.add_argument_group("ground truth")
    truth.add_argument("--subject", metavar="NAMES", help="masks: white at these objects or collections, separated by commas")
    truth.add_argument("--labels", action="store_true", help="label images: one value per object")
    truth.add_argument("--points", type=int, default=20_000, help="initial points on surfaces (default: 20000; 0: none)")
    truth.add_argument("--tracks", type=int, default=256, help="surface points that are followed (default: 256; 0: none)")
    truth.add_argument("--no-depth", action="store_true", help="no depth maps")
    truth.add_argument("--no-flow", action="store_true", help="no optical flow")
    return made


def checked(args):
    """Refuses values that no scene could satisfy."""
    if args.blend and args.demo:
        raise Problem("--blend and --demo exclude each other")
    if args.blend and not os.path.isfile(args.blend):
        raise Problem(f"{args.blend}: no such file")
    for name, value, least in (("--step", args.step, 1), ("--count", args.count, 1), ("--samples", args.samples, 1),
                               ("--points", args.points, 0), ("--tracks", args.tracks, 0)):
        if value is not None and value < least:
            raise Problem(f"invalid {name}: expected at least {least}, found {value}")
    for name, value, low, high in (("--radius", args.radius, 0, math.inf), ("--fov", args.fov, 0, 170), ("--span", args.span, 0, 360)):
        if value is not None and not low < value < high + (name == "--span"):
            raise Problem(f"invalid {name}: expected a number between {low} and {high}, found {value:g}")
    if not 0 <= args.shutter <= 1:
        raise Problem(f"invalid --shutter: expected 0 to 1 frames, found {args.shutter:g}")
    if args.size and min(args.size) < 8:
        raise Problem(f"invalid --size: expected at least 8 pixels each way, found {args.size[0]} x {args.size[1]}")
    if args.elevation and not all(-90 <= e <= 90 for e in args.elevation):
        raise Problem("invalid --elevation: expected degrees from -90 to 90")
    if args.rig == "scene":
        for name in ("count", "target", "radius", "elevation", "span", "fov"):
            if getattr(args, name) is not None:
                raise Problem(f"--{name} places new cameras; --rig scene uses those of the scene")
        if args.moving:
            raise Problem("--moving makes a path; a camera of the scene (--rig scene --cameras NAME) moves as it is animated")
    elif args.cameras:
        raise Problem("--cameras needs --rig scene")
    if args.moving and args.count is not None:
        raise Problem("--moving has one camera: --count has no effect")


# Files

class Folder:
    """The capture's folder. Files appear under their names when they are complete."""

    def __init__(self, path, settings):
        self.path = pathlib.Path(path)
        marker = self.path / MARKER
        if self.path.exists() and not self.path.is_dir():
            raise Problem(f"{path} is a file. Choose another folder")
        if marker.is_file():
            try:
                before = json.loads(marker.read_text("utf-8"))
            except ValueError:
                raise Problem(f"{marker}: damaged. Choose another folder, or delete this one") from None
            for key in sorted(before.keys() | settings.keys()):
                if before.get(key) != settings.get(key):
                    raise Problem(f"{path} was begun with other settings: {key} was {before.get(key)}, now {settings.get(key)}. "
                                  "Repeat the same command to continue it, or choose another folder")
            if settings["scene"] == "unsaved":
                raise Problem(f"{path} was begun with an unsaved scene, which may have changed. Save the scene, and choose another folder")
        elif self.path.is_dir() and any(self.path.iterdir()):
            raise Problem(f"{path} exists and this script did not write it. Choose another folder")
        else:
            self.write(MARKER, json.dumps(settings, indent=1).encode())

    def has(self, name):
        return (self.path / name).exists()

    def write(self, name, content):
        """Writes a file next to its place, then renames it."""
        target = self.path / name
        target.parent.mkdir(parents=True, exist_ok=True)
        part = target.with_name(f"{target.name}.{os.getpid()}.part")
        try:
            part.write_bytes(content)
            os.replace(part, target)
        finally:
            part.unlink(missing_ok=True)


def png(image):
    """A PNG of [h, w] or [h, w, 2 to 4], 8 or 16 bits."""
    image = np.atleast_3d(image)
    height, width, channels = image.shape
    depth = 8 * image.dtype.itemsize
    rows = np.ascontiguousarray(image.astype(image.dtype.newbyteorder(">"))).view(np.uint8).reshape(height, -1)
    lines = np.empty((height, rows.shape[1] + 1), np.uint8)
    lines[:, 0] = 2  # each row minus the one above it
    lines[0, 1:], lines[1:, 1:] = rows[0], rows[1:] - rows[:-1]

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, depth, (0, 4, 2, 6)[channels - 1], 0, 0, 0)
    # Colours are sRGB; other images are numbers.
    colours = chunk(b"sRGB", b"\0") if depth == 8 and channels >= 3 else b""
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + colours + chunk(b"IDAT", zlib.compress(lines.tobytes(), 6)) + chunk(b"IEND", b"")


def exr(depth):
    """An OpenEXR file with the channel Z, 32 bits, compressed in blocks of 16 rows (ZIP)."""
    height, width = depth.shape

    def attribute(name, kind, value):
        return name + b"\0" + kind + b"\0" + struct.pack("<i", len(value)) + value

    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    head = b"\x76\x2f\x31\x01\x02\0\0\0" + attribute(b"channels", b"chlist", b"Z\0" + struct.pack("<iB3xii", 2, 0, 1, 1) + b"\0")
    head += attribute(b"compression", b"compression", b"\x03") + attribute(b"dataWindow", b"box2i", window)
    head += attribute(b"displayWindow", b"box2i", window) + attribute(b"lineOrder", b"lineOrder", b"\0")
    head += attribute(b"pixelAspectRatio", b"float", struct.pack("<f", 1)) + attribute(b"screenWindowCenter", b"v2f", bytes(8))
    head += attribute(b"screenWindowWidth", b"float", struct.pack("<f", 1)) + b"\0"
    blocks = []
    for top in range(0, height, 16):
        raw = np.frombuffer(depth[top:top + 16].astype("<f4").tobytes(), np.uint8)
        halves = np.concatenate([raw[0::2], raw[1::2]])
        halves[1:] = halves[1:] - halves[:-1] + np.uint8(128)
        packed = zlib.compress(halves.tobytes(), 6)
        packed = packed if len(packed) < raw.size else raw.tobytes()
        blocks.append(struct.pack("<ii", top, len(packed)) + packed)
    places, at = [], len(head) + 8 * len(blocks)
    for block in blocks:
        places.append(at)
        at += len(block)
    return head + struct.pack(f"<{len(places)}Q", *places) + b"".join(blocks)


def read_exr(path):
    """Channels of an uncompressed OpenEXR file of one part, as Blender writes its passes: name → [h, w]."""
    data = pathlib.Path(path).read_bytes()
    if data[:4] != b"\x76\x2f\x31\x01" or data[5] & 0x1A:
        raise Problem("Blender wrote its passes in an unknown form. Please report its version")
    at, values = 8, {}
    while data[at]:
        name, kind, rest = data[at:at + 512].split(b"\0", 2)
        start = at + len(name) + len(kind) + 6
        size, = struct.unpack_from("<i", data, start - 4)
        values[name], at = data[start:start + size], start + size
    left, top, right, bottom = struct.unpack("<4i", values[b"dataWindow"])
    width, height = right - left + 1, bottom - top + 1
    channels, rest = [], values[b"channels"]
    while rest[0]:
        name, rest = rest.split(b"\0", 1)
        channels.append((name.decode(), "<u4 <f2 <f4".split()[struct.unpack_from("<i", rest)[0]]))
        rest = rest[16:]
    if values[b"compression"] != b"\0":
        raise Problem("Blender compressed its passes. Please report its version")
    kinds = [("y", "<i4"), ("size", "<i4")] + [(name, kind, (width,)) for name, kind in channels]
    rows = np.frombuffer(data, kinds, height, at + 1 + 8 * height)
    if not (rows["y"] == np.arange(top, bottom + 1)).all():
        raise Problem("Blender wrote its passes in an unknown order. Please report its version")
    return {name: rows[name].astype(np.float32) for name, _ in channels}


def ply(points, colours, times):
    kinds = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1"), ("time", "<f4")]
    rows = np.empty(len(points), kinds)
    for column, name in enumerate("xyz"):
        rows[name] = points[:, column]
    for column, name in enumerate(("red", "green", "blue")):
        rows[name] = colours[:, column]
    rows["time"] = times
    words = {"<f4": "float", "u1": "uchar"}
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    head += [f"property {words[kind]} {name}" for name, kind in kinds] + ["end_header", ""]
    return "\n".join(head).encode() + rows.tobytes()


# Settings of Blender

class Settings:
    """Changes properties of Blender and restores them."""

    def __init__(self):
        self.before = []

    def set(self, owner, **values):
        for name, value in values.items():
            if hasattr(owner, name) and getattr(owner, name) != value:
                self.before.append((owner, name, getattr(owner, name)))
                setattr(owner, name, value)

    def restore(self):
        for owner, name, value in reversed(self.before):
            try:
                setattr(owner, name, value)
            except (ReferenceError, TypeError):
                pass  # removed, or an enumeration that has changed with another property
        self.before.clear()


# Geometry

class Surface:
    """Triangles of one object or instance at a frame: vertices [V, 3] in the world, triangles [T, 3]."""

    def __init__(self, owner, vertices, triangles):
        self.owner, self.vertices, self.triangles = owner, vertices, triangles

    def areas(self):
        a, b, c = (self.vertices[self.triangles[:, k]] for k in range(3))
        return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def surfaces():
    """All surfaces that cameras can see at the current frame, by object and instance."""
    found = {}
    for instance in bpy.context.evaluated_depsgraph_get().object_instances:
        thing = instance.object
        if thing.type not in SURFACES or not instance.show_self or thing.hide_render or not thing.visible_camera or thing.is_holdout:
            continue
        owner = instance.parent.original.name if instance.is_instance else thing.original.name
        key = (owner, thing.original.name, tuple(instance.persistent_id) if instance.is_instance else ())
        mesh = thing.to_mesh()
        if mesh is None:
            continue
        mesh.calc_loop_triangles()
        vertices = np.empty(3 * len(mesh.vertices), np.float32)
        mesh.vertices.foreach_get("co", vertices)
        triangles = np.empty(3 * len(mesh.loop_triangles), np.int32)
        mesh.loop_triangles.foreach_get("vertices", triangles)
        world = np.array(instance.matrix_world, np.float64)
        thing.to_mesh_clear()
        if triangles.size:
            points = vertices.reshape(-1, 3).astype(np.float64) @ world[:3, :3].T + world[:3, 3]
            # Blender's order of faces and objects differs between runs.
            triangles = np.sort(triangles.reshape(-1, 3), 1)
            found[key] = Surface(thing.original.name, points, triangles[np.lexsort(triangles.T)])
    return dict(sorted(found.items()))


def tree(found):
    """A search tree over all triangles."""
    vertices, triangles, count = [], [], 0
    for surface in found.values():
        vertices.append(surface.vertices)
        triangles.append(surface.triangles + count)
        count += len(surface.vertices)
    return BVHTree.FromPolygons(np.concatenate(vertices).tolist(), np.concatenate(triangles).tolist(), all_triangles=True)


def sampled(found, keys, count, rng):
    """Points spread evenly by area over surfaces: a list of (key, vertices of the triangle, weights of its corners)."""
    keys = [key for key in found if key in keys]
    areas = [found[key].areas() for key in keys]
    total = sum(a.sum() for a in areas)
    chosen = []
    for key, area in zip(keys, areas):
        share = count * area.sum() / total if total > 0 else 0
        number = int(share) + (rng.random() < share % 1)
        if not number:
            continue
        faces = rng.choice(len(area), number, p=area / area.sum())
        a, b = rng.random((2, number))
        a, b = np.where(a + b > 1, 1 - a, a), np.where(a + b > 1, 1 - b, b)
        weights = np.stack([1 - a - b, a, b], 1)
        chosen += [(key, found[key].triangles[f], w) for f, w in zip(faces, weights)]
    return chosen


def located(found, chosen, counts):
    """Positions of sampled points at the current frame; NaN where a surface is gone or has another topology."""
    out = np.full((len(chosen), 3), np.nan)
    for row, (key, corners, weights) in enumerate(chosen):
        if key in found and (len(found[key].vertices), len(found[key].triangles)) == counts[key]:
            out[row] = weights @ found[key].vertices[corners]
    return out


class World:
    """What the whole clip shows: bounds, and which surfaces move or change their topology."""

    def __init__(self, scene, frames):
        self.moving, self.changing, self.counts = set(), set(), {}
        self.low, self.high = np.full(3, np.inf), np.full(3, -np.inf)
        self.subject = {}
        first = {}
        # Simulations are computed from the scene's first frame on, in order; flow needs the frame after the last.
        for frame in range(min(scene.frame_start, frames[0]), frames[-1] + 2):
            scene.frame_set(frame)
            if frame not in frames:
                continue
            found = surfaces()
            for key, surface in found.items():
                low, high = surface.vertices.min(0), surface.vertices.max(0)
                self.low, self.high = np.minimum(self.low, low), np.maximum(self.high, high)
                bounds = self.subject.setdefault(surface.owner, [low, high])
                bounds[:] = np.minimum(bounds[0], low), np.maximum(bounds[1], high)
                counts = len(surface.vertices), len(surface.triangles)
                if key not in first:
                    first[key], self.counts[key] = surface.vertices, counts
                    if frame != frames[0]:
                        self.moving.add(key)
                elif counts != self.counts[key]:
                    self.moving.add(key)
                    self.changing.add(surface.owner)
                elif key not in self.moving and not np.allclose(first[key], surface.vertices, rtol=0, atol=1e-7 + 1e-6 * np.ptp(high - low)):
                    self.moving.add(key)
            self.moving |= first.keys() - found.keys()
        if not first:
            raise Problem("the scene has no surface that a camera can see: no mesh, curve, text or metaball is enabled in renders")


def named_objects(names):
    """Names of the objects of a list of objects and collections."""
    out = set()
    for name in filter(None, (n.strip() for n in names.split(","))):
        if name in bpy.data.objects:
            out.add(name)
        elif name in bpy.data.collections:
            out |= {thing.name for thing in bpy.data.collections[name].all_objects}
        else:
            known = ", ".join(sorted(o.name for o in bpy.data.objects if o.type in SURFACES)[:20])
            raise Problem(f"--subject {name}: the scene has no object or collection of this name. Objects: {known}")
    if not out:
        raise Problem("--subject: no name is given")
    return out


# Cameras

class Camera:
    def __init__(self, name, thing, animated):
        self.name, self.thing, self.animated = name, thing, animated
        self.poses, self.lens = [], None

    def record(self, scene):
        """Records world-to-camera at the current frame and the intrinsics, which may not change."""
        graph = bpy.context.evaluated_depsgraph_get()
        camera = self.thing.evaluated_get(graph)
        width, height = scene.render.resolution_x, scene.render.resolution_y
        p = camera.calc_matrix_camera(graph, x=width, y=height, scale_x=scene.render.pixel_aspect_x, scale_y=scene.render.pixel_aspect_y)
        lens = {"fx": p[0][0] * width / 2, "fy": p[1][1] * height / 2, "cx": (1 - p[0][2]) * width / 2, "cy": (1 + p[1][2]) * height / 2}
        if self.lens and any(abs(lens[k] - self.lens[k]) > 1e-3 for k in lens):
            raise Problem(f"camera {self.name} zooms or shifts at frame {scene.frame_current}. capture.json has fixed lenses: "
                          "use a fixed focal length")
        self.lens = self.lens or lens
        place, turn, _ = camera.matrix_world.decompose()
        # Blender's cameras look along -z with y up; ours along z with y down.
        axes = np.array(turn.to_matrix(), np.float64) @ np.diag([1.0, -1.0, -1.0])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = axes.T, -axes.T @ np.array(place, np.float64)
        self.poses.append(pose)

    def project(self, points, frame):
        """Pixels [N, 2] and depths [N] of points in the world."""
        pose = self.poses[frame]
        x, y, z = (points @ pose[:3, :3].T + pose[:3, 3]).T
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.stack([self.lens["fx"] * x / z + self.lens["cx"], self.lens["fy"] * y / z + self.lens["cy"]], 1), z

    def centre(self, frame):
        pose = self.poses[frame]
        return -pose[:3, :3].T @ pose[:3, 3]


def facing(place, target):
    """Pose of a Blender camera that looks from a place at a target, z up."""
    back = (Vector(place) - Vector(target)).normalized()
    right = Vector((0, 0, 1)).cross(back)
    right = right.normalized() if right.length > 1e-6 else Vector((1, 0, 0))
    up = back.cross(right)
    return Matrix.Translation(place) @ Matrix((right, up, back)).transposed().to_4x4()


def directions(rig, count, elevation, span, moving):
    """Unit vectors from the target to the cameras. Azimuth 0 is Blender's front view, -y."""
    low, high = (math.radians(e) for e in elevation)
    out = []
    for i in range(count):
        if rig == "arc":
            share = i / (count - 1) if count > 1 else 0.5
            # A full circle does not end where it begins.
            share = i / count if span >= 360 else share
            angle, rise = math.radians(span) * (share - 0.5), low + (high - low) * share
        else:
            share = (i + 0.5) / count
            rise = math.asin(math.sin(low) + (math.sin(high) - math.sin(low)) * share)
            # Golden angle for many cameras; one camera takes two rounds.
            angle = share * 4 * math.pi if moving else i * math.pi * (3 - math.sqrt(5))
        out.append((math.sin(angle) * math.cos(rise), -math.cos(angle) * math.cos(rise), math.sin(rise)))
    return out


def new_cameras(args, scene, world, frames, wanted, temporary):
    """Cameras on a sphere or an arc."""
    rig = args.rig or wanted.get("rig", "sphere")
    fov = math.radians(args.fov or wanted.get("fov", 50))
    low, high = world.low, world.high
    if args.subject:
        bounds = [world.subject[name] for name in named_objects(args.subject) if name in world.subject]
        if bounds:
            low, high = np.min([b[0] for b in bounds], 0), np.max([b[1] for b in bounds], 0)
    target = args.target or wanted.get("target") or ((low + high) / 2).tolist()
    width, height = scene.render.resolution_x, scene.render.resolution_y
    narrow = min(fov, 2 * math.atan(math.tan(fov / 2) * height / width))
    size = float(np.linalg.norm(high - low)) / 2
    radius = args.radius or wanted.get("radius") or max(size, 1e-3) / math.sin(narrow / 2)
    elevation = args.elevation or wanted.get("elevation") or ((15, 15) if rig == "arc" else (5, 60))
    count = len(frames) if args.moving else args.count or 12
    places = [Vector(target) + radius * Vector(d) for d in directions(rig, count, elevation, args.span or wanted.get("span", 120), args.moving)]
    cameras = []
    for i in range(1 if args.moving else count):
        data = bpy.data.cameras.new("capture")
        temporary.append((bpy.data.cameras, data))
        data.sensor_fit, data.angle = "HORIZONTAL", fov
        data.clip_start, data.clip_end = radius / 1000, radius * 1000
        thing = bpy.data.objects.new("capture", data)
        temporary.insert(0, (bpy.data.objects, thing))
        scene.collection.objects.link(thing)
        thing.rotation_mode = "QUATERNION"
        if args.moving:
            # The camera also needs a pose before and after the clip, for Blender's vectors.
            path = [frames[0] - 1, *frames, frames[-1] + 1]
            for frame, place in zip(path, [places[0], *places, places[-1]]):
                thing.matrix_world = facing(place, target)
                thing.keyframe_insert("location", frame=frame)
                thing.keyframe_insert("rotation_quaternion", frame=frame)
        else:
            thing.matrix_world = facing(places[i], target)
        cameras.append(Camera(f"cam{i:02d}", thing, args.moving))
    return cameras


def scene_cameras(args, scene, settings):
    """The scene's own cameras."""
    there = {thing.name: thing for thing in scene.objects if thing.type == "CAMERA"}
    if not there:
        raise Problem("the scene has no camera. Add one, or use --rig sphere or --rig arc")
    names = [n.strip() for n in args.cameras.split(",")] if args.cameras else sorted(there)
    cameras = []
    for name in names:
        if name not in there:
            raise Problem(f"--cameras {name}: the scene has no camera of this name. Cameras: {', '.join(sorted(there))}")
        data = there[name].data
        if data.type != "PERSP":
            raise Problem(f"camera {name} is {'panoramic' if data.type == 'PANO' else 'orthographic'}: expected a perspective camera")
        settings.set(data.dof, use_dof=False)
        safe = re.sub(r"[^A-Za-z0-9_-]", "_", name)
        if any(c.name == safe for c in cameras):
            raise Problem(f"--cameras: two cameras would be called {safe} in the capture. Rename one")
        cameras.append(Camera(safe, there[name], None))
    return cameras


# Rendering

class Renderer:
    def __init__(self, scene, args, settings, numbers):
        self.scene, self.args, self.settings, self.numbers = scene, args, settings, numbers
        self.layer = bpy.context.view_layer
        self.exposure = 2.0 ** scene.view_settings.exposure
        self.scratch = pathlib.Path(bpy.app.tempdir) / f"splat4d-{os.getpid()}.exr"
        render = scene.render
        settings.set(render, use_border=False, use_compositing=False, use_sequencer=False, use_single_layer=True, use_multiview=False,
                     use_persistent_data=False, resolution_percentage=100, film_transparent=not args.opaque, use_overwrite=True,
                     use_placeholder=False, use_file_extension=True, filepath=str(self.scratch))
        # Files of all passes are another kind of medium since Blender 5.0.
        settings.set(render.image_settings, media_type="MULTI_LAYER_IMAGE")
        settings.set(render.image_settings, file_format="OPEN_EXR_MULTILAYER", color_depth="32", exr_codec="NONE", use_exr_interleave=True)
        settings.set(self.layer, use_pass_combined=True, samples=0)
        self.engine = render.engine
        self.look = {name: getattr(scene.cycles, name) for name in ("samples", "pixel_filter_type", "filter_width", "use_denoising",
                     "use_adaptive_sampling", "max_bounces")}
        if args.samples:
            self.look["samples"] = args.samples

    def run(self, camera, frame):
        self.scratch.unlink(missing_ok=True)
        self.settings.set(self.scene, camera=camera.thing)
        result = bpy.ops.render.render(write_still=True)
        if "FINISHED" not in result or not self.scratch.exists():
            raise Problem(f"Blender did not render camera {camera.name} at frame {frame} ({', '.join(result)}). Run the same command to continue")
        passes = read_exr(self.scratch)
        self.scratch.unlink()
        # Names without the view layer: Combined.R, Depth.Z, Vector.X, IndexOB.X or Object Index.X.
        return {".".join(name.split(".")[-2:]): image for name, image in passes.items()}

    def image(self, camera, frame):
        """8-bit sRGB with straight alpha, [h, w, 3 or 4]."""
        render = self.scene.render
        self.settings.set(render, engine="CYCLES" if self.args.engine == "cycles" else self.engine, use_motion_blur=self.args.shutter > 0,
                          motion_blur_shutter=self.args.shutter or 0.5, motion_blur_position="CENTER")
        self.settings.set(self.scene.cycles, **self.look)
        self.settings.set(self.layer, use_pass_z=False, use_pass_vector=False, use_pass_object_index=False)
        passes = self.run(camera, frame)
        alpha = np.clip(passes["Combined.A"], 0, 1)
        colour = np.stack([passes[f"Combined.{c}"] for c in "RGB"], 2) * self.exposure
        if not self.args.opaque:
            colour = np.divide(colour, alpha[..., None], out=np.zeros_like(colour), where=alpha[..., None] > 0)
        encoded = as_srgb(colour)
        return encoded if self.args.opaque else np.dstack([encoded, np.floor(255 * alpha + 0.5).astype(np.uint8)])

    def passes(self, camera, frame):
        """Depth [h, w] (0: no surface), flow [h, w, 2] to the next frame and object numbers [h, w], at the centres of pixels."""
        self.settings.set(self.scene.render, engine="CYCLES", use_motion_blur=False)
        self.settings.set(self.scene.cycles, samples=1, pixel_filter_type="BLACKMAN_HARRIS", filter_width=CENTRE, use_denoising=False,
                          use_adaptive_sampling=False, max_bounces=0)
        self.settings.set(self.layer, use_pass_z=True, use_pass_vector=True, use_pass_object_index=True)
        passes = self.run(camera, frame)
        depth = passes["Depth.Z"]
        depth = np.where(depth < NO_SURFACE, depth, 0)
        # Blender stores current minus next, with y up.
        flow = np.stack([-passes["Vector.Z"], passes["Vector.W"]], 2)
        index = passes.get("Object Index.X", passes.get("IndexOB.X"))
        return depth, flow, np.where(depth > 0, np.rint(index), 0).astype(np.int32)


def as_srgb(linear):
    linear = np.clip(np.nan_to_num(linear), 0, 1)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.floor(255 * encoded + 0.5).astype(np.uint8)


def stored_image(path):
    """Bytes of an image that was written before, [h, w, 4]."""
    image = bpy.data.images.load(str(path))
    width, height = image.size
    values = np.empty(4 * width * height, np.float32)
    image.pixels.foreach_get(values)
    bpy.data.images.remove(image)
    return np.rint(255 * values.reshape(height, width, 4)[::-1]).astype(np.uint8)


# Points and tracks

def visible(points, camera, frame, size, search):
    """Pixels of points, and which are inside the image with nothing in front of them."""
    pixels, depth = camera.project(points, frame)
    with np.errstate(invalid="ignore"):
        seen = (depth > 0) & (pixels >= 0).all(1) & (pixels < size).all(1)
    start = camera.centre(frame)
    for row in np.flatnonzero(seen):
        ray = points[row] - start
        distance = float(np.linalg.norm(ray))
        hit = search.ray_cast(start.tolist(), (ray / distance).tolist(), distance)
        seen[row] = hit[3] is None or hit[3] > distance * (1 - HIDDEN)
    return pixels, seen


def points_and_tracks(scene, args, folder, cameras, world, frames, fps):
    """Writes points.ply and tracks/NAME.npz."""
    size = (scene.render.resolution_x, scene.render.resolution_y)
    wanted = [c for c in cameras if args.tracks and not folder.has(f"tracks/{c.name}.npz")]
    points_left = args.points > 0 and not folder.has("points.ply")
    if not wanted and not points_left:
        return
    rng = np.random.default_rng(0)
    step = max(1, -(-len(frames) // SAMPLED_FRAMES))
    chosen, found_points, tracks = [], [], {c.name: ([], []) for c in wanted}
    density = None
    for i, frame in enumerate(frames):
        scene.frame_set(frame)
        found = surfaces()
        if not found:
            raise Problem(f"no surface is visible at frame {frame}")
        search = tree(found)
        if i == 0:
            moving, still = found.keys() & world.moving, found.keys() - world.moving
            half = args.tracks if not still else args.tracks // 2
            chosen = sampled(found, moving, half if moving else 0, rng)
            chosen += sampled(found, still, args.tracks - len(chosen), rng)
            areas = sum(s.areas().sum() for s in found.values())
            density = args.points / areas
        if wanted:
            places = located(found, chosen, world.counts)
            for camera in wanted:
                pixels, seen = visible(places, camera, i, size, search)
                tracks[camera.name][0].append(np.where(seen[:, None], pixels, 0))
                tracks[camera.name][1].append(seen)
        if points_left and i % step == 0:
            for keys, when in ((found.keys() - world.moving, math.nan), (found.keys() & world.moving, i / fps)):
                if i > 0 and math.isnan(when):
                    continue
                area = sum(s.areas().sum() for key, s in found.items() if key in keys)
                share = density * area * (1 if math.isnan(when) else step / len(frames))
                rows = sampled(found, keys, share, rng)
                if rows:
                    places = located(found, rows, {key: (len(s.vertices), len(s.triangles)) for key, s in found.items()})
                    colours, seen = coloured(places, cameras, i, size, search, folder)
                    found_points.append((places[seen], colours[seen], np.full(seen.sum(), when)))
    for camera in wanted:
        pixels, seen = (np.array(part) for part in tracks[camera.name])
        once = seen.any(0)
        folder.write(f"tracks/{camera.name}.npz", npz(tracks=pixels[:, once].astype(np.float32), visibility=seen[:, once]))
    if points_left:
        folder.write("points.ply", ply(*(np.concatenate(part) for part in zip(*found_points))))


def coloured(points, cameras, frame, size, search, folder):
    """Median colours of points in the images that see them, and which points are seen."""
    step = max(1, len(cameras) // COLOUR_CAMERAS)
    values = np.full((len(points), len(cameras[::step]), 3), np.nan)
    for column, camera in enumerate(cameras[::step]):
        image = stored_image(folder.path / f"images/{camera.name}/{frame:04d}.png")
        pixels, seen = visible(points, camera, frame, size, search)
        x, y = np.where(seen[:, None], pixels, 0).astype(int).T
        seen &= image[y, x, 3] > 127
        values[seen, column] = image[y, x, :3][seen]
    seen = np.isfinite(values[:, :, 0]).any(1)
    colours = np.zeros((len(points), 3), np.uint8)
    if seen.any():
        colours[seen] = np.rint(np.nanmedian(values[seen], 1))
    return colours, seen


def npz(**arrays):
    import io

    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


# The capture

def prepared(args):
    """Opens or builds the scene: the scene, what a demonstration wants of the rig, and what identifies the scene."""
    wanted = {}
    if args.demo:
        sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent))
        import demos

        if args.demo not in demos.SCENES:
            raise Problem(f"--demo {args.demo}: expected {' or '.join(sorted(demos.SCENES))}")
        wanted = demos.build(args.demo, args.frames[1] if args.frames else None)
        identity = f"demo {args.demo}"
    else:
        if args.blend:
            try:
                bpy.ops.wm.open_mainfile(filepath=os.path.abspath(args.blend))
            except RuntimeError as error:
                raise Problem(f"{args.blend}: Blender does not open it: {str(error).strip()}") from None
        path = bpy.data.filepath
        if not path and bpy.app.background:
            raise Problem("no scene is given. Use blender -b scene.blend -P capture.py -- OUTPUT, or --blend FILE, or --demo table")
        saved = path and (bpy.app.background or not bpy.data.is_dirty) and os.path.isfile(path)
        identity = "sha256 " + hashlib.sha256(pathlib.Path(path).read_bytes()).hexdigest() if saved else "unsaved"
    scene = bpy.context.scene
    if not hasattr(scene, "cycles"):
        raise Problem("this Blender has no Cycles, which renders depth and flow. Enable the add-on Cycles Render Engine")
    space = getattr(getattr(bpy.data, "colorspace", None), "working_space", "Linear Rec.709")
    if space != "Linear Rec.709":
        raise Problem(f"the scene's working colour space is {space}: expected Linear Rec.709, so that images are sRGB")
    return scene, wanted, identity


def frame_numbers(args, scene):
    first, last = args.frames or (scene.frame_start, scene.frame_end)
    frames = list(range(first, last + 1, args.step))
    if not frames:
        raise Problem(f"no frame is left: first {first}, last {last}. Give --frames FIRST LAST with FIRST at most LAST")
    if args.demo and first < 1:
        raise Problem(f"--frames {first} {last}: demonstrations begin at frame 1")
    return frames


def as_rendered(scene, settings):
    """Gives the depsgraph the geometry of renders: tracks and points come from it."""
    for thing in scene.objects:
        settings.set(thing, hide_viewport=thing.hide_render)
        for modifier in thing.modifiers:
            settings.set(modifier, show_viewport=modifier.show_render)
            if hasattr(modifier, "render_levels"):
                settings.set(modifier, levels=modifier.render_levels)


def capture(args, say, settings, temporary):
    scene, wanted, identity = prepared(args)
    frames = frame_numbers(args, scene)
    settings.before.append((scene, "camera", scene.camera))
    render = scene.render
    if args.size:
        settings.set(render, resolution_x=args.size[0], resolution_y=args.size[1])
    elif render.resolution_percentage != 100:
        share = render.resolution_percentage / 100
        settings.set(render, resolution_x=int(render.resolution_x * share), resolution_y=int(render.resolution_y * share))
    settings.set(render, resolution_percentage=100)
    fps = render.fps / render.fps_base / args.step

    options = {key: value for key, value in sorted(vars(args).items()) if key not in ("output", "blend", "demo")}
    folder = Folder(args.output, {"splat4d": "blender 1", "blender": bpy.app.version_string, "scene": identity, **options})
    if folder.has("capture.json"):
        say(f"{args.output} is complete: nothing to do")
        return
    as_rendered(scene, settings)
    world = World(scene, frames)
    if args.rig == "scene":
        cameras = scene_cameras(args, scene, settings)
    else:
        cameras = new_cameras(args, scene, world, frames, wanted, temporary)
    for frame in frames:
        scene.frame_set(frame)
        for camera in cameras:
            camera.record(scene)
    for camera in cameras:
        camera.animated = any(not np.allclose(camera.poses[0], pose, rtol=0, atol=1e-9) for pose in camera.poses)

    if args.hold_out and args.hold_out != "none":
        held_out(args.hold_out, [c.name for c in cameras])

    # Every object gets a number, which the passes contain.
    numbers = {}
    for thing in sorted((o for o in scene.objects if o.type in SURFACES), key=lambda o: o.name):
        numbers[thing.name] = len(numbers) + 1
        settings.set(thing, pass_index=numbers[thing.name])
    subject = None
    if args.subject:
        subject = np.array(sorted(numbers[name] for name in named_objects(args.subject) if name in numbers))
        if not subject.size:
            raise Problem(f"--subject {args.subject}: none of these objects has a surface")
    if args.labels and len(numbers) > MOST_LABELS:
        raise Problem(f"--labels: the scene has {len(numbers)} objects, at most {MOST_LABELS} are possible")
    changing = np.array([numbers[name] for name in world.changing if name in numbers])
    flow_wanted = not args.no_flow and args.step == 1 and len(frames) > 1
    if args.step > 1 and not args.no_flow:
        say(f"note: no flow is written with --step {args.step}: Blender's vectors are to the next frame")
    renderer = Renderer(scene, args, settings, numbers)
    what = "1 camera that moves" if args.moving else f"{len(cameras)} camera{'s' * (len(cameras) > 1)}"
    say(f"{what}, {len(frames)} frames at {fps:g} fps, {render.resolution_x}x{render.resolution_y}, "
        f"{renderer.look['samples']} samples: {args.output}")

    for i, frame in enumerate(frames):
        for camera in cameras:
            if STOPS:
                raise KeyboardInterrupt
            place = f"{camera.name}/{i:04d}"
            files = {"image": f"images/{place}.png"}
            if not args.no_depth:
                files["depth"] = f"depth/{place}.exr"
            if flow_wanted and i + 1 < len(frames):
                files["flow"] = f"flow/{place}.png"
            if subject is not None:
                files["mask"] = f"masks/{place}.png"
            if args.labels:
                files["labels"] = f"labels/{place}.png"
            left = {kind: name for kind, name in files.items() if not folder.has(name)}
            if not left:
                continue
            if scene.frame_current != frame:
                scene.frame_set(frame)
            if "image" in left:
                folder.write(left["image"], png(renderer.image(camera, frame)))
            if left.keys() == {"image"}:
                continue
            depth, flow, index = renderer.passes(camera, frame)
            if i == 0 and not depth.any():
                say(f"warning: camera {camera.name} sees no surface at frame {frame}")
            if "depth" in left:
                folder.write(left["depth"], exr(depth))
            if "flow" in left:
                known = (depth > 0) & (np.abs(flow) < LARGEST_FLOW).all(2) & ~np.isin(index, changing)
                stored = np.where(known[..., None], np.rint(64 * flow) + 32768, 0)
                folder.write(left["flow"], png(np.dstack([stored, known]).astype(np.uint16)))
            if "mask" in left:
                folder.write(left["mask"], png(np.where(np.isin(index, subject), 255, 0).astype(np.uint8)))
            if "labels" in left:
                folder.write(left["labels"], png(index.astype(np.uint8)))
        say(f"frame {i + 1} of {len(frames)}", last=i + 1 == len(frames))
    points_and_tracks(scene, args, folder, cameras, world, frames, fps)
    folder.write("capture.json", json.dumps(description(args, scene, folder, cameras, frames, fps, numbers, flow_wanted), indent=1).encode())
    say(f"{args.output} is complete. Next: splat4d info {args.output}")


def held_out(given, names):
    held = [n.strip() for n in given.split(",")]
    for name in held:
        if name not in names:
            raise Problem(f"--hold-out {name}: no camera has this name. Cameras: {', '.join(names)}")
    if len(set(held)) == len(names):
        raise Problem("--hold-out names all cameras: nothing is left to train on")
    return held


def description(args, scene, folder, cameras, frames, fps, numbers, flow_wanted):
    """Content of capture.json."""
    out = {"version": 1, "name": folder.path.resolve().name, "axes": "opencv", "fps": fps, "frames": len(frames), "up": [0, 0, 1]}
    names = [c.name for c in cameras]
    if args.hold_out == "none":
        out["hold_out"] = "none"
    elif args.hold_out:
        out["hold_out"] = {"cameras": held_out(args.hold_out, names)}
    elif len(cameras) == 1:
        out["hold_out"] = {"every": 8} if len(frames) >= 8 else "none"
    else:
        out["hold_out"] = {"cameras": [names[len(names) // 2]]} if len(cameras) >= 4 else "none"
    if args.points:
        out["points"] = "points.ply"
    if not args.no_depth:
        out["depth_kind"], out["depth_scale"] = "metric", 1
    if args.labels:
        out["labels"] = ["background", *numbers]
    out["cameras"] = []
    for camera in cameras:
        entry = {"name": camera.name, "width": scene.render.resolution_x, "height": scene.render.resolution_y, **camera.lens}
        entry["world_to_camera"] = [p.tolist() for p in camera.poses] if camera.animated else camera.poses[0].tolist()
        entry["images"] = f"images/{camera.name}/%04d.png"
        if args.subject:
            entry["masks"] = f"masks/{camera.name}/%04d.png"
        if not args.no_depth:
            entry["depth"] = f"depth/{camera.name}/%04d.exr"
        if flow_wanted:
            entry["flow"] = f"flow/{camera.name}/%04d.png"
        if args.labels:
            entry["labels"] = f"labels/{camera.name}/%04d.png"
        if args.tracks:
            entry["tracks"] = f"tracks/{camera.name}.npz"
        out["cameras"].append(entry)
    out["extra"] = {"source": "clients/blender/capture.py", "blender": bpy.app.version_string, "first_frame": frames[0],
                    "step": args.step, "shutter": args.shutter}
    return out


def main(argv):
    args = parser().parse_args(argv)
    settings, temporary = Settings(), []
    # Blender prints a line per render to the standard output of C: it goes to a file of no interest, ours do not.
    sys.stdout.flush()
    own, null = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    terminal = os.isatty(own)
    os.dup2(null, 1)

    def say(text, last=True):
        end = "\n" if last or not terminal else "\r"
        if last or terminal:
            os.write(own, (text + end).encode())

    STOPS.clear()
    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:
        signal.signal(signal.SIGINT, lambda *_: STOPS.append(True))
    try:
        checked(args)
        capture(args, say, settings, temporary)
        return 0
    except Problem as problem:
        print(f"error: {problem}.", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("stopped. The same command continues.", file=sys.stderr)
        return 130
    finally:
        if before is signal.default_int_handler:
            signal.signal(signal.SIGINT, before)
        settings.restore()
        for where, thing in temporary:
            try:
                where.remove(thing)
            except ReferenceError:
                pass
        os.dup2(own, 1)
        os.close(own)
        os.close(null)


if __name__ == "__main__":
    # Blender passes what is behind "--" to scripts.
    inside = "--" in sys.argv and not sys.argv[0].endswith(".py")
    given = sys.argv[sys.argv.index("--") + 1:] if inside else [] if not sys.argv[0].endswith(".py") else sys.argv[1:]
    sys.exit(main(given))
