"""``animation.glb``: a simulated face as an animated skin, small enough to be handed on.

Skins are a few shapes (:mod:`solver.rig.frames.skin_basis`), stored as whole numbers
(KHR_mesh_quantization) of the vertices that move. Keys are the frames that are needed; between
them weights lie on straight lines, and the head turns steadily. Weights lie between 0 and 1, where
animation tools hold them; so the first shape, ``start``, has the weight 1 throughout. Objects that
the face meets are nodes of their own.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import numpy as np
import pygltflib as gl
from scipy.spatial.transform import Rotation, Slerp

from solver.animation import on_lines
from solver.errors import SolveError
from solver.rig.frames import SequenceFrame
from solver.rig.frames.gltf import (
    MorphTargetOptions,
    Solid,
    Tracks,
    animation,
    rigid_tracks,
    write_face,
    write_morphed,
)
from solver.rig.frames.gltf_buffer import METRES, Buffer
from solver.rig.frames.joints import Joints
from solver.rig.frames.read_back import MorphedSkin, compare_motion, read_glb
from solver.rig.frames.skin_basis import Basis, Singles, SkinBasisOptions, normal_shapes, span_skins
from solver.similarity import small_motion
from solver.surface import Floats, Ints, Surface

# how far frames (k,) between two others are off, mm, where those two are the only keys
Error = Callable[[int, int, Ints], Floats]


def needed_keys(frames: int, error: Error, within_mm: float) -> Ints:
    """Return the frames (k,) that keep all others within so much (Douglas and Peucker 1973)."""
    kept = {0, frames - 1} if frames else set()
    gaps = [(0, frames - 1)]
    while gaps:
        first, last = gaps.pop()
        between = np.arange(first + 1, last)
        off = error(first, last, between) if len(between) else np.zeros(1)
        if off.max() > within_mm:
            worst = int(between[off.argmax()])
            kept.add(worst)
            gaps += [(first, worst), (worst, last)]
    return np.array(sorted(kept), np.int64)


QUANTISATION = "KHR_mesh_quantization"  # glTF's extension for whole numbers
SHORT = 2**15 - 1  # the greatest of 16 bits


@dataclass(frozen=True)
class AnimationOptions:
    """Limits of what an animation's file leaves out."""

    basis: SkinBasisOptions = field(default_factory=SkinBasisOptions)
    keys_mm: float = 0.05  # a vertex may be so far off for the keys that are left out
    # small shapes are stored so many times as large at most, and their weights as much smaller:
    # whole numbers are as far apart in small shapes as in large ones
    most_stretch: float = 30.0
    # what was left out, rounded and moved adds up: where a file is too far off, it is written again
    # with these parts of the distances
    parts: tuple[float, ...] = (1.0, 0.5, 0.25)

    def closer(self, part: float) -> AnimationOptions:
        """Return the options with so small a part of the distances."""
        basis = replace(self.basis, within_mm=part * self.basis.within_mm)
        return replace(self, basis=basis, keys_mm=part * self.keys_mm)


@dataclass(frozen=True)
class AnimatedGlb:
    """Figures of what was written, read back from the file.

    They are numbers of ``shapes`` and ``keys``, and how far a ``vertex`` is off in a ``frame`` (its
    position among all), at most, mm.
    """

    shapes: int
    keys: int
    max_error_mm: float
    frame: int
    vertex: int


def write_animation_glb(
    path: Path,
    neutral: Surface,
    skins: Singles,
    heads: Floats,
    times: Floats,
    solids: Sequence[Solid] = (),
    joints: Joints | None = None,
    options: AnimationOptions = AnimationOptions(),
) -> AnimatedGlb:
    """Write ``skins`` (f, v, 3), mm in the head's frame, of the moments ``times`` (f,) in s.

    ``heads`` (f, 6) are rotation vectors in rad and shifts in mm, which the face's node carries;
    ``solids`` have nodes beside it. ``joints`` carry the skin, in the place of that node, where
    there are some. Lengths in the file are in metres. Raises
    :class:`~solver.errors.SolveError` ``file.differs`` where what was written is too far off.
    """
    for part in options.parts:
        limits = options.closer(part)
        shapes, keys = _write_animation(path, neutral, skins, heads, times, solids, joints, limits)
        try:
            found = compare_motion(path, read_glb(path), range(len(times)), times, skins, heads)
            for node, each in enumerate(solids, start=1):
                still = np.broadcast_to(
                    each.shape.vertices, (len(times), *each.shape.vertices.shape)
                )
                shown = read_glb(path, node)
                compare_motion(path, shown, range(len(times)), times, still, each.places)
            break
        except SolveError:
            if part == options.parts[-1]:
                raise
    return AnimatedGlb(shapes, keys, found["max_mm"], found["frame"], found["vertex"])


