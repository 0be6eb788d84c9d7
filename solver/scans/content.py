"""The bytes of a file that is small enough to be what it should be."""

from __future__ import annotations

from pathlib import Path

from solver.errors import InputError
from solver.scans.faults import empty


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
            "scan.unreadable", f"{path.name} can not be read: {error.strerror}", file=path.name
        ) from None
    if not content.strip():
        raise empty(path.name)
    return content
