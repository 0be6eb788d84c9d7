"""Commands that run from a checkout or an image: they import the service's or the solver's code."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from myoface.cli.assets import assets
from myoface.cli.commands import Group, Runnable
from myoface.cli.console import as_typed, complain
from myoface.cli.demo import demo
from myoface.cli.markers import markers
from myoface.cli.offline import solve
from myoface.cli.service import admin_key, backup, doctor, restore, up
from myoface.cli.template import template
from myoface.cli.tenants import tenants
from myoface.cli.transfer import transfer
from myoface.errors import describe
from service import process
from solver.errors import InputError, SolveError

_root = Group("")
for _function in (up, demo, doctor, admin_key, backup, restore, transfer):
    _root.command()(_function)
MEMBERS: Mapping[str, Runnable] = {
    **_root.members,
    "tenants": tenants,
    "template": template,
    "assets": assets,
    "markers": markers,
    "solve": solve,
}


def configure_logs() -> None:
    """Send warnings of the service's and the solver's code to standard error."""
    process.configure_logs(json=False)
    logging.getLogger().setLevel(logging.WARNING)


@contextmanager
def told_faults() -> Iterator[None]:
    """Tell a fault of what was given to a solver in a line, and end the program with 1."""
    try:
        yield
    except (InputError, SolveError) as error:
        complain(describe(error.as_dict() | {"message": as_typed(error.message)}))
        raise SystemExit(1) from error
