"""One thing that a check of a template found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


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
