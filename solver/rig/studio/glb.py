"""``studio.glb``: a light rig with morph targets by ARKit's names and a skeleton, in glTF 2.0."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib as gl

from solver.anatomy.tangents import vertex_tangents
from solver.anatomy.texture_coordinates import TextureCoordinates
from solver.rig.frames.gltf import DEFAULTS, GENERATOR, material_of, textured_material
from solver.rig.frames.gltf_buffer import METRES, Buffer
from solver.rig.frames.read_back import Comparison, accessor_values, split_glb
from solver.rig.studio.eyes import EYE_COLOURS, eye_image
from solver.rig.studio.light_rig import LightRig
from solver.rig.studio.parts import TEXTURED, Part, parts_of
from solver.rig.studio.skin_texture import COLOURS, NORMALS, SkinTexture
from solver.surface import Floats, Ints

MOST_JOINTS = 4  # of a vertex, in one attribute of glTF


def write_glb(rig: LightRig, path: Path, texture: SkinTexture | None = None) -> None:
    """Write a rig: joints, and a node for each part of the head, in metres, at rest.

    A part has the morph targets that move it, and the skin its images, within the file.
    """
    buffer = Buffer()
    skeleton = rig.skeleton
    parts = parts_of(rig.neutral, skeleton, texture.coordinates if texture else None)
    materials = list(dict.fromkeys(part.material for part in parts))
    meshes = _Meshes(rig, buffer, materials, has_normals=bool(texture and texture.normals))
    count = len(skeleton.joints)
    nodes = [
        *_joints(rig),
        *(gl.Node(name=part.name, mesh=number, skin=0) for number, part in enumerate(parts)),
    ]
    document = gl.GLTF2(
        asset=gl.Asset(version="2.0", generator=GENERATOR),
        scene=0,
        scenes=[gl.Scene(name="face", nodes=[0, *range(count, len(nodes))])],
        nodes=nodes,
        skins=[_skin(rig, buffer)],
        materials=[material_of(name) for name in materials],
        meshes=[meshes.of(part) for part in parts],
        accessors=buffer.accessors,
        bufferViews=buffer.views,
    )
    _wear(document, buffer, worn_images(parts, texture))
    document.buffers = [gl.Buffer(byteLength=len(buffer.content))]
    document.set_binary_blob(bytes(buffer.content))
    document.save_binary(str(path))


def worn_images(parts: Sequence[Part], texture: SkinTexture | None) -> dict[str, bytes]:
    """Return the PNGs that a rig's parts wear, by their files' names: the skin's, and the eyes'."""
    images = dict(texture.files) if texture else {}
    if any(part.material == "eyes" and part.places is not None for part in parts):
        images[EYE_COLOURS] = eye_image()
    return images


def _wear(document: gl.GLTF2, buffer: Buffer, images: Mapping[str, bytes]) -> None:
    """Put images into a document, and on the materials of skin and eyes."""
    if not images:
        return
    numbers = {name: number for number, name in enumerate(images)}
    document.images = [
        gl.Image(name=Path(name).stem, mimeType="image/png", bufferView=buffer.image(content))
        for name, content in images.items()
    ]
    document.samplers = [gl.Sampler(magFilter=gl.LINEAR, minFilter=gl.LINEAR_MIPMAP_LINEAR)]
    document.textures = [gl.Texture(source=number, sampler=0) for number in numbers.values()]
    worn = {
        TEXTURED: textured_material(TEXTURED, numbers.get(COLOURS), numbers.get(NORMALS)),
        "eyes": textured_material("eyes", numbers.get(EYE_COLOURS), None),
    }
    document.materials = [worn.get(each.name, each) for each in document.materials]


class _Meshes:
    """Makes the mesh of each part, its data in the buffer."""

    def __init__(
        self, rig: LightRig, buffer: Buffer, materials: Sequence[str], *, has_normals: bool
    ) -> None:
        self._buffer = buffer
        self._has_normals = has_normals
        self._materials = materials
        self._points = rig.neutral.vertices * METRES
        self._rig = rig
        self._joints, self._weights = influences(rig.skeleton.weights)

    def of(self, part: Part) -> gl.Mesh:
        """Return a part's mesh."""
        names = part.moving(self._rig.targets, DEFAULTS.still_mm)
        primitive = gl.Primitive(
            attributes=self._at_rest(part),
            indices=self._buffer.indices(part.faces),
            material=self._materials.index(part.material),
            mode=gl.TRIANGLES,
            targets=[self._target(name, part.vertices) for name in names] or None,
        )
        extras = {"targetNames": names} if names else {}
        weights = [0.0] * len(names) or None
        return gl.Mesh(name=part.name, weights=weights, extras=extras, primitives=[primitive])

    def _at_rest(self, part: Part) -> gl.Attributes:
        buffer = self._buffer
        used = part.vertices
        places = tangents = None
        if part.places is not None:  # glTF's rows count from the upper edge
            turned = np.column_stack([part.places[:, 0], 1.0 - part.places[:, 1]])
            places = buffer.dense(turned, gl.VEC2, gl.ARRAY_BUFFER)
            if self._has_normals and part.name == TEXTURED:
                rest = self._points[used], self._rig.normals[used]
                found = vertex_tangents(*rest, part.places, part.faces)
                tangents = buffer.dense(found, gl.VEC4, gl.ARRAY_BUFFER)
        return gl.Attributes(
            TEXCOORD_0=places,
            TANGENT=tangents,
            POSITION=buffer.dense(self._points[used], gl.VEC3, gl.ARRAY_BUFFER, bounds=True),
            NORMAL=buffer.dense(self._rig.normals[used], gl.VEC3, gl.ARRAY_BUFFER),
            JOINTS_0=buffer.joints(self._joints[used]),
            WEIGHTS_0=buffer.dense(self._weights[used], gl.VEC4, gl.ARRAY_BUFFER),
        )

    def _target(self, name: str, used: Ints) -> gl.Attributes:
        motion = self._rig.targets[name][used] * METRES
        return gl.Attributes(
            POSITION=self._buffer.morph(motion, DEFAULTS.still_mm * METRES, bounds=True),
            NORMAL=self._buffer.morph(self._rig.turned[name][used], DEFAULTS.still_normal),
        )


