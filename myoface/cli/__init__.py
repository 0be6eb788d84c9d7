"""The command ``myoface``."""

from __future__ import annotations

import os

import typer

from myoface.cli.app import app
from myoface.cli.batches import batches
from myoface.cli.captures import add, captures
from myoface.cli.client import jobs, rigs, subjects, templates
from myoface.cli.console import complain
from myoface.cli.keys import keys
from myoface.errors import ApiError, StackError, describe

missing: str | None = None
try:
    from myoface.cli import checkout
except ModuleNotFoundError as error:
    checkout, missing = None, error.name  # type: ignore[assignment]

NEED_CHECKOUT = (
    "up",
    "demo",
    "doctor",
    "admin-key",
    "backup",
    "restore",
    "tenants",
    "template",
    "assets",
    "solve",
)


def _refuse(context: typer.Context) -> None:
    """Say that a command is not here."""
    complain(
        f"`myoface {context.info_name}` runs from a checkout of Myoface, after `make setup` in it "
        f"(there is no module {missing!r} here)"
    )
    raise typer.Exit(1)


if checkout is None:
    anything = {"allow_extra_args": True, "ignore_unknown_options": True}
    for name in NEED_CHECKOUT:
        described = app.command(name, help="(From a checkout.)", context_settings=anything)
        described(_refuse)
else:
    for command in checkout.COMMANDS:
        app.command()(command)
app.command("upload", help="Short for `captures add`.")(add)
for group, name in (
    (subjects, "subjects"),
    (captures, "captures"),
    (batches, "batches"),
    (jobs, "jobs"),
    (rigs, "rigs"),
    (templates, "templates"),
    (keys, "keys"),
):
    app.add_typer(group, name=name)
if checkout is not None:
    for name, group in checkout.GROUPS.items():
        app.add_typer(group, name=name)


def main() -> None:
    """Run the command line; a fault that a person can act on ends it with one line and code 1."""
    os.umask(0o077)  # what it writes is faces, and nobody else's to read
    if checkout is not None:
        checkout.configure_logs()
    faults = () if checkout is None else checkout.FAULTS
    try:
        app()
    except (ApiError, StackError) as error:
        complain(str(error))
    except faults as error:
        complain(describe(error.as_dict()))
    else:
        return
    raise SystemExit(1)
