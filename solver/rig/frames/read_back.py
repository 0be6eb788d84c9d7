"""Comparison of a written file, read again, with the arrays that it was written from.

A program that reads the file sees what is in it, not what the report speaks of. So files are read
again, blended in single precision as other programs do, and their greatest distance to the arrays
goes into the job's report, with its frame and vertex. A file that is further off than
:data:`LIMIT_MM` ends the job.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from solver.animation import on_lines
from solver.errors import SolveError
from solver.meshio.glb import COMPONENTS, WIDTHS
from solver.rig.frames.joints import ReadJoints, read_joints, turn_between
from solver.rig.frames.skin_basis import Singles
from solver.surface import Floats

LIMIT_MM = 0.2  # that a file may be off
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
        self.max_mm = float(off[self.vertex])
        self.frame = frame
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
    joints: ReadJoints | None = None  # that carry it after its targets

    def at(self, times: Floats) -> Floats:
        """Return the skins (f, v, 3) at ``times`` (f,), blended and moved."""
        weights, rotations, shifts = self.motion(times)
        blended = self.blend(weights).astype(np.float64)
        if self.joints is not None:
            return self.joints.carry(blended, times)
        return np.asarray(blended @ np.swapaxes(rotations, 1, 2) + shifts[:, None])

    def blend(self, weights: Floats) -> Singles:
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
        for row, placed in enumerate(shown.at(times[rows]), start=first):
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
        turns = np.tile(np.eye(3), (len(times), 1, 1))
        shifts = np.zeros((len(times), 3))
        if "weights" in tracks:
            keys, table = tracks["weights"]
            weights = on_lines(keys, table.reshape(len(keys), len(shapes)), times)
        if "translation" in tracks:
            shifts = METRE * on_lines(*tracks["translation"], times)
        if "rotation" in tracks:
            turns = turn_between(*tracks["rotation"], times)
        return weights, turns, shifts

    names = mesh.get("extras", {}).get("targetNames", [])
    joints = None
    if "skin" in moved:
        joints = read_joints(document, document["skins"][moved["skin"]], values, part)
    return MorphedSkin(neutral, names, shapes, motion, joints)


# Reading of GLB files, and structural checks for places without the Khronos validator.


def validate_glb(path: Path, names: list[str]) -> list[str]:
    """Return what is wrong with the rig in ``path``; nothing if all is well.

    Checked are the container, every accessor (bounds of memory, finite values, min and max), the
    triangles' indices, the morph targets ``names`` in order, and the animation of their weights.
    """
    try:
        document, binary = split_glb(path)
    except ValueError as error:
        return [str(error)]
    try:
        return list(_faults(document, binary, names))
    except (KeyError, IndexError, TypeError, ValueError) as error:
        return [f"the description does not fit the data: {error!r}"]


def split_glb(path: Path) -> tuple[dict[str, Any], memoryview]:
    """Return the description and the binary of a file; raises :class:`ValueError` if it is none."""
    content = path.read_bytes()
    if content[:4] != b"glTF" or len(content) < 20:
        raise ValueError("not a binary glTF file")
    if int.from_bytes(content[8:12], "little") != len(content):
        raise ValueError("the header's length is not the file's")
    end = 20 + int.from_bytes(content[12:16], "little")
    return json.loads(content[20:end]), memoryview(content)[end + 8 :]


def _faults(document: dict[str, Any], binary: memoryview, names: list[str]) -> Iterator[str]:
    values = [accessor_values(document, binary, accessor) for accessor in document["accessors"]]
    for number, (accessor, table) in enumerate(zip(document["accessors"], values, strict=True)):
        if not np.isfinite(table).all():
            yield f"accessor {number} holds what is not finite"
        for name, bound in (("min", table.min(axis=0)), ("max", table.max(axis=0))):
            if name in accessor and not np.array_equal(bound, np.float32(accessor[name])):
                yield f"accessor {number} states another {name} than it has"
    mesh = document["meshes"][0]
    if mesh.get("extras", {}).get("targetNames", []) != names:
        yield "the morph targets are not named as the expressions"
    for number, part in enumerate(mesh["primitives"]):
        positions = values[part["attributes"]["POSITION"]]
        targets = part.get("targets", [])
        if values[part["indices"]].max() >= len(positions):
            yield f"primitive {number} uses a vertex that is not there"
        if len(targets) != len(names):
            yield f"primitive {number} does not have {len(names)} morph targets"
        for attribute, accessor in (each for target in targets for each in target.items()):
            if values[accessor].shape != positions.shape:
                yield f"primitive {number} has a {attribute} target of another size"
            if attribute == "POSITION" and "min" not in document["accessors"][accessor]:
                yield f"primitive {number} has a target without min and max"
    for animation in document.get("animations", []):
        for channel in animation["channels"]:
            sampler = animation["samplers"][channel["sampler"]]
            times = values[sampler["input"]]
            output = values[sampler["output"]]
            if (np.diff(times[:, 0]) <= 0).any():
                yield "the animation's times do not increase"
            each = len(names) if channel["target"]["path"] == "weights" else 1
            if len(output) != len(times) * each:
                yield "the animation does not set every value at every time"


def accessor_values(
    document: dict[str, Any], binary: memoryview, accessor: dict[str, Any]
) -> np.ndarray:
    """Return an accessor's table as it is stored, its sparse values put in."""

    def read(view: int, kind: str, *shape: int) -> np.ndarray:
        place = document["bufferViews"][view]
        start = place.get("byteOffset", 0)
        size = place["byteLength"]
        if start % np.dtype(kind).itemsize:
            raise ValueError(f"bufferView {view} is not aligned")
        return np.frombuffer(binary[start : start + size], kind).reshape(shape)

    width = WIDTHS[accessor["type"]]
    kind = COMPONENTS[accessor["componentType"]]
    values = np.zeros((accessor["count"], width), kind)
    if "bufferView" in accessor:
        values = read(accessor["bufferView"], kind, *values.shape)
    if "sparse" in accessor:
        sparse = accessor["sparse"]
        place = sparse["indices"]
        count = sparse["count"]
        rows = read(place["bufferView"], COMPONENTS[place["componentType"]], count)
        if (np.diff(rows.astype(np.int64)) <= 0).any():
            raise ValueError("sparse indices do not increase")
        values[rows] = read(sparse["values"]["bufferView"], kind, count, width)
    return values
