"""Errors a person can act on: each names the file, the line or the vertex it is about."""

from __future__ import annotations

from typing import Any


class _PlainError(Exception):
    """A fault that is told to people.

    ``code`` is stable and machine readable (``scan.nan``, ``scan.vertex_count`` ...), ``message``
    is one plain sentence, ``context`` holds what locates the fault (``file``, ``line``, ``vertex``,
    ``expected``, ``found`` ...).
    """

    def __init__(self, code: str, message: str, **context: Any) -> None:
        super().__init__(message)
        self.code = code
        self.message = message
        self.context = context

    def as_dict(self) -> dict[str, Any]:
        """Return the error as plain JSON values."""
        return {"code": self.code, "message": self.message, **self.context}


class InputError(_PlainError, ValueError):
    """Something the user gave can not be used."""


class SolveError(_PlainError, RuntimeError):
    """A solve could not be finished (singular system, no descent, a mesher that died)."""
