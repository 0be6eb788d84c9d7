"""Strict documents: their values, sentences for what is wrong with them, and their JSON Schemas."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    ValidationError,
)
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import ErrorDetails, core_schema

DIALECT = "https://json-schema.org/draft/2020-12/schema"
LONGEST = 200  # characters of a value in a sentence: it may be a file's worth
PLAIN_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
MARK = "<"  # begins the tags of a union's choices, which pydantic puts into an error's place

Path = Sequence[str | int]  # of an error in a document


class Document(BaseModel):
    """An object of JSON that has no members but its own; values are not converted."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, defer_build=True)


def _whole(value: Any) -> Any:
    """Return a number without a fraction as an integer: to JSON 5.0 is one."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


Integral = BeforeValidator(_whole)  # after the bounds, or these are left out of JSON Schemas
Whole = Annotated[int, Integral]
FrameNumber = Annotated[int, Field(ge=-(2**31), le=2**31), Integral]  # as a take's file counts
Vector = Annotated[
    list[Annotated[float, Field(ge=-10000, le=10000)]], Field(min_length=3, max_length=3)
]
Name = Annotated[str, Field(min_length=1, max_length=64)]


def tell_forms(find: Callable[[Any], str | None], otherwise: str) -> Discriminator:
    """Tell forms of a value apart by the tags that ``find`` returns."""
    return Discriminator(find, custom_error_type="no_such_form", custom_error_message=otherwise)


def by_type(forms: Mapping[type, str]) -> Callable[[Any], str | None]:
    """Return what finds the tag of a value by its type."""
    return lambda value: forms.get(type(value))


Place = Annotated[
    Annotated[Name, Tag("<name>")]
    | Annotated[int, Field(ge=0), Integral, Tag("<vertex>")]
    | Annotated[Vector, Tag("<point>")],
    tell_forms(
        by_type({str: "<name>", int: "<vertex>", float: "<vertex>", list: "<point>"}),
        "is not a landmark's name, a vertex's number or a point",
    ),
    Field(description="a landmark's name, the number of a skin vertex, or a point [x, y, z] in mm"),
]
Time = Annotated[float, Field(ge=0, le=600, description="in seconds")]


def find_kind(value: Any) -> str | None:
    """Return the tag of an object that its member ``kind`` tells from others."""
    if isinstance(value, Mapping):
        return f"<{value['kind']}>" if "kind" in value else None
    return f"<{value.kind}>" if isinstance(value, Document) and hasattr(value, "kind") else None


def by_member(*members: str) -> Callable[[Any], str | None]:
    """Return what finds the tag of an object by the first of the members that it has."""

    def find_form(value: Any) -> str | None:
        names = value if isinstance(value, Mapping) else getattr(value, "__dict__", ())
        return next((f"<{member}>" for member in members if member in names), None)

    return find_form


# Faults: the place, the value and its bounds, in a sentence.


@dataclass(frozen=True)
class Fault:
    """A fault at one place of a document."""

    where: str  # a JSON path, such as options.scene.keys[1].time
    message: str  # a sentence with the value and what is allowed
    path: tuple[str | int, ...]  # the path's parts below the document's own name
    unknown: bool = False  # whether the place is a member that a document may not have

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


def _path(place: Path, document: Any) -> list[str | int]:
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


def _text(path: Path, name: str) -> str:
    """Return a place as a JSON path."""
    for part in path:
        if isinstance(part, int):
            name += f"[{part}]"
        else:
            name += f".{part}" if PLAIN_NAME.fullmatch(part) else f"[{part!r}]"
    return name


def _choice(path: list[str | int], detail: ErrorDetails) -> tuple[list[str | int], str]:
    """Return the place and a sentence for every entry of an unknown ``kind``."""
    given = detail["input"]
    if not isinstance(given, Mapping):
        return path, f"{_shown(given)} is not of type 'object'"
    if "kind" not in given:
        return path, "'kind' is a required property"
    known = detail["ctx"]["expected_tags"].replace(MARK, "").replace(">", "")
    return [*path, "kind"], f"{_shown(given['kind'])} is not one of [{known}]"


def _sentence(detail: ErrorDetails) -> str:
    kind = detail["type"]
    value = detail["input"]
    if value != value:
        return f"{value} is not a number"
    if kind in _TYPES:
        if kind == "float_type" and isinstance(value, int) and not isinstance(value, bool):
            return f"{_shown(value)} is greater than the maximum of a number"
        return f"{_shown(value)} is not of type '{_TYPES[kind]}'"
    if kind not in _WORDS:
        return f"{_shown(value)} {detail['msg']}"
    bounds = {name: _whole(bound) for name, bound in detail.get("ctx", {}).items()}
    return f"{_shown(value)} {_WORDS[kind].format(**bounds)}"


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}..."


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
    "string_pattern_mismatch": "does not match {pattern}",
}


# JSON Schemas, as clients, the page and OpenAPI read them.


class _Printed(GenerateJsonSchema):
    """Writes what may be null as one more type, and no titles that only repeat a name."""

    def field_title_should_be_set(self, _schema: Any) -> bool:
        return False

    def literal_schema(self, schema: core_schema.LiteralSchema) -> JsonSchemaValue:
        found = super().literal_schema(schema)
        if "enum" in found:
            found.pop("type", None)
        return found

    def nullable_schema(self, schema: core_schema.NullableSchema) -> JsonSchemaValue:
        found = self.generate_inner(schema["schema"])
        if "enum" in found:
            return {**found, "enum": [*found["enum"], None]}
        if isinstance(found.get("type"), str):
            return {**found, "type": [found["type"], "null"]}
        return super().nullable_schema(schema)


@cache
def json_schema(model: type[BaseModel]) -> dict[str, Any]:
    """Return the JSON Schema of a document; its members' order is the model's."""
    found = model.model_json_schema(schema_generator=_Printed)
    for name in ("title", "description"):  # of the class: the kind has better ones
        found.pop(name, None)
    return {"$schema": DIALECT, **found}