def _skin(rig: LightRig, buffer: Buffer) -> gl.Skin:
    """Return the binding of the skin to the joints."""
    count = len(rig.skeleton.joints)
    matrices = buffer.bindings(rig.skeleton.places)
    return gl.Skin(
        name="skeleton", joints=list(range(count)), skeleton=0, inverseBindMatrices=matrices
    )


def influences(weights: Floats) -> tuple[Ints, Floats]:
    """Return the joints (V, 4) that move each vertex most, and their weights, which add up to 1."""
    count = weights.shape[1]
    padded = np.pad(weights, ((0, 0), (0, max(MOST_JOINTS - count, 0))))
    order = np.argsort(-padded, axis=1, kind="stable")[:, :MOST_JOINTS]
    kept = np.take_along_axis(padded, order, axis=1)
    kept /= kept.sum(axis=1, keepdims=True)
    return np.where(kept > 0.0, order, 0).astype(np.int64), kept


def _joints(rig: LightRig) -> list[gl.Node]:
    """Return the joints' nodes, the first with the others as its children."""
    places = rig.skeleton.places * METRES
    head, *others = rig.skeleton.joints
    return [
        gl.Node(
            name=head, translation=places[0].tolist(), children=list(range(1, 1 + len(others)))
        ),
        *(
            gl.Node(name=name, translation=(place - places[0]).tolist())
            for name, place in zip(others, places[1:], strict=True)
        ),
    ]


def compare_glb(
    rig: LightRig, path: Path, coordinates: TextureCoordinates | None = None
) -> dict[str, Any]:
    """Return how far the file's shapes are off the rig's, whole, its joints at rest.

    Raises :class:`~solver.errors.SolveError` (``file.differs``).
    """
    document, binary = split_glb(path)

    def values(number: int) -> np.ndarray:
        return accessor_values(document, binary, document["accessors"][number])

    found = Comparison(path.name)
    parts = {part.name: part for part in parts_of(rig.neutral, rig.skeleton, coordinates)}
    shown = {name: rig.neutral.vertices.copy() for name in rig.targets}
    for mesh in document["meshes"]:
        part = parts[mesh["name"]]
        primitive = mesh["primitives"][0]
        neutral = values(primitive["attributes"]["POSITION"]) / METRES
        for skin in shown.values():
            skin[part.vertices] = neutral
        names = mesh.get("extras", {}).get("targetNames", [])
        for name, target in zip(names, primitive.get("targets", []), strict=True):
            shown[name][part.vertices] = neutral + values(target["POSITION"]) / METRES
    for name, motion in rig.targets.items():
        found.add(name, shown[name], rig.neutral.vertices + motion)
    return found.figures()
