"""Read and write performances: registered points of the skin, frame after frame.

They come frame by frame, never all at once, from an array in a ``.npy`` file or a folder of
registered scans. They are in mm, in the template's order: all skin vertices, or the face's alone.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from solver.errors import InputError
from solver.meshio.registered import REGISTERED_FORMATS as SCAN_FORMATS
from solver.meshio.registered import RegisteredScan, read_registered
from solver.storage import map_array, natural_order
from solver.surface import Floats, Ints, Surface

FORMATS = (".npy",)
FARTHEST_MM = 1e4  # a coordinate beyond it is no place in a studio
SIZES = (0.5, 2.0)  # of a face beside the neutral; a wrong unit is farther off


def open_performance(path: Path, neutral: Surface, face: Ints) -> Performance:
    """Open a performance: ``.npy`` or a folder of registered scans, which are sorted by name.

    ``neutral`` (V vertices) is the person's skin at rest, ``face`` (k,) the vertices that frames
    are read for. Frames are read when they are asked for and raise what is wrong with them then.

    Raises :class:`InputError`: ``performance.format``, ``performance.unreadable``,
    ``performance.empty``, ``performance.shape`` (neither V nor k points a frame) or
    ``performance.order`` (an array whose frames do not lie one after the other); from a frame
    ``performance.bounds`` (infinite or too far away; ``vertex`` is the point's number in the file)
    or ``performance.unit``, with ``frame``, or what :func:`read_registered` finds.
    """
    file = path.name
    if not path.is_dir() and path.suffix.lower() not in FORMATS:
        message = f"{file}: a performance is a .npy file or a folder of registered scans"
        raise InputError("performance.format", message, file=file, expected=list(FORMATS))
    opened = (_Folder if path.is_dir() else _Array).open(path, neutral, face)
    if not len(opened):
        raise InputError("performance.empty", f"{file} has no frames", file=file)
    return opened


def write_performance(
    path: Path, frames: Iterable[NDArray[np.floating]], count: int, points: int
) -> None:
    """Write ``count`` frames (points, 3), mm, one after the other; they are never all in memory."""
    shape = (count, points, 3)
    file = np.lib.format.open_memmap(path, mode="w+", dtype=np.float32, shape=shape)
    for number, frame in enumerate(frames):
        file[number] = frame
    file.flush()


@dataclass(frozen=True)
class _Array:
    """Frames (f, V or k, 3) in a file; ``columns`` picks the face's points."""

    name: str
    points: np.ndarray
    columns: Ints | slice
    rest: Floats

    @classmethod
    def open(cls, path: Path, neutral: Surface, face: Ints) -> _Array:
        file = path.name
        try:
            points = map_array(path)
        except ValueError as error:
            message = f"{file} is not a whole array of numbers: {error}"
            raise InputError("performance.unreadable", message, file=file) from error
        whole = len(neutral.vertices)
        part = len(face)
        is_array = points.ndim == 3 and points.shape[2] == 3 and points.dtype.kind == "f"
        if not is_array or points.shape[1] not in (whole, part):
            message = (
                f"{file} holds {points.dtype} of shape {points.shape}; a performance holds "
                f"floats of shape (frames, {whole}, 3), all skin vertices, or (frames, {part}, 3), "
                "the face's"
            )
            about = {"file": file, "expected": [whole, part], "found": list(points.shape)}
            raise InputError("performance.shape", message, **about)
        if not points.flags.c_contiguous:
            message = (
                f"{file} is stored in Fortran order, its frames are scattered over the file; "
                "write it with numpy.ascontiguousarray"
            )
            raise InputError("performance.order", message, file=file)
        columns = face if points.shape[1] == whole else slice(None)
        return cls(file, points, columns, neutral.vertices[face])

    def __len__(self) -> int:
        return len(self.points)

    def frame(self, number: int) -> RegisteredScan:
        """Return the face's points (k, 3) in mm and their confidence (k,), 0 where unseen."""
        points = np.asarray(self.points[number][self.columns], np.float64)
        beyond = (np.abs(points) > FARTHEST_MM).any(axis=1)  # NaN is not: unseen
        if beyond.any():
            first = int(np.argmax(beyond))
            vertex = int(np.arange(self.points.shape[1])[self.columns][first])
            place = points[first].tolist()
            message = f"{self.name}, frame {number}: point {vertex} lies at {place} mm"
            about = {"file": self.name, "frame": number, "vertex": vertex}
            raise InputError("performance.bounds", message, **about)
        seen = np.asarray(np.isfinite(points).all(axis=1))
        if 2 * seen.sum() > len(seen):
            _check_size(self.name, number, points[seen], self.rest[seen])
        return RegisteredScan(np.where(seen[:, None], points, np.nan), seen.astype(np.float64))


@dataclass(frozen=True)
class _Folder:
    """A scan a frame."""

    name: str
    paths: list[Path]
    neutral: Surface
    face: Ints

    @classmethod
    def open(cls, path: Path, neutral: Surface, face: Ints) -> _Folder:
        scans = {
            each.name: each
            for each in path.iterdir()
            if each.suffix.lower() in SCAN_FORMATS and not each.name.startswith(".")
        }
        return cls(path.name, [scans[name] for name in natural_order(scans)], neutral, face)

    def __len__(self) -> int:
        return len(self.paths)

    def frame(self, number: int) -> RegisteredScan:
        """Return the same as :meth:`_Array.frame`."""
        path = self.paths[number]
        vertices = self.neutral.vertices
        try:
            scan = read_registered(path, self.neutral.faces, len(vertices))
        except InputError as error:
            error.context["frame"] = number
            raise
        points = np.where(scan.confidence[:, None] > 0, scan.vertices, np.nan)[self.face]
        return RegisteredScan(points, scan.confidence[self.face])


Performance = _Array | _Folder  # frames of one person's face; ``name`` is the file's or folder's


def _check_size(file: str, number: int, points: Floats, rest: Floats) -> None:
    """Raise ``performance.unit`` unless the points (s, 3) spread about as far as at ``rest``."""
    size = float(np.linalg.norm(points.std(axis=0)) / np.linalg.norm(rest.std(axis=0)))
    if not SIZES[0] <= size <= SIZES[1]:
        message = (
            f"{file}, frame {number}: the points spread {size:.3g} times as far as the neutral's; "
            "a performance is in mm, in the template's vertex order"
        )
        raise InputError("performance.unit", message, file=file, frame=number, found=size)
