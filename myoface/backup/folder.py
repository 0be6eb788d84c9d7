"""The folder of a backup: its manifests, dumps and files, and which of them may go."""

from __future__ import annotations

import fcntl
import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError, model_validator

from myoface.errors import StackError
from service.store.durable import sync_folder, write_durably
from service.store.files import FolderFiles
from service.store.integrity import Fault

MANIFEST = "manifest.json"
DELETIONS = "deletions.json"
SECRET = "secret"
FILES = "files"
LOCK = "lock"
DUMP_ENDINGS = {"sqlite": "sqlite", "postgresql": "dump"}
STAMP = "%Y%m%dT%H%M%S.%fZ"


class Missing(BaseModel):
    """A file that the store itself had lost or damaged; ``belongs_to`` names its rows."""

    sha256: str
    fault: Fault
    belongs_to: list[str] = []


class Manifest(BaseModel):
    """Contents of a backup; ``release`` made it, of a database at ``revision``."""

    made_at: datetime
    release: str | None = None
    revision: str | None = None
    database: str
    dump: str
    database_sha256: str
    files: list[str]
    missing: list[Missing]

    @model_validator(mode="before")
    @classmethod
    def _of_0_1_0(cls, given: Any) -> Any:
        """Read a manifest of release 0.1.0: its dump had one name, its missing files no reason."""
        if not isinstance(given, dict) or "dump" in given:
            return given
        missing = [{"sha256": sha256, "fault": "lost"} for sha256 in given.get("missing", ())]
        ending = DUMP_ENDINGS.get(given.get("database", ""), "")
        return {**given, "missing": missing, "dump": f"database.{ending}"}

    @property
    def stamp(self) -> str:
        """The moment of the backup, as in file names and for `myoface restore --at`."""
        return self.made_at.strftime(STAMP)


class Deleted(BaseModel):
    """Something that was deleted and stays so when an older backup is restored."""

    kind: str
    object_id: str
    created_at: datetime


class BackupFolder:
    """A folder of one or several backups, which share their files."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Keep other backups out of the folder.

        Raises
        ------
        StackError
            If one is being written into it.
        """
        with (self.path / LOCK).open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise StackError(f"another backup into {self.path} is at work") from error
            yield

    @property
    def files(self) -> FolderFiles:
        """The stored files."""
        return FolderFiles(self.path / FILES)

    def dump(self, manifest: Manifest) -> Path:
        """Return a backup's dump."""
        return self.path / manifest.dump

    def new_dump(self, database: str, made_at: datetime) -> Path:
        """Return the name of a new dump."""
        return self.path / f"database.{made_at.strftime(STAMP)}.{DUMP_ENDINGS[database]}"

    def newest(self) -> Manifest | None:
        """Return the manifest of the newest backup; None: there is none yet."""
        path = self.path / MANIFEST
        return _read(path) if path.exists() else None

    def choose(self, stamp: str | None) -> Manifest:
        """Return the manifest of the newest backup, or of the one made at ``stamp``.

        Raises
        ------
        StackError
            If there is none, or it cannot be read.
        """
        if stamp is None:
            return _read(self.path / MANIFEST)
        found = [manifest for manifest in self._all() if manifest.stamp == stamp]
        if not found:
            known = ", ".join(sorted({manifest.stamp for manifest in self._all()})) or "none"
            raise StackError(f"{self.path} has no backup of {stamp}; it has {known}")
        return found[0]

    def commit(self, manifest: Manifest, keep: int) -> None:
        """Make ``manifest`` the newest one; with ``keep`` above 1 the one before stays."""
        before = self.newest()
        if before and keep > 1:
            self._write(f"manifest.{before.stamp}.json", before)
        self._write(MANIFEST, manifest)

    def prune(self, keep: int) -> None:
        """Remove what none of the newest ``keep`` backups names."""
        newest = self.newest()
        older = [path for path in self._older() if not (newest and _read(path).dump == newest.dump)]
        for path in {*self._older()}.difference(older[: keep - 1]):
            path.unlink()
        self.remove_strangers()

    def remove_strangers(self) -> None:
        """Remove the dumps and files that no manifest names: an interrupted backup's, old ones."""
        manifests = self._all()
        dumps = {manifest.dump for manifest in manifests}
        for path in self.path.glob("database.*"):
            if path.name not in dumps:
                path.unlink()
        for path in self.path.glob("*.new"):
            path.unlink()
        files = self.files
        named = {sha256 for each in manifests for sha256 in each.files}
        for sha256 in {stored.sha256 for stored in files.list_stored()} - named:
            files.put_aside(sha256)
        for stored in list(files.list_aside()):
            files.remove(stored.sha256)
        for path in files.incoming.iterdir():
            path.unlink()
        sync_folder(self.path)

    def deletions(self) -> list[Deleted]:
        """Return what was noted as deleted.

        Raises
        ------
        StackError
            If the list is missing or damaged: without it people who are deleted would come back.
        """
        path = self.path / DELETIONS
        try:
            return [Deleted.model_validate(row) for row in json.loads(path.read_bytes())]
        except (OSError, ValueError, TypeError) as error:
            raise StackError(
                f"{path}, which says what was deleted since, cannot be read ({error}). Without it "
                "deleted people would come back; if nothing was deleted, put [] into it"
            ) from error

    def note(self, rows: Sequence[Deleted]) -> None:
        """Add to the list of what was deleted."""
        known: list[Deleted] = []
        with suppress(StackError):  # none yet, or damaged: the database has them all
            known = self.deletions()
        merged = {(row.kind, row.object_id, row.created_at): row for row in (*known, *rows)}
        listed = sorted(merged.values(), key=lambda row: row.created_at)
        content = json.dumps([row.model_dump(mode="json") for row in listed], indent=1)
        write_durably(self.path / DELETIONS, content.encode())

    def _write(self, name: str, manifest: Manifest) -> None:
        write_durably(self.path / name, manifest.model_dump_json(indent=1).encode())

    def _older(self) -> list[Path]:
        """Return the manifests of older backups, the newest first."""
        return sorted(self.path.glob("manifest.*.json"), reverse=True)

    def _all(self) -> list[Manifest]:
        newest = self.newest()
        return [*([newest] if newest else []), *map(_read, self._older())]


def _read(path: Path) -> Manifest:
    try:
        return Manifest.model_validate_json(path.read_bytes())
    except (OSError, ValidationError) as error:
        raise StackError(f"{path.parent} is no whole backup: {error}") from error
