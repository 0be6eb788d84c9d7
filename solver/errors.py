"""Errors a person can act on: each names the file, the line or the vertex it is about."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

LONGEST_QUOTE = 60  # characters of what a file says
MOST_NAMES = 20  # of a list


def quote(value: object) -> str:
    """Return what a file says as it may stand in a message: short, on one line, printable."""
    text = str(value)[: LONGEST_QUOTE + 1]
    shown = "".join(each if each.isprintable() else ascii(each)[1:-1] for each in text)
    return shown if len(shown) <= LONGEST_QUOTE else f"{shown[: LONGEST_QUOTE - 3]}..."


def quote_names(names: Sequence[object]) -> list[str]:
    """Return the first of a file's ``names``, each as :func:`quote` does, and how many follow."""
    more = len(names) - MOST_NAMES
    return [*map(quote, names[:MOST_NAMES]), *([f"and {more} more"] if more > 0 else [])]


def count_words(number: int, one: str, many: str) -> str:
    """Return a number with its noun, and a verb, in the singular or the plural."""
    return f"{number:,} {one if number == 1 else many}"


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


def file_error(code: str, file: object, reason: str, **where: Any) -> InputError:
    """Return the error about a file, at a ``line`` if it is about one."""
    place = f"{file}, line {where['line']}" if "line" in where else f"{file}"
    return InputError(code, f"{place}: {reason}", file=str(file), **where)


class SolveError(_PlainError, RuntimeError):
    """A solve could not be finished (singular system, no descent, a mesher that died)."""


Severity = Literal["info", "warning", "error"]
Verdict = Literal["good", "usable", "bad"]


@dataclass(frozen=True)
class Finding:
    """One thing that a check found: in a scan, in a template, in a result.

    With an ``error`` what was checked is of no use, a ``warning`` is worth a look, an ``info`` only
    tells.
    """

    code: str  # stable
    severity: Severity
    message: str  # one plain sentence
    advice: str = ""  # what to do about it
    context: dict[str, Any] = field(default_factory=dict)  # where and how much, as JSON values

    def to_dict(self) -> dict[str, Any]:
        """Return the finding as plain JSON values."""
        named = {"code": self.code, "severity": self.severity, "message": self.message}
        return {**named, "advice": self.advice, **self.context}

    def as_dict(self) -> dict[str, Any]:
        """Return a warning without advice as plain JSON values, as errors are written."""
        return {"code": self.code, "message": self.message, **self.context}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Finding:
        """Return the finding that :meth:`to_dict` or :meth:`as_dict` wrote."""
        given = {"severity": "warning", "advice": "", **values}
        named = {key: given.pop(key) for key in ("code", "severity", "message", "advice")}
        return cls(**named, context=given)


def advise(
    advice: Mapping[str, str], code: str, severity: Severity, message: str, **context: Any
) -> Finding:
    """Return a finding with the ``advice`` that belongs to its code."""
    return Finding(code, severity, message, advice[code], context)


def judge_findings(findings: Iterable[Finding]) -> Verdict:
    """Return ``bad`` with any error, ``usable`` with any warning, else ``good``."""
    severities = {finding.severity for finding in findings}
    if "error" in severities:
        return "bad"
    return "usable" if "warning" in severities else "good"


def worst_first(findings: Iterable[Finding]) -> list[Finding]:
    """Return errors, then warnings, then what only tells, each as they came."""
    order = ("error", "warning", "info")
    return sorted(findings, key=lambda each: order.index(each.severity))


def make_warning(code: str, message: str, context: dict[str, Any] | None = None) -> Finding:
    """Return a finding of a fit, without advice; ``context`` has its ``expression``, if of one."""
    return Finding(code, "warning", message, context=context or {})
