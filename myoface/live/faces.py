"""A followed frame by names, as sinks have it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isnan, prod
from typing import Any

from myoface.live.readings import unpack_numbers

HELD, RESUMED, GAP = 1, 2, 4  # flags of a followed frame: docs/reference/live.md


@dataclass(frozen=True)
class Face:
    """The face as a session followed it: lengths in mm, the jaw's turns in rad."""

    number: int
    seconds: float  # as the frame that was sent has it
    solve_ms: float
    error_mm: tuple[float, float]  # running error, p50 and p95; NaN before it is known
    dropped: int  # frames so far that came too fast
    flags: int
    head: Sequence[float]  # (16,) a matrix by rows, into the source's axes
    jaw: Sequence[float]  # (5,)
    values: Mapping[str, float]  # of the template's expressions
    contractions: Mapping[str, float]  # of muscles, parts of their fibres' length

    @property
    def is_held(self) -> bool:
        """Whether the frame said nothing of use, so that the face is as before."""
        return bool(self.flags & HELD)


@dataclass(frozen=True)
class Layout:
    """Where a session's arrays lie in the numbers of its frames, and what their rows are called."""

    sizes: Mapping[str, int]
    sliders: tuple[str, ...]
    muscles: tuple[str, ...]

    @classmethod
    def of(cls, ready: Mapping[str, Any]) -> Layout:
        """Return what the session's ready message says."""
        sizes = {each["name"]: prod(each["shape"]) for each in ready["layout"]}
        return cls(sizes, tuple(ready["sliders"]), tuple(ready["muscles"]))

    def arrays(self, data: bytes) -> dict[str, Sequence[float]]:
        """Return the arrays of a frame's numbers by name; raises ValueError for another length."""
        numbers = unpack_numbers(data)
        if len(numbers) != sum(self.sizes.values()):
            expected = sum(self.sizes.values())
            raise ValueError(f"a frame has {len(numbers)} numbers, and {expected} are expected")
        found = {}
        place = 0
        for name, size in self.sizes.items():
            found[name] = numbers[place : place + size]
            place += size
        return found


def tell_face(face: Face, latency_ms: float | None) -> dict[str, Any]:
    """Return a face as JSON has it; what is not known is null."""
    return {
        "type": "frame",
        "number": face.number,
        "seconds": face.seconds,
        "latency_ms": latency_ms,
        "solve_ms": _known(face.solve_ms),
        "error_mm": {"p50": _known(face.error_mm[0]), "p95": _known(face.error_mm[1])},
        "dropped": face.dropped,
        "held": face.is_held,
        "head": list(face.head),
        "jaw": list(face.jaw),
        "values": dict(face.values),
        "contractions": {name: _known(value) for name, value in face.contractions.items()},
    }


def _known(value: float) -> float | None:
    return None if isnan(value) else value
