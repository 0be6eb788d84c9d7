"""A rig, or a fitted performance, as USD: a skeleton of head and jaw, and blend shapes.

Needs the extra ``usd``. Lengths are mm (``metersPerUnit`` 0.001), y up. ``/Face`` is a SkelRoot:

- ``Skin``: the skin with its parts as subsets with materials, a BlendShape for each expression, and
  the greatest distance to the scans as the primvar ``error_mm``; of a performance it has the shapes
  of its ``sequence.glb``;
- ``cranium`` and ``mandible``: the bones, with the purpose ``guide``;
- ``Skeleton``: the joints ``head`` and ``head/jaw``. The skin hangs on the head alone, as its
  shapes hold what the jaw does to it; the jaw is for the mandible and what else is fixed to it;
- ``Animation``: one expression after the other, as in ``rig.glb``; of a performance its frames, by
  their numbers as time codes.

Of a rig with several systems the variant set ``system`` has the shapes, distances and animation of
each; its default system is shown until another is chosen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

try:
    from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdSkel, Vt
except ModuleNotFoundError as error:
    raise ModuleNotFoundError("USD is an extra: pip install 'myoface[usd]'") from error

from solver.drawing.head import skin_parts
from solver.errors import InputError
from solver.mechanics.boundary import JAW_FREEDOM, FreeJaw
from solver.model import SubjectModel
from solver.rig.exporters.systems import compare_systems
from solver.rig.expression import ExpressionFit
from solver.rig.frames import MarkerFrame
from solver.rig.frames.animation_gltf import SEQUENCE_SHAPES, AnimatedSkin
from solver.rig.frames.gltf import DEFAULTS, worst_error
from solver.rig.frames.gltf import MorphTargetOptions as Options
from solver.rig.frames.read_back import MorphedSkin, compare_expressions
from solver.rig.frames.usd import (
    ROOT,
    define_material,
    define_triangles,
    extent,
    free_path,
    give_blend_shapes,
    give_normals,
    new_stage,
    numbers,
    quaternion,
)
from solver.rig.rig import Rig
from solver.similarity import IDENTITY, Similarity, small_motion
from solver.surface import Floats, Surface, vertex_normals

FILE = "rig.usdc"
MEDIA_TYPE = "model/vnd.usd"
WITH_EVERY_RIG = True  # where the extra is there
FORMATS = [".usdc", ".usda", ".usd"]
FRAMES_PER_SECOND = 30.0  # of the time codes, as animation tools expect
SKIN = ROOT.AppendChild("Skin")
VARIANTS = "system"  # the variant set of a rig with several systems
HEAD = "head"
JAW = "head/jaw"
JOINTS = [HEAD, JAW]


def write(rig: Rig, path: Path, options: Options = DEFAULTS) -> None:
    """Write a rig as ``.usdc``, ``.usda`` or ``.usd``; a file that is there is replaced.

    Raises :class:`InputError` (``usd.format``) for another ending.
    """
    if path.suffix not in FORMATS:
        message = f"{path.name} does not end in {', '.join(FORMATS)}"
        raise InputError("usd.format", message, file=path.name, expected=FORMATS)
    stage = _stage(rig.model)
    systems = rig.fits_by_system
    names = list(dict.fromkeys(fit.name for fits in systems.values() for fit in fits))
    if not rig.systems:
        _show(stage, rig.model, rig.expressions, names, options)
    else:
        variants = stage.GetDefaultPrim().GetVariantSets().AddVariantSet(VARIANTS)
        for system, fits in systems.items():
            variants.AddVariant(system)
            variants.SetVariantSelection(system)
            with variants.GetVariantEditContext():
                _show(stage, rig.model, fits, names, options)
        variants.SetVariantSelection(rig.default_system)
    stage.GetRootLayer().Export(str(path))


def _show(
    stage: Usd.Stage,
    model: SubjectModel,
    expressions: Sequence[ExpressionFit],
    names: Sequence[str],
    options: Options,
) -> None:
    """Give the skin its expressions, and move it through them; ``names`` are those of all systems.

    Expressions of one name are shown at one time by all systems.
    """
    shapes = {fit.name: fit.skin for fit in expressions}
    _give_shapes(stage, model.skin, shapes, options.still_mm)
    kind = Sdf.ValueTypeNames.FloatArray
    primvars = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(SKIN))
    error = primvars.CreatePrimvar("error_mm", kind, UsdGeom.Tokens.vertex)
    worst = worst_error(expressions, len(model.skin.vertices))
    error.Set(Vt.FloatArray.FromNumpy(worst.astype(np.float32)))
    jaws = np.array([fit.jaw for fit in expressions]).reshape(-1, JAW_FREEDOM)
    times, weights = options.keys(len(names))
    rows = weights[:, [names.index(name) for name in shapes]]
    keys = [
        _Key(round(seconds * FRAMES_PER_SECOND), row, FreeJaw(model.jaw).matrix(row @ jaws))
        for seconds, row in zip(times.tolist(), rows, strict=True)
    ]
    skins = [model.skin.vertices, *shapes.values()]
    held = [_Key(0, rows[0], FreeJaw(model.jaw).matrix(fit.jaw)) for fit in expressions]
    places = [*skins, *(_bones(model, each) for each in (keys[0], *held))]
    _animate(stage, model, list(shapes), keys, FRAMES_PER_SECOND, np.vstack(places))


def read_back(rig: Rig, path: Path, _options: Options = DEFAULTS) -> dict[str, Any]:
    """Return how far the file's skins are off the rig's, of several systems with the worst."""
    if rig.systems:
        return compare_systems(rig, path, lambda system, _: read_usd(path, system))
    return compare_expressions(path, read_usd(path).expressions(), rig.skins())


def write_sequence(
    path: Path,
    model: SubjectModel,
    skin: AnimatedSkin,
    fps: float,
    options: Options = SEQUENCE_SHAPES,
) -> dict[str, Any]:
    """Write the frames of a performance that ``skin`` has taken, ``fps`` a second.

    Returns how far the file is off them, as :meth:`.AnimatedSkin.compare`.
    """
    shapes, weights = skin.morphs()
    stage = _stage(model)
    _give_shapes(stage, model.skin, shapes, options.still_mm)
    keys = []
    places = [skin.extent]
    for frame, row in zip(skin.frames, weights, strict=True):
        mandible = FreeJaw(model.jaw).matrix(frame.jaw)
        if isinstance(frame, MarkerFrame):
            mandible = frame.mandible  # exact where it is on tracks
        keys.append(_Key(frame.frame, row, mandible, small_motion(frame.head)))
        moved = _bones(model, keys[-1])
        if len(moved):
            # of a long take the extremes are enough, and all that fits into memory
            places.append(np.stack([moved.min(axis=0), moved.max(axis=0)]))
    _animate(stage, model, list(shapes), keys, fps, np.vstack(places))
    stage.GetRootLayer().Export(str(path))
    return skin.compare(path, read_usd(path), np.array([key.time for key in keys], np.float64))


class _Key(NamedTuple):
    """A moment of an animation."""

    time: int  # code
    weights: Floats  # (s,) of the shapes
    mandible: Floats  # (4, 4) its motion from rest, in the head's frame
    head: Similarity = IDENTITY


def _stage(model: SubjectModel) -> Usd.Stage:
    """Return a stage with skeleton, skin and bones, at rest."""
    stage, _ = new_stage()
    _skeleton(stage, model)
    _skin(stage, model.skin)
    for name, bone in model.bones.items():
        joint = JAW if name == "mandible" else HEAD
        _mesh(stage, name, bone, joint).CreatePurposeAttr(UsdGeom.Tokens.guide)
    return stage


def _bones(model: SubjectModel, key: _Key) -> Floats:
    """Return the vertices (k, 3) of all bones at a moment."""
    found = [np.zeros((0, 3))]
    for name, bone in model.bones.items():
        places = bone.vertices
        if name == "mandible":
            places = places @ key.mandible[:3, :3].T + key.mandible[:3, 3]
        found.append(key.head(places))
    return np.vstack(found)


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


def _skin(stage: Usd.Stage, skin: Surface) -> None:
    """Define the skin at rest."""
    mesh = _mesh(stage, SKIN.name, skin, joint=HEAD)
    give_normals(mesh, vertex_normals(skin))
    _materials(stage, mesh, skin)


def _give_shapes(
    stage: Usd.Stage, skin: Surface, shapes: Mapping[str, Floats], still_mm: float
) -> None:
    """Give the skin a blend shape for each of ``shapes`` (v, 3)."""
    normals = vertex_normals(skin)
    changes = {
        name: (points - skin.vertices, vertex_normals(skin.with_vertices(points)) - normals)
        for name, points in shapes.items()
    }
    give_blend_shapes(stage, UsdGeom.Mesh(stage.GetPrimAtPath(SKIN)), changes, still_mm)


def _mesh(stage: Usd.Stage, name: str, surface: Surface, joint: str) -> UsdGeom.Mesh:
    """Define triangles that move rigidly with a joint."""
    place = free_path(stage, ROOT, name)
    mesh = define_triangles(stage, place, surface.vertices, surface.faces)
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([ROOT.AppendChild("Skeleton")])
    binding.CreateJointIndicesPrimvar(constant=True, elementSize=1).Set([JOINTS.index(joint)])
    binding.CreateJointWeightsPrimvar(constant=True, elementSize=1).Set([1.0])
    return mesh


def _materials(stage: Usd.Stage, mesh: UsdGeom.Mesh, skin: Surface) -> None:
    """Give every part of the skin its material, the same as in ``rig.glb``."""
    scope = UsdGeom.Scope.Define(stage, ROOT.AppendChild("Materials"))
    for part, faces in skin_parts(skin).items():
        material = define_material(stage, scope.GetPath(), part)
        subset = UsdShade.MaterialBindingAPI(mesh).CreateMaterialBindSubset(part, numbers(faces))
        UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(material)
    UsdShade.MaterialBindingAPI(mesh).SetMaterialBindSubsetsFamilyType(UsdGeom.Tokens.partition)


def _animate(
    stage: Usd.Stage,
    model: SubjectModel,
    shapes: Sequence[str],
    keys: Sequence[_Key],
    fps: float,
    places: Floats,
) -> None:
    """Move shapes, head and jaw by ``keys``; ``places`` (k, 3) span what is moved."""
    animation = UsdSkel.Animation.Define(stage, ROOT.AppendChild("Animation"))
    animation.CreateJointsAttr(JOINTS)
    animation.CreateBlendShapesAttr(list(shapes))
    animation.CreateScalesAttr([Gf.Vec3h(1.0)] * len(JOINTS))
    weights = animation.CreateBlendShapeWeightsAttr()
    translations = animation.CreateTranslationsAttr()
    rotations = animation.CreateRotationsAttr()
    origin = model.jaw.origin
    for key in keys:
        jaw = key.mandible[:3, :3] @ origin + key.mandible[:3, 3]
        weights.Set(Vt.FloatArray.FromNumpy(key.weights.astype(np.float32)), key.time)
        translations.Set([Gf.Vec3f(*each.tolist()) for each in (key.head.shift, jaw)], key.time)
        turns = key.head.rotation, key.mandible[:3, :3]
        rotations.Set([quaternion(each) for each in turns], key.time)
    UsdSkel.Root(stage.GetPrimAtPath(ROOT)).CreateExtentAttr(extent(places))
    stage.SetTimeCodesPerSecond(fps)
    stage.SetFramesPerSecond(fps)
    stage.SetStartTimeCode(keys[0].time)
    stage.SetEndTimeCode(keys[-1].time)


# Reading of a face's USD file, by the library's own skeletons and blend shapes.


def read_usd(path: Path, system: str | None = None) -> MorphedSkin:
    """Read a USD file as this product writes them; times are time codes.

    ``system`` is one of a rig's in the place of that which the file shows.
    """
    stage = Usd.Stage.Open(str(path))
    cache = UsdSkel.Cache()
    face = stage.GetDefaultPrim()
    if system is not None:
        stage.SetEditTarget(stage.GetSessionLayer())
        face.GetVariantSet(VARIANTS).SetVariantSelection(system)
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
        poses = skeleton.GetAnimQuery()
        mapper = skinning.GetBlendShapeMapper()
        weights = np.zeros((len(times), len(names)))
        turns = np.empty((len(times), 3, 3))
        shifts = np.empty((len(times), 3))
        for row, time in enumerate(times.tolist()):
            if names:
                weights[row] = mapper.Remap(poses.ComputeBlendShapeWeights(time))
            joints = skeleton.ComputeSkinningTransforms(time)
            # of USD's row vectors
            placed = np.array(skinning.ComputeSkinnedTransform(joints, time))
            turns[row] = placed[:3, :3].T
            shifts[row] = placed[3, :3]
        return weights, turns, shifts

    return MorphedSkin(neutral, names, shapes, motion)
