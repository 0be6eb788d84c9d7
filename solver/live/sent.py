"""The faces that a live session sent of its takes, for the jobs of exact fits to compare with.

While a take is recorded the amounts of the skin's modes that were sent go into its file of plain
numbers (:mod:`solver.live.takes`). They are left for each take when it ends, and at the session's
end in one file, ``live_takes.npz``, with the modes at the face's vertices: whoever has the rig has
the faces by it. A take is known by the hash of its file, a frame by its number there.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
import structlog
from numpy.typing import NDArray

from solver.errors import InputError, quote, quote_names
from solver.kinds import FILES
from solver.kinds.live_session import PART
from solver.model import SubjectModel, identity
from solver.storage import Archive, Arrays, hash_file
from solver.surface import Floats

log = structlog.get_logger(__name__)

FILE = "live_takes.npz"
FORMAT = FILES[FILE].format
NOTHING: Arrays = {}
TOLD = ("p50_mm", "p95_mm")  # of the running error
AMOUNT = np.dtype("<f2")  # of a mode: half precision is within a thousandth of a face's motion


@dataclass(frozen=True)
class SentOptions:
    """Bounds of the file of all takes."""

    most_bytes: int = 1 << 29  # of amounts: of more than are read the first takes are left out


@dataclass(frozen=True, eq=False)
class SentModes:
    """What amounts are of: a rig, and the modes (r, k, 3) of its face's vertices."""

    rig: Mapping[str, str]
    basis: NDArray[np.float16]

    @classmethod
    def of_skin(cls, model: SubjectModel, S: sp.csr_array, basis: Floats) -> SentModes:
        """Return the modes of a rig's whole skin (r, n, 3), as its face has them."""
        return cls(identity(model, S), basis[:, model.face].astype(np.float16))

    @cached_property
    def identity(self) -> dict[str, str]:
        """The hashes by which files know what their amounts are of."""
        modes = hashlib.sha256(np.ascontiguousarray(self.basis, "<f2").tobytes()).hexdigest()
        return {**self.rig, "modes": modes}


@dataclass(frozen=True, eq=False)
class SentTake:
    """What was sent of one take: amounts (f, r) in its ``frames`` (f,), as its file numbers them.

    ``told`` has the running error at its end by :data:`TOLD`, None where it was not known.
    Frames that were dropped or held are not among them.
    """

    name: str
    sha256: str  # of the take's file
    told: dict[str, float | None]
    frames: NDArray[np.int64]
    amounts: NDArray[np.float16]


def part_of(take: Path) -> Path:
    """Return the file of what was sent of a take while its session lasts."""
    return take.with_name(f"sent_{take.name}{PART}")


def write_takes(
    path: Path, of: Mapping[str, str], takes: Sequence[SentTake], more: Arrays = NOTHING
) -> None:
    """Write takes whose amounts are ``of`` what :attr:`SentModes.identity` says."""
    told = [{"name": each.name, "sha256": each.sha256, "told": each.told} for each in takes]
    arrays = dict(more)
    for number, each in enumerate(takes):
        arrays |= {f"frames_{number}": each.frames, f"amounts_{number}": each.amounts}
    # amounts hardly get smaller by packing, and a session is to end at once
    Archive({"format": FORMAT, "of": dict(of), "takes": told}, arrays).write(path, packed=False)


def read_takes(path: Path) -> tuple[Archive, list[SentTake]]:
    """Return what :func:`write_takes` wrote.

    Raises :class:`InputError`: ``live_takes.unreadable``, ``live_takes.format``.
    """
    archive = Archive.read(path, "live_takes", "what a live session sent of its takes", FORMAT)
    try:
        takes = [_take_of(archive, *each) for each in enumerate(archive.header["takes"])]
    except (ArithmeticError, LookupError, TypeError, ValueError) as error:
        message = f"{path.name} is not what a live session sent of its takes: {error}"
        raise InputError("live_takes.unreadable", message, file=path.name) from error
    return archive, takes


