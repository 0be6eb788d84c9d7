"""Run by Blender's Python: write what plays in a studio's scene or FBX file into an NPZ file.

python tests/dcc/blender_studio_scene.py scene.blend|rig.fbx out.npz [frame ...]
"""

import json
import sys

import bpy
import numpy as np
from blender_scene import evaluated


def main() -> None:
    path = sys.argv[1]
    if path.endswith(".fbx"):
        bpy.ops.wm.read_factory_settings(use_empty=True)
        bpy.ops.import_scene.fbx(filepath=path, anim_offset=0.0)
    else:
        bpy.ops.wm.open_mainfile(filepath=path)
    scene = bpy.context.scene
    meshes = [each for each in bpy.data.objects if each.type == "MESH"]
    skin = next(each for each in meshes if each.name == "skin")
    arrays = {}
    strengths = []  # of the skin's wrinkles, a frame each
    for number, frame in enumerate(map(int, sys.argv[3:])):
        scene.frame_set(frame)
        arrays[f"frame_{number}"] = evaluated(skin)
        nodes = skin.material_slots[0].material.node_tree.nodes
        values = {
            each.name: each.outputs[0].default_value for each in nodes if each.type == "VALUE"
        }
        strengths.append(values)
    known = {
        "bones": sorted(bone.name for each in bpy.data.armatures for bone in each.bones),
        "strengths": strengths,
        "keys": [key.name for key in skin.data.shape_keys.key_blocks[1:]],
    }
    np.savez(sys.argv[2], known=json.dumps(known), **arrays)


if __name__ == "__main__":
    main()
