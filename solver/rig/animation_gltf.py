"""``animation.glb``: a simulated face as an animated skin, small enough to be handed on.

Skins are a few shapes (:mod:`solver.rig.animation_basis`), stored as whole numbers
(KHR_mesh_quantization) of the vertices that move. Keys are the frames that are needed; between
them weights lie on straight lines, and the head turns steadily. Weights lie between 0 and 1, where
animation tools hold them; so the first shape, ``start``, has the weight 1 throughout. What the face
meets are nodes of their own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pygltflib as gl
from scipy.spatial.transform import Rotation, Slerp

from solver.rig.animation_basis import (
    Basis,
    Singles,
    greatest_error,
    normal_shapes,
    spanning,
)
from solver.rig.animation_keys import Error, needed_keys
from solver.rig.gltf import METRES, Buffer, Solid, Tracks, animation, rigid_tracks, write_morphed
from solver.surface import Floats, Ints, Surface

SHAPES_MM, KEYS_MM = 0.1, 0.05
"""What vertices may be off for the shapes that are left out, and for the keys that are."""
QUANTISATION = "KHR_mesh_quantization"


MOST_STRETCH = 30.0
"""Small shapes are stored so many times as large at most, and their weights as much smaller: whole
numbers are as far apart in small shapes as in large ones."""
SHORT = 2**15 - 1


@dataclass(frozen=True)
class AnimatedGlb:
    """What was written: how many ``shapes`` and ``keys``, how far a vertex is off, at most, mm."""

    shapes: int
    keys: int
    max_error_mm: float


def write_animation_glb(
    path: Path,
    neutral: Surface,
    skins: Singles,
    heads: Floats,
    times: Floats,
    solids: Sequence[Solid] = (),
) -> AnimatedGlb:
    """Write ``skins`` (f, v, 3), mm in the head's frame, of the moments ``times`` (f,) in s.

    ``heads`` (f, 6) are rotation vectors in rad and shifts in mm, which the face's node carries;
    ``solids`` have nodes beside it. Lengths in the file are in metres.
    """
    basis = spanning(neutral, skins, SHAPES_MM)
    normals = normal_shapes(neutral, skins, basis)
    stretch = np.clip(1.0 / np.maximum(_greatest(normals), 1e-9), 1.0, MOST_STRETCH)
    rounded = _rounded(basis, stretch)
    keys = needed_keys(len(times), _skin_error(rounded, times), KEYS_MM)

    def rigid(buffer: Buffer, shape: Surface, places: Floats) -> Tracks:
        turns = needed_keys(len(times), _rigid_error(shape, places, times), KEYS_MM)
        return rigid_tracks(buffer, times[turns], places[turns])

    def targets(buffer: Buffer, _normals: Floats) -> list[gl.Attributes]:
        places = buffer.places(basis.moving, len(neutral.vertices))
        return [
            gl.Attributes(
                POSITION=buffer.quantised(shape * METRES * factor, places, 16, bounds=True),
                NORMAL=buffer.quantised(normal * factor, places, 8),
            )
            for shape, normal, factor in zip(basis.shapes, normals, stretch, strict=True)
        ]

    def animate(buffer: Buffer, _count: int) -> gl.Animation:
        at_keys = buffer.dense(times[keys], gl.SCALAR, bounds=True)
        weights = buffer.dense((basis.weights[keys] / stretch).ravel(), gl.SCALAR)
        head = rigid(buffer, neutral, heads) if heads.any() else {}
        others = [rigid(buffer, each.shape, each.places) for each in solids]
        return animation("animation", {gl.WEIGHTS: (at_keys, weights), **head}, *others)

    names = ["start", *(f"shape_{number}" for number in range(1, len(basis.shapes)))]
    write_morphed(path, neutral, names, targets, animate, extensions=[QUANTISATION], solids=solids)
    shown = _between(rounded.weights[keys], times[keys], times)
    error = greatest_error(neutral, skins, replace(rounded, weights=shown))
    return AnimatedGlb(len(names), len(keys), error)


def _rounded(basis: Basis, stretch: Floats) -> Basis:
    """Return the basis as it reads back."""
    steps = SHORT * METRES * stretch[:, None, None]
    return replace(basis, shapes=(np.rint(basis.shapes * steps) / steps).astype(np.float32))


def _skin_error(basis: Basis, times: Floats) -> Error:
    shapes = basis.shapes.reshape(len(basis.shapes), -1)

    def error(first: int, last: int, frames: Ints) -> Floats:
        ends = [first, last]
        shown = _between(basis.weights[ends], times[ends], times[frames])
        off = (shown - basis.weights[frames]).astype(np.float32)
        return np.array([_greatest((row @ shapes).reshape(-1, 3)) for row in off])

    return error


def _rigid_error(shape: Surface, places: Floats, times: Floats) -> Error:
    """Return the error of what turns and moves from frame to frame, seen at its box's corners.

    By glTF it turns steadily (slerp); Blender draws quaternions' entries as lines. Both count.
    """
    box = np.array([shape.vertices.min(axis=0), shape.vertices.max(axis=0)])
    corners = np.stack(np.meshgrid(*box.T), axis=-1).reshape(-1, 3)
    turns = Rotation.from_rotvec(places[:, :3])

    def error(first: int, last: int, frames: Ints) -> Floats:
        ends, now = times[[first, last]], times[frames]
        shifts = _between(places[[first, last], 3:], ends, now) - places[frames, 3:]
        quaternions = turns[[first, last]].as_quat()
        quaternions[1] *= np.copysign(1.0, quaternions[0] @ quaternions[1])
        steady = Slerp(ends, turns[[first, last]])(now)
        straight = Rotation.from_quat(_between(quaternions, ends, now))
        apart = [
            way[number].apply(corners) - turns[frame].apply(corners) + shifts[number]
            for number, frame in enumerate(frames)
            for way in (steady, straight)
        ]
        return np.asarray(_greatest(np.array(apart)).reshape(-1, 2).max(axis=1))

    return error


def _greatest(vectors: Singles) -> Floats:
    """Return the greatest length of the vectors (k, 3) in an array (..., k, 3)."""
    return np.asarray(np.linalg.norm(vectors, axis=-1).max(axis=-1), np.float64)


def _between(values: Floats, keys: Floats, times: Floats) -> Floats:
    """Return ``values`` (k, c) at ``keys`` (k,) at other ``times`` (f,), on straight lines."""
    return np.array([np.interp(times, keys, column) for column in values.T]).T
