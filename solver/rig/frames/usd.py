"""Values, paths and materials of USD files. Needs the extra ``usd``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

try:
    from pxr import Gf, Kind, Sdf, Tf, Usd, UsdGeom, UsdShade, UsdSkel, Vt
except ModuleNotFoundError as error:
    raise ModuleNotFoundError("USD is an extra: pip install 'myoface[usd]'") from error

from solver.rig.frames.gltf import MATERIALS
from solver.surface import Floats, Ints

ROOT = Sdf.Path("/Face")  # of every file


def new_stage() -> tuple[Usd.Stage, UsdSkel.Root]:
    """Return an empty stage in mm, y up, and its root, which holds a skeleton."""
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, UsdGeom.LinearUnits.millimeters)
    root = UsdSkel.Root.Define(stage, ROOT)
    stage.SetDefaultPrim(root.GetPrim())
    Usd.ModelAPI(root).SetKind(Kind.Tokens.component)
    return stage, root


def define_triangles(stage: Usd.Stage, path: Sdf.Path, points: Floats, faces: Ints) -> UsdGeom.Mesh:
    """Define triangles (f, 3) with corners at ``points`` (n, 3), which are seen from both sides."""
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr(vectors(points))
    mesh.CreateFaceVertexCountsAttr([3] * len(faces))
    mesh.CreateFaceVertexIndicesAttr(numbers(faces))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateDoubleSidedAttr(True)
    mesh.CreateExtentAttr(extent(points))
    return mesh


def give_normals(mesh: UsdGeom.Mesh, normals: Floats) -> None:
    """Give a mesh the normals (n, 3) of its points."""
    mesh.CreateNormalsAttr(vectors(normals))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)


def give_blend_shapes(
    stage: Usd.Stage,
    mesh: UsdGeom.Mesh,
    shapes: Mapping[str, tuple[Floats, Floats]],
    still_mm: float,
) -> None:
    """Give a mesh ``shapes``: by name the changes (n, 3) of its points and of its normals.

    Points that move less than ``still_mm`` are left out.
    """
    places = []
    for name, (change, turned) in shapes.items():
        moving = np.flatnonzero((np.abs(change) > still_mm).any(axis=1))
        places.append(free_path(stage, mesh.GetPath(), name))
        shape = UsdSkel.BlendShape.Define(stage, places[-1])
        shape.CreatePointIndicesAttr(numbers(moving))
        shape.CreateOffsetsAttr(vectors(change[moving]))
        shape.CreateNormalOffsetsAttr(vectors(turned[moving]))
    binding = UsdSkel.BindingAPI(mesh)
    binding.CreateBlendShapesAttr(list(shapes))
    binding.CreateBlendShapeTargetsRel().SetTargets(places)


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
