"""The scene document: what may stand in it, and whether it does."""

from __future__ import annotations

import json
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
    """Return a scene that is one for ``job``.

    Raises :class:`InputError` (``scene.schema``) with ``where`` the first fault is, a JSON path.
    """
    schema = {"$ref": f"#/$defs/{job}_scene", "$defs": DEFINITIONS}
    error = best_match(Draft202012Validator(schema).iter_errors(document))
    if error is not None:
        where = error.json_path.replace("$", "scene", 1)
        raise InputError("scene.schema", f"{where}: {error.message}", where=where)
    checked: Mapping[str, Any] = document
    return checked
