"""The command ``myoface``."""

from __future__ import annotations

from myoface.cli import client, demo, offline, service, template
from myoface.cli.app import app
from myoface.cli.console import complain
from myoface.errors import ApiError, describe
from solver.errors import InputError, SolveError

app.add_typer(client.subjects, name="subjects")
app.add_typer(client.templates, name="templates")
app.add_typer(client.jobs, name="jobs")
app.add_typer(client.rigs, name="rigs")
app.command()(client.upload)
app.command()(service.up)
app.command()(service.doctor)
app.command()(demo.demo)
app.add_typer(template.template, name="template")
app.add_typer(offline.solve, name="solve")


def main() -> None:
    """Run the command line; a fault that a person can act on ends it with one line and code 1."""
    try:
        app()
    except ApiError as error:
        complain(str(error))
    except (InputError, SolveError) as error:
        complain(describe(error.as_dict()))
    else:
        return
    raise SystemExit(1)
