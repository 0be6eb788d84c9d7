"""``studio.usdc``: a light rig with a skeleton and blend shapes, in USD. Needs the extra ``usd``.

Lengths are mm (``metersPerUnit`` 0.001), y up. ``/Face`` is a SkelRoot with a mesh for each part,
``Skeleton``, and ``Animation``, which holds joints and shapes at rest for a program to set.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdSkel, Vt

from solver.anatomy.texture_coordinates import TextureCoordinates
from solver.rig.frames.gltf import DEFAULTS
from solver.rig.frames.read_back import Comparison
from solver.rig.frames.usd import (
    ROOT,
    define_material,
    define_triangles,
    extent,
    give_blend_shapes,
    give_normals,
    new_stage,
    numbers,
)
from solver.rig.studio.eyes import EYE_COLOURS
from solver.rig.studio.glb import MOST_JOINTS, influences
from solver.rig.studio.light_rig import LightRig
from solver.rig.studio.parts import TEXTURED, Part, parts_of
from solver.rig.studio.skin_texture import COLOURS, NORMALS, SkinTexture
from solver.surface import Floats, Ints


def write_usd(rig: LightRig, path: Path, texture: SkinTexture | None = None) -> None:
    """Write a rig at rest; a part has the blend shapes that move it.

    Skin and eyes wear images that lie beside the file
    (:func:`~solver.rig.studio.glb.worn_images`).
    """
    stage, root = new_stage()
    root.CreateExtentAttr(extent(rig.neutral.vertices))
    _skeleton(stage, rig)
    joints, weights = influences(rig.skeleton.weights)
    UsdGeom.Scope.Define(stage, ROOT.AppendChild("Materials"))
    for part in parts_of(rig.neutral, rig.skeleton, texture.coordinates if texture else None):
        mesh = _mesh(stage, part, rig)
        if part.places is not None and part.name == TEXTURED:
            files = texture.files if texture else {}
            _wear(stage, mesh, part.places, [name for name in (COLOURS, NORMALS) if name in files])
        elif part.places is not None:
            _wear(stage, mesh, part.places, [EYE_COLOURS])
        _bind(mesh, joints[part.vertices], weights[part.vertices])
        used = part.vertices
        moved = part.moving(rig.targets, DEFAULTS.still_mm)
        changes = {name: (rig.targets[name][used], rig.turned[name][used]) for name in moved}
        give_blend_shapes(stage, mesh, changes, DEFAULTS.still_mm)
    stage.GetRootLayer().Export(str(path))


def _paths(rig: LightRig) -> list[str]:
    """Return the joints' paths: all hang on the head."""
    head, *others = rig.skeleton.joints
    return [head, *(f"{head}/{name}" for name in others)]


def _skeleton(stage: Usd.Stage, rig: LightRig) -> None:
    """Define the joints, and an animation in which they and the shapes are at rest."""
    places = rig.skeleton.places
    paths = _paths(rig)
    skeleton = UsdSkel.Skeleton.Define(stage, ROOT.AppendChild("Skeleton"))
    skeleton.CreateJointsAttr(paths)
    own = places - np.vstack([np.zeros(3), np.tile(places[0], (len(places) - 1, 1))])
    skeleton.CreateBindTransformsAttr([_translation(place) for place in places])
    skeleton.CreateRestTransformsAttr([_translation(place) for place in own])
    skeleton.CreatePurposeAttr(UsdGeom.Tokens.guide)
    motion = UsdSkel.Animation.Define(stage, ROOT.AppendChild("Animation"))
    motion.CreateJointsAttr(paths)
    motion.CreateTranslationsAttr([Gf.Vec3f(*place.tolist()) for place in own])
    motion.CreateRotationsAttr([Gf.Quatf(1.0)] * len(paths))
    motion.CreateScalesAttr([Gf.Vec3h(1.0)] * len(paths))
    motion.CreateBlendShapesAttr(list(rig.targets))
    motion.CreateBlendShapeWeightsAttr([0.0] * len(rig.targets))
    binding = UsdSkel.BindingAPI.Apply(skeleton.GetPrim())
    binding.CreateAnimationSourceRel().SetTargets([motion.GetPath()])


def _translation(place: Floats) -> Gf.Matrix4d:
    return Gf.Matrix4d().SetTranslate(Gf.Vec3d(*place.tolist()))


