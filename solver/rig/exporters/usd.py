"""A rig as USD: a skeleton of head and jaw, and a blend shape for every expression.

Needs the extra ``usd``. Lengths are mm (``metersPerUnit`` 0.001), y up. ``/Face`` is a SkelRoot:

- ``Skin``: the skin with its parts as subsets with materials, a BlendShape for each expression, and
  the greatest distance to the scans as the primvar ``error_mm``;
- ``cranium`` and ``mandible``: the bones, with the purpose ``guide``;
- ``Skeleton``: the joints ``head`` and ``head/jaw``. The skin hangs on the head alone, as its
  shapes hold what the jaw does to it; the jaw is for the mandible and what else is fixed to it;
- ``Animation``: one expression after the other, as in ``rig.glb``.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

try:
    from pxr import Gf, Kind, Sdf, Tf, Usd, UsdGeom, UsdShade, UsdSkel, Vt
except ModuleNotFoundError as error:
    raise ModuleNotFoundError("USD is an extra: pip install 'myoface[usd]'") from error

from solver.drawing.head import skin_parts
from solver.errors import InputError
from solver.mechanics.boundary import JAW_FREEDOM, jaw_rotation, move_jaw
from solver.model import SubjectModel
from solver.rig.gltf import DEFAULTS, MATERIALS, worst_error
from solver.rig.gltf import ShapeOptions as Options
from solver.rig.rig import ExpressionFit, Rig
from solver.surface import Floats, Surface, vertex_normals

FILE = "rig.usdc"
MEDIA_TYPE = "model/vnd.usd"
WITH_EVERY_RIG = True  # where the extra is there
FORMATS = [".usdc", ".usda", ".usd"]
FRAMES_PER_SECOND = 30.0  # of the time codes, as animation tools expect
ROOT = Sdf.Path("/Face")
HEAD, JAW = "head", "head/jaw"
JOINTS = [HEAD, JAW]


def write(rig: Rig, path: Path, options: Options = DEFAULTS) -> None:
    """Write a rig as ``.usdc``, ``.usda`` or ``.usd``; a file that is there is replaced.

    Raises :class:`InputError` (``usd.format``) for another ending.
    """
    if path.suffix not in FORMATS:
        message = f"{path.name} does not end in {', '.join(FORMATS)}"
        raise InputError("usd.format", message, file=path.name, expected=FORMATS)
    model, expressions = rig.model, rig.expressions
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, UsdGeom.LinearUnits.millimeters)
    root = UsdSkel.Root.Define(stage, ROOT)
    stage.SetDefaultPrim(root.GetPrim())
    Usd.ModelAPI(root).SetKind(Kind.Tokens.component)
    _skeleton(stage, model)
    _skin(stage, model.skin, expressions, options.still_mm)
    for name, bone in model.bones.items():
        joint = JAW if name == "mandible" else HEAD
        _mesh(stage, name, bone, joint).CreatePurposeAttr(UsdGeom.Tokens.guide)
    _animation(stage, model, expressions, options)
    places = [surface.vertices for surface in (model.skin, *model.bones.values())]
    for fit in expressions:
        places.append(fit.skin)
        if "mandible" in model.bones:
            places.append(move_jaw(model.jaw, model.bones["mandible"].vertices, fit.jaw))
    root.CreateExtentAttr(_extent(np.vstack(places)))
    stage.GetRootLayer().Export(str(path))


def _skeleton(stage: Usd.Stage, model: SubjectModel) -> None:
    """Define the joints; the jaw's is half way between the condyles, along the head's axes."""
    skeleton = UsdSkel.Skeleton.Define(stage, ROOT.AppendChild("Skeleton"))
    skeleton.CreateJointsAttr(JOINTS)
    places = [Gf.Matrix4d(1.0), Gf.Matrix4d().SetTranslate(Gf.Vec3d(*model.jaw.origin.tolist()))]
    skeleton.CreateBindTransformsAttr(places)
    skeleton.CreateRestTransformsAttr(places)
    skeleton.CreatePurposeAttr(UsdGeom.Tokens.guide)
    binding = UsdSkel.BindingAPI.Apply(skeleton.GetPrim())
    binding.CreateAnimationSourceRel().SetTargets([ROOT.AppendChild("Animation")])


def _skin(
    stage: Usd.Stage, skin: Surface, expressions: Sequence[ExpressionFit], still_mm: float
) -> None:
    mesh = _mesh(stage, "Skin", skin, joint=HEAD)
    normals = vertex_normals(skin)
    mesh.CreateNormalsAttr(_vectors(normals))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    kind, primvars = Sdf.ValueTypeNames.FloatArray, UsdGeom.PrimvarsAPI(mesh)
    error = primvars.CreatePrimvar("error_mm", kind, UsdGeom.Tokens.vertex)
    worst = worst_error(expressions, len(skin.vertices))
    error.Set(Vt.FloatArray.FromNumpy(worst.astype(np.float32)))
    _materials(stage, mesh, skin)
    shapes = []
    for fit in expressions:
        place = _free(stage, mesh.GetPath(), fit.name)
        change = fit.skin - skin.vertices
        moving = np.flatnonzero((np.abs(change) > still_mm).any(axis=1))
        turned = vertex_normals(skin.moved(fit.skin)) - normals
        shape = UsdSkel.BlendShape.Define(stage, place)
        shape.CreatePointIndicesAttr(Vt.IntArray.FromNumpy(moving.astype(np.int32)))
        shape.CreateOffsetsAttr(_vectors(change[moving]))
        shape.CreateNormalOffsetsAttr(_vectors(turned[moving]))
        shapes.append(place)
    binding = UsdSkel.BindingAPI(mesh)
    binding.CreateBlendShapesAttr([fit.name for fit in expressions])
    binding.CreateBlendShapeTargetsRel().SetTargets(shapes)


def _mesh(stage: Usd.Stage, name: str, surface: Surface, joint: str) -> UsdGeom.Mesh:
    """Define triangles that move rigidly with a joint."""
    mesh = UsdGeom.Mesh.Define(stage, _free(stage, ROOT, name))
    mesh.CreatePointsAttr(_vectors(surface.vertices))
    mesh.CreateFaceVertexCountsAttr([3] * len(surface.faces))
    mesh.CreateFaceVertexIndicesAttr(_numbers(surface.faces))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateDoubleSidedAttr(True)
    mesh.CreateExtentAttr(_extent(surface.vertices))
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([ROOT.AppendChild("Skeleton")])
    binding.CreateJointIndicesPrimvar(constant=True, elementSize=1).Set([JOINTS.index(joint)])
    binding.CreateJointWeightsPrimvar(constant=True, elementSize=1).Set([1.0])
    return mesh


def _materials(stage: Usd.Stage, mesh: UsdGeom.Mesh, skin: Surface) -> None:
    """Give every part of the skin its material, the same as in ``rig.glb``."""
    scope = UsdGeom.Scope.Define(stage, ROOT.AppendChild("Materials"))
    for part, faces in skin_parts(skin).items():
        colour, roughness = MATERIALS[part]
        material = UsdShade.Material.Define(stage, scope.GetPath().AppendChild(part))
        shader = UsdShade.Shader.Define(stage, material.GetPath().AppendChild("Surface"))
        shader.CreateIdAttr("UsdPreviewSurface")
        shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(colour[:3])
        shader.CreateInput("opacity", Sdf.ValueTypeNames.Float).Set(colour[3])
        shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(roughness)
        material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
        subset = UsdShade.MaterialBindingAPI(mesh).CreateMaterialBindSubset(part, _numbers(faces))
        UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(material)
    UsdShade.MaterialBindingAPI(mesh).SetMaterialBindSubsetsFamilyType(UsdGeom.Tokens.partition)


def _animation(
    stage: Usd.Stage, model: SubjectModel, expressions: Sequence[ExpressionFit], options: Options
) -> None:
    """Move shapes and jaw: from neutral to an expression, hold it, and back, one by one."""
    animation = UsdSkel.Animation.Define(stage, ROOT.AppendChild("Animation"))
    animation.CreateJointsAttr(JOINTS)
    animation.CreateBlendShapesAttr([fit.name for fit in expressions])
    animation.CreateScalesAttr([Gf.Vec3h(1.0)] * len(JOINTS))
    weights = animation.CreateBlendShapeWeightsAttr()
    translations, rotations = animation.CreateTranslationsAttr(), animation.CreateRotationsAttr()

    jaws = np.array([fit.jaw for fit in expressions]).reshape(-1, JAW_FREEDOM)
    times, rows = options.keys(len(expressions))
    for seconds, shown in zip(times.tolist(), rows, strict=True):
        time, b = Usd.TimeCode(round(seconds * FRAMES_PER_SECOND)), shown @ jaws
        x, y, z, w = Rotation.from_matrix(jaw_rotation(model.jaw, b)).as_quat().tolist()
        place = move_jaw(model.jaw, model.jaw.origin[None], b)[0]
        weights.Set(Vt.FloatArray.FromNumpy(shown.astype(np.float32)), time)
        translations.Set([Gf.Vec3f(0.0), Gf.Vec3f(*place.tolist())], time)
        rotations.Set([Gf.Quatf(1.0), Gf.Quatf(w, x, y, z)], time)
    stage.SetTimeCodesPerSecond(FRAMES_PER_SECOND)
    stage.SetFramesPerSecond(FRAMES_PER_SECOND)
    stage.SetStartTimeCode(0.0)
    stage.SetEndTimeCode(round(times[-1] * FRAMES_PER_SECOND))


def _free(stage: Usd.Stage, parent: Sdf.Path, name: str) -> Sdf.Path:
    """Return a path for a ``name``, changed where USD does not allow it or has it already."""
    identifier = Tf.MakeValidIdentifier(name)
    while stage.GetPrimAtPath(parent.AppendChild(identifier)):
        identifier += "_"
    return parent.AppendChild(identifier)


def _vectors(points: Floats) -> Any:
    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(points, np.float32))


def _numbers(values: np.ndarray) -> Any:
    return Vt.IntArray.FromNumpy(np.ascontiguousarray(values.ravel(), np.int32))


def _extent(points: Floats) -> Any:
    return _vectors(np.stack([points.min(axis=0), points.max(axis=0)]))
