"""Removing stored files that nothing refers to any more."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from datetime import datetime, timedelta

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.store.files import Files, Stored
from service.store.models import (
    Artifact,
    Capture,
    FrameChunk,
    Job,
    Template,
    Upload,
    now,
)
from service.store.store import Store
from service.store.transitions import FINAL

REFERRING = (
    Artifact.sha256,
    Capture.sha256,
    Capture.landmarks_sha256,
    FrameChunk.sha256,
    Template.sha256,
    Upload.sha256,
)
"""The columns that keep a file."""


def collect(store: Store, age: float) -> int:
    """Remove files that no row refers to and that are older than ``age`` seconds.

    In two steps, each with a look into the tables of its own: such a file is put aside, and goes
    ``age`` seconds later if still nothing refers to it. So the row of what is stored must be
    committed within ``age`` seconds. Returns how many went.
    """
    limit = now() - timedelta(seconds=age)
    store.files.remove_unfinished(limit)
    # Listed before the tables are read: what is stored in between is not in the lists.
    aside, stored = _older(store.files.aside(), limit), _older(store.files.stored(), limit)
    wanted = referenced_files(store)
    removed = sum(_decide(store.files, sha256, sha256 in wanted) for sha256 in aside)
    for sha256 in stored:
        if sha256 not in wanted:
            with suppress(FileNotFoundError):  # another sweeper was faster
                store.files.put_aside(sha256)
    return removed


def referenced_files(store: Store) -> set[str]:
    """Return the sha256 of the files that rows refer to, and that jobs still read."""
    with store.read() as session:
        return references(session)


def references(session: Session) -> set[str]:
    """Return the sha256 of the files that the rows of a session refer to."""
    found: set[str] = set()
    for column in REFERRING:
        found.update(filter(None, session.scalars(select(column).distinct())))
    active = select(Job.inputs).where(Job.state.not_in(FINAL))
    for inputs in session.scalars(active):
        found.update(item["sha256"] for item in inputs)
    return found


def _older(files: Iterator[Stored], limit: datetime) -> list[str]:
    return [stored.sha256 for stored in files if stored.at < limit]


def _decide(files: Files, sha256: str, wanted: bool) -> bool:
    """Take back or remove a file that was put aside; returns whether it is gone."""
    with suppress(FileNotFoundError):
        if wanted:
            files.take_back(sha256)
        else:
            files.remove(sha256)
    return not wanted
