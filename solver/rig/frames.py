"""Frames on disk as they come: one record, one file format, one writer and one reader.

A folder ``frames`` holds JSON files: ``000010-000019.json`` has the 11th to the 20th frame, and
beside them what its kind of job needs to go on. A file is whole or not there, and files follow on
one another; docs/guide/sequences.md and docs/guide/simulation.md describe their values.
"""

from __future__ import annotations

import base64
import json
import time
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, Generic, Self, TypeVar

import numpy as np

from solver.errors import InputError
from solver.surface import Floats

FORMAT = 1  # of files of frames
FRAMES = "frames"  # name of the folder


@dataclass(frozen=True)
class FrameRecord:
    """One frame of a face over time, as far as all jobs with frames know it.

    frame
        Its number, from 0.
    activations, jaw
        (m, 6) and (5,), as of an expression.
    head
        (6,) rotation vector (rad) and translation (mm): the head in the world, x -> R x + t.
    inverted
        Number of tets with det F <= 0.
    iterations, seconds
        How the solve went.
    """

    frame: int
    activations: Floats
    jaw: Floats
    head: Floats
    inverted: int
    iterations: int
    seconds: float

    ARRAYS: ClassVar[tuple[str, ...]] = ("activations", "jaw", "head")
    # array (., 3) -> its name in a file, where it is packed in single precision
    PACKED: ClassVar[Mapping[str, str]] = {}

    def as_dict(self) -> dict[str, Any]:
        """Return the frame as JSON values."""
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        for name in self.ARRAYS:
            values[name] = values[name].tolist()
        for name, key in self.PACKED.items():
            values[key] = pack(values.pop(name), "<f4")
        return values

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Self:
        """Return the frame that :meth:`as_dict` gave these values of."""
        given = dict(values)
        for name in cls.ARRAYS:
            given[name] = np.array(given[name], np.float64)
        for name, key in cls.PACKED.items():
            given[name] = unpack(given.pop(key), "<f4")
        return cls(**given)


Record = TypeVar("Record", bound=FrameRecord)


def pack(values: Floats, kind: str) -> str:
    """Return an array (., 3) as text: zlib of its bytes as ``kind``, in base 64."""
    return base64.b64encode(zlib.compress(values.astype(kind).tobytes(), 1)).decode()


def unpack(text: str, kind: str) -> Floats:
    """Return the array (., 3) that :func:`pack` gave a text of."""
    content = zlib.decompress(base64.b64decode(text))
    return np.frombuffer(content, kind).reshape(-1, 3).astype(np.float64)


def write_chunk(
    folder: Path, first: int, frames: Sequence[FrameRecord], beside: Mapping[str, Any]
) -> Path:
    """Write frames, the ``first``-th of the folder and on, whole or not at all.

    ``beside`` are more JSON values of the file.
    """
    folder.mkdir(parents=True, exist_ok=True)
    content = {"format": FORMAT, **beside, "frames": [frame.as_dict() for frame in frames]}
    path = folder / _name(first, len(frames))
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(content, allow_nan=False), encoding="utf-8")
    partial.replace(path)
    return path


@dataclass(frozen=True)
class ChunkOptions:
    """Size of the files of frames: written after so many frames or seconds, whichever is first."""

    frames: int = 30
    seconds: float = 2.0


class ChunkWriter(Generic[Record]):
    """Writes frames into the files of a ``folder`` as they come, the ``first``-th and on.

    ``beside`` is called with the last frame of a file for the values beside its frames.
    """

    def __init__(
        self,
        folder: Path,
        first: int,
        options: ChunkOptions,
        beside: Callable[[Record], Mapping[str, Any]] = lambda _last: {},
    ) -> None:
        self._folder, self._first = folder, first
        self._options, self._beside = options, beside
        self._frames: list[Record] = []
        self._since = time.monotonic()

    def add(self, frame: Record) -> None:
        """Take a frame; write a file if it is full or long due."""
        self._frames.append(frame)
        overdue = time.monotonic() - self._since > self._options.seconds
        if overdue or len(self._frames) >= self._options.frames:
            self.flush()

    def flush(self) -> None:
        """Write the frames that wait, if there are any."""
        if self._frames:
            write_chunk(self._folder, self._first, self._frames, self._beside(self._frames[-1]))
        self._first += len(self._frames)
        self._frames, self._since = [], time.monotonic()


@dataclass(frozen=True)
class ChunkReader(Generic[Record]):
    """Reads the frames of a folder.

    record
        The class of its frames.
    code
        Of the error for what is no frame, or leaves a gap.
    fits
        Says whether a frame is of this model.
    take
        Is called with each file's values and frames, before they are looked at: for the values
        beside the frames. It may raise an :class:`InputError` of its own.
    """

    record: type[Record]
    code: str
    fits: Callable[[Record], bool]
    take: Callable[[Mapping[str, Any], Sequence[Record]], None] = lambda _values, _frames: None

    def read(self, folder: Path) -> list[Record]:
        """Return the frames of a folder in their order, none if it is not there.

        Raises :class:`InputError` if there is a gap, what is no frame, or another model's.
        """
        frames: list[Record] = []
        for path in sorted(folder.glob("*.json")):
            read = self._read_file(path)
            if path.name != _name(len(frames), len(read)) or not all(map(self.fits, read)):
                raise InputError(
                    self.code,
                    f"{path.name} does not follow on the {len(frames)} frames before it",
                    file=path.name,
                )
            frames += read
        return frames

    def _read_file(self, path: Path) -> list[Record]:
        try:
            content = json.loads(path.read_bytes())
            if content["format"] != FORMAT:
                raise ValueError(f"their format is {content['format']}, not {FORMAT}")
            read = [self.record.of(each) for each in content["frames"]]
            self.take(content, read)
        except InputError as error:
            error.context["file"] = path.name
            raise
        except (OSError, ValueError, LookupError, TypeError, zlib.error) as error:
            raise InputError(
                self.code, f"{path.name} holds no frames: {error}", file=path.name
            ) from error
        return read


def _name(first: int, count: int) -> str:
    return f"{first:06d}-{first + count - 1:06d}.json"
