"""``studio.glb``: a light rig with morph targets by ARKit's names and a skeleton, in glTF 2.0."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pygltflib as gl

from solver.rig.frames.gltf import DEFAULTS, GENERATOR, METRES, Buffer, material_of
from solver.rig.frames.read_back import Comparison, accessor_values, split_glb
from solver.rig.studio.light_rig import LightRig
from solver.rig.studio.parts import parts_of
from solver.surface import Floats, Ints, vertex_normals

MOST_JOINTS = 4  # of a vertex, in one attribute of glTF


def write_glb(rig: LightRig, path: Path, still_mm: float = DEFAULTS.still_mm) -> None:
    """Write a rig: joints, and a node for each part of the head, in metres, at rest.

    A part has the morph targets that move it, of the shapes and then those of half ways.
    """
    buffer = Buffer()
    skeleton = rig.skeleton
    names = [*rig.names, *(each.name for each in rig.half_ways)]
    motions = np.concatenate([rig.motions, *(each.motion[None] for each in rig.half_ways)])
    normals = vertex_normals(rig.neutral)
    turned = [
        vertex_normals(rig.neutral.with_vertices(rig.neutral.vertices + motion)) - normals
        for motion in motions
    ]
    parts = parts_of(rig.neutral, skeleton)
    materials = list(dict.fromkeys(part.material for part in parts))
    joints, weights = _influences(skeleton.weights)
    meshes = []
    for part in parts:
        rows = part.moving(motions, still_mm)
        used = part.vertices
        attributes = gl.Attributes(
            POSITION=buffer.dense(
                rig.neutral.vertices[used] * METRES, gl.VEC3, gl.ARRAY_BUFFER, bounds=True
            ),
            NORMAL=buffer.dense(normals[used], gl.VEC3, gl.ARRAY_BUFFER),
            JOINTS_0=buffer.joints(joints[used]),
            WEIGHTS_0=buffer.dense(weights[used], gl.VEC4, gl.ARRAY_BUFFER),
        )
        targets = [
            gl.Attributes(
                POSITION=buffer.morph(motions[row][used] * METRES, still_mm * METRES, bounds=True),
                NORMAL=buffer.morph(turned[row][used], DEFAULTS.still_normal),
            )
            for row in rows
        ]
        meshes.append(
            gl.Mesh(
                name=part.name,
                weights=[0.0] * len(rows) or None,
                extras={"targetNames": [names[row] for row in rows]} if len(rows) else {},
                primitives=[
                    gl.Primitive(
                        attributes=attributes,
                        indices=buffer.indices(part.faces),
                        material=materials.index(part.material),
                        mode=gl.TRIANGLES,
                        targets=targets or None,
                    )
                ],
            )
        )
    first = len(skeleton.joints)
    nodes = [
        *_joints(rig),
        *(gl.Node(name=part.name, mesh=number, skin=0) for number, part in enumerate(parts)),
    ]
    roots = [0, *range(first, len(nodes))]
    binding = np.tile(np.eye(4), (first, 1, 1))
    binding[:, :3, 3] = -skeleton.places * METRES
    document = gl.GLTF2(
        asset=gl.Asset(version="2.0", generator=GENERATOR),
        scene=0,
        scenes=[gl.Scene(name="face", nodes=roots)],
        nodes=nodes,
        skins=[
            gl.Skin(
                name="skeleton",
                joints=list(range(first)),
                skeleton=0,
                inverseBindMatrices=buffer.dense(
                    binding.transpose(0, 2, 1).reshape(first, 16), gl.MAT4
                ),
            )
        ],
        materials=[material_of(name) for name in materials],
        meshes=meshes,
        accessors=buffer.accessors,
        bufferViews=buffer.views,
        buffers=[gl.Buffer(byteLength=len(buffer.content))],
    )
    document.set_binary_blob(bytes(buffer.content))
    document.save_binary(str(path))


def _influences(weights: Floats) -> tuple[Ints, Floats]:
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


def compare_glb(rig: LightRig, path: Path) -> dict[str, Any]:
    """Return how far the file's shapes are off the rig's, whole, its joints at rest.

    Raises :class:`~solver.errors.SolveError` (``file.differs``).
    """
    document, binary = split_glb(path)

    def values(number: int) -> np.ndarray:
        return accessor_values(document, binary, document["accessors"][number])

    found = Comparison(path.name)
    wanted = dict(zip(rig.names, rig.motions, strict=True))
    wanted |= {each.name: each.motion for each in rig.half_ways}
    parts = {part.name: part for part in parts_of(rig.neutral, rig.skeleton)}
    shown = {name: rig.neutral.vertices.copy() for name in wanted}
    for mesh in document["meshes"]:
        part = parts[mesh["name"]]
        primitive = mesh["primitives"][0]
        neutral = values(primitive["attributes"]["POSITION"]) / METRES
        for skin in shown.values():
            skin[part.vertices] = neutral
        names = mesh.get("extras", {}).get("targetNames", [])
        for name, target in zip(names, primitive.get("targets", []), strict=True):
            shown[name][part.vertices] = neutral + values(target["POSITION"]) / METRES
    for name, motion in wanted.items():
        found.add(name, shown[name], rig.neutral.vertices + motion)
    return found.figures()
