"""The command ``myoface``."""

from __future__ import annotations

import logging

from myoface.cli.app import app
from myoface.cli.assets import assets
from myoface.cli.batches import batches
from myoface.cli.captures import add, captures
from myoface.cli.client import jobs, rigs, subjects, templates
from myoface.cli.console import complain
from myoface.cli.demo import demo
from myoface.cli.keys import keys
from myoface.cli.offline import solve
from myoface.cli.service import admin_key, backup, doctor, restore, up
from myoface.cli.template import template
from myoface.cli.tenants import tenants
from myoface.errors import ApiError, StackError, describe
from service import logs
from solver.errors import InputError, SolveError

for command in (up, demo, doctor, admin_key, backup, restore):
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
    (tenants, "tenants"),
    (template, "template"),
    (assets, "assets"),
    (solve, "solve"),
):
    app.add_typer(group, name=name)


def main() -> None:
    """Run the command line; a fault that a person can act on ends it with one line and code 1."""
    logs.configure(json=False)
    logging.getLogger().setLevel(logging.WARNING)
    try:
        app()
    except (ApiError, StackError) as error:
        complain(str(error))
    except (InputError, SolveError) as error:
        complain(describe(error.as_dict()))
    else:
        return
    raise SystemExit(1)
