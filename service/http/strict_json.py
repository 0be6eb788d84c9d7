"""JSON as RFC 8259 has it, and no more: what several parsers would read differently is refused."""

from __future__ import annotations

import json
import math
import re
from typing import Any

from service.errors import Problem

DEEPEST = 32
_UNICODE_FAULT = re.compile("[\x00\ud800-\udfff]")


def check(body: bytes) -> None:
    """Refuse a body that is not strict JSON.

    Refused are NaN and infinity (also as ``1e999``), an object with a name twice, nesting deeper
    than :data:`DEEPEST`, other encodings than UTF-8, and text that no database column holds (NUL,
    half of a surrogate pair).

    Raises
    ------
    Problem
        422 ``request.json``.
    """
    try:
        value = json.loads(
            body.decode(),
            parse_constant=_no_constant,
            parse_float=_finite,
            object_pairs_hook=_no_name_twice,
        )
    except RecursionError:
        raise _problem(f"it is nested deeper than {DEEPEST}") from None
    except json.JSONDecodeError as error:
        raise _problem(f"{error.msg}, line {error.lineno} column {error.colno}") from None
    except UnicodeDecodeError:
        raise _problem("it is not UTF-8") from None
    except ValueError as error:
        raise _problem(str(error)) from None
    _check_nesting(value)


def _check_nesting(value: Any) -> None:
    level = [value]
    for _ in range(DEEPEST + 1):
        if not level:
            return
        for item in level:
            if isinstance(item, str) and _UNICODE_FAULT.search(item):
                raise _problem("a text holds NUL, or half of a surrogate pair")
        level = [inner for item in level for inner in _parts(item)]
    raise _problem(f"it is nested deeper than {DEEPEST}")


def _parts(value: Any) -> list[Any]:
    if isinstance(value, dict):
        return [*value.keys(), *value.values()]
    return value if isinstance(value, list) else []


def _no_constant(name: str) -> None:
    raise ValueError(f"{name} is not a number in JSON")


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text[:32]} is too large a number")
    return number


def _no_name_twice(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        raise ValueError("an object has a name twice")
    return found


def _problem(what: str) -> Problem:
    return Problem(422, "request.json", f"the body is not valid JSON: {what}")
