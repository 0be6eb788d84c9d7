"""What a file that was written shows, compared with the arrays that it was written from.

A program that reads the file sees what is in it, not what the report speaks of. So files are read
again, blended in single precision as other programs do, and their greatest distance to the arrays
goes into the job's report, with its frame and vertex. A file that is further off than
:data:`LIMIT_MM` ends the job.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from solver.errors import SolveError
from solver.rig.gltf_check import accessor_values, split_glb
from solver.rig.skin_basis import Singles
from solver.surface import Floats

LIMIT_MM = 0.2
NEUTRAL = "neutral"  # the skin at rest, among expressions
BLOCK = 16  # frames that are looked at together
METRE = 1e3  # mm

Frame = int | str  # a frame's number, or an expression's name


@dataclass
class Comparison:
    """Greatest distance so far of what ``file`` shows from what it was written from."""

    file: str
    max_mm: float = 0.0
    frame: Frame | None = None
    vertex: int | None = None

    def add(self, frame: Frame, shown: np.ndarray, wanted: np.ndarray) -> None:
        """Compare the points (v, 3), mm, of a frame; raises :class:`SolveError` ``file.differs``.

        So it does where there are others than were wanted. A point that was not known (NaN) is to
        be none in the file.
        """
        if shown.shape != wanted.shape:
            words = f"{len(shown)} points, not {len(wanted)}"
            raise self._fault(frame, words, expected=len(wanted), found=len(shown))
        off = np.linalg.norm(np.subtract(shown, wanted, dtype=np.float64), axis=1)
        unknown = np.isnan(wanted).any(axis=1) & np.isnan(shown).any(axis=1)
        off = np.where(unknown, 0.0, np.where(np.isfinite(off), off, np.inf))
        if not len(off) or (self.frame is not None and off.max() <= self.max_mm):
            return
        self.vertex = int(off.argmax())
        self.max_mm, self.frame = float(off[self.vertex]), frame
        if self.max_mm > LIMIT_MM:
            found = self.max_mm if np.isfinite(self.max_mm) else None
            words = f"vertex {self.vertex} {self.max_mm:.2f} mm off what was computed"
            raise self._fault(frame, words, vertex=self.vertex, expected=LIMIT_MM, found=found)

    def figures(self) -> dict[str, Any]:
        """Return what a report says of the file."""
        return {"max_mm": round(self.max_mm, 4), "frame": self.frame, "vertex": self.vertex}

    def _fault(self, frame: Frame, words: str, **context: Any) -> SolveError:
        message = f"{self.file}, read back, has in frame {frame} {words}"
        return SolveError("file.differs", message, file=self.file, frame=frame, **context)


def compare_activations(
    path: Path, shown: np.ndarray, wanted: np.ndarray, most: float
) -> dict[str, Any]:
    """Return how far activations in a file are off those ``wanted``, ``most`` at most.

    One that was not known (NaN) is to be none in the file. Raises :class:`SolveError`
    ``file.differs`` where they are further off, or others.
    """
    message = f"{path.name}, read back, has"
    if shown.shape != wanted.shape:
        words = f"{message} activations {shown.shape}, not {wanted.shape}"
        raise SolveError("file.differs", words, file=path.name)
    unknown = np.isnan(shown) & np.isnan(wanted)
    off = np.where(unknown, 0.0, np.abs(shown - wanted))
    off = np.where(np.isfinite(off), off, np.inf)
    found = float(off.max(initial=0.0))
    if found > most:
        row = int(np.unravel_index(off.argmax(), off.shape)[0])
        words = f"{message} in row {row} an activation that is {found:g} off"
        raise SolveError("file.differs", words, file=path.name, row=row, expected=most)
    return {"max_activation": found}


@dataclass(frozen=True)
class MorphedSkin:
    """A skin with morph targets as a file has it; lengths in mm.

    ``motion`` gives the weights (f, s) at times (f,) and the rigid motion of the whole, rotations
    (f, 3, 3) and shifts (f, 3).
    """

    neutral: Singles  # (v, 3)
    names: list[str]
    shapes: Singles  # (s, 3 v) changes from the neutral
    motion: Callable[[Floats], tuple[Floats, Floats, Floats]]

    def blended(self, weights: Floats) -> Singles:
        """Return the skins (f, v, 3) of weights (f, s)."""
        change = weights.astype(np.float32) @ self.shapes
        return np.asarray(self.neutral + change.reshape(len(weights), *self.neutral.shape))

    def expressions(self) -> dict[str, Singles]:
        """Return the neutral and every shape, whole, by its name."""
        whole = self.neutral + self.shapes.reshape(-1, *self.neutral.shape)
        return {NEUTRAL: self.neutral, **dict(zip(self.names, whole, strict=True))}


def compare_expressions(
    path: Path, shown: Mapping[str, np.ndarray], wanted: Mapping[str, np.ndarray]
) -> dict[str, Any]:
    """Return how far the points (v, 3), mm, that a file has by name are off those ``wanted``."""
    found = Comparison(path.name)
    for name, points in wanted.items():
        found.add(name, shown.get(name, np.zeros((0, 3))), points)
    return found.figures()


def compare_motion(
    path: Path,
    shown: MorphedSkin,
    numbers: Sequence[int],
    times: Floats,
    skins: np.ndarray,
    heads: Floats,
) -> dict[str, Any]:
    """Return how far the file's frames are off ``skins`` (f, v, 3) that ``heads`` (f, 6) move.

    Frames have ``numbers`` and are shown at ``times`` (f,). Skins may be mapped: a few at a time
    are read.
    """
    found = Comparison(path.name)
    turns = Rotation.from_rotvec(heads[:, :3]).as_matrix()
    for first in range(0, len(skins), BLOCK):
        rows = slice(first, first + BLOCK)
        weights, rotations, shifts = shown.motion(times[rows])
        blended = shown.blended(weights)
        for number, row in enumerate(range(first, first + len(blended))):
            placed = blended[number].astype(np.float64) @ rotations[number].T + shifts[number]
            wanted = skins[row].astype(np.float64) @ turns[row].T + heads[row, 3:]
            found.add(numbers[row], placed, wanted)
    return found.figures()


def read_glb(path: Path, node: int = 0) -> MorphedSkin:
    """Read a node of a GLB as this product writes them: the face is 0, objects follow."""
    document, binary = split_glb(path)

    def values(number: int) -> np.ndarray:
        accessor = document["accessors"][number]
        stored = accessor_values(document, binary, accessor)
        if not accessor.get("normalized"):
            return stored
        return stored.astype(np.float32) / np.float32(np.iinfo(stored.dtype).max)

    moved = document["nodes"][node]
    mesh = document["meshes"][moved["mesh"]]
    part = mesh["primitives"][0]
    neutral = (METRE * values(part["attributes"]["POSITION"])).astype(np.float32)
    targets = part.get("targets", [])
    shapes = np.empty((len(targets), neutral.size), np.float32)
    for row, target in zip(shapes, targets, strict=True):
        row[:] = METRE * values(target["POSITION"]).ravel()
    tracks = {}
    for animation in document.get("animations", []):
        for channel in animation["channels"]:
            if channel["target"]["node"] == node:
                sampler = animation["samplers"][channel["sampler"]]
                keys = values(sampler["input"])[:, 0].astype(np.float64)
                tracks[channel["target"]["path"]] = keys, values(sampler["output"])

    def motion(times: Floats) -> tuple[Floats, Floats, Floats]:
        weights = np.zeros((len(times), len(shapes)))
        turns, shifts = np.tile(np.eye(3), (len(times), 1, 1)), np.zeros((len(times), 3))
        if "weights" in tracks:
            keys, table = tracks["weights"]
            weights = between(keys, table.reshape(len(keys), len(shapes)), times)
        if "translation" in tracks:
            shifts = METRE * between(*tracks["translation"], times)
        if "rotation" in tracks:
            turns = _turned(*tracks["rotation"], times)
        return weights, turns, shifts

    names = mesh.get("extras", {}).get("targetNames", [])
    return MorphedSkin(neutral, names, shapes, motion)


def _turned(keys: Floats, quaternions: np.ndarray, times: Floats) -> Floats:
    """Return rotations (f, 3, 3) at ``times``, steady between keys (k,), of (x, y, z, w) (k, 4)."""
    turns = Rotation.from_quat(quaternions.astype(np.float64))
    if len(keys) == 1:
        return np.repeat(turns.as_matrix(), len(times), axis=0)
    return np.asarray(Slerp(keys, turns)(np.clip(times, keys[0], keys[-1])).as_matrix())


def between(keys: Floats, table: np.ndarray, times: Floats) -> Floats:
    """Return a table (k, c) of ``keys`` (k,) at ``times``, on straight lines."""
    after = np.clip(np.searchsorted(keys, times), 1, max(len(keys) - 1, 1))
    before, after = after - 1, np.minimum(after, len(keys) - 1)
    span = np.where(after > before, keys[after] - keys[before], 1.0)
    share = np.clip((times - keys[before]) / span, 0.0, 1.0)[:, None]
    return np.asarray((1.0 - share) * table[before] + share * table[after])
