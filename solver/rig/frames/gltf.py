"""Skins with morph targets and animations in one binary file, after glTF 2.0."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Protocol

import numpy as np
import pygltflib as gl
from pydantic import Field
from scipy.spatial.transform import Rotation

from solver.drawing.head import skin_parts
from solver.rig.expression import ExpressionFit
from solver.rig.frames.gltf_buffer import METRES, Buffer
from solver.surface import Floats, Ints, Surface, vertex_normals

GENERATOR = "Myoface"
ERROR_ATTRIBUTE = "_ERROR_MM"
NOTHING: Mapping[str, Floats] = MappingProxyType({})
# property of a node that is moved -> accessors of its times and its values
Tracks = Mapping[str, tuple[int, int]]
MATERIALS = {  # linear base colour and opacity, roughness
    "skin": ((0.67, 0.40, 0.30, 1.0), 0.55),
    "eyes": ((0.80, 0.80, 0.78, 1.0), 0.10),
    "teeth": ((0.78, 0.72, 0.60, 1.0), 0.25),
    "mouth": ((0.42, 0.10, 0.10, 1.0), 0.35),  # gums and tongue in one
    "gums": ((0.44, 0.12, 0.12, 1.0), 0.30),
    "tongue": ((0.40, 0.11, 0.11, 1.0), 0.40),
    "lashes": ((0.10, 0.07, 0.06, 0.15), 0.60),
    "object": ((0.35, 0.45, 0.52, 0.30), 0.20),
}


NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
# of 24 frames a second, which USD counts by, there is one in between
Seconds = Annotated[float, Field(ge=0.05, le=60.0, allow_inf_nan=False)]


@dataclass(frozen=True)
class MorphTargetOptions:
    """Limits below which a shape is still, and the times in which shapes are shown in turn."""

    still_mm: NotNegative = 1e-3  # a vertex that moves less is left out of a sparse target
    still_normal: NotNegative = 1e-3  # and one whose normal turns less, of length 1
    move_seconds: Seconds = 0.6  # from the neutral to a shape, and back
    hold_seconds: Seconds = 0.4

    def keys(self, count: int) -> tuple[Floats, Floats]:
        """Return times (k,) in s and weights (k, count): neutral, shape, neutral, one by one."""
        period = 2 * self.move_seconds + self.hold_seconds
        steps = np.array([self.move_seconds, self.move_seconds + self.hold_seconds, period])
        times = (period * np.arange(count)[:, None] + steps).ravel()
        rows = np.kron(np.eye(count), [[1.0], [1.0], [0.0]])
        return np.append(0.0, times), np.vstack([np.zeros((1, count)), rows])


DEFAULTS = MorphTargetOptions()  # every expression whole, a second and a half each


@dataclass(frozen=True)
class Solid:
    """A rigid ``shape`` (mm) and its ``places`` (f, 6): rotation vectors in rad, shifts in mm."""

    name: str
    shape: Surface
    places: Floats


class Chain(Protocol):
    """Joints, each hanging on the one before, that carry a skin: :mod:`.joints`."""

    @property
    def nodes(self) -> list[gl.Node]:
        """Return a node of each joint."""

    def attributes(self, buffer: Buffer) -> dict[str, int]:
        """Add each vertex's joints and weights, and return their accessors by attribute."""

    def skin(self, buffer: Buffer, first: int) -> gl.Skin:
        """Return the skin whose joints are nodes from the number ``first`` on."""


def write_face(
    path: Path,
    neutral: Surface,
    shapes: Mapping[str, Floats],
    animate: Callable[[Buffer, int], gl.Animation | None],
    attributes: Mapping[str, Floats] = NOTHING,
    options: MorphTargetOptions = DEFAULTS,
) -> None:
    """Write a skin with named ``shapes`` (v, 3), mm, as morph targets of node 0, and an animation.

    Every part of the skin (skin, eyes, teeth ...) is a primitive with its own material; they share
    all vertex data, so that vertex numbers stay the scan's. ``attributes`` are more values (v,) of
    the vertices. ``animate`` gets the buffer and the number of shapes; None is no animation.
    """

    def targets(buffer: Buffer, normals: Floats) -> list[gl.Attributes]:
        return _targets(buffer, neutral, normals, shapes, options)

    write_morphed(path, neutral, list(shapes), targets, animate, attributes)


