"""Commands that run the service here, look at this machine, and back up what is kept."""

from __future__ import annotations

import logging
import signal
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import ValidationError
from pydantic_settings import SettingsError

from myoface.cli.commands import Argument, Option, UsageError
from myoface.cli.console import Painted, complain, out
from service.process import configure_logs
from service.settings import Settings

if TYPE_CHECKING:
    from myoface.backup.folder import Manifest

COLOURS = {"ok": "green", "warning": "yellow", "fault": "red"}

Port = Annotated[int | None, Option(help="0 takes a free one")]
Data = Annotated[Path | None, Option(help="folder for everything the service keeps")]
BackupFolder = Annotated[Path, Argument(file_okay=False, help="the backup's folder")]


def up(port: Port = None, data: Data = None) -> None:
    """Run the service here: API, broker and worker, until Ctrl-C."""
    from myoface.stack import Stack  # loading the service's parts takes a while
    from service.access.bootstrap import is_loopback
    from worker.kernels import remove_stale

    settings = _settings(port, data)
    configure_logs(settings.log_json)
    end_in_order()
    logging.getLogger("httpx").setLevel(logging.WARNING)  # the stack asks itself for its health
    remove_stale()
    with Stack(settings) as stack:
        out.print(f"Myoface listens on {stack.url}. Ctrl-C stops it.")
        out.print(f"Its key is in {settings.admin_key}.")
        if is_loopback(settings.host):
            key = f"#key={stack.key}" if out.is_terminal else ""  # never into a log
            out.print(f"Its page: {stack.url}/{key}")
        compile_kernels()
        stack.wait()


def admin_key(
    data: Data = None,
    first: Annotated[bool, Option("--first", help="only if there is no key yet")] = False,
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
    out.print(bootstrap.admin_key(store, keyring, settings, only_first=first))


def doctor(port: Port = None, data: Data = None) -> None:
    """Check this machine and say what to do where something is missing."""
    from myoface.doctor import examine

    faults = 0
    for diagnosis in examine(_settings(port, data)):
        mark = Painted(f"{diagnosis.verdict:7}", COLOURS[diagnosis.verdict])
        out.print(mark, f" {diagnosis.subject}: {diagnosis.found}")
        if diagnosis.advice:
            out.print(f"        {diagnosis.advice}")
        faults += diagnosis.verdict == "fault"
    if faults:
        raise SystemExit(1)


def backup(
    folder: BackupFolder,
    data: Data = None,
    deletions: Annotated[
        bool, Option("--deletions", help="only note what was deleted since")
    ] = False,
    keep: Annotated[int, Option(min=1, help="backups that stay in the folder")] = 1,
    verify: Annotated[
        bool, Option("--verify", help="read all of it again and restore it for a try")
    ] = False,
) -> None:
    """Copy the database and every file into a folder, also while the service runs.

    It ends with 1 if files are lost or damaged in the service itself: the rest is in the backup.
    """
    from myoface import backup as backups

    settings = _settings(None, data)
    if deletions:
        out.print(f"{backups.note_deletions(settings, folder)} deletions noted")
        return
    manifest = backups.back_up(settings, folder, keep=keep, reread=verify)
    _show_backup(manifest)
    if verify:
        backups.verify(folder)
        out.print("verified: it can be restored")
    if manifest.missing:
        raise SystemExit(1)


def restore(
    folder: Annotated[Path, Argument(exists=True, file_okay=False)],
    data: Data = None,
    at: Annotated[str | None, Option(help="an older backup of the folder, by its moment")] = None,
    verify: Annotated[bool, Option("--verify", help="only try it, in a scratch folder")] = False,
) -> None:
    """Fill an empty service from a backup; what was deleted after it stays deleted."""
    from myoface import backup as backups

    if verify:
        _show_backup(backups.verify(folder, at)[0])
        out.print("verified: it can be restored")
        return
    manifest, repeated = backups.restore(_settings(None, data), folder, at)
    _show_backup(manifest)
    out.print(f"{repeated} later deletions repeated")


def _show_backup(manifest: Manifest) -> None:
    out.print(f"{len(manifest.files)} files and the database as of {manifest.made_at:%F %T} UTC")
    for each in manifest.missing:
        owners = ", ".join(each.belongs_to) or "something deleted since"
        out.print(f"not in it: {each.fault} in the service: {owners} ({each.sha256})")


def end_in_order() -> None:
    """Have SIGTERM stop, in order, what a command has started."""
    signal.signal(signal.SIGTERM, lambda number, _frame: sys.exit(128 + number))


def compile_kernels(niceness: int = 10) -> None:
    """Compile the solver's kernels where they are not of this code; jobs can do without."""
    from worker.kernels import are_compiled, compile_all

    if are_compiled():
        return
    out.print(
        "compiling the solver's kernels, once for each release: about a minute; "
        "scans can be uploaded and checked meanwhile"
    )
    try:
        compile_all(out.print, niceness=niceness)
    except (subprocess.CalledProcessError, OSError) as error:
        complain(f"the kernels were not compiled, each job compiles its own: {error}")
        return
    out.print("the kernels are compiled")


def read_settings(**given: Any) -> Settings:
    """Return the settings of the environment, with those that are ``given`` in their place."""
    try:
        return Settings(**given)
    except ValidationError as error:
        faults = (
            f"MYOFACE_{fault['loc'][0]}".upper() + f": {fault['msg']}" for fault in error.errors()
        )
        raise UsageError("; ".join(faults)) from error
    except SettingsError as error:  # a value that should be JSON
        raise UsageError(str(error)) from error


def _settings(port: int | None, data: Path | None) -> Settings:
    given: dict[str, Any] = {"port": port, "data_dir": data}
    return read_settings(**{key: value for key, value in given.items() if value is not None})
