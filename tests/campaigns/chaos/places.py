"""The places where the service keeps things: on disks that can be filled, with its own clock."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psycopg

from tests.campaigns.chaos.clock import Clock, settable_clock
from tests.campaigns.chaos.disk import Disk, small_disk
from tests.servers.postgres import postgres
from tests.servers.s3 import s3

MEGABYTES_OF_TABLES = 32
"""PostgreSQL's empty database has eight."""


@dataclass(frozen=True)
class Places:
    """Settings of a service, and what of its places a blow may hit; None: not on this machine."""

    settings: dict[str, Any]
    results: Disk | None
    tables: Disk | None
    clock: Clock | None


@contextmanager
def _embedded(folder: Path) -> Iterator[Places]:
    """Give SQLite and a folder of files, each on a disk of its own."""
    tables = folder / "database"
    with (
        settable_clock(folder) as clock,
        small_disk(folder / "files") as files,
        small_disk(tables) as disk,
    ):
        settings = {"database_url": f"sqlite:///{tables / 'myoface.db'}"}
        yield Places(settings, files, disk, clock)


@contextmanager
def _servers(folder: Path) -> Iterator[Places]:
    """Give PostgreSQL with its tables on a disk of their own, S3, and such a disk for attempts."""
    folder.chmod(0o711)  # PostgreSQL is another user's
    tables = folder / "database"
    work = folder / "work"
    with (
        settable_clock(folder) as clock,
        small_disk(work) as attempts,
        small_disk(tables, MEGABYTES_OF_TABLES) as disk,
        postgres() as server,
        s3(folder / "s3") as bucket,
    ):
        database = _database_at(server, tables)
        settings = {"database_url": database, "files_url": bucket, "work_dir": work}
        yield Places(settings, attempts, disk, clock)


def _database_at(server: str, folder: Path) -> str:
    """Make a database whose tables are in a folder; returns its URL."""
    place = folder / "tables"
    place.mkdir()
    if os.geteuid() == 0:
        shutil.chown(place, "postgres")
    with psycopg.connect(server, autocommit=True) as connection:
        connection.execute(f"CREATE TABLESPACE small LOCATION '{place}'")
        connection.execute("CREATE DATABASE chaos TABLESPACE small")
    return server.rpartition("/")[0] + "/chaos"


STORES: dict[str, Callable[[Path], AbstractContextManager[Places]]] = {
    "sqlite": _embedded,
    "postgresql+s3": _servers,
}
