"""Scenes for `capture.py --demo NAME`, built of primitives and procedural textures. CC0: use captures of them for anything.

table: a tumbling cube, a bouncing ball and waving cloth on a round floor; cameras all around.
robot: a skinned arm with four bones, a pendulum and a rolling ball in a room; cameras on an arc.
"""

import math

import bpy

FRAMES = 24
FPS = 24


def build(name, last):
    """Replaces the open scene by a demonstration with keys until its last frame + 1; returns defaults of the rig."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end, scene.frame_current = 1, FRAMES, 1
    scene.render.fps, scene.render.fps_base = FPS, 1
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 320, 240, 100
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.use_adaptive_sampling = 32, False, False
    scene.view_settings.exposure = 0
    world = bpy.data.worlds.new("World")
    scene.world = world
    world.use_nodes = True
    background = next(n for n in world.node_tree.nodes if n.type == "BACKGROUND")
    background.inputs["Color"].default_value = (0.55, 0.6, 0.7, 1)
    background.inputs["Strength"].default_value = 0.6
    return SCENES[name](scene, range(0, max(last or FRAMES, FRAMES) + 2))


def material(name, texture, colours, scale):
    """A diffuse material of one procedural texture with two colours, fixed to the undeformed surface."""
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    nodes, links = made.node_tree.nodes, made.node_tree.links
    nodes.clear()
    place, out, shade = (nodes.new(kind) for kind in ("ShaderNodeTexCoord", "ShaderNodeOutputMaterial", "ShaderNodeBsdfDiffuse"))
    pattern = nodes.new(f"ShaderNodeTex{texture}")
    pattern.inputs["Scale"].default_value = scale
    links.new(place.outputs["Generated"], pattern.inputs["Vector"])
    colours = [(*c, 1) for c in colours]
    if texture in ("Checker", "Brick"):
        pattern.inputs["Color1"].default_value, pattern.inputs["Color2"].default_value = colours
        links.new(pattern.outputs["Color"], shade.inputs["Color"])
    else:
        ramp = nodes.new("ShaderNodeValToRGB")
        for stop, colour, position in zip(ramp.color_ramp.elements, colours, (0.35, 0.65)):
            stop.color, stop.position = colour, position
        links.new(pattern.outputs["Distance" if texture == "Voronoi" else 0], ramp.inputs[0])
        links.new(ramp.outputs[0], shade.inputs["Color"])
    links.new(shade.outputs[0], out.inputs["Surface"])
    return made


def primitive(name, kind, looks, location=(0, 0, 0), rotation=(0, 0, 0), scale=(1, 1, 1), smooth=False, **options):
    getattr(bpy.ops.mesh, f"primitive_{kind}_add")(location=location, rotation=rotation, **options)
    thing = bpy.context.object
    thing.name, thing.scale = name, scale
    thing.data.materials.append(looks)
    if smooth:
        thing.data.polygons.foreach_set("use_smooth", [True] * len(thing.data.polygons))
    return thing


def animated(thing, keys, **values):
    """Keys at every frame: values are functions of the frame."""
    for frame in keys:
        for name, value in values.items():
            setattr(thing, name, value(frame))
            thing.keyframe_insert(name, frame=frame)


def light(name, location, power, size):
    data = bpy.data.lights.new(name, "AREA")
    data.energy, data.size = power, size
    thing = bpy.data.objects.new(name, data)
    thing.location = location
    bpy.context.scene.collection.objects.link(thing)
    bpy.context.view_layer.update()
    thing.rotation_euler = (-thing.location).to_track_quat("-Z", "Y").to_euler()


def turn(frame, period=FRAMES):
    return 2 * math.pi * (frame - 1) / period


def table(scene, keys):
    floor = material("floor", "Checker", ((0.75, 0.7, 0.6), (0.25, 0.3, 0.38)), 14)
    primitive("floor", "cylinder", floor, (0, 0, -0.05), vertices=64, radius=2.2, depth=0.1)
    for i, (x, y, height) in enumerate(((-1.3, 0.9, 0.5), (1.2, 1.1, 0.8), (-1.2, -1.1, 0.3))):
        looks = material(f"block {i}", "Voronoi", ((0.8, 0.75 - 0.2 * i, 0.3 + 0.2 * i), (0.12, 0.1, 0.2)), 6)
        primitive(f"block {i}", "cube", looks, (x, y, height / 2), (0, 0, 0.4 * i), (0.25, 0.25, height / 2), size=2)
    cube = primitive("cube", "cube", material("cube", "Checker", ((0.85, 0.15, 0.1), (0.95, 0.85, 0.7)), 4), size=0.6)
    animated(cube, keys, location=lambda f: (0.9 * math.sin(turn(f, 48)), -0.5 + 0.3 * math.cos(turn(f, 48)), 0.75),
             rotation_euler=lambda f: (0.7 * turn(f, 48), 0.4, turn(f, 48)))
    ball = primitive("ball", "uv_sphere", material("ball", "Noise", ((0.05, 0.2, 0.75), (0.95, 0.9, 0.3)), 5), smooth=True,
                     segments=48, ring_count=24, radius=0.3)
    animated(ball, keys, location=lambda f: (-0.6 + 0.3 * math.sin(turn(f)), -0.9, 0.3 + 0.7 * abs(math.sin(turn(f) / 2))),
             rotation_euler=lambda f: (0, 0.3 * turn(f), 0))
    pole = material("pole", "Noise", ((0.3, 0.3, 0.3), (0.6, 0.6, 0.6)), 3)
    primitive("pole", "cylinder", pole, (-0.1, 0.9, 0.8), vertices=24, radius=0.04, depth=1.6)
    cloth = primitive("cloth", "grid", material("cloth", "Brick", ((0.1, 0.5, 0.25), (0.85, 0.85, 0.75)), 3),
                      (0.42, 0.9, 1.15), (math.pi / 2, 0, 0), x_subdivisions=40, y_subdivisions=30, size=1, smooth=True)
    # The edge at the pole is fixed.
    group = cloth.vertex_groups.new(name="free")
    for vertex in cloth.data.vertices:
        group.add([vertex.index], vertex.co.x + 0.5, "REPLACE")
    wave = cloth.modifiers.new("wave", "WAVE")
    wave.use_x, wave.use_y, wave.vertex_group = True, False, "free"
    wave.height, wave.width, wave.narrowness, wave.speed, wave.time_offset = 0.3, 0.5, 4, 0.06, -200
    wave.start_position_x = -1.5
    light("key", (3, -3, 4), 260, 2)
    light("fill", (-3, 2, 3), 110, 2)
    return {"rig": "sphere", "target": [0, 0, 0.5], "radius": 5.2, "elevation": (10, 55)}


def robot(scene, keys):
    walls = material("walls", "Checker", ((0.5, 0.22, 0.15), (0.65, 0.42, 0.28)), 9)
    primitive("floor", "plane", material("floor", "Checker", ((0.7, 0.7, 0.68), (0.3, 0.28, 0.3)), 12), size=5)
    primitive("back", "cube", walls, (0, 2.5, 1.25), scale=(2.5, 0.05, 1.25), size=2)
    primitive("left", "cube", material("left", "Voronoi", ((0.25, 0.45, 0.4), (0.85, 0.85, 0.75)), 8), (-2.5, 0, 1.25),
              scale=(0.05, 2.5, 1.25), size=2)
    primitive("right", "cube", material("right", "Noise", ((0.8, 0.75, 0.5), (0.35, 0.25, 0.4)), 7), (2.5, 0, 1.25),
              scale=(0.05, 2.5, 1.25), size=2)
    arm(scene, keys)
    anchor = bpy.data.objects.new("anchor", None)
    anchor.location = (1.3, 0.6, 2.3)
    scene.collection.objects.link(anchor)
    animated(anchor, keys, rotation_euler=lambda f: (0, 0.7 * math.sin(turn(f)), 0))
    rod = primitive("rod", "cylinder", material("rod", "Noise", ((0.2, 0.2, 0.2), (0.5, 0.5, 0.5)), 3), (0, 0, -0.6),
                    vertices=24, radius=0.03, depth=1.2)
    bob = primitive("bob", "uv_sphere", material("bob", "Checker", ((0.95, 0.75, 0.1), (0.2, 0.1, 0.4)), 5), (0, 0, -1.3), smooth=True,
                    segments=48, ring_count=24, radius=0.28)
    rod.parent = bob.parent = anchor
    ball = primitive("ball", "uv_sphere", material("ball", "Voronoi", ((0.9, 0.2, 0.15), (0.95, 0.95, 0.9)), 4), smooth=True,
                     segments=48, ring_count=24, radius=0.3)
    # Rolls without slipping.
    way = lambda f: -0.9 + 1.6 * (0.5 - 0.5 * math.cos(turn(f, 48)))
    animated(ball, keys, location=lambda f: (way(f), -1.0, 0.3), rotation_euler=lambda f: (0, way(f) / 0.3, 0))
    light("key", (1.5, -2.5, 4), 110, 1.5)
    light("fill", (-1.5, -3, 3), 60, 1.5)
    return {"rig": "arc", "target": [0, 0.4, 0.9], "radius": 5.5, "span": 50, "elevation": (10, 25)}


def arm(scene, keys, bones=4, length=0.45):
    """A skinned tube: each bone bends, weights blend linearly around the joints."""
    tube = primitive("arm", "cylinder", material("arm", "Checker", ((0.05, 0.25, 0.6), (0.85, 0.85, 0.9)), 7),
                     (-0.6, 0.5, bones * length / 2), vertices=32, radius=0.2, depth=bones * length)
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.subdivide(number_cuts=24)
    bpy.ops.object.mode_set(mode="OBJECT")
    tube.data.polygons.foreach_set("use_smooth", [True] * len(tube.data.polygons))
    data = bpy.data.armatures.new("bones")
    rig = bpy.data.objects.new("bones", data)
    rig.location = (-0.6, 0.5, 0)
    scene.collection.objects.link(rig)
    bpy.context.view_layer.objects.active = rig
    bpy.ops.object.mode_set(mode="EDIT")
    parent = None
    for i in range(bones):
        bone = data.edit_bones.new(f"bone {i}")
        bone.head, bone.tail, bone.parent = (0, 0, i * length), (0, 0, (i + 1) * length), parent
        parent = bone
    bpy.ops.object.mode_set(mode="OBJECT")
    for i in range(bones):
        group = tube.vertex_groups.new(name=f"bone {i}")
        for vertex in tube.data.vertices:
            along = vertex.co.z / length + bones / 2 - i - 0.5
            weight = min(max(1.5 - 2 * abs(along), 0), 1) if 0 < i < bones - 1 else min(max(1.5 - 2 * (along if i == 0 else -along), 0), 1)
            if weight > 0:
                group.add([vertex.index], weight, "REPLACE")
    skin = tube.modifiers.new("skin", "ARMATURE")
    skin.object = rig
    for i, bone in enumerate(rig.pose.bones):
        bone.rotation_mode = "XYZ"
        animated(bone, keys, rotation_euler=lambda f, i=i: (0.25 * math.sin(turn(f) + i), 0, 0.45 * i / bones * math.cos(turn(f))))


SCENES = {"table": table, "robot": robot}
