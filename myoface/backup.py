"""Backup and restore: the database as it was at a moment, and every file that it refers to.

The folder has ``manifest.json``, the database's dump, ``files/`` and the secret. Stored files never
change, so the next backup into the same folder copies only new ones.
"""

from __future__ import annotations

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

from pydantic import BaseModel, ValidationError
from sqlalchemy import URL, inspect, select, text
from sqlalchemy.orm import Session

from myoface.client.files import sha256_of
from myoface.errors import StackError
from service.access.bootstrap import write_secret
from service.secret import secret
from service.settings import Settings
from service.store import deletion
from service.store.database import Database, Store
from service.store.deletion import references
from service.store.files import DamagedFileError, FolderFiles
from service.store.models import Capture, Deletion, Job, Rig, Subject, Template, now

MANIFEST, DELETIONS, SECRET, FILES = "manifest.json", "deletions.json", "secret", "files"
DUMPS = {"sqlite": "database.sqlite", "postgresql": "database.dump"}


class Manifest(BaseModel):
    """Contents of a backup."""

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
        If the database cannot be dumped.
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


def restore(settings: Settings, folder: Path) -> tuple[Manifest, int]:
    """Restore a backup; what was deleted after it stays deleted.

    Returns the backup's manifest, and how many deletions were repeated.

    Raises
    ------
    StackError
        If ``folder`` is no backup or damaged, is of another database, or something is there.
    """
    manifest = _read_manifest(folder)
    store = Store(settings.database, settings.files, settings.broker)
    database = store.database
    name = database.url.get_backend_name()
    if name != manifest.database:
        raise StackError(f"the backup is of {manifest.database}, and the database is {name}")
    if inspect(database.engine).get_table_names():
        raise StackError("the database has tables already; restore into an empty one")
    dump = folder / DUMPS[name]
    if sha256_of(dump) != manifest.database_sha256:
        raise StackError(f"{dump} is not what the manifest says: it is damaged")
    _restore_files(store, folder, manifest)  # first: rows never refer to what is not there
    _restore_secret(settings, folder)
    if database.is_sqlite:
        database.close()
        shutil.copyfile(dump, Path(str(database.url.database)))
    else:
        _run_tool("pg_restore", database.url, "--no-owner", "--exit-on-error", dump)
    database = Database(settings.database)
    database.migrate()
    again = _repeat_deletions(store, folder, manifest)
    store.close()
    return manifest, again


def _run_tool(name: str, url: URL, *words: str | Path) -> None:
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
        _run_tool("pg_dump", database.url, "-Fc", f"--snapshot={name}", f"--file={dump}")
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


def _read_manifest(folder: Path) -> Manifest:
    try:
        return Manifest.model_validate_json((folder / MANIFEST).read_bytes())
    except (OSError, ValidationError) as error:
        raise StackError(f"{folder} is no whole backup: {error}") from error


def _restore_files(store: Store, folder: Path, manifest: Manifest) -> None:
    kept = FolderFiles(folder / FILES)
    fetched = kept.incoming / "restored"
    for sha256 in manifest.files:
        try:
            kept.fetch(sha256, fetched)
        except (FileNotFoundError, DamagedFileError) as error:
            raise StackError(f"the backup's file {sha256} is missing or damaged") from error
        store.files.put(fetched)
        fetched.unlink()


def _restore_secret(settings: Settings, folder: Path) -> None:
    """Put the secret back, without which no key of the backup opens anything."""
    kept, target = folder / SECRET, settings.data_dir / "secret"
    if kept.exists() and settings.secret_key is None:
        write_secret(target, kept.read_bytes())


def _repeat_deletions(store: Store, folder: Path, manifest: Manifest) -> int:
    """Delete what was deleted after the backup was made, as far as `note_deletions` knows."""
    rows = [Deleted.model_validate(row) for row in json.loads((folder / DELETIONS).read_text())]
    with store.write() as session:
        found = (
            _repeat_deletion(session, row) for row in rows if row.created_at >= manifest.made_at
        )
        return sum(found)


def _repeat_deletion(session: Session, row: Deleted) -> bool:
    """Delete one thing; False: it is not in the backup."""
    match row.kind:
        case "subject":
            subject = session.get(Subject, row.object_id)
            if subject is not None:
                deletion.delete_subject(session, subject, "request")
            return subject is not None
        case "capture":
            capture = session.get(Capture, row.object_id)
            if capture is not None:
                deletion.delete_capture(session, capture, "request")
            return capture is not None
        case "template":
            template = session.get(Template, row.object_id)
            if template is not None:
                deletion.delete_template(session, template, "request")
            return template is not None
        case "rig":
            job = session.scalars(
                select(Job).join(Rig, Rig.job_id == Job.id).where(Rig.id == row.object_id)
            ).one_or_none()
        case _:
            job = session.get(Job, row.object_id)
    if job is not None:
        deletion.delete_job(session, job, "request")
    return job is not None
