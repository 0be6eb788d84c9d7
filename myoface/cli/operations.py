"""Commands of those who run the service: backups."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from myoface.cli.app import read_settings
from myoface.cli.console import out

Folder = Annotated[Path, typer.Argument(file_okay=False, help="the backup's folder")]


def backup(
    folder: Folder,
    deletions: Annotated[
        bool, typer.Option("--deletions", help="only note what was deleted since")
    ] = False,
) -> None:
    """Copy the database and every file into a folder, also while the service runs."""
    from myoface.backup import back_up, note_deletions
    from service.store.database import Store

    settings = read_settings()
    if deletions:
        store = Store(settings.database, settings.files, settings.broker)
        out.print(f"{note_deletions(store, folder)} deletions noted")
        store.close()
        return
    manifest = back_up(settings, folder)
    out.print(f"{len(manifest.files)} files and the database as of {manifest.made_at:%F %T} UTC")
    if manifest.missing:
        out.print(f"{len(manifest.missing)} files are missing in the store itself")
        raise typer.Exit(1)


def restore(folder: Annotated[Path, typer.Argument(exists=True, file_okay=False)]) -> None:
    """Fill an empty service from a backup; what was deleted after it stays deleted."""
    from myoface.restore import restore as fill

    manifest, again = fill(read_settings(), folder)
    out.print(f"{len(manifest.files)} files and the database as of {manifest.made_at:%F %T} UTC")
    out.print(f"{again} later deletions repeated")
