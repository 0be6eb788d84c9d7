"""Restore a backup: check all of it before anything is written, and repeat deletions."""

from __future__ import annotations

import sqlite3
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from myoface import __version__
from myoface.backup.dump import check_postgresql, check_sqlite, dumped_revision, is_empty, load
from myoface.backup.folder import SECRET, BackupFolder, Deleted, Manifest
from myoface.client.files import sha256_of
from myoface.errors import StackError
from service.settings import Settings
from service.store import deletion
from service.store.database import Database, known_revisions
from service.store.durable import write_durably
from service.store.files import files_at
from service.store.integrity import find_fault
from service.store.models import Capture, Job, Rig, Subject, Template


def restore(settings: Settings, folder: Path, stamp: str | None = None) -> tuple[Manifest, int]:
    """Restore the newest backup of a folder, or that of ``stamp``, into a service without data.

    What was deleted after it stays deleted. Returns the backup's manifest, and how many deletions
    were repeated. One that was interrupted can be done again.

    Raises
    ------
    StackError
        If the backup is not whole, is of another kind of database or a newer release, or the
        service has data already: nothing is written then.
    """
    source, manifest, deletions = _open(folder, stamp)
    database = Database(settings.database)
    try:
        _check_target(settings, database, manifest)
        _check_whole(source, manifest)
        _restore_files(settings, source, manifest)
        kept = source.path / SECRET
        if kept.exists() and settings.secret_key is None:
            write_durably(settings.data_dir / "secret", kept.read_bytes())
        repeated = _load(source.dump(manifest), database, manifest, deletions)
    except OSError as error:
        raise StackError(
            f"the restore stopped, and can be done again: {error.strerror or error}"
        ) from error
    finally:
        database.close()
    return manifest, repeated


def verify(folder: Path, stamp: str | None = None) -> tuple[Manifest, int]:
    """Restore a backup's database into a scratch folder, and compare every file with its name.

    A dump of PostgreSQL, for which there may be no server here, is read as a whole.

    Raises
    ------
    StackError
        If it could not be restored; the message says what is damaged.
    """
    source, manifest, deletions = _open(folder, stamp)
    _check_whole(source, manifest)
    if manifest.database != "sqlite":
        check_postgresql(source.dump(manifest))
        return manifest, 0
    with tempfile.TemporaryDirectory(prefix="myoface-verify-") as scratch:
        database = Database(f"sqlite:///{Path(scratch) / 'myoface.db'}")
        repeated = _load(source.dump(manifest), database, manifest, deletions)
        with database.read() as session:
            wanted = deletion.references(session)
        database.close()
    known = {*manifest.files, *(each.sha256 for each in manifest.missing)}
    if strangers := wanted - known:
        raise StackError(f"{len(strangers)} files of the database are not in the backup")
    return manifest, repeated


def _open(folder: Path, stamp: str | None) -> tuple[BackupFolder, Manifest, list[Deleted]]:
    """Read a backup's lists; raises if this release cannot restore it."""
    source = BackupFolder(folder)
    manifest = source.choose(stamp)
    dump = source.dump(manifest)
    if not dump.is_file() or sha256_of(dump) != manifest.database_sha256:
        raise StackError(f"{dump} is not what the manifest says: it is damaged or lost")
    known = known_revisions()
    revision = manifest.revision or dumped_revision(dump, manifest.database)
    if revision not in known:
        raise StackError(
            f"the backup is of release {manifest.release or 'unknown'} (revision {revision}), "
            f"newer than this one, {__version__} (revision {known[0]}): restore it with that one"
        )
    return source, manifest, source.deletions()


def _check_target(settings: Settings, database: Database, manifest: Manifest) -> None:
    """Check that the service that is to be filled can take the backup."""
    name = database.url.get_backend_name()
    if name != manifest.database:
        raise StackError(f"the backup is of {manifest.database}, and the database is {name}")
    if not is_empty(database):
        raise StackError("the database has tables already; restore into an empty one")
    if not files_at(settings.files).ready():
        raise StackError("the service's file store takes no files: is it there, and writable?")


def _check_whole(source: BackupFolder, manifest: Manifest) -> None:
    """Compare every file with its name."""
    files = source.files
    for sha256 in manifest.files:
        if fault := find_fault(files, sha256):
            raise StackError(f"the backup's file {sha256} is {fault}")
    if manifest.database == "sqlite":
        try:
            check_sqlite(source.dump(manifest))
        except sqlite3.Error as error:
            raise StackError(f"the backup's database is damaged: {error}") from error


def _restore_files(settings: Settings, source: BackupFolder, manifest: Manifest) -> None:
    """Store the files, before there are rows that refer to them."""
    kept = source.files
    target = files_at(settings.files)
    settings.data_dir.mkdir(mode=0o700, parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=settings.data_dir, prefix="restore-") as folder:
        fetched = Path(folder) / "file"
        for sha256 in manifest.files:
            kept.fetch(sha256, fetched)
            target.put(fetched)


def _load(dump: Path, database: Database, manifest: Manifest, deletions: Sequence[Deleted]) -> int:
    """Fill the database, bring it up to date and repeat deletions; returns how many."""
    repeated: list[Deleted] = []

    def complete(filled: Database) -> None:
        filled.migrate()
        with filled.write() as session:
            later = (row for row in deletions if row.created_at >= manifest.made_at)
            repeated.extend(row for row in later if _repeat(session, row))

    load(dump, database, complete)
    return len(repeated)


# How what was deleted by a kind of id is deleted again; all others are ids of jobs or rigs
DELETIONS: dict[str, tuple[type[Any], Callable[..., object]]] = {
    "subject": (Subject, deletion.delete_subject),
    "capture": (Capture, deletion.delete_capture),
    "template": (Template, deletion.delete_template),
}


def _repeat(session: Session, row: Deleted) -> bool:
    """Delete one thing; False: it is not in the backup."""
    model, delete = DELETIONS.get(row.kind, (Job, deletion.delete_job))
    if row.kind == "rig":
        of_rig = select(Job).join(Rig, Rig.job_id == Job.id).where(Rig.id == row.object_id)
        found = session.scalars(of_rig).one_or_none()
    else:
        found = session.get(model, row.object_id)
    if found is not None:
        delete(session, found, "request")
    return found is not None
