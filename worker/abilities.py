"""Abilities of this worker: it claims no other jobs, and shows them in the table of workers."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, version

from sqlalchemy.orm import Session

from service.queue.claims import Abilities
from service.settings import Settings
from service.store.database import clock
from service.store.models import Worker
from solver.kinds import KINDS
from solver.landmarker import lacking_of_faces

OWN_JOBS = Settings.model_fields["jobs"].default
HOST = socket.gethostname()
NAME = f"{HOST}:{os.getpid()}"


def abilities(settings: Settings, kinds: Iterable[str] = ()) -> Abilities:
    """Return what this process can do; ``kinds`` are the only ones it shall do, none: all.

    Raises
    ------
    ValueError
        If this release does not know one of them.
    """
    known = KINDS.keys()
    only = frozenset(kinds)
    if strangers := only - known:
        raise ValueError(f"unknown kinds of job: {', '.join(sorted(strangers))}")
    return Abilities(
        worker=NAME,
        kinds=only or frozenset(known),
        memory_mb=settings.solver_memory_mb,
        threads=settings.solver_threads,
    )


def lacking(settings: Settings) -> list[str]:
    """Return what is missing here of finding faces in pictures, as it is now.

    A model that is fetched meanwhile serves the next job. Jobs of another package may do without.
    """
    return lacking_of_faces() if settings.jobs == OWN_JOBS else []


def show_life(
    session: Session, queue: str, can: Abilities, slots: int, lacks: Iterable[str] = ()
) -> None:
    """Say in the table of workers that this one lives, what it does, and what it lacks for it."""
    worker = session.get(Worker, can.worker)
    if worker is None:
        worker = Worker(name=can.worker, queue=queue)
        session.add(worker)
    worker.host = HOST
    worker.version = _version()
    worker.kinds = sorted(kind for kind in can.kinds if KINDS[kind].queue == queue)
    worker.lacks = list(lacks)
    worker.memory_mb = can.memory_mb
    worker.threads = can.threads
    worker.slots = slots
    worker.seen_at = clock(session)


def _version() -> str:
    try:
        return version("myoface")
    except PackageNotFoundError:
        return "0"
