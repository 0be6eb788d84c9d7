"""Run by Blender's Python: write what is in a scene into an NPZ file.

python tests/dcc/blender_scene.py scene.blend out.npz [frame ...]
"""

import json
import sys

import bpy
import numpy as np


def evaluated(face) -> np.ndarray:
    """Return the vertices (v, 3) as they are shown, in the world."""
    shown = face.evaluated_get(bpy.context.evaluated_depsgraph_get())
    mesh = shown.to_mesh()
    values = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", values)
    world = np.array(shown.matrix_world)
    shown.to_mesh_clear()
    return values.reshape(-1, 3) @ world[:3, :3].T + world[:3, 3]


def main() -> None:
    bpy.ops.wm.open_mainfile(filepath=sys.argv[1])
    face = bpy.data.objects["face"]
    mesh = face.data
    scene = bpy.context.scene
    normals = np.empty(3 * len(mesh.loops), np.float32)
    mesh.corner_normals.foreach_get("vector", normals)
    corners = np.empty(len(mesh.loops), np.int32)
    mesh.loops.foreach_get("vertex_index", corners)
    arrays = {"normals": normals.reshape(-1, 3), "corners": corners, "rest": evaluated(face)}
    for number, frame in enumerate(map(float, sys.argv[3:])):
        scene.frame_set(int(frame), subframe=frame % 1)
        arrays[f"frame_{number}"] = evaluated(face)
    keys = mesh.shape_keys.key_blocks
    attribute = mesh.attributes.get("_ERROR_MM")
    if attribute is not None:
        values = np.empty(len(mesh.vertices), np.float32)
        attribute.data.foreach_get("value", values)
        arrays["error_mm"] = values
    known = {
        "objects": [each.name for each in bpy.data.objects],
        "keys": [key.name for key in keys],
        "actions": {each.name: list(each.frame_range) for each in bpy.data.actions},
        "range": [scene.frame_start, scene.frame_end],
        "markers": {each.name: each.frame for each in scene.timeline_markers},
        "materials": [each.name for each in mesh.materials],
        "repaired": mesh.validate(),
    }
    mesh.shape_keys.animation_data_clear()
    for shown in keys[1:]:
        for key in keys[1:]:
            key.value = float(key == shown)
        arrays[f"key_{shown.name}"] = evaluated(face)
    np.savez(sys.argv[2], known=json.dumps(known), **arrays)


if __name__ == "__main__":
    main()
