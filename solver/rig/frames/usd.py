"""Values, paths and materials of USD files. Needs the extra ``usd``."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

try:
    from pxr import Gf, Sdf, Tf, Usd, UsdShade, Vt
except ModuleNotFoundError as error:
    raise ModuleNotFoundError("USD is an extra: pip install 'myoface[usd]'") from error

from solver.rig.frames.gltf import MATERIALS
from solver.surface import Floats


def vectors(points: Floats) -> Any:
    """Return points (n, 3) as USD has them."""
    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(points, np.float32))


def numbers(values: np.ndarray) -> Any:
    """Return whole numbers as one row of USD's."""
    return Vt.IntArray.FromNumpy(np.ascontiguousarray(values.ravel(), np.int32))


def extent(points: Floats) -> Any:
    """Return the box about points (n, 3)."""
    return vectors(np.stack([points.min(axis=0), points.max(axis=0)]))


def quaternion(rotation: Floats) -> Gf.Quatf:
    """Return a rotation (3, 3) as a quaternion."""
    x, y, z, w = Rotation.from_matrix(rotation).as_quat(canonical=True).tolist()
    return Gf.Quatf(w, x, y, z)


def free_path(stage: Usd.Stage, parent: Sdf.Path, name: str) -> Sdf.Path:
    """Return a path for a ``name``, changed where USD does not allow it or has it already."""
    identifier = Tf.MakeValidIdentifier(name)
    while stage.GetPrimAtPath(parent.AppendChild(identifier)):
        identifier += "_"
    return parent.AppendChild(identifier)


def define_material(stage: Usd.Stage, scope: Sdf.Path, part: str) -> UsdShade.Material:
    """Define the material of a part of a head under ``scope``, the same as in GLB files."""
    colour, roughness = MATERIALS[part]
    material = UsdShade.Material.Define(stage, scope.AppendChild(part))
    shader = UsdShade.Shader.Define(stage, material.GetPath().AppendChild("Surface"))
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(colour[:3])
    shader.CreateInput("opacity", Sdf.ValueTypeNames.Float).Set(colour[3])
    shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(roughness)
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    return material
