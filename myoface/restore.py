"""Restoring a backup into a service that has nothing yet."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

from pydantic import ValidationError
from sqlalchemy import inspect, select
from sqlalchemy.orm import Session

from myoface.backup import (
    DELETIONS,
    DUMPS,
    FILES,
    MANIFEST,
    SECRET,
    Deleted,
    Manifest,
    run_tool,
    sha256_of,
)
from myoface.errors import StackError
from service.access.bootstrap import write_secret
from service.settings import Settings
from service.store import deletion
from service.store.database import Database, Store
from service.store.files import DamagedFileError, FolderFiles
from service.store.models import Capture, Job, Rig, Subject, Template


def restore(settings: Settings, folder: Path) -> tuple[Manifest, int]:
    """Restore a backup; what was deleted after it stays deleted.

    Returns the backup's manifest, and how many deletions were repeated.

    Raises
    ------
    StackError
        If ``folder`` is no backup or damaged, is of another database, or something is there.
    """
    manifest = _read(folder)
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
    _put_files(store, folder, manifest)  # first: rows never refer to what is not there
    _put_secret(settings, folder)
    if database.is_sqlite:
        database.close()
        shutil.copyfile(dump, Path(str(database.url.database)))
    else:
        run_tool("pg_restore", database.url, "--no-owner", "--exit-on-error", dump)
    database = Database(settings.database)
    database.migrate()
    again = _delete_again(store, folder, manifest)
    store.close()
    return manifest, again


def _read(folder: Path) -> Manifest:
    try:
        return Manifest.model_validate_json((folder / MANIFEST).read_bytes())
    except (OSError, ValidationError) as error:
        raise StackError(f"{folder} is no whole backup: {error}") from error


def _put_files(store: Store, folder: Path, manifest: Manifest) -> None:
    kept = FolderFiles(folder / FILES)
    fetched = kept.incoming / "restored"
    for sha256 in manifest.files:
        try:
            kept.fetch(sha256, fetched)
        except (FileNotFoundError, DamagedFileError) as error:
            raise StackError(f"the backup's file {sha256} is missing or damaged") from error
        store.files.put(fetched)
        fetched.unlink()


def _put_secret(settings: Settings, folder: Path) -> None:
    """Put the secret back, without which no key of the backup opens anything."""
    kept, target = folder / SECRET, settings.data_dir / "secret"
    if kept.exists() and settings.secret_key is None:
        write_secret(target, kept.read_bytes())


def _delete_again(store: Store, folder: Path, manifest: Manifest) -> int:
    """Delete what was deleted after the backup was made, as far as `note_deletions` knows."""
    rows = [Deleted.model_validate(row) for row in json.loads((folder / DELETIONS).read_text())]
    with store.write() as session:
        found = (_delete(session, row) for row in rows if row.created_at >= manifest.made_at)
        return sum(found)


def _delete(session: Session, row: Deleted) -> bool:
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
