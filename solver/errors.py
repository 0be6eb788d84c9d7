"""Errors a person can act on: each names the file, the line or the vertex it is about."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal


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
    """Something the user gave cannot be used."""


class SolveError(_PlainError, RuntimeError):
    """A solve could not be finished (singular system, no descent, a mesher that died)."""


# One thing that a check of a template found.


@dataclass(frozen=True)
class Finding:
    """``code`` is stable; ``about`` is the part it is about, such as a muscle's name.

    An ``error`` makes the template of no use, a ``warning`` is worth a look.
    """

    severity: Literal["error", "warning"]
    code: str
    about: str
    message: str


def error(code: str, about: str, message: str) -> Finding:
    """Return a finding that makes the template of no use."""
    return Finding("error", code, about, message)


def warning(code: str, about: str, message: str) -> Finding:
    """Return a finding that is worth a look."""
    return Finding("warning", code, about, message)


# What a fit has to tell besides its result: things that are wrong but did not stop it.


@dataclass(frozen=True)
class Notice:
    """One warning: a stable ``code``, one plain sentence, and figures that say where and how much.

    ``context`` holds plain JSON values; ``expression`` is among them where it is about one.
    """

    code: str
    message: str
    context: dict[str, Any] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Return the notice as plain JSON values."""
        return {"code": self.code, "message": self.message, **self.context}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Notice:
        """Return the notice that :meth:`as_dict` wrote."""
        context = {key: value for key, value in values.items() if key not in ("code", "message")}
        return cls(values["code"], values["message"], context)
