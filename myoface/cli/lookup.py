"""Find what a person means on the command line: an id, the first characters of one, or a name."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Protocol, TypeVar

from myoface.cli.commands import UsageError
from myoface.client import Client

WHOLE = re.compile(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}")
LEAST = 6  # characters of an id that stand for it
MOST_SHOWN = 5


class Identified(Protocol):
    """A value that the service knows by an id."""

    @property
    def id(self) -> str:
        """The id."""


Thing = TypeVar("Thing", bound=Identified)


def find_subject(client: Client, given: str) -> str:
    """Return the id of the subject that ``given`` is: an id, its start, or the person's name."""
    return _find(given, "subject", client.subjects, lambda each: each.name)


def find_template(client: Client, given: str) -> str:
    """Return the id of the template that ``given`` is: an id, its start, or a name."""
    return _find(given, "template", client.templates, lambda each: each.name)


def find_job(client: Client, given: str) -> str:
    """Return the id of the job that ``given`` is, whole or by its start."""
    return _find(given, "job", client.jobs)


def find_rig(client: Client, given: str) -> str:
    """Return the id of the rig that ``given`` is: an id, its start, or a name."""
    return _find(given, "rig", client.rigs, lambda each: each.name)


def refuse_missing(given: str) -> None:
    """Refuse what is a file by its name and is not there: no service's rig is called so.

    Raises :class:`UsageError`.
    """
    if not Path(given).exists() and ("/" in given or given.endswith((".npz", ".zip"))):
        raise UsageError(f"there is no file {given}")


def find_batch(client: Client, given: str) -> str:
    """Return the id of the batch that ``given`` is: an id, its start, or a name."""
    return _find(given, "batch", client.batches, lambda each: each.name)


def find_webhook(client: Client, given: str) -> str:
    """Return the id of the webhook that ``given`` is: an id, its start, or its address."""
    return _find(given, "webhook", client.webhooks, lambda each: each.url)


def matching(
    given: str, things: Iterable[Thing], name: Callable[[Thing], str] | None = None
) -> list[Thing]:
    """Return the things whose id is or begins with ``given``, and those that are called so.

    Names may differ in their case alone, so one that is meant exactly comes first.
    """
    start = given.lower()
    things = list(things)
    exact = [each for each in things if each.id == start or (name and name(each) == given)]
    return exact or [
        each
        for each in things
        if (len(start) >= LEAST and each.id.startswith(start))
        or (name and name(each).casefold() == given.casefold())
    ]


def _find(
    given: str,
    what: str,
    listed: Callable[[], Iterable[Thing]],
    name: Callable[[Thing], str] | None = None,
) -> str:
    if WHOLE.fullmatch(given.lower()):
        return given.lower()
    found = matching(given, listed(), name)
    if len(found) == 1:
        return found[0].id
    if found:
        ids = ", ".join(each.id for each in found[:MOST_SHOWN])
        more = ", ..." if len(found) > MOST_SHOWN else ""
        raise UsageError(f"{given!r} may be one of {len(found)}: {ids}{more}; give more of the id")
    words = f"an id, or {LEAST} characters of its start" + (", or a name" if name else "")
    raise UsageError(f"there is no {what} {given!r}: {words} is needed")
