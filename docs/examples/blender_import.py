"""Import a rig or a sequence (GLB) into Blender: frame rate, frame range and markers as they are.

With Blender: blender --background --python docs/examples/blender_import.py -- rig.glb rig.blend
With its Python module (scripts/blender-venv makes one):
    .venv-blender/bin/python docs/examples/blender_import.py rig.glb rig.blend --fps 30

Each expression is a shape key of the object ``face``, in metres, z up, looking along -y. A rig's
timeline shows one after the other, with a marker where each is held.
"""

import argparse
import math
import sys

import bpy

MOVE_SECONDS = 0.6
HOLD_SECONDS = 0.4
"""From neutral to an expression and back, and how long it is held; docs/reference/rig-format.md."""


def main() -> None:
    """Read the command line, import the file and save the scene."""
    own = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("glb", help="rig.glb or sequence.glb")
    parser.add_argument("blend", help="the scene to write")
    parser.add_argument("--fps", type=int, default=30, help="frames per second of the scene")
    given = parser.parse_args(own)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps = given.fps  # before the import: it turns seconds into frames
    bpy.ops.import_scene.gltf(filepath=given.glb)
    face = bpy.data.objects["face"]
    if bpy.data.actions:
        ends = [action.frame_range[1] for action in bpy.data.actions]
        scene.frame_start = 0
        scene.frame_end = math.ceil(max(ends))
        scene.frame_set(0)
    if "expressions" in bpy.data.actions:
        for number, key in enumerate(face.data.shape_keys.key_blocks[1:]):
            seconds = number * (2 * MOVE_SECONDS + HOLD_SECONDS) + MOVE_SECONDS
            scene.timeline_markers.new(key.name, frame=round(seconds * given.fps))
    bpy.ops.wm.save_as_mainfile(filepath=given.blend)


if __name__ == "__main__":
    main()