def write_faces(
    path: Path,
    neutral: Surface,
    faces: Mapping[str, Mapping[str, Floats]],
    errors: Mapping[str, Floats],
    apart_mm: float = 0.0,
    options: MorphTargetOptions = DEFAULTS,
) -> None:
    """Write several faces of one skin, name -> named shapes (v, 3), mm, that move together.

    Each is a node of its name, ``apart_mm`` to the side of the one before; they share the skin's
    vertices, normals and triangles. ``errors`` are the values (v,) of each that
    :func:`write_face` has as an attribute. Shapes of one name are shown at one time.
    """
    buffer = Buffer()
    normals = vertex_normals(neutral)
    base = _base(buffer, neutral, normals)
    parts = _parts(neutral)
    triangles = [buffer.indices(neutral.faces[part]) for part in parts.values()]
    names = list(dict.fromkeys(name for shapes in faces.values() for name in shapes))
    times, weights = options.keys(len(names))
    at_keys = buffer.dense(times, gl.SCALAR, bounds=True)
    meshes = list[gl.Mesh]()
    tracks = list[Tracks]()
    for name, shapes in faces.items():
        error = buffer.dense(errors[name], gl.SCALAR, gl.ARRAY_BUFFER)
        of_vertices = gl.Attributes(**{**base, ERROR_ATTRIBUTE: error})
        targets = _targets(buffer, neutral, normals, shapes, options)
        meshes.append(_morph_mesh(f"face.{name}", list(shapes), of_vertices, triangles, targets))
        own = weights[:, [names.index(shape) for shape in shapes]]
        values = {gl.WEIGHTS: (at_keys, buffer.dense(own.ravel(), gl.SCALAR))} if shapes else {}
        tracks.append(values)
    places = [[number * apart_mm * METRES, 0.0, 0.0] for number in range(len(meshes))]
    _save(
        path,
        buffer,
        [
            gl.Node(name=mesh.name, mesh=number, translation=place)
            for number, (mesh, place) in enumerate(zip(meshes, places, strict=True))
        ],
        meshes,
        list(parts),
        animation("expressions", *tracks) if names else None,
    )


def write_morphed(
    path: Path,
    neutral: Surface,
    names: Sequence[str],
    make_targets: Callable[[Buffer, Floats], list[gl.Attributes]],
    animate: Callable[[Buffer, int], gl.Animation | None],
    attributes: Mapping[str, Floats] = NOTHING,
    extensions: Sequence[str] = (),
    solids: Sequence[Solid] = (),
    joints: Chain | None = None,
) -> None:
    """Write as :func:`write_face` morph targets that ``make_targets`` puts into the buffer.

    It gets the neutral's normals (v, 3); a reader needs the ``extensions`` of glTF to read them.
    ``solids`` are nodes 1, 2 ... by their names, then come the ``joints`` that carry the skin.
    """
    buffer = Buffer()
    normals = vertex_normals(neutral)
    of_vertices = gl.Attributes(**_base(buffer, neutral, normals))
    if joints is not None:
        for name, accessor in joints.attributes(buffer).items():
            setattr(of_vertices, name, accessor)
    for name, values in attributes.items():
        setattr(of_vertices, name, buffer.dense(values, gl.SCALAR, gl.ARRAY_BUFFER))
    targets = make_targets(buffer, normals)
    animation = animate(buffer, len(names))
    parts = _parts(neutral)
    triangles = [buffer.indices(neutral.faces[part]) for part in parts.values()]
    face = gl.Node(name="face", mesh=0)
    nodes = [face, *(_node(solid, number) for number, solid in enumerate(solids, start=1))]
    skins = list[gl.Skin]()
    roots = len(nodes)
    if joints is not None:
        skins = [joints.skin(buffer, len(nodes))]
        roots = len(nodes) + 1
        face.skin = 0
        hanging = joints.nodes
        for number, node in enumerate(hanging[:-1], start=len(nodes) + 1):
            node.children = [number]
        nodes += hanging
    _save(
        path,
        buffer,
        nodes,
        [
            _morph_mesh("face", names, of_vertices, triangles, targets),
            *(_mesh(buffer, solid, len(parts)) for solid in solids),
        ],
        [*parts, "object"] if solids else list(parts),
        animation,
        extensions,
        skins,
        roots,
    )


