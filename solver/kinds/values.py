"""Parts of documents: strict objects, numbers, vectors and places."""

from collections.abc import Callable, Mapping
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Discriminator, Field, Tag


class Document(BaseModel):
    """An object of JSON that has no members but its own; values are not converted."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, defer_build=True)


def _whole(value: Any) -> Any:
    """Return a number without a fraction as an integer: to JSON 5.0 is one."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


Integral = BeforeValidator(_whole)  # after the bounds, or these are left out of JSON Schemas
Whole = Annotated[int, Integral]
Vector = Annotated[
    list[Annotated[float, Field(ge=-10000, le=10000)]], Field(min_length=3, max_length=3)
]
Name = Annotated[str, Field(min_length=1, max_length=64)]


def _form_of_place(value: Any) -> str | None:
    if isinstance(value, bool):
        return None
    forms = {str: "<name>", int: "<vertex>", float: "<vertex>", list: "<point>"}
    return forms.get(type(value))


Place = Annotated[
    Annotated[Name, Tag("<name>")]
    | Annotated[int, Field(ge=0), Integral, Tag("<vertex>")]
    | Annotated[Vector, Tag("<point>")],
    Discriminator(
        _form_of_place,
        custom_error_type="no_such_form",
        custom_error_message="is not a landmark's name, a vertex's number or a point",
    ),
    Field(description="a landmark's name, the number of a skin vertex, or a point [x, y, z] in mm"),
]


def find_kind(value: Any) -> str | None:
    """Return the tag of an object that its member ``kind`` tells from others."""
    if isinstance(value, Mapping):
        return f"<{value['kind']}>" if "kind" in value else None
    return f"<{value.kind}>" if isinstance(value, Document) and hasattr(value, "kind") else None


def form_by_member(*members: str) -> Callable[[Any], str | None]:
    """Return what finds the tag of an object by the first of the members that it has."""

    def find_form(value: Any) -> str | None:
        names = value if isinstance(value, Mapping) else getattr(value, "__dict__", ())
        return next((f"<{member}>" for member in members if member in names), None)

    return find_form
