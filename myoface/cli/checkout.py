"""Commands that run from a checkout or an image: they import the service's or the solver's code."""

from __future__ import annotations

import logging

from myoface.cli.assets import assets
from myoface.cli.demo import demo
from myoface.cli.offline import solve
from myoface.cli.service import admin_key, backup, doctor, restore, up
from myoface.cli.template import template
from myoface.cli.tenants import tenants
from service import process
from solver.errors import InputError, SolveError

COMMANDS = (up, demo, doctor, admin_key, backup, restore)
GROUPS = {"tenants": tenants, "template": template, "assets": assets, "solve": solve}
FAULTS = (InputError, SolveError)


def configure_logs() -> None:
    """Send warnings of the service's and the solver's code to standard error."""
    process.configure_logs(json=False)
    logging.getLogger().setLevel(logging.WARNING)
