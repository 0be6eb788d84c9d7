"""Shapes that several resources share."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated, Any, Generic, Self, TypeVar

from pydantic import (
    AfterValidator,
    AwareDatetime,
    BaseModel,
    ConfigDict,
    Field,
    StringConstraints,
    model_validator,
)
from pydantic_core import PydanticCustomError

Item = TypeVar("Item")

_ID = r"^[0-9a-fA-F]{8}(-[0-9a-fA-F]{4}){3}-[0-9a-fA-F]{12}$"
# No control characters (C0, C1), and none that turn round the order of what is shown
_LINE = r"^[^\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]*$"
_NAME = r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$"
_FILE_NAME = r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,254}$"
_LABEL = r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}(:[^\x00-\x1f\x7f-\x9f]*)?$"
_LETTERS = "letters, digits, '_', '.' and '-', with a letter or digit first"

# Unknown members of an object in a request that are told one by one
MOST_STRANGERS = 30

# The patterns of texts in words, for error messages
IN_WORDS = {
    _ID: "an id is needed, such as 8c1d3a52-0f4e-4c5b-9b39-1f3a4f1f6c11",
    _LINE: "one line of text is needed, without control characters",
    _NAME: f"a name is needed of at most 64 {_LETTERS}",
    _LABEL: f"`key:value` or a `key` is needed, a key of at most 64 {_LETTERS}",
    _FILE_NAME: f"a file's name is needed of at most 255 {_LETTERS}",
}

# A UUID, as the text that the tables hold
Id = Annotated[
    str, StringConstraints(pattern=_ID, to_lower=True), Field(json_schema_extra={"format": "uuid"})
]

# One line of text; PostgreSQL could not hold a NUL
Line = Annotated[str, StringConstraints(strip_whitespace=True, max_length=200, pattern=_LINE)]

Title = Annotated[Line, StringConstraints(min_length=1)]
# A name that also serves in file names and as the name of a morph target
Name = Annotated[str, StringConstraints(pattern=_NAME)]

# Labels that an object may have
MOST_LABELS = 32

Labels = Annotated[
    dict[Name, Title],
    Field(
        max_length=MOST_LABELS,
        description="what the studio notes of it: `{key: value}`",
        examples=[{"session": "Monday", "actor": "17"}],
    ),
]
LabelChanges = Annotated[
    dict[Name, Title | None],
    Field(
        max_length=2 * MOST_LABELS,
        description="labels to be set; null takes one away, the others stay",
        examples=[{"session": "Monday", "draft": None}],
    ),
]
# A label that is asked for: `key:value`, or a key with any value
Label = Annotated[str, StringConstraints(max_length=265, pattern=_LABEL)]

# The name of a result's file, which may hold a `Name` and more
FileName = Annotated[str, StringConstraints(pattern=_FILE_NAME)]

# A number that the database can compare with its own
Position = Annotated[int, Field(ge=0, lt=2**63)]


RetainUntil = Annotated[
    datetime | None,
    Field(description="when it is deleted by itself; null: when somebody deletes it"),
]


def _in_utc(moment: datetime) -> datetime:
    try:
        return moment.astimezone(UTC)
    except OverflowError as error:
        raise ValueError("the year must lie between 1 and 9999 in UTC too") from error


# A moment with its zone, that the tables can hold
Moment = Annotated[AwareDatetime, AfterValidator(_in_utc)]


class RequestBody(BaseModel):
    """A request's body: an unknown member is an error, not a typing mistake that goes unnoticed.

    Each one is told, but not hundreds: pydantic makes an error of each.
    """

    model_config = ConfigDict(extra="forbid")

    @model_validator(mode="before")
    @classmethod
    def _refuse_many(cls, given: Any) -> Any:
        if isinstance(given, dict) and len(given) > len(cls.model_fields) + MOST_STRANGERS:
            raise PydanticCustomError("many_members", "there are more members than it may have")
        return given


class Change(RequestBody):
    """Changes of a resource: what is left out stays as it is, and nothing can be null."""

    @model_validator(mode="after")
    def _no_nulls(self) -> Self:
        if nulls := [name for name in self.model_fields_set if getattr(self, name) is None]:
            raise ValueError(f"{nulls[0]} cannot be null")
        return self


class View(BaseModel):
    """A resource as the API shows it."""

    model_config = ConfigDict(from_attributes=True)


class Page(View, Generic[Item]):
    """A list, newest first; pass `next` as `cursor` to go on, null is the end."""

    items: list[Item]
    next: str | None = None
