"""Reading of a face's USD file, by the library's own skeletons and blend shapes.

Needs the extra ``usd``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pxr import Usd, UsdGeom, UsdSkel

from solver.rig.read_back import MorphedSkin
from solver.surface import Floats


def read_usd(path: Path) -> MorphedSkin:
    """Read a USD file as this product writes them; times are time codes."""
    stage, cache = Usd.Stage.Open(str(path)), UsdSkel.Cache()
    face = stage.GetDefaultPrim()
    cache.Populate(UsdSkel.Root(face), Usd.PrimDefaultPredicate)
    place = face.GetPath().AppendChild("Skin")
    binding = UsdSkel.BindingAPI(stage.GetPrimAtPath(place))
    neutral = np.array(UsdGeom.Mesh(stage.GetPrimAtPath(place)).GetPointsAttr().Get())
    names = [str(name) for name in binding.GetBlendShapesAttr().Get() or []]
    query = UsdSkel.BlendShapeQuery(binding)
    shapes = np.zeros((len(names), neutral.size), np.float32)
    for number, row in enumerate(shapes):
        shape = query.GetBlendShape(number)
        moving = np.array(shape.GetPointIndicesAttr().Get(), np.int64)
        row.reshape(-1, 3)[moving] = np.array(shape.GetOffsetsAttr().Get()).reshape(-1, 3)

    def motion(times: Floats) -> tuple[Floats, Floats, Floats]:
        # queries live no longer than stage and cache, which this function keeps
        skinning = cache.GetSkinningQuery(stage.GetPrimAtPath(place))
        skeleton = cache.GetSkelQuery(binding.GetInheritedSkeleton())
        poses, mapper = skeleton.GetAnimQuery(), skinning.GetBlendShapeMapper()
        weights = np.zeros((len(times), len(names)))
        turns, shifts = np.empty((len(times), 3, 3)), np.empty((len(times), 3))
        for row, time in enumerate(times.tolist()):
            if names:
                weights[row] = mapper.Remap(poses.ComputeBlendShapeWeights(time))
            joints = skeleton.ComputeSkinningTransforms(time)
            # of USD's row vectors
            placed = np.array(skinning.ComputeSkinnedTransform(joints, time))
            turns[row], shifts[row] = placed[:3, :3].T, placed[3, :3]
        return weights, turns, shifts

    return MorphedSkin(neutral, names, shapes, motion)
