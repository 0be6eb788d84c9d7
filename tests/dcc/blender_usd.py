"""Run by Blender's Python: import a take in USD, and write its meshes at some frames as NPZ.

python tests/dcc/blender_usd.py sequence.usdc out.npz frame [frame ...]
"""

import sys
from pathlib import Path

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from blender_scene import evaluated


def main() -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.usd_import(filepath=sys.argv[1], import_guide=True)
    scene = bpy.context.scene
    arrays = {"range": np.array([scene.frame_start, scene.frame_end])}
    for frame in map(int, sys.argv[3:]):
        scene.frame_set(frame)
        for name in ("Skin", "mandible"):
            arrays[f"{name}_{frame}"] = evaluated(bpy.data.objects[name])
    np.savez(sys.argv[2], **arrays)


if __name__ == "__main__":
    main()
