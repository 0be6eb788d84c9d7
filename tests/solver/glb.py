"""Read back what a glTF file of an animated skin shows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pygltflib

from solver.surface import Floats


def shown_skins(path: Path, neutral: Floats) -> Floats:
    """Return the skins (f, v, 3), mm, of a ``sequence.glb`` without the motion of its head."""
    document = pygltflib.GLTF2().load(str(path))
    shapes = target_shapes(document)
    weights = tracks(document)["weights"].reshape(-1, len(shapes))
    return neutral + 1e3 * np.tensordot(weights, shapes, 1)


def target_shapes(document: pygltflib.GLTF2) -> list[Floats]:
    """Return the displacement (v, 3) of each morph target, in metres."""
    targets = document.meshes[0].primitives[0].targets
    return [values(document, target["POSITION"]) for target in targets]


def tracks(document: pygltflib.GLTF2) -> dict[str, Floats]:
    """Return the output of each channel, by what it moves."""
    animation = document.animations[0]
    return {
        channel.target.path: values(document, animation.samplers[channel.sampler].output)
        for channel in animation.channels
    }


def values(document: pygltflib.GLTF2, number: int) -> Floats:
    """Return an accessor of single floats, row by row; a sparse one is zero elsewhere."""
    accessor = document.accessors[number]
    sparse = accessor.sparse
    if sparse is None:
        return _view(document, accessor.bufferView, "<f4").reshape(accessor.count, -1)
    kind = {pygltflib.UNSIGNED_SHORT: "<u2", pygltflib.UNSIGNED_INT: "<u4"}
    rows = _view(document, sparse.indices.bufferView, kind[sparse.indices.componentType])
    found = np.zeros((accessor.count, 3))
    found[rows.astype(int)] = _view(document, sparse.values.bufferView, "<f4").reshape(-1, 3)
    return found


def _view(document: pygltflib.GLTF2, number: int, kind: str) -> Floats:
    view = document.bufferViews[number]
    content = document.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
    return np.frombuffer(content, kind).astype(float)
