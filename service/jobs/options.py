"""Options of jobs checked at a bounded cost, whatever a megabyte of them holds.

pydantic makes an error for every fault, a hundred thousand of a document that was made for it. So
options are read once by a schema whose lists stop at their first fault; only where there is one,
the contract reads what is around it, and tells all that is wrong there.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

from pydantic import ValidationError
from pydantic_core import SchemaValidator

from service.bounds import shorten
from service.errors import Problem, faulty
from solver.kinds import KINDS, Kind

# Items of a list that are read after the first with a fault, and of lists without one
AROUND = 25
# Number of an item whose fault is told alone: to read all before it again costs as much again
FAR = 500
# Steps of a simulation: at 0.3 s each they take a day
MOST_STEPS = 250_000
# Steps of a frame where a scene says nothing, by its mode
STEPS = {"quasi_static": 1, "dynamic": 4}
# Overrides by core-schema type for the fast validator
QUICK = {"list": {"fail_fast": True}, "default": {"copy_default": False}}


def check_options(name: str, options: dict[str, Any], place: str = "options") -> Kind:
    """Return the kind of job of a name; raises a problem if it does not take these options.

    ``place`` is that of the options in the request.
    """
    kind = find_kind(name)
    try:
        read = _quick(kind).validate_python(options)
    except ValidationError as error:
        told = [
            (where.replace("options", place, 1), message)
            for where, message in _find_faults(kind, options, error)
        ]
        raise faulty(422, "job.options", told, at_least=True) from None
    _refuse_endless(getattr(read, "scene", None))
    return kind


def _refuse_endless(scene: Any) -> None:
    """Refuse a scene of keys whose steps no worker would come to the end of in a day."""
    if not hasattr(scene, "keys"):
        return
    last = max((key.time for key in scene.keys), default=0.0)
    seconds = last if scene.duration is None else scene.duration
    steps = scene.steps_per_frame or STEPS[scene.mode]
    count = round(seconds * scene.fps * steps)
    if count > MOST_STEPS:
        detail = (
            f"{seconds:g} s of {scene.fps:g} frames of {steps} steps are {count} steps, more than "
            f"{MOST_STEPS}: make it shorter, or in parts"
        )
        raise Problem(422, "job.too_long", detail, expected=MOST_STEPS, found=count)


def find_kind(name: str) -> Kind:
    """Return the kind of job of a name."""
    kind = KINDS.get(name)
    if kind is None:
        detail = f"there is no kind of job {shorten(name)!r}"
        told = sorted(KINDS)
        raise Problem(422, "job.kind", detail, expected=told, found=shorten(name))
    return kind


@cache
def _quick(kind: Kind) -> SchemaValidator:
    """Return a validator of a kind's options whose lists stop at the first fault.

    What it reads is only looked at, so that its defaults need not be copies.
    """
    kind.options.model_rebuild()
    return SchemaValidator(_fail_fast(kind.options.__pydantic_core_schema__), _use_prebuilt=False)


def _fail_fast(schema: Any) -> Any:
    if isinstance(schema, dict):
        found = {name: _fail_fast(value) for name, value in schema.items()}
        return {**found, **QUICK.get(str(found.get("type")), {})}
    return [_fail_fast(item) for item in schema] if isinstance(schema, list) else schema


def _find_faults(
    kind: Kind, options: dict[str, Any], error: ValidationError
) -> list[tuple[str, str]]:
    """Return the faults of options around the first of each list, or those first ones alone."""
    places = [_numbers(each["loc"]) for each in error.errors(include_url=False)]
    numbers = max(places, default=())
    around = [] if max(numbers, default=0) > FAR else kind.faults(_cut(options, numbers))
    return [(fault.where, fault.message) for fault in around or kind.explain(error, options)]


def _numbers(place: Sequence[str | int]) -> tuple[int, ...]:
    return tuple(part for part in place if isinstance(part, int))


def _cut(value: Any, numbers: Sequence[int]) -> Any:
    """Return a value with shortened lists; ``numbers`` are the items of the way to a fault."""
    if isinstance(value, dict):
        return {name: _cut(item, numbers) for name, item in value.items()}
    if not isinstance(value, list):
        return value
    first, inner = (numbers[0], numbers[1:]) if numbers else (0, ())
    return [_cut(item, inner) for item in value[: first + AROUND]]
