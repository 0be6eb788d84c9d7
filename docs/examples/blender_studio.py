"""Bring a studio's rig (studio.glb) into Blender, play a recording on it, and write FBX.

With Blender: blender --background --python docs/examples/blender_studio.py -- studio.glb rig.blend
With its Python module (scripts/blender-venv makes one):
    .venv-blender/bin/python docs/examples/blender_studio.py studio.glb rig.blend \
        --recording take.csv --rate 60 --fbx rig.fbx

The object ``skin`` has the shapes; all other parts follow its values by drivers, and so do the
shapes ``..._half``. Wrinkles that ``studio.json``, beside the GLB, names are added to the skin's
normals, driven by its shapes. Where that file has turns for a shape, joints are keyed by the
recording's weights, too. A recording is a CSV file of Live Link Face.
"""

import argparse
import csv
import json
import sys
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix, Quaternion, Vector

SKIN = "skin"
HALF = "_half"
LEAST_UP = 0.1  # part of a wrinkle's normal along the mesh's
MOST_TERMS = 20  # of an expression in Blender, which takes 256 characters
# Blender's axes by glTF's: y up becomes z up, the face looks along -y
TO_BLENDER = Matrix(((1, 0, 0, 0), (0, 0, -1, 0), (0, 1, 0, 0), (0, 0, 0, 1)))


def main() -> None:
    """Read the command line, make the scene and write it."""
    own = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("glb", type=Path, help="studio.glb, with studio.json beside it")
    parser.add_argument("blend", help="the scene to write")
    parser.add_argument("--recording", type=Path, help="CSV file of Live Link Face")
    parser.add_argument("--rate", type=float, default=60.0, help="frames per second of it")
    parser.add_argument("--fbx", help="the FBX file to write")
    given = parser.parse_args(own)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    bpy.ops.import_scene.gltf(filepath=str(given.glb))
    objects = bpy.data.objects
    keys = {
        each.name: each.data.shape_keys
        for each in objects
        if each.type == "MESH" and each.data.shape_keys
    }
    follow(keys)
    known = json.loads(given.glb.with_name("studio.json").read_text(encoding="utf-8"))
    if known.get("wrinkles") and objects[SKIN].data.uv_layers:
        add_wrinkles(objects[SKIN], known["wrinkles"], given.glb.parent)
    if given.recording is not None:
        weights = read_recording(given.recording)
        scene.render.fps = round(given.rate)
        scene.render.fps_base = round(given.rate) / given.rate
        scene.frame_start = 0
        scene.frame_end = max(map(len, weights.values()), default=1) - 1
        play(keys[SKIN], weights)
        armature = next(each for each in objects if each.type == "ARMATURE")
        turn(armature, known, weights, scene.frame_end + 1)
    bpy.ops.wm.save_as_mainfile(filepath=str(given.blend))
    if given.fbx is not None:
        bpy.ops.export_scene.fbx(
            filepath=given.fbx,
            object_types={"ARMATURE", "MESH"},
            add_leaf_bones=False,
            bake_anim_use_nla_strips=False,  # with these, shapes' values are left out
            bake_anim_use_all_actions=False,
            bake_anim_simplify_factor=0.0,
            path_mode="COPY",
            embed_textures=True,
        )


def follow(keys: dict) -> None:
    """Have the shapes of other parts follow the skin's, and those half way into a shape lead it."""
    skin = keys[SKIN]
    for name, blocks in keys.items():
        for block in blocks.key_blocks[1:]:
            is_half = block.name.endswith(HALF)
            if name == SKIN and not is_half:
                continue
            driver = block.driver_add("value").driver
            variable = driver.variables.new()
            variable.name = "w"
            target = variable.targets[0]
            target.id_type = "KEY"
            target.id = skin
            target.data_path = f'key_blocks["{block.name.removesuffix(HALF)}"].value'
            driver.type = "SCRIPTED"
            driver.expression = "4 * w * (1 - w)" if is_half else "w"


class Nodes:
    """Makes nodes of a material whose inputs are sockets or values."""

    def __init__(self, material: bpy.types.Material) -> None:
        self.tree = material.node_tree

    def of(self, kind: str, *inputs: object, operation: str = "") -> bpy.types.Node:
        """Return a new node; ``inputs`` are its first ones."""
        node = self.tree.nodes.new(kind)
        if operation:
            node.operation = operation
        for socket, given in zip(node.inputs, inputs, strict=False):
            if isinstance(given, bpy.types.NodeSocket):
                self.tree.links.new(given, socket)
            else:
                socket.default_value = given
        return node

    def number(self, operation: str, *inputs: object) -> bpy.types.NodeSocket:
        """Return what comes of numbers."""
        return self.of("ShaderNodeMath", *inputs, operation=operation).outputs[0]

    def slopes(self, colour: bpy.types.NodeSocket) -> list:
        """Return x / z and y / z of the normal that a map's colour stands for."""
        parts = self.of("ShaderNodeSeparateColor", colour).outputs
        x, y, z = (
            self.number("MULTIPLY_ADD", part, 2.0, -1.0)
            for part in (parts["Red"], parts["Green"], parts["Blue"])
        )
        up = self.number("MAXIMUM", z, LEAST_UP)
        return [self.number("DIVIDE", x, up), self.number("DIVIDE", y, up)]