def _take_of(archive: Archive, number: int, told: Mapping[str, Any]) -> SentTake:
    frames = archive.arrays[f"frames_{number}"]
    amounts = archive.arrays[f"amounts_{number}"]
    is_plain = frames.dtype.kind in "iu" and amounts.dtype == AMOUNT and amounts.ndim == 2
    if not is_plain or amounts.shape[:1] != frames.shape:
        raise ValueError(f"the take {number} has other arrays than a number and amounts a frame")
    if not np.isfinite(amounts).all():
        raise ValueError(f"the take {number} has amounts that are no numbers")
    given = {each: told["told"][each] for each in TOLD}
    error = {each: None if value is None else float(value) for each, value in given.items()}
    if not all(each is None or 0.0 <= each < np.inf for each in error.values()):
        raise ValueError(f"the take {number} has a running error that is no distance")
    return SentTake(quote(told["name"]), str(told["sha256"]), error, frames, amounts)


def gather_takes(out: Path, modes: SentModes | None, options: SentOptions = SentOptions()) -> None:
    """Leave what was sent of all takes of a session as one file in its folder ``out``.

    What an earlier session of the same modes left there is kept. Without ``modes``, as of a session
    that never began, only the takes' own files go.
    """
    found: dict[tuple[str, str], SentTake] = {}
    parts = sorted(out.glob(f"sent_*{PART}"), key=lambda path: path.stat().st_mtime_ns)
    for path in (out / FILE, *parts):
        if modes is not None and path.is_file():
            for take in _takes_of(path, modes):  # of an attempt that was killed here one is in both
                found.pop((take.name, take.sha256), None)
                found[take.name, take.sha256] = take
    if modes is not None and found:
        takes = [*found.values()]
        room = options.most_bytes - np.cumsum([each.amounts.nbytes for each in takes[::-1]])
        kept = takes[len(takes) - int(np.count_nonzero(room >= 0)) :]
        write_takes(out / FILE, modes.identity, kept, {"basis": modes.basis})
    for path in parts:
        path.unlink()


def _takes_of(path: Path, modes: SentModes) -> list[SentTake]:
    """Return the takes in a file that are of these modes."""
    try:
        archive, takes = read_takes(path)
    except InputError as error:
        log.warning("sent.unreadable", file=path.name, error=error.message)
        return []
    return takes if archive.header.get("of") == modes.identity else []


class SentFaces:
    """The faces that a session sent of one take, by the frames of the take's file."""

    def __init__(self, take: SentTake, basis: NDArray[np.float16], rest: Floats) -> None:
        self.take = take
        self._basis = basis.reshape(len(basis), -1).astype(np.float64)
        self._rest = rest
        self._places = {number: place for place, number in enumerate(take.frames.tolist())}

    @classmethod
    def open(cls, path: Path, model: SubjectModel, S: sp.csr_array, take: Path) -> SentFaces:
        """Return what a session of a rig sent of the take in a file.

        Raises :class:`InputError`: as :func:`read_takes`, ``live_takes.rig`` for a session of
        another rig, ``live_takes.take`` for a file that is none of the session's takes.
        """
        archive, takes = read_takes(path)
        rest = model.skin.vertices[model.face]
        of = archive.header.get("of")
        if not isinstance(of, dict) or {**of, **identity(model, S)} != of:
            message = f"{path.name} is of a live session with another rig"
            raise InputError("live_takes.rig", message, file=path.name)
        digest = hash_file(take) if take.is_file() else ""  # a folder of scans is none
        found = next((each for each in takes if each.sha256 == digest), None)
        if found is None:
            names = ", ".join(quote_names([each.name for each in takes])) or "none"
            message = f"{take.name} is no take of the live session of {path.name}: it has {names}"
            about = {"file": path.name, "take": take.name}
            raise InputError("live_takes.take", message, **about)
        basis = archive.arrays.get("basis", np.zeros(0))
        size = (found.amounts.shape[1], *rest.shape)
        if basis.dtype != AMOUNT or basis.shape != size or not np.isfinite(basis).all():
            message = f"{path.name} has no modes of the face that its amounts are of"
            raise InputError("live_takes.unreadable", message, file=path.name)
        return cls(found, basis, rest)

    def off_mm(self, frame: int, skin: NDArray[np.floating]) -> float | None:
        """Return the mean distance of the face (k, 3) in a frame from the one that was sent.

        Both are in the head's frame. None where none was sent.
        """
        place = self._places.get(frame)
        if place is None:
            return None
        amounts = self.take.amounts[place].astype(np.float64)
        sent = self._rest + (amounts @ self._basis).reshape(-1, 3)
        return float(np.linalg.norm(sent - skin, axis=1).mean())
