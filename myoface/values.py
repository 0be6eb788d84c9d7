"""Read a service's answers into typed values, and refuse what is not this API's."""

from __future__ import annotations

import dataclasses
import functools
import re
import types
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from typing import Annotated, Any, Literal, Self, Union, get_args, get_origin, get_type_hints

from myoface.errors import ApiError

NOT_OF_THE_API = "client.answer"


class ValueFaultError(Exception):
    """A fault of a value, with its place in the answer."""

    def __init__(self, message: str) -> None:
        super().__init__(message)
        self.message = message
        self.where: list[str] = []


@dataclass(frozen=True)
class Resource:
    """A value of the API; members that this client does not know are ignored."""

    @classmethod
    def read(cls, values: Any) -> Self:
        """Read a value of an answer.

        Raises
        ------
        ApiError
            With ``client.answer`` if it is not what this API answers.
        """
        try:
            found: Self = _read(cls, values)
        except ValueFaultError as fault:
            where = ".".join([cls.__name__, *fault.where])
            detail = f"the service's answer is not this API's: {where}: {fault.message}"
            raise ApiError({"code": NOT_OF_THE_API, "detail": detail}) from fault
        return found

    def as_dict(self) -> dict[str, Any]:
        """Return it as JSON has it."""
        return dataclasses.asdict(
            self, dict_factory=lambda items: {name: _plain(value) for name, value in items}
        )


def matching(pattern: str, words: str) -> Callable[[Any], None]:
    """Return a rule for ``Annotated[str, ...]``: the whole text is as ``pattern`` says.

    ``words`` say the same to people.
    """
    compiled = re.compile(pattern)

    def check(text: Any) -> None:
        if not compiled.fullmatch(text):
            raise ValueFaultError(f"{text!r:.80} is not {words}")

    return check


def _read(kind: Any, given: Any) -> Any:
    """Return ``given`` as a value of a type; raise :class:`ValueFaultError` if it is none."""
    origin = get_origin(kind)
    if kind is Any:
        return given
    if origin is Annotated:
        base, *rules = get_args(kind)
        value = _read(base, given)
        for rule in rules:
            rule(value)
        return value
    if origin in (Union, types.UnionType):
        (some,) = [each for each in get_args(kind) if each is not type(None)]
        return None if given is None else _read(some, given)
    if origin is Literal:
        return _require(given in get_args(kind), given, f"one of {', '.join(get_args(kind))}")
    if origin is list:
        _require(isinstance(given, list), given, "a list")
        (each,) = get_args(kind)
        return [_read_at(str(place), each, value) for place, value in enumerate(given)]
    if origin is dict:
        return _require(isinstance(given, dict), given, "an object")
    if isinstance(kind, type) and issubclass(kind, Resource):
        return _read_fields(kind, given)
    return _read_plain(kind, given)


def _read_fields(kind: Any, given: Any) -> Any:
    _require(isinstance(given, dict), given, "an object")
    found = {}
    for name, (hint, is_required) in _fields(kind).items():
        if name in given:
            found[name] = _read_at(name, hint, given[name])
        elif is_required:
            fault = ValueFaultError("it is missing")
            fault.where = [name]
            raise fault
    return kind(**found)


def _read_plain(kind: Any, given: Any) -> Any:
    if kind is datetime:
        try:
            return datetime.fromisoformat(given)
        except (ValueError, TypeError) as error:
            raise ValueFaultError(f"{given!r:.80} is no moment") from error
    if kind is float:
        is_number = isinstance(given, (int, float)) and not isinstance(given, bool)
        return float(_require(is_number, given, "a number"))
    is_one = isinstance(given, kind) and (kind is bool or not isinstance(given, bool))
    return _require(
        is_one, given, {str: "a text", int: "a whole number", bool: "true or false"}[kind]
    )


def _read_at(where: str, kind: Any, given: Any) -> Any:
    try:
        return _read(kind, given)
    except ValueFaultError as fault:
        fault.where.insert(0, where)
        raise


def _require(holds: bool, given: Any, what: str) -> Any:
    if not holds:
        raise ValueFaultError(f"{given!r:.80} is not {what}")
    return given


@functools.cache
def _fields(kind: Any) -> dict[str, tuple[Any, bool]]:
    """Return the type of each field, and True where an answer must have it."""
    hints = get_type_hints(kind, include_extras=True)
    missing = dataclasses.MISSING
    return {
        each.name: (hints[each.name], each.default is missing and each.default_factory is missing)
        for each in dataclasses.fields(kind)
    }


def _plain(value: Any) -> Any:
    return value.isoformat() if isinstance(value, datetime) else value