def add_wrinkles(skin: bpy.types.Object, wrinkles: dict, folder: Path) -> None:
    """Add wrinkle maps to the normals of a skin, as strong as its shapes' values say.

    Slopes add up: normal = normalize(n.xy / n.z + sum s m e.xy / e.z, 1), m a map's opacity; no z
    counts as less than LEAST_UP.
    """
    material = skin.material_slots[0].material
    nodes = Nodes(material)
    tree = nodes.tree
    bent = next((each for each in tree.nodes if each.type == "NORMAL_MAP"), None)
    if bent is None:
        bent = nodes.of("ShaderNodeNormalMap")
        surface = next(each for each in tree.nodes if each.type == "BSDF_PRINCIPLED")
        tree.links.new(bent.outputs["Normal"], surface.inputs["Normal"])
    colour = bent.inputs["Color"]
    slopes = nodes.slopes(colour.links[0].from_socket) if colour.links else [0.0, 0.0]
    for name, told in wrinkles.items():
        image = bpy.data.images.load(str(folder / told["file"]))
        image.colorspace_settings.name = "Non-Color"
        image.alpha_mode = "CHANNEL_PACKED"
        image.pack()
        read = nodes.of("ShaderNodeTexImage")
        read.image = image
        strength = nodes.of("ShaderNodeValue")
        strength.name = strength.label = name
        drive(strength.outputs[0], skin.data.shape_keys, told["driven_by"])
        share = nodes.number("MULTIPLY", strength.outputs[0], read.outputs["Alpha"])
        own = nodes.slopes(read.outputs["Color"])
        slopes = [
            nodes.number("MULTIPLY_ADD", slope, share, before)
            for slope, before in zip(own, slopes, strict=True)
        ]
    normal = nodes.of("ShaderNodeCombineXYZ", *slopes, 1.0).outputs[0]
    unit = nodes.of("ShaderNodeVectorMath", normal, operation="NORMALIZE").outputs[0]
    half = (0.5, 0.5, 0.5)
    mapped = nodes.of("ShaderNodeVectorMath", unit, half, half, operation="MULTIPLY_ADD")
    tree.links.new(mapped.outputs[0], colour)


def drive(socket: bpy.types.NodeSocket, keys: bpy.types.Key, driven_by: dict) -> None:
    """Drive a value by shapes w: min(max(sum w c, 0) / sum c c, 1)."""
    driver = socket.driver_add("default_value").driver
    whole = sum(weight**2 for weight in driven_by.values())
    strongest = sorted(driven_by.items(), key=lambda item: -abs(item[1]))[:MOST_TERMS]
    for number, (shape, _) in enumerate(strongest):
        variable = driver.variables.new()
        variable.name = f"w{number}"
        variable.targets[0].id_type = "KEY"
        variable.targets[0].id = keys
        variable.targets[0].data_path = f'key_blocks["{shape}"].value'
    along = "+".join(f"{weight / whole:.4f}*w{k}" for k, (_, weight) in enumerate(strongest))
    driver.type = "SCRIPTED"
    driver.expression = f"min(max({along}, 0), 1)"


def read_recording(path: Path) -> dict[str, np.ndarray]:
    """Return the weights of each frame by the shapes' names, whose first letter is small."""
    with path.open(newline="", encoding="utf-8-sig") as stream:
        rows = list(csv.DictReader(stream))
    names = [name for name in (rows[0] if rows else {}) if name[:1].isupper()]
    found = {}
    for name in names:
        try:
            values = np.array([float(row[name]) for row in rows])
        except (TypeError, ValueError):
            continue  # a timecode
        found[name[0].lower() + name[1:]] = values
    return found


def play(skin: bpy.types.Key, weights: dict[str, np.ndarray]) -> None:
    """Key the skin's shapes by weights, a frame each."""
    for block in skin.key_blocks[1:]:
        # Blender cuts what is beyond
        block.slider_min = -1.0
        block.slider_max = 2.0
        for frame, value in enumerate(weights.get(block.name, ())):
            block.value = value
            block.keyframe_insert("value", frame=frame)


def turn(armature: bpy.types.Object, known: dict, weights: dict, frames: int) -> None:
    """Key the joints that shapes turn: rotation vectors and shifts add up by the weights."""
    for joint, place in known["joints"].items():
        twists = np.zeros((frames, 6))
        for shape, told in known["shapes"].items():
            moved = told.get("joints", {}).get(joint)
            if moved and shape in weights:
                twist = [*np.radians(moved["turn_deg"]), *moved["move_mm"]]
                twists += np.outer(weights[shape], twist)
        if twists.any():
            bone = armature.pose.bones[joint]
            for frame, twist in enumerate(twists):
                bone.matrix = placed(place, twist) @ bone.bone.matrix_local
                bone.keyframe_insert("location", frame=frame)
                bone.keyframe_insert("rotation_quaternion", frame=frame)


def placed(place: list, twist: np.ndarray) -> Matrix:
    """Return the motion of a turn about a place and a shift, in Blender's axes and metres."""
    about = Vector(place)
    axis = Vector(twist[:3])
    turned = Quaternion(axis.normalized(), axis.length) if axis.length else Quaternion()
    shift = about + Vector(twist[3:]) - turned @ about
    motion = Matrix.LocRotScale(shift / 1000.0, turned, None)
    return TO_BLENDER @ motion @ TO_BLENDER.inverted()


if __name__ == "__main__":
    main()
