"""Imports `.s4d` playback files, dynamic scenes of 3D Gaussians, and plays them on Blender's timeline.

A scene becomes a mesh without edges: a vertex per Gaussian that is visible at the current frame, with the attributes of
`ATTRIBUTES`. Geometry nodes show them as ellipsoids. Changing the frame replaces vertices and attributes.
"""

import math
import pathlib

import bpy
import numpy as np
from bpy.app.handlers import persistent
from bpy.props import BoolProperty, EnumProperty, IntProperty, StringProperty
from bpy_extras.io_utils import ImportHelper
from mathutils import Vector

from . import s4d

# Name, type and numbers per Gaussian of what every mesh has. Lengths are scene units, in the axes of the file.
ATTRIBUTES = {
    "rotation": ("QUATERNION", 4),  # w x y z
    "scale": ("FLOAT_VECTOR", 3),  # standard deviations along the Gaussian's axes
    "opacity": ("FLOAT", 1),  # temporal opacity applied
    "color": ("FLOAT_COLOR", 4),  # base colour in linear light, and opacity
    "base_color": ("FLOAT_VECTOR", 3),  # as the file has it: display values, not clamped
    "section": ("INT", 1),  # of the page in the file; with `row` it names a Gaussian
    "row": ("INT", 1),
}
# Foreign properties of an object, by which the handler finds it.
FILE, FIRST, LOOP = "s4d_file", "s4d_first_frame", "s4d_loop"
TREE = "splat4d ellipsoids"
# Ellipsoids end here: two standard deviations, where a Gaussian has 14 % of its opacity.
EXTENT = 2.0

_open = {}


def scene_of(path):
    """The decoded file; it is read again if it has changed."""
    path = pathlib.Path(bpy.path.abspath(path))
    stamp = path.stat().st_mtime_ns
    if _open.get(path, (None, None))[0] != stamp:
        _open[path] = (stamp, s4d.Scene.open(path))
    return _open[path][1]


def time_of(obj, frame, fps):
    """Second of the file that an object shows at a frame of Blender's scene."""
    scene = scene_of(obj[FILE])
    first, last = scene.clip
    passed = (frame - obj[FIRST]) / fps
    if obj.get(LOOP) and last > first:
        # The last frame lasts as long as the others.
        passed %= last - first + 1.0 / scene.meta["fps"]
    return min(max(first + passed, first), last)


def linear(display):
    """Display values (sRGB) as linear light."""
    display = np.clip(display, 0.0, 1.0)
    return np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)


def show(obj, time):
    """Replaces the vertices and attributes of an object's mesh by the Gaussians at a time."""
    gaussians, mesh = scene_of(obj[FILE]).at(time), obj.data
    n = len(gaussians.row)
    if len(mesh.vertices) != n:
        mesh.clear_geometry()
        mesh.vertices.add(n)
    mesh.attributes["position"].data.foreach_set("vector", gaussians.position.astype(np.float32).ravel())
    color = np.concatenate([linear(gaussians.base_color), gaussians.opacity[:, None]], axis=1)
    values = {
        "rotation": gaussians.rotation,
        "scale": gaussians.scale,
        "opacity": gaussians.opacity,
        "color": color,
        "base_color": gaussians.base_color,
        "section": gaussians.page,
        "row": gaussians.row,
    }
    fields = {"QUATERNION": "value", "FLOAT_VECTOR": "vector", "FLOAT": "value", "FLOAT_COLOR": "color", "INT": "value"}
    for name, (kind, _) in ATTRIBUTES.items():
        write(mesh, name, kind, fields[kind], values[name])
    # Coefficients of the spherical harmonics above degree 0, a vector (red, green, blue) each.
    for k in range(gaussians.sh.shape[1]):
        write(mesh, f"sh_{k + 1}", "FLOAT_VECTOR", "vector", gaussians.sh[:, k])
    mesh.update()


def write(mesh, name, kind, field, values):
    attribute = mesh.attributes.get(name) or mesh.attributes.new(name, kind, "POINT")
    dtype = np.int32 if kind == "INT" else np.float32
    attribute.data.foreach_set(field, np.ascontiguousarray(values, dtype).ravel())


def material():
    """Emits the base colour, as transparent as the Gaussian."""
    made = bpy.data.materials.get(TREE)
    if made:
        return made
    made = bpy.data.materials.new(TREE)
    made.use_nodes = True
    nodes, links = made.node_tree.nodes, made.node_tree.links
    nodes.clear()
    color = nodes.new("ShaderNodeAttribute")
    color.attribute_type, color.attribute_name = "INSTANCER", "color"
    emission, clear = nodes.new("ShaderNodeEmission"), nodes.new("ShaderNodeBsdfTransparent")
    mix, out = nodes.new("ShaderNodeMixShader"), nodes.new("ShaderNodeOutputMaterial")
    links.new(color.outputs["Color"], emission.inputs["Color"])
    links.new(color.outputs["Alpha"], mix.inputs[0])
    links.new(clear.outputs[0], mix.inputs[1])
    links.new(emission.outputs[0], mix.inputs[2])
    links.new(mix.outputs[0], out.inputs["Surface"])
    return made