def _write_animation(
    path: Path,
    neutral: Surface,
    skins: Singles,
    heads: Floats,
    times: Floats,
    solids: Sequence[Solid],
    joints: Joints | None,
    options: AnimationOptions,
) -> tuple[int, int]:
    """Write the file; returns the numbers of its shapes and its keys."""
    skins = skins if joints is None else joints.unposed
    basis = span_skins(neutral, skins, options.basis)
    normals = normal_shapes(neutral, skins, basis, options.basis)
    stretch = np.clip(1.0 / np.maximum(_greatest(normals), 1e-9), 1.0, options.most_stretch)
    # fractions of a metre, and of a normal's length, go to 1
    farthest = METRES * np.abs(basis.shapes).max(axis=(1, 2), initial=1e-9)
    stretch = np.minimum(stretch, np.maximum(1.0 / farthest, 1.0))
    steps = SHORT * METRES * stretch[:, None, None]
    read_back = (np.rint(basis.shapes * steps) / steps).astype(np.float32)
    rounded = replace(basis, shapes=read_back)
    keys = needed_keys(len(times), _skin_error(rounded, times), options.keys_mm)

    def rigid(buffer: Buffer, shape: Surface, places: Floats) -> Tracks:
        turns = needed_keys(len(times), _rigid_error(shape, places, times), options.keys_mm)
        return rigid_tracks(buffer, times[turns], places[turns])

    def targets(buffer: Buffer, _normals: Floats) -> list[gl.Attributes]:
        places = buffer.places(basis.moving, len(neutral.vertices))
        return [
            gl.Attributes(
                POSITION=buffer.quantise(shape * METRES * factor, places, 16, bounds=True),
                NORMAL=buffer.quantise(normal * factor, places, 8),
            )
            for shape, normal, factor in zip(basis.shapes, normals, stretch, strict=True)
        ]

    def animate(buffer: Buffer, _count: int) -> gl.Animation:
        at_keys = buffer.dense(times[keys], gl.SCALAR, bounds=True)
        weights = buffer.dense((basis.weights[keys] / stretch).ravel(), gl.SCALAR)
        head = rigid(buffer, neutral, heads) if joints is None and heads.any() else {}
        others = [rigid(buffer, each.shape, each.places) for each in solids]
        if joints is not None:
            error = partial(joints.error, neutral.vertices, times)
            others += joints.tracks(buffer, times, needed_keys(len(times), error, options.keys_mm))
        return animation("animation", {gl.WEIGHTS: (at_keys, weights), **head}, *others)

    names = [_shape_name(number) for number in range(len(basis.shapes))]
    write_morphed(
        path,
        neutral,
        names,
        targets,
        animate,
        extensions=[QUANTISATION],
        solids=solids,
        joints=joints,
    )
    return len(names), len(keys)


def _skin_error(basis: Basis, times: Floats) -> Error:
    shapes = basis.shapes.reshape(len(basis.shapes), -1)

    def error(first: int, last: int, frames: Ints) -> Floats:
        ends = [first, last]
        shown = on_lines(times[ends], basis.weights[ends], times[frames])
        off = (shown - basis.weights[frames]).astype(np.float32)
        return np.array([_greatest((row @ shapes).reshape(-1, 3)) for row in off])

    return error


def _rigid_error(shape: Surface, places: Floats, times: Floats) -> Error:
    """Return the error at the corners of the box of what turns and moves from frame to frame."""
    box = np.array([shape.vertices.min(axis=0), shape.vertices.max(axis=0)])
    corners = np.stack(np.meshgrid(*box.T), axis=-1).reshape(-1, 3)
    turns = Rotation.from_rotvec(places[:, :3])

    def error(first: int, last: int, frames: Ints) -> Floats:
        ends = times[[first, last]]
        now = times[frames]
        shifts = on_lines(ends, places[[first, last], 3:], now) - places[frames, 3:]
        quaternions = turns[[first, last]].as_quat()
        quaternions[1] *= np.copysign(1.0, quaternions[0] @ quaternions[1])
        # by glTF it turns steadily, Blender draws quaternions' entries as lines: both count
        steady = Slerp(ends, turns[[first, last]])(now)
        straight = Rotation.from_quat(on_lines(ends, quaternions, now))
        wanted = turns[frames].as_matrix()
        apart = [
            corners @ np.swapaxes(way.as_matrix() - wanted, 1, 2) + shifts[:, None]
            for way in (steady, straight)
        ]
        return np.asarray(_greatest(np.array(apart)).max(axis=0))

    return error


def _greatest(vectors: Singles) -> Floats:
    """Return the greatest length of the vectors (k, 3) in an array (..., k, 3)."""
    return np.asarray(np.linalg.norm(vectors, axis=-1).max(axis=-1), np.float64)


