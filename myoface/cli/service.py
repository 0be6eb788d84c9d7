"""Commands that run the service here, look at this machine, and back up what is kept."""

from __future__ import annotations

import logging
import subprocess
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import ValidationError
from pydantic_settings import SettingsError
from rich.markup import escape

from myoface.cli.console import complain, out
from service.process import configure_logs
from service.settings import Settings

MARKS = {"ok": "[green]ok[/]     ", "warning": "[yellow]warning[/]", "fault": "[red]fault[/]  "}

Port = Annotated[int | None, typer.Option(help="0 takes a free one")]
Data = Annotated[Path | None, typer.Option(help="folder for everything the service keeps")]
BackupFolder = Annotated[Path, typer.Argument(file_okay=False, help="the backup's folder")]


def up(port: Port = None, data: Data = None) -> None:
    """Run the service here: API, broker and worker, until Ctrl-C."""
    from myoface.stack import Stack  # loading the service's parts takes a while
    from service.access.bootstrap import is_loopback

    settings = _settings(port, data)
    configure_logs(settings.log_json)
    compile_kernels()
    logging.getLogger("httpx").setLevel(logging.WARNING)  # the stack asks itself for its health
    with Stack(settings) as stack:
        out.print(f"Myoface listens on {stack.url}. Ctrl-C stops it.")
        out.print(f"Its key is in {settings.admin_key}.", markup=False)
        if is_loopback(settings.host):
            out.print(f"Its page: {stack.url}/#key={stack.key}", markup=False, soft_wrap=True)
        stack.wait()


def admin_key(
    data: Data = None,
    first: Annotated[bool, typer.Option("--first", help="only if there is no key yet")] = False,
) -> None:
    """Make a key that may do everything; it is written to the data folder's admin.key."""
    from service.access import bootstrap
    from service.access.keys import Keyring
    from service.secret import secret
    from service.store.database import Store

    settings = _settings(None, data)
    store = Store(settings.database, settings.files, settings.broker)
    store.database.migrate()
    keyring = Keyring(store, secret(settings))
    out.print(bootstrap.admin_key(store, keyring, settings, only_first=first), markup=False)


def doctor(port: Port = None, data: Data = None) -> None:
    """Check this machine and say what to do where something is missing."""
    from myoface.doctor import examine

    faults = 0
    for diagnosis in examine(_settings(port, data)):
        out.print(f"{MARKS[diagnosis.verdict]} {diagnosis.subject}: {escape(diagnosis.found)}")
        if diagnosis.advice:
            out.print(f"        {escape(diagnosis.advice)}")
        faults += diagnosis.verdict == "fault"
    if faults:
        raise typer.Exit(1)


def backup(
    folder: BackupFolder,
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
    from myoface.backup import restore as fill

    manifest, again = fill(read_settings(), folder)
    out.print(f"{len(manifest.files)} files and the database as of {manifest.made_at:%F %T} UTC")
    out.print(f"{again} later deletions repeated")


def compile_kernels() -> None:
    """Compile the solver's kernels where they are not of this code; jobs can do without."""
    from worker.kernels import are_compiled, compile_all

    if are_compiled():
        return
    out.print("compiling the solver's kernels, once for each release: about a minute")
    try:
        compile_all()
    except (subprocess.CalledProcessError, OSError) as error:
        complain(f"the kernels were not compiled, each job compiles its own: {error}")


def read_settings(**given: Any) -> Settings:
    """Return the settings of the environment, with those that are ``given`` in their place."""
    try:
        return Settings(**given)
    except ValidationError as error:
        faults = (
            f"MYOFACE_{fault['loc'][0]}".upper() + f": {fault['msg']}" for fault in error.errors()
        )
        raise typer.BadParameter("; ".join(faults)) from error
    except SettingsError as error:  # a value that should be JSON
        raise typer.BadParameter(str(error)) from error


def _settings(port: int | None, data: Path | None) -> Settings:
    given: dict[str, Any] = {"port": port, "data_dir": data}
    return read_settings(**{key: value for key, value in given.items() if value is not None})
