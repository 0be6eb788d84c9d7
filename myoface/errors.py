"""Errors of starting the service and of talking to it."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import httpx

UNREACHABLE = "client.unreachable"
NUMBER = re.compile(r"(-?\d[\d,]*(\.\d+)?)")
LOCATING_KEYS = ("file", "line", "vertex", "frame", "time", "expected", "found", "field")

MOMENTS = ("frame", "time")


class StackError(RuntimeError):
    """The service could not be started here."""


class ApiError(Exception):
    """The service refused a request, a job failed, or nobody answered.

    ``problem`` is the problem document (RFC 9457): ``code`` is stable, ``title`` and ``detail``
    are for people, and other members locate the fault.
    """

    def __init__(self, problem: dict[str, Any]) -> None:
        super().__init__(describe(problem))
        self.problem = problem

    @property
    def code(self) -> str:
        """The stable, machine-readable code."""
        return str(self.problem.get("code", "unknown"))

    @property
    def status(self) -> int | None:
        """The HTTP status, where there was an answer."""
        return self.problem.get("status")

    def with_places(self, told: Callable[[str], str]) -> ApiError:
        """Return the error with the place of its first fault as ``told`` says it."""
        faults = self.problem.get("errors")
        first = faults[0] if isinstance(faults, list) and faults else None
        where = first.get("where") if isinstance(first, dict) else None
        detail = self.problem.get("detail")
        if not (isinstance(where, str) and where and isinstance(detail, str)):
            return self
        if not detail.startswith(f"{where}: "):
            return self
        return ApiError({**self.problem, "detail": told(where) + detail.removeprefix(where)})

    @classmethod
    def from_response(cls, response: httpx.Response) -> ApiError:
        """Read the problem document of an error answer (or make one of another server's page)."""
        try:
            problem = response.json()
        except ValueError:
            problem = None
        if not isinstance(problem, dict) or "code" not in problem:
            detail = f"{response.request.method} {response.request.url}: {response.text[:200]}"
            problem = {"code": f"http.{response.status_code}", "detail": detail}
        return cls({"status": response.status_code, **problem})


def describe(problem: dict[str, Any]) -> str:
    """Return a problem document as one line: what, where (unless that said it), code."""
    text = str(problem.get("detail") or problem.get("message") or problem.get("title") or "failed")
    known = {key: problem[key] for key in LOCATING_KEYS if problem.get(key) is not None}
    located = {key: f"{key} {_short(value)}" for key, value in known.items()}
    where = [
        words
        for key, words in located.items()
        # a number in a sentence is seldom that of a frame
        if not (words in text if key in MOMENTS else _says(text, known[key]))
    ]
    return f"{text} ({', '.join([*where, problem.get('code', 'unknown')])})"


def _short(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _says(text: str, value: Any) -> bool:
    """Return True if ``text`` has ``value`` in it, a number as rounded as a sentence has it."""
    if isinstance(value, (list, tuple)):
        return all(_says(text, each) for each in value)
    if not isinstance(value, (int, float)):
        return str(value) in text
    return any(
        abs(float(number.replace(",", "")) - value) <= 0.5 * 10.0 ** -len(decimals[1:])
        for number, decimals in NUMBER.findall(text)
    )