# a frame has many shapes at once: what each leaves out for a still vertex adds up
SEQUENCE_SHAPES = MorphTargetOptions(still_mm=1e-4)
# a file's numbers have the rest of the 0.2 mm that it may be off; frames of takes are noisy, and
# ask for more shapes and samples than those of simulations
SEQUENCE_BASIS = SkinBasisOptions(
    within_mm=0.15, most_shapes=512, more_shapes=2.0, more_samples=200, samplings=32
)


class AnimatedSkin:
    """``sequence.glb``: takes the skins (v, 3), mm, of a fitted sequence's frames as they come.

    ``neutral`` is the skin at rest, ``frames`` lists those that were taken, and ``extent`` (2, 3)
    has the least and the greatest coordinates of their skins, in the world. Skins lie in a file
    without a name until what is written has been compared with them.
    """

    def __init__(self, neutral: Surface, options: SkinBasisOptions = SEQUENCE_BASIS) -> None:
        self.neutral = neutral
        self._options = options
        self.frames: list[SequenceFrame] = []
        self.extent = np.array([[np.inf] * 3, [-np.inf] * 3])
        self._morphs: tuple[dict[str, Floats], Floats] | None = None
        self._skins = TemporaryFile()  # noqa: SIM115
        weakref.finalize(self, self._skins.close)

    def add(self, frame: SequenceFrame, skin: Floats) -> None:
        """Take a frame, fitted or not."""
        self._skins.write(skin.astype(np.float32).tobytes())
        self._morphs = None
        self.frames.append(frame)
        placed = small_motion(frame.head)(skin)
        self.extent[0] = np.minimum(self.extent[0], placed.min(axis=0))
        self.extent[1] = np.maximum(self.extent[1], placed.max(axis=0))

    def solved(self) -> Iterator[tuple[int, Singles]]:
        """Yield the numbers of frames that are no guess, with their skins (v, 3)."""
        for frame, skin in zip(self.frames, self._read_skins(), strict=True):
            if frame.status in ("fitted", "smoothed"):
                yield frame.frame, skin

    def write(self, path: Path, fps: float, first: int = 0) -> dict[str, Any]:
        """Write the animation, in metres; a node carries the motion of the head.

        The frame with the number ``first`` is at 0 s. If neither face nor head moves, it is the
        neutral. Returns as :meth:`compare`.
        """
        shapes, table = self.morphs()
        times = np.array([(frame.frame - first) / fps for frame in self.frames])
        heads = self.heads

        def animate(buffer: Buffer, _count: int) -> gl.Animation | None:
            moved = {}
            if table.size:
                at_frames = buffer.dense(times, gl.SCALAR, bounds=True)
                moved[gl.WEIGHTS] = at_frames, buffer.dense(table.ravel(), gl.SCALAR)
            if heads.any():
                moved |= rigid_tracks(buffer, times, heads)
            return animation("sequence", moved) if moved else None

        write_face(path, self.neutral, shapes, animate, options=SEQUENCE_SHAPES)
        return self.compare(path, read_glb(path), times)

    def compare(self, path: Path, shown: MorphedSkin, times: Floats) -> dict[str, Any]:
        """Return how far a file is off the skins, see :func:`~.read_back.compare_motion`.

        The frames are in it at ``times`` (f,).
        """
        numbers = [frame.frame for frame in self.frames]
        found = compare_motion(path, shown, numbers, times, self._read_skins(), self.heads)
        return {"shapes": len(shown.names), **found}

    @property
    def heads(self) -> Floats:
        """Return the head's motion (f, 6) that was added with the frames."""
        return np.array([frame.head for frame in self.frames])

    def morphs(self) -> tuple[dict[str, Floats], Floats]:
        """Return shapes (v, 3), mm, by name, and their weights (f, s) from 0 to 1 in every frame.

        They are those of :func:`.span_skins`, none where the face is as the neutral throughout.
        """
        if self._morphs is None:
            basis = span_skins(self.neutral, self._read_skins(), self._options)
            moves = np.abs(basis.shapes).max(axis=(1, 2)) > self._options.still_mm
            shapes = {}
            for number in np.flatnonzero(moves).tolist():
                whole = self.neutral.vertices.copy()
                whole[basis.moving] += basis.shapes[number]
                shapes[_shape_name(number)] = whole
            self._morphs = shapes, basis.weights[:, moves]
        return self._morphs

    def _read_skins(self) -> Singles:
        """Return the skins (f, v, 3), mapped."""
        self._skins.flush()
        shape = (len(self.frames), *self.neutral.vertices.shape)
        return np.memmap(self._skins, np.float32, "r", shape=shape)


def _shape_name(number: int) -> str:
    """Return the name of a basis' shape: the first is what the others count from."""
    return f"shape_{number}" if number else "start"
