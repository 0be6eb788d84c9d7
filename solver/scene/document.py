"""Scene documents: from JSON to what it says, and back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

from pydantic import ValidationError

from solver.errors import InputError
from solver.kinds.faults import find_faults
from solver.kinds.values import Document

Scene = TypeVar("Scene", bound=Document)


def read_scene(document: Any, kind: type[Scene]) -> Scene:
    """Return a scene of a kind.

    Raises :class:`InputError` (``scene.schema``) with ``where`` the first fault is, a JSON path.
    """
    try:
        return kind.model_validate(document)
    except ValidationError as error:
        fault = find_faults(error, document, "scene")[0]
        message = f"{fault.where}: {fault.message}"
        raise InputError("scene.schema", message, where=fault.where) from error


def document_of(scene: Document) -> Mapping[str, Any]:
    """Return what was given of a scene, as JSON values with whole numbers as such."""
    document: Mapping[str, Any] = _whole(scene.model_dump(mode="json", exclude_unset=True))
    return document


def _whole(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _whole(each) for name, each in value.items()}
    if isinstance(value, list):
        return [_whole(each) for each in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value
