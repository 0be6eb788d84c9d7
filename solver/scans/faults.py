"""The faults every scan format shares, in one wording and with stable codes."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from solver.errors import InputError
from solver.surface import Floats


def unreadable(file: str, reason: str, **where: Any) -> InputError:
    """Return the error for content that breaks the format's rules."""
    return InputError("scan.unreadable", f"{file}{_at(where)}: {reason}", file=file, **where)


def truncated(file: str, reason: str, **where: Any) -> InputError:
    """Return the error for a file that ends before what it announces."""
    return InputError("scan.truncated", f"{file} is cut short: {reason}", file=file, **where)


def unsupported(file: str, reason: str, **where: Any) -> InputError:
    """Return the error for a well-formed file in a form that can not be used."""
    return InputError("scan.format", f"{file}{_at(where)}: {reason}", file=file, **where)


def check_suffix(path: Path, formats: Collection[str]) -> str:
    """Return a file's suffix in small letters; raises ``scan.format`` if it is none of these."""
    suffix = path.suffix.lower()
    if suffix not in formats:
        raise InputError(
            "scan.format",
            f"{path.name}: unknown suffix {suffix!r}; a scan is one of {', '.join(formats)}",
            file=path.name,
            expected=list(formats),
            found=suffix,
        )
    return suffix


def empty(file: str) -> InputError:
    """Return the error for a file without a single vertex."""
    return InputError("scan.empty", f"{file} holds no vertices", file=file)


def wrong_vertex_count(file: str, expected: int, found: int) -> InputError:
    """Return the error for another topology than the template's."""
    return InputError(
        "scan.vertex_count",
        f"{file} has {found} vertices; the template's topology has {expected}; a raw scan is sent "
        "as raw and registered first",
        file=file,
        expected=expected,
        found=found,
    )


def not_finite(file: str, vertex: int, found: object, **where: Any) -> InputError:
    """Return the error for a coordinate that is NaN or infinite; ``vertex`` counts from 0."""
    return InputError(
        "scan.nan",
        f"{file}{_at(where)}: vertex {vertex} is not finite: {found}",
        file=file,
        vertex=vertex,
        found=str(found),
        **where,
    )


def check_finite(file: str, vertices: Floats) -> None:
    """Raise ``scan.nan`` for the first vertex (n, 3) that is not finite."""
    bad = ~np.isfinite(vertices).all(axis=1)
    if bad.any():
        vertex = int(np.argmax(bad))
        raise not_finite(file, vertex, tuple(vertices[vertex].tolist()))


def _at(where: dict[str, Any]) -> str:
    return f", line {where['line']}" if "line" in where else ""
