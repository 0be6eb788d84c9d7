"""Make a backup, while the service may be running; what goes wrong leaves the one before whole."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from sqlalchemy import select

from myoface import __version__
from myoface.backup.dump import dump_of
from myoface.backup.folder import SECRET, BackupFolder, Deleted, Manifest, Missing
from myoface.client.files import sha256_of
from myoface.errors import StackError
from service.secret import secret
from service.settings import Settings
from service.store.database import Store, clock, revision_of
from service.store.deletion import references
from service.store.durable import write_durably
from service.store.files import Files, FolderFiles
from service.store.integrity import Fault, find_fault, holders
from service.store.models import Deletion


def back_up(settings: Settings, folder: Path, *, keep: int = 1, reread: bool = False) -> Manifest:
    """Write a backup into ``folder``; files that the store has lost are listed and stepped over.

    ``keep`` backups stay in the folder, this one among them. ``reread`` compares the files that
    the folder has already with their names, and copies the damaged ones again.

    Raises
    ------
    StackError
        If it cannot be made; the one before is still there, and can be restored.
    """
    target = BackupFolder(folder)
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with target.lock():
            return _replace(settings, target, keep, reread)
    except OSError as error:
        raise StackError(f"there is no new backup: {error.strerror or error}") from error


def _replace(settings: Settings, target: BackupFolder, keep: int, reread: bool) -> Manifest:
    """Make a backup, then let go of those before."""
    before = target.newest()
    target.remove_strangers()
    store = Store(settings.database, settings.files, settings.broker)
    try:
        manifest = _write(settings, store, target, reread)
        target.commit(manifest, keep)
    except (OSError, StackError) as error:
        with suppress(OSError):  # makes room on a disk that is full
            target.remove_strangers()
        reason = error.strerror if isinstance(error, OSError) else None
        text = f"there is no new backup: {reason or error}"
        if before:
            text += f"; the one of {before.made_at:%F %T} UTC is still there"
        raise StackError(text) from error
    finally:
        store.close()
    try:
        target.prune(keep)
    except (OSError, StackError) as error:
        text = f"the backup is made, but what was before could not be removed: {error}"
        raise StackError(text) from error
    return manifest


def note_deletions(settings: Settings, folder: Path) -> int:
    """Write down what was deleted so far, for a later `restore`; returns how many."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    store = Store(settings.database, settings.files, settings.broker)
    try:
        return _note_deletions(store, BackupFolder(folder))
    finally:
        store.close()


def _write(settings: Settings, store: Store, target: BackupFolder, reread: bool) -> Manifest:
    """Write all of a backup but its manifest, which is returned."""
    database = store.database
    name = database.url.get_backend_name()
    with database.read() as session:
        made_at = clock(session)
    dump = target.new_dump(name, made_at)
    with dump_of(database, dump) as session:
        revision = revision_of(session.connection())
        if revision is None:
            raise StackError("the database has no tables: is --data the service's folder?")
        wanted = sorted(references(session))
        faults = _copy(store.files, target.files, wanted, reread)
        named = holders(session, faults)
    if settings.secret_key is None:
        write_durably(target.path / SECRET, secret(settings))
    _note_deletions(store, target)
    return Manifest(
        made_at=made_at,
        release=__version__,
        revision=revision,
        database=name,
        dump=dump.name,
        database_sha256=sha256_of(dump),
        files=[each for each in wanted if each not in faults],
        missing=[
            Missing(sha256=sha256, fault=fault, belongs_to=named.get(sha256, []))
            for sha256, fault in faults.items()
        ],
    )


def _copy(
    source: Files, kept: FolderFiles, wanted: Iterable[str], reread: bool
) -> dict[str, Fault]:
    """Copy the files that the backup lacks; returns those that the store itself has not whole.

    Raises
    ------
    OSError
        If it is not the file that is at fault, but its store or the backup's folder.
    """
    faults: dict[str, Fault] = {}
    for sha256 in wanted:
        if kept.exists(sha256) and not (reread and find_fault(kept, sha256)):
            continue
        incoming = kept.incoming / sha256
        try:
            source.fetch(sha256, incoming)
            kept.put(incoming)
        except OSError:
            fault = find_fault(source, sha256)
            if fault is None:
                raise
            faults[sha256] = fault
        finally:
            incoming.unlink(missing_ok=True)
    return faults


def _note_deletions(store: Store, target: BackupFolder) -> int:
    with store.read() as session:
        found = session.scalars(select(Deletion).order_by(Deletion.created_at)).all()
        rows = [
            Deleted(kind=row.kind, object_id=row.object_id, created_at=row.created_at)
            for row in found
        ]
    target.note(rows)
    return len(rows)
