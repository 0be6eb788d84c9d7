"""The scene document: what may stand in it, and whether it does."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from importlib import resources
from typing import Any, Literal

from jsonschema import Draft202012Validator
from jsonschema.exceptions import best_match

from solver.errors import InputError

Job = Literal["simulate", "animate", "edit"]


def _definitions() -> dict[str, Any]:
    files = (
        resources.files(__package__).joinpath(name)
        for name in ("scene.schema.json", "edit.schema.json")
    )
    return {
        name: schema
        for file in files
        for name, schema in json.loads(file.read_text())["$defs"].items()
    }


DEFINITIONS = _definitions()
"""JSON Schemas by name; that of a job's scene is ``<job>_scene``."""


def check(document: Any, job: Job) -> Mapping[str, Any]:
    """Return a scene that is one for ``job``, whole numbers as such: 5.0 is one to JSON Schema.

    Raises :class:`InputError` (``scene.schema``) with ``where`` the first fault is, a JSON path.
    """
    schema = {"$ref": f"#/$defs/{job}_scene", "$defs": DEFINITIONS}
    error = best_match(Draft202012Validator(schema).iter_errors(document))
    if error is not None:
        raise _fault(error.json_path.replace("$", "scene", 1), error.message)
    checked: Mapping[str, Any] = _plain(document, "scene")
    return checked


def _plain(value: Any, where: str) -> Any:
    """Return JSON values with whole numbers as integers; refuse NaN, which no bound keeps out."""
    if isinstance(value, dict):
        return {name: _plain(each, f"{where}.{name}") for name, each in value.items()}
    if isinstance(value, list):
        return [_plain(each, f"{where}[{number}]") for number, each in enumerate(value)]
    if not isinstance(value, float):
        return value
    if not math.isfinite(value):
        raise _fault(where, f"{value} is not a number")
    return int(value) if value.is_integer() else value


def _fault(where: str, message: str) -> InputError:
    return InputError("scene.schema", f"{where}: {message}", where=where)