def ellipsoids():
    """The node group that puts an ellipsoid on every vertex."""
    made = bpy.data.node_groups.get(TREE)
    if made:
        return made
    made = bpy.data.node_groups.new(TREE, "GeometryNodeTree")
    made.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    made.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    nodes, links = made.nodes, made.links
    source, out = nodes.new("NodeGroupInput"), nodes.new("NodeGroupOutput")
    sphere = nodes.new("GeometryNodeMeshIcoSphere")
    sphere.inputs["Radius"].default_value, sphere.inputs["Subdivisions"].default_value = EXTENT, 2
    paint = nodes.new("GeometryNodeSetMaterial")
    paint.inputs["Material"].default_value = material()
    instances = nodes.new("GeometryNodeInstanceOnPoints")
    links.new(source.outputs[0], instances.inputs["Points"])
    links.new(sphere.outputs["Mesh"], paint.inputs["Geometry"])
    links.new(paint.outputs["Geometry"], instances.inputs["Instance"])
    for name, kind in [("rotation", "QUATERNION"), ("scale", "FLOAT_VECTOR")]:
        read = nodes.new("GeometryNodeInputNamedAttribute")
        read.data_type = kind
        read.inputs["Name"].default_value = name
        value = next(o for o in read.outputs if o.enabled and o.name == "Attribute")
        links.new(value, instances.inputs[name.capitalize()])
    links.new(instances.outputs["Instances"], out.inputs[0])
    return made


def add(context, path, first_frame=1, up="Z", shape="ELLIPSOIDS", loop=False, set_range=True):
    """Imports a file; returns the new object. Errors: `s4d.Damaged`, `OSError`."""
    scene = scene_of(path)
    name = pathlib.Path(path).stem
    obj = bpy.data.objects.new(name, bpy.data.meshes.new(name))
    obj[FILE], obj[FIRST], obj[LOOP] = str(path), first_frame, loop
    if up == "Z":
        turn = Vector(scene.meta["up"]).rotation_difference(Vector((0.0, 0.0, 1.0)))
        obj.matrix_world = turn.to_matrix().to_4x4()
    context.collection.objects.link(obj)
    if shape == "ELLIPSOIDS":
        modifier = obj.modifiers.new(TREE, "NODES")
        modifier.node_group = ellipsoids()
    target = context.scene
    if set_range:
        fps = scene.meta["fps"]
        # Blender's rate is fps / fps_base with a whole fps.
        target.render.fps = max(1, round(fps))
        target.render.fps_base = target.render.fps / fps
        first, last = scene.clip
        target.frame_start = first_frame
        target.frame_end = first_frame + max(0, math.floor((last - first) * fps + 1e-6))
    update(target)
    return obj


@persistent
def update(scene, _depsgraph=None):
    """Shows the current frame in all imported objects of a scene."""
    fps = scene.render.fps / scene.render.fps_base
    for obj in scene.objects:
        if FILE not in obj or obj.type != "MESH":
            continue
        try:
            show(obj, time_of(obj, scene.frame_current_final, fps))
        except (OSError, s4d.Damaged) as e:
            # A file that is gone must not stop the playback of the others.
            print(f"splat4d: {obj[FILE]}: {e}")


class ImportS4D(bpy.types.Operator, ImportHelper):
    """Import a dynamic scene of 3D Gaussians (.s4d)"""

    bl_idname = "import_scene.s4d"
    bl_label = "Import .s4d"
    bl_options = {"REGISTER", "UNDO"}

    filename_ext = ".s4d"
    filter_glob: StringProperty(default="*.s4d", options={"HIDDEN"})
    first_frame: IntProperty(name="First Frame", description="Frame at which the clip begins", default=1)
    up: EnumProperty(
        name="Up",
        description="Rotation of the object",
        items=[("Z", "Z", "The scene's up direction becomes +Z"), ("KEEP", "Keep", "The axes of the file")],
    )
    shape: EnumProperty(
        name="Show As",
        description="Display of the Gaussians",
        items=[("ELLIPSOIDS", "Ellipsoids", "An ellipsoid per Gaussian"), ("POINTS", "Points", "Vertices only")],
    )
    loop: BoolProperty(name="Loop", description="Repeat the clip", default=False)
    set_range: BoolProperty(name="Set Frame Range", description="Frame rate and range of the scene follow the clip", default=True)

    def execute(self, context):
        try:
            add(context, self.filepath, self.first_frame, self.up, self.shape, self.loop, self.set_range)
        except (OSError, s4d.Damaged) as e:
            self.report({"ERROR"}, f"{self.filepath}: {e}")
            return {"CANCELLED"}
        return {"FINISHED"}


def entry(menu, _context):
    menu.layout.operator(ImportS4D.bl_idname, text="splat4d (.s4d)")


def register():
    bpy.utils.register_class(ImportS4D)
    bpy.types.TOPBAR_MT_file_import.append(entry)
    bpy.app.handlers.frame_change_post.append(update)


def unregister():
    bpy.app.handlers.frame_change_post.remove(update)
    bpy.types.TOPBAR_MT_file_import.remove(entry)
    bpy.utils.unregister_class(ImportS4D)
    _open.clear()
