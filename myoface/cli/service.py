"""Commands that run the service here and look at this machine."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape

from myoface.cli.app import read_settings
from myoface.cli.console import out
from service.access.bootstrap import is_loopback
from service.process import configure_logs
from service.settings import Settings

MARKS = {
    "ok": "[green]ok[/]     ",
    "warning": "[yellow]warning[/]",
    "fault": "[red]fault[/]  ",
}

Port = Annotated[int | None, typer.Option(help="0 takes a free one")]
Data = Annotated[Path | None, typer.Option(help="folder for everything the service keeps")]


def up(port: Port = None, data: Data = None) -> None:
    """Run the service here: API, broker and worker, until Ctrl-C."""
    from myoface.stack import Stack  # loading the service's parts takes a while

    settings = _settings(port, data)
    configure_logs(settings.log_json)
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
    for finding in examine(_settings(port, data)):
        out.print(f"{MARKS[finding.verdict]} {finding.subject}: {escape(finding.found)}")
        if finding.advice:
            out.print(f"        {escape(finding.advice)}")
        faults += finding.verdict == "fault"
    if faults:
        raise typer.Exit(1)


def _settings(port: int | None, data: Path | None) -> Settings:
    given: dict[str, Any] = {"port": port, "data_dir": data}
    return read_settings(**{key: value for key, value in given.items() if value is not None})
