"""The faults that every mesh format shares, in one wording and with stable codes."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from solver.errors import InputError
from solver.surface import Floats


def unreadable_error(file: str, reason: str, **where: Any) -> InputError:
    """Return the error for content that breaks the format's rules."""
    return InputError("scan.unreadable", f"{file}{_at(where)}: {reason}", file=file, **where)


def truncated_error(file: str, reason: str, **where: Any) -> InputError:
    """Return the error for a file that ends before what it announces."""
    return InputError("scan.truncated", f"{file} is cut short: {reason}", file=file, **where)


def unsupported_error(file: str, reason: str, **where: Any) -> InputError:
    """Return the error for a well-formed file in a form that cannot be used."""
    return InputError("scan.format", f"{file}{_at(where)}: {reason}", file=file, **where)


def empty_error(file: str) -> InputError:
    """Return the error for a file without a single vertex."""
    return InputError("scan.empty", f"{file} holds no vertices", file=file)


def not_finite_error(file: str, vertex: int, found: object, **where: Any) -> InputError:
    """Return the error for a coordinate that is NaN or infinite; ``vertex`` counts from 0."""
    return InputError(
        "scan.nan",
        f"{file}{_at(where)}: vertex {vertex} is not finite: {found}",
        file=file,
        vertex=vertex,
        found=str(found),
        **where,
    )


def _at(where: dict[str, Any]) -> str:
    return f", line {where['line']}" if "line" in where else ""


def check_finite(file: str, vertices: Floats) -> None:
    """Raise ``scan.nan`` for the first vertex (n, 3) that is not finite."""
    bad = ~np.isfinite(vertices).all(axis=1)
    if bad.any():
        vertex = int(np.argmax(bad))
        raise not_finite_error(file, vertex, tuple(vertices[vertex].tolist()))


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


def read_content(path: Path, limit: int, what: str) -> bytes:
    """Return a file's bytes; ``what`` says in an error what has at most ``limit`` of them.

    Raises :class:`InputError`: ``scan.too_large``, ``scan.unreadable`` or ``scan.empty``.
    """
    try:
        size = path.stat().st_size
        if size > limit:
            raise InputError(
                "scan.too_large",
                f"{path.name} has {size} bytes; {what} has at most {limit}",
                file=path.name,
                expected=limit,
                found=size,
            )
        content = path.read_bytes()
    except OSError as error:
        raise InputError(
            "scan.unreadable", f"{path.name} cannot be read: {error.strerror}", file=path.name
        ) from None
    if not content.strip():
        raise empty_error(path.name)
    return content
