"""Bounds on what is quoted of a stranger's input: short plain texts, short lists, small documents.

Errors and results quote what files and requests hold. Whoever stores them or sends them on passes
them through `shorten` or `fit` first.
"""

from __future__ import annotations

import json
import math
import unicodedata
from dataclasses import dataclass
from typing import Any

from solver.kinds import FILES

ELLIPSIS = "..."
# Set in a document of which something was left out
MARK = "shortened"
DEEPEST = 32


@dataclass(frozen=True)
class DocumentBounds:
    """Bounds of a document: characters of a text, items of a list or object, bytes of the whole."""

    text: int = 500
    items: int = 50
    size: int = 64 * 1024


# What a solver tells of its failure and of its progress, and what it tells of its results
ERROR = DocumentBounds()
PROGRESS = DocumentBounds(size=3000)
SUMMARY = DocumentBounds(items=2000, size=1024**2)
# The number of a file's format, at most
HIGHEST_FORMAT = 1_000_000


def shorten(text: str, most: int = 200) -> str:
    """Return a text of at most ``most`` characters, without characters that steer a terminal."""
    text = text if len(text) <= most else text[: most - len(ELLIPSIS)] + ELLIPSIS
    if text.isprintable():
        return text
    escaped = "".join(map(_escape, text))
    return escaped if len(escaped) <= most else escaped[: most - len(ELLIPSIS)] + ELLIPSIS


def fit(document: dict[str, Any], bounds: DocumentBounds) -> dict[str, Any]:
    """Return a document of JSON values within ``bounds``, with the mark `MARK` if it was cut.

    Where it is too large with all its members, the last ones go: the first say what it is about.
    """
    found = _Cut(bounds)
    whole: dict[str, Any] = found.of(document, DEEPEST)
    room = bounds.size - len(MARK) - len('{"": true}')
    fitting = {}
    for name, value in whole.items():
        room -= len(json.dumps({name: value}))
        if room < 0:
            found.something = True
            break
        fitting[name] = value
    return {**fitting, MARK: True} if found.something else fitting


def fit_result(
    summary: dict[str, Any], expressions: list[Any], formats: dict[str, Any]
) -> dict[str, Any]:
    """Return what a job tells of its results within `SUMMARY`.

    ``formats`` are numbers of formats by the names of files, of those that later jobs read.
    """
    names = [shorten(str(name)) for name in expressions[: SUMMARY.items]]
    known = {name: formats.get(name) for name in FILES}
    numbers = {
        name: number
        for name, number in known.items()
        if type(number) is int and 0 < number <= HIGHEST_FORMAT
    }
    return {"expressions": names, "summary": fit(summary, SUMMARY), "formats": numbers}


def fit_progress(step: dict[str, Any]) -> dict[str, Any]:
    """Return a report of progress within `PROGRESS`, its phase and its fraction first."""
    fraction = float(min(1.0, max(0.0, step["fraction"])))
    head = {"phase": str(step["phase"]), "fraction": fraction}
    return fit(head | step | head, PROGRESS)


def refuse_constant(name: str) -> float:
    """Raise ValueError for NaN and infinity, which are no JSON: ``parse_constant`` of a reader."""
    raise ValueError(f"{name} is no JSON")


class _Cut:
    """Cuts values; ``something`` says whether there was anything to cut."""

    def __init__(self, bounds: DocumentBounds) -> None:
        self._bounds = bounds
        self.something = False

    def of(self, value: Any, depth: int) -> Any:
        if isinstance(value, str):
            short = shorten(value, self._bounds.text)
            self.something |= len(value) > self._bounds.text
            return short
        if isinstance(value, (dict, list, tuple)):
            self.something |= len(value) > self._bounds.items or not depth
            most = self._bounds.items if depth else 0
            if isinstance(value, dict):
                members = list(value.items())[:most]
                return {self.of(str(key), depth): self.of(item, depth - 1) for key, item in members}
            return [self.of(item, depth - 1) for item in value[:most]]
        if isinstance(value, float) and not math.isfinite(value):  # written as 1e999
            self.something = True
            return None
        return value


def _escape(character: str) -> str:
    """Return a character, or its escape if it is a control, a mark of direction or a line's end."""
    if unicodedata.category(character)[0] != "C" and character not in "\u2028\u2029":
        return character
    return character.encode("unicode_escape").decode()
