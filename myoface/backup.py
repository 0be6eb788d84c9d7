"""A backup: the database as it was at a moment, and every file that it refers to.

The folder has ``manifest.json``, the database's dump, ``files/`` and the secret. Stored files never
change, so the next backup into the same folder copies only new ones.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import sqlite3
import subprocess
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

from pydantic import BaseModel
from sqlalchemy import URL, select, text
from sqlalchemy.orm import Session

from myoface.errors import StackError
from service.access.bootstrap import write_secret
from service.secret import secret
from service.settings import Settings
from service.store.database import Database, Store
from service.store.deletion import references
from service.store.files import FolderFiles
from service.store.models import Deletion, now

MANIFEST, DELETIONS, SECRET, FILES = "manifest.json", "deletions.json", "secret", "files"
DUMPS = {"sqlite": "database.sqlite", "postgresql": "database.dump"}


class Manifest(BaseModel):
    """What a backup holds."""

    made_at: datetime
    database: str
    database_sha256: str
    files: list[str]
    missing: list[str]
    """Files that rows refer to and that the store did not have."""


class Deleted(BaseModel):
    """Something that was deleted and stays so when an older backup is restored."""

    kind: str
    object_id: str
    created_at: datetime


def back_up(settings: Settings, folder: Path) -> Manifest:
    """Write a backup into ``folder``, while the service may be running.

    Raises
    ------
    StackError
        If the database can not be dumped.
    """
    folder.mkdir(parents=True, exist_ok=True)
    store = Store(settings.database, settings.files, settings.broker)
    made_at, name = now(), store.database.url.get_backend_name()
    dump = folder / DUMPS[name]
    with _snapshot(store.database, dump) as session:
        wanted = sorted(references(session))
    kept = FolderFiles(folder / FILES)
    missing = _copy(store, kept, wanted)
    if settings.secret_key is None:
        write_secret(folder / SECRET, secret(settings))
    manifest = Manifest(
        made_at=made_at,
        database=name,
        database_sha256=sha256_of(dump),
        files=[each for each in wanted if each not in missing],
        missing=missing,
    )
    _forget_others(kept, wanted)
    note_deletions(store, folder)
    _write(folder / MANIFEST, manifest.model_dump(mode="json"))
    store.close()
    return manifest


def note_deletions(store: Store, folder: Path) -> int:
    """Write down what was deleted so far, for a later `restore`; returns how many."""
    with store.read() as session:
        found = session.scalars(select(Deletion).order_by(Deletion.created_at)).all()
        rows = [
            Deleted(kind=row.kind, object_id=row.object_id, created_at=row.created_at)
            for row in found
        ]
    _write(folder / DELETIONS, [row.model_dump(mode="json") for row in rows])
    return len(rows)


def sha256_of(path: Path) -> str:
    """Return the hex digest of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def run_tool(name: str, url: URL, *words: str | Path) -> None:
    """Run ``pg_dump`` or ``pg_restore`` on a database; its password is not on the command line."""
    program = shutil.which(name)
    if program is None:
        raise StackError(f"{name} is not installed: apt-get install postgresql-client")
    where = (url.username, None, url.host, url.port, url.database, url.query)
    plain = URL.create("postgresql", *where).render_as_string()
    command = [program, *map(str, words), f"--dbname={plain}"]
    environment = os.environ | {"PGPASSWORD": url.password or ""}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise StackError(f"{name} failed: {done.stderr.strip()}")


@contextmanager
def _snapshot(database: Database, dump: Path) -> Iterator[Session]:
    """Dump the database; gives a session that sees just what was dumped."""
    dump.unlink(missing_ok=True)
    if database.is_sqlite:
        with closing(sqlite3.connect(str(database.url.database))) as connection:
            connection.execute("VACUUM INTO ?", [str(dump)])
        dump.chmod(0o600)
        copy = Database(f"sqlite:///{dump}")
        with copy.read() as session:
            yield session
        copy.close()
        return
    frozen = database.engine.execution_options(isolation_level="REPEATABLE READ")
    with Session(frozen) as session:
        name = session.scalar(text("SELECT pg_export_snapshot()"))
        run_tool("pg_dump", database.url, "-Fc", f"--snapshot={name}", f"--file={dump}")
        dump.chmod(0o600)
        yield session


def _copy(store: Store, kept: FolderFiles, wanted: Iterable[str]) -> list[str]:
    """Copy the files that the backup lacks; returns those that the store lacks, too."""
    missing = []
    for sha256 in wanted:
        if kept.exists(sha256):
            continue
        incoming = kept.incoming / sha256
        try:
            store.files.fetch(sha256, incoming)
            kept.put(incoming)
        except FileNotFoundError:
            missing.append(sha256)
        finally:
            incoming.unlink(missing_ok=True)
    return missing


def _forget_others(kept: FolderFiles, wanted: Iterable[str]) -> None:
    """Remove what earlier backups had and this one does not: what is deleted goes here, too."""
    for sha256 in {stored.sha256 for stored in kept.list_stored()}.difference(wanted):
        kept.put_aside(sha256)
        kept.remove(sha256)


def _write(path: Path, content: Any) -> None:
    fresh = path.with_suffix(".new")
    fresh.write_text(json.dumps(content, indent=1))
    fresh.replace(path)