def _base(buffer: Buffer, neutral: Surface, normals: Floats) -> dict[str, int]:
    """Add a skin's vertices and normals, and return their accessors by attribute."""
    points = neutral.vertices * METRES
    return {
        "POSITION": buffer.dense(points, gl.VEC3, gl.ARRAY_BUFFER, bounds=True),
        "NORMAL": buffer.dense(normals, gl.VEC3, gl.ARRAY_BUFFER),
    }


def _targets(
    buffer: Buffer,
    neutral: Surface,
    normals: Floats,
    shapes: Mapping[str, Floats],
    options: MorphTargetOptions,
) -> list[gl.Attributes]:
    """Add shapes (v, 3), mm, as changes of positions and normals."""
    return [
        gl.Attributes(
            POSITION=buffer.morph(
                (shape - neutral.vertices) * METRES, options.still_mm * METRES, bounds=True
            ),
            NORMAL=buffer.morph(
                vertex_normals(neutral.with_vertices(shape)) - normals, options.still_normal
            ),
        )
        for shape in shapes.values()
    ]


def _parts(neutral: Surface) -> dict[str, Ints]:
    """Return the triangles of each part of a skin, which is a primitive with its own material."""
    # Blender numbers vertices by primitives: so it keeps their order where parts do not mix
    return dict(sorted(skin_parts(neutral).items(), key=lambda part: neutral.faces[part[1]].min()))


def _morph_mesh(
    name: str,
    names: Sequence[str],
    of_vertices: gl.Attributes,
    triangles: Sequence[int],
    targets: list[gl.Attributes],
) -> gl.Mesh:
    """Return a mesh with named morph targets; each part's ``triangles`` have its material."""
    return gl.Mesh(
        name=name,
        weights=[0.0] * len(names),
        extras={"targetNames": list(names)},
        primitives=[
            gl.Primitive(
                attributes=of_vertices,
                indices=indices,
                material=number,
                mode=gl.TRIANGLES,
                targets=targets,
            )
            for number, indices in enumerate(triangles)
        ],
    )


def _save(
    path: Path,
    buffer: Buffer,
    nodes: list[gl.Node],
    meshes: list[gl.Mesh],
    materials: Sequence[str],
    animation: gl.Animation | None,
    extensions: Sequence[str] = (),
    skins: Sequence[gl.Skin] = (),
    roots: int | None = None,
) -> None:
    """Write the file of a buffer; its first nodes are ``roots``, by default all."""
    document = gl.GLTF2(
        asset=gl.Asset(version="2.0", generator=GENERATOR),
        scene=0,
        scenes=[gl.Scene(name="face", nodes=list(range(roots or len(nodes))))],
        nodes=nodes,
        materials=[material_of(part) for part in materials],
        meshes=meshes,
        animations=[] if animation is None else [animation],
        accessors=buffer.accessors,
        bufferViews=buffer.views,
        skins=list(skins),
        extensionsUsed=list(extensions),
        extensionsRequired=list(extensions),
        buffers=[gl.Buffer(byteLength=len(buffer.content))],
    )
    document.set_binary_blob(bytes(buffer.content))
    document.save_binary(str(path))


def _mesh(buffer: Buffer, solid: Solid, material: int) -> gl.Mesh:
    """Return a solid's triangles; without normals they are drawn flat, as edges of objects are."""
    corners = buffer.dense(solid.shape.vertices * METRES, gl.VEC3, gl.ARRAY_BUFFER, bounds=True)
    triangles = gl.Primitive(
        attributes=gl.Attributes(POSITION=corners),
        indices=buffer.indices(solid.shape.faces),
        material=material,
        mode=gl.TRIANGLES,
    )
    return gl.Mesh(name=solid.name, primitives=[triangles])


