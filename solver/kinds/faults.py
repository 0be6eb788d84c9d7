"""Sentences for what is wrong with a document: the place, the value and its bounds."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError
from pydantic_core import ErrorDetails

LONGEST = 200  # characters of a value in a sentence: it may be a file's worth
PLAIN_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
MARK = "<"  # begins the tags of a union's choices, which pydantic puts into an error's place

Place = Sequence[str | int]


@dataclass(frozen=True)
class Fault:
    """A fault at one place of a document.

    where
        A JSON path, such as ``options.scene.keys[1].time``.
    message
        A sentence with the value and what is allowed.
    path
        The path's parts below the document's own name.
    unknown
        Whether the place is a member that a document may not have.
    """

    where: str
    message: str
    path: tuple[str | int, ...]
    unknown: bool = False

    def as_dict(self) -> dict[str, str]:
        """Return place and sentence for an answer."""
        return {"where": self.where, "message": self.message}


def find_faults(error: ValidationError, document: Any, name: str) -> list[Fault]:
    """Return the faults of a document called ``name`` in their order."""
    return [_fault(each, document, name) for each in error.errors(include_url=False)]


def _fault(detail: ErrorDetails, document: Any, name: str) -> Fault:
    path = _path(detail["loc"], document)
    if detail["type"] == "extra_forbidden":
        message = f"Additional properties are not allowed ({path[-1]!r} was unexpected)"
        return Fault(_text(path[:-1], name), message, tuple(path), unknown=True)
    if detail["type"] == "missing":
        message = f"{path.pop()!r} is a required property"
    elif detail["type"] in ("union_tag_not_found", "union_tag_invalid"):
        path, message = _choice(path, detail)
    else:
        message = _sentence(detail)
    return Fault(_text(path, name), message, tuple(path))


def _path(place: Place, document: Any) -> list[str | int]:
    """Return an error's place without the tags of unions."""
    path: list[str | int] = []
    for part in place:
        has = isinstance(document, Mapping) and part in document
        if isinstance(part, str) and part.startswith(MARK) and not has:
            continue
        path.append(part)
        is_item = isinstance(document, list) and isinstance(part, int) and part < len(document)
        document = document[part] if has or is_item else None
    return path


def _text(path: Place, name: str) -> str:
    """Return a place as a JSON path."""
    for part in path:
        if isinstance(part, int):
            name += f"[{part}]"
        else:
            name += f".{part}" if PLAIN_NAME.fullmatch(part) else f"[{part!r}]"
    return name


def _choice(path: list[str | int], detail: ErrorDetails) -> tuple[list[str | int], str]:
    """Return place and sentence of what is of no known ``kind``."""
    given = detail["input"]
    if not isinstance(given, Mapping):
        return path, f"{_shown(given)} is not of type 'object'"
    if "kind" not in given:
        return path, "'kind' is a required property"
    known = detail["ctx"]["expected_tags"].replace(MARK, "").replace(">", "")
    return [*path, "kind"], f"{_shown(given['kind'])} is not one of [{known}]"


def _sentence(detail: ErrorDetails) -> str:
    """Return what is wrong with a value."""
    kind, value = detail["type"], detail["input"]
    if value != value:
        return f"{value} is not a number"
    if kind in _TYPES:
        if kind == "float_type" and isinstance(value, int) and not isinstance(value, bool):
            return f"{_shown(value)} is greater than the maximum of a number"
        return f"{_shown(value)} is not of type '{_TYPES[kind]}'"
    if kind not in _WORDS:
        return f"{_shown(value)} {detail['msg']}"
    bounds = {name: _bound(bound) for name, bound in detail.get("ctx", {}).items()}
    return f"{_shown(value)} {_WORDS[kind].format(**bounds)}"


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}..."


def _bound(value: Any) -> str:
    return str(int(value)) if isinstance(value, float) and value.is_integer() else str(value)


_TYPES = {
    "model_type": "object",
    "dict_type": "object",
    "list_type": "array",
    "string_type": "string",
    "bool_type": "boolean",
    "int_type": "integer",
    "float_type": "number",
}
_WORDS = {
    "greater_than_equal": "is less than the minimum of {ge}",
    "less_than_equal": "is greater than the maximum of {le}",
    "greater_than": "is less than or equal to the minimum of {gt}",
    "too_short": "is too short",
    "string_too_short": "is too short",
    "too_long": "is too long",
    "string_too_long": "is too long",
    "finite_number": "is not finite",
    "literal_error": "is not one of {expected}",
}
