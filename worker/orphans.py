"""What dead workers of this host left: folders of attempts, and processes still at work in them."""

from __future__ import annotations

import os
import re
import shutil
import signal
from pathlib import Path

import structlog

from service.store.models import Job
from service.store.store import Store
from service.store.transitions import HELD

FOLDER_VARIABLE = "MYOFACE_ATTEMPT"
"""In the environment of a solver process, and so of every process that it starts."""

ATTEMPT = re.compile(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}\.\d+")
"""The name of an attempt's folder, ``<job>.<attempt>``; nothing else is ever removed."""

log = structlog.get_logger()


def remove_orphans(store: Store, work: Path) -> None:
    """Remove the folders of attempts that nobody is at any more, and end their processes.

    The solver itself dies with its supervisor, but not what it had started (the mesher).
    """
    if not work.is_dir():
        return
    for folder in work.iterdir():
        if ATTEMPT.fullmatch(folder.name) and not _is_held(store, folder.name):
            end_processes(folder)
            shutil.rmtree(folder, ignore_errors=True)
            log.info("attempt.removed", folder=folder.name)


def end_processes(folder: Path) -> None:
    """Kill the processes of an attempt (Linux; elsewhere they end by themselves)."""
    mark = f"{FOLDER_VARIABLE}={folder}".encode()
    for environment in Path("/proc").glob("[0-9]*/environ"):
        try:
            if mark in environment.read_bytes().split(b"\0"):
                os.kill(int(environment.parent.name), signal.SIGKILL)
        except OSError:
            continue  # gone meanwhile, or another user's


def _is_held(store: Store, name: str) -> bool:
    job_id, _, attempt = name.rpartition(".")
    with store.read() as session:
        job = session.get(Job, job_id)
        return job is not None and job.state in HELD and str(job.attempt) == attempt