def _node(solid: Solid, mesh: int) -> gl.Node:
    """Return a solid's node, where the first frame has it."""
    place = solid.places[0]
    return gl.Node(
        name=solid.name,
        mesh=mesh,
        rotation=Rotation.from_rotvec(place[:3]).as_quat().tolist(),
        translation=(place[3:] * METRES).tolist(),
    )


def worst_error(expressions: Sequence[ExpressionFit], vertices: int) -> Floats:
    """Return the greatest distance (v,) to the scans, mm; 0 where nothing was measured."""
    errors = [fit.error_mm for fit in expressions]
    return np.asarray(np.fmax.reduce([np.zeros(vertices), *errors]))


def material_of(part: str) -> gl.Material:
    """Return the material of a part of a head."""
    colour, roughness = MATERIALS[part]
    return gl.Material(
        name=part,
        doubleSided=True,
        alphaMode=gl.OPAQUE if colour[3] == 1.0 else gl.BLEND,
        alphaCutoff=None,
        pbrMetallicRoughness=gl.PbrMetallicRoughness(
            baseColorFactor=list(colour), metallicFactor=0.0, roughnessFactor=roughness
        ),
    )


def textured_material(part: str, colours: int | None, normals: int | None) -> gl.Material:
    """Return the material of a part that has textures of these numbers: base colour, normals."""
    material = material_of(part)
    if colours is not None:
        surface = material.pbrMetallicRoughness
        surface.baseColorFactor = [1.0, 1.0, 1.0, 1.0]
        surface.baseColorTexture = gl.TextureInfo(index=colours)
    if normals is not None:
        material.normalTexture = gl.NormalMaterialTexture(index=normals)
    return material


def in_turn(
    buffer: Buffer, count: int, options: MorphTargetOptions = DEFAULTS
) -> gl.Animation | None:
    """Return an animation of all shapes one after the other; None if there is none."""
    if not count:
        return None
    times, weights = options.keys(count)
    at_keys = buffer.dense(times, gl.SCALAR, bounds=True)
    values = buffer.dense(weights.ravel(), gl.SCALAR)
    return animation("expressions", {gl.WEIGHTS: (at_keys, values)})


def rigid_tracks(buffer: Buffer, times: Floats, places: Floats) -> Tracks:
    """Add a rigid motion, ``places`` (f, 6) as of :class:`Solid`, for :func:`animation`."""
    turns = steady_side(Rotation.from_rotvec(places[:, :3]).as_quat())
    at_keys = buffer.dense(times, gl.SCALAR, bounds=True)
    return {
        gl.ROTATION: (at_keys, buffer.dense(turns, gl.VEC4)),
        gl.TRANSLATION: (at_keys, buffer.dense(places[:, 3:] * METRES, gl.VEC3)),
    }


def steady_side(turns: Floats) -> Floats:
    """Return quaternions (f, 4), each with the sign that is on the side of the one before."""
    flips = np.where(np.sum(turns[1:] * turns[:-1], axis=1) < 0, -1.0, 1.0)
    return np.asarray(turns * np.cumprod(np.concatenate([[1.0], flips]))[:, None])


def animation(name: str, *tracks: Tracks) -> gl.Animation:
    """Return an animation of node 0, 1 ... by the ``tracks`` of each, linear between two times."""
    moved = [(node, path, each[path]) for node, each in enumerate(tracks) for path in each]
    return gl.Animation(
        name=name,
        samplers=[
            gl.AnimationSampler(input=times, output=values, interpolation=gl.ANIM_LINEAR)
            for _, _, (times, values) in moved
        ],
        channels=[
            gl.AnimationChannel(
                sampler=number, target=gl.AnimationChannelTarget(node=node, path=path)
            )
            for number, (node, path, _) in enumerate(moved)
        ],
    )