def _mesh(stage: Usd.Stage, part: Part, rig: LightRig) -> UsdGeom.Mesh:
    """Define a part's triangles with its material."""
    own = rig.neutral.vertices[part.vertices]
    mesh = define_triangles(stage, ROOT.AppendChild(part.name), own, part.faces)
    give_normals(mesh, rig.normals[part.vertices])
    scope = ROOT.AppendChild("Materials")
    there = UsdShade.Material.Get(stage, scope.AppendChild(part.material))
    material = there if there else define_material(stage, scope, part.material)
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    return mesh


def _wear(stage: Usd.Stage, mesh: UsdGeom.Mesh, places: Floats, files: Sequence[str]) -> None:
    """Give a mesh places (k, 2) in images, and its material the images in ``files``."""
    primvars = UsdGeom.PrimvarsAPI(mesh)
    coordinates = primvars.CreatePrimvar(
        "st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex
    )
    coordinates.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(places, np.float32)))
    material, _ = UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial()
    reader = UsdShade.Shader.Define(stage, material.GetPath().AppendChild("Coordinates"))
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
    found = reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
    surface = UsdShade.Shader.Get(stage, material.GetPath().AppendChild("Surface"))
    for file in set(files) - {NORMALS}:
        colours = _image(stage, material.GetPath().AppendChild("BaseColour"), file, found)
        colours.GetInput("sourceColorSpace").Set("sRGB")
        surface.GetInput("diffuseColor").ConnectToSource(colours.GetOutput("rgb"))
    if NORMALS in files:
        normals = _image(stage, material.GetPath().AppendChild("Normals"), NORMALS, found)
        normals.CreateInput("scale", Sdf.ValueTypeNames.Float4).Set(Gf.Vec4f(2, 2, 2, 1))
        normals.CreateInput("bias", Sdf.ValueTypeNames.Float4).Set(Gf.Vec4f(-1, -1, -1, 0))
        turned = surface.CreateInput("normal", Sdf.ValueTypeNames.Normal3f)
        turned.ConnectToSource(normals.GetOutput("rgb"))


def _image(
    stage: Usd.Stage, path: Sdf.Path, file: str, coordinates: UsdShade.Output
) -> UsdShade.Shader:
    """Define an image beside the file, whose values are what they are, at ``coordinates``."""
    image = UsdShade.Shader.Define(stage, path)
    image.CreateIdAttr("UsdUVTexture")
    image.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(f"./{file}")
    image.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set("raw")
    image.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(coordinates)
    image.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
    return image


def _bind(mesh: UsdGeom.Mesh, joints: Ints, weights: Floats) -> None:
    """Let a mesh follow the joints (k, 4) by weights."""
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([ROOT.AppendChild("Skeleton")])
    of = {"constant": False, "elementSize": MOST_JOINTS}
    binding.CreateJointIndicesPrimvar(**of).Set(numbers(joints))
    shares = Vt.FloatArray.FromNumpy(np.ascontiguousarray(weights.ravel(), np.float32))
    binding.CreateJointWeightsPrimvar(**of).Set(shares)


def compare_usd(
    rig: LightRig, path: Path, coordinates: TextureCoordinates | None = None
) -> dict[str, Any]:
    """Return how far the file's shapes are off the rig's, whole, its joints at rest.

    Raises :class:`~solver.errors.SolveError` (``file.differs``).
    """
    stage = Usd.Stage.Open(str(path))
    found = Comparison(path.name)
    shown = {name: rig.neutral.vertices.copy() for name in rig.targets}
    for part in parts_of(rig.neutral, rig.skeleton, coordinates):
        mesh = stage.GetPrimAtPath(ROOT.AppendChild(part.name))
        neutral = np.array(UsdGeom.Mesh(mesh).GetPointsAttr().Get(), np.float64)
        for skin in shown.values():
            skin[part.vertices] = neutral
        binding = UsdSkel.BindingAPI(mesh)
        shapes = UsdSkel.BlendShapeQuery(binding)
        for number, name in enumerate(binding.GetBlendShapesAttr().Get() or []):
            shape = shapes.GetBlendShape(number)
            moving = part.vertices[np.array(shape.GetPointIndicesAttr().Get(), np.int64)]
            shown[str(name)][moving] += np.array(shape.GetOffsetsAttr().Get()).reshape(-1, 3)
    for name, motion in rig.targets.items():
        found.add(name, shown[name], rig.neutral.vertices + motion)
    return found.figures()
