"""Commands about batches: all scans of a session in one call."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, cast

import typer

from myoface.cli.app import Url
from myoface.cli.console import out, show_table, transfer_bar
from myoface.client import DEFAULT_URL, Client
from myoface.resources import Batch, Then

batches = typer.Typer(help="All scans of a session in one call.", no_args_is_help=True)

BatchId = Annotated[str, typer.Argument(help="batch id")]


@batches.command("add")
def add_batch(
    files: Annotated[
        list[Path], typer.Argument(exists=True, dir_okay=False, help="scans of expressions")
    ],
    neutral: Annotated[
        Path | None, typer.Option(exists=True, dir_okay=False, help="the neutral scan")
    ] = None,
    subject: Annotated[str | None, typer.Option(help="subject id")] = None,
    person: Annotated[str | None, typer.Option(help="name of a new subject")] = None,
    registered: Annotated[
        bool, typer.Option("--registered", help="they have the template's vertices")
    ] = False,
    then: Annotated[
        list[str] | None, typer.Option(help="register, model, geometry; repeat; default: all")
    ] = None,
    wait: Annotated[bool, typer.Option(help="follow the batch until it ends")] = True,
    url: Url = DEFAULT_URL,
) -> None:
    """Upload scans, each named like its file, and check, register, model and fit them."""
    if (subject is None) == (person is None):
        raise typer.BadParameter("give either --subject or --person")
    steps = cast(list[Then], then or ["register", "model", "geometry"])
    with Client(url) as client:
        with transfer_bar("scans") as progress:
            batch = client.create_batch(
                neutral,
                files,
                subject_id=subject,
                person=person,
                registered=registered,
                then=steps,
                progress=progress,
            )
        out.print(batch.id)
        if wait:
            _show(client.wait_for_batch(batch.id))


@batches.command("list")
def list_batches(
    subject: Annotated[str | None, typer.Option(help="subject id")] = None, url: Url = DEFAULT_URL
) -> None:
    """List batches."""
    with Client(url) as client:
        found = client.batches(subject_id=subject)
    rows = [(each.id, each.name, each.state, each.subject_id, len(each.scans)) for each in found]
    show_table(("batch", "name", "state", "subject", "scans"), rows)


@batches.command("show")
def show_batch(batch: BatchId, url: Url = DEFAULT_URL) -> None:
    """Show what became of each scan of a batch."""
    with Client(url) as client:
        _show(client.batch(batch))


@batches.command("cancel")
def cancel_batch(
    batch: BatchId,
    reason: Annotated[str, typer.Option(help="why, for the record")] = "by the command line",
    url: Url = DEFAULT_URL,
) -> None:
    """Stop a batch and its jobs."""
    with Client(url) as client:
        out.print(client.cancel_batch(batch, reason).state)


def _show(batch: Batch) -> None:
    rows = [
        (
            each.name,
            each.role,
            each.check and (each.check.verdict or each.check.state),
            each.registration and each.registration.state,
            each.left_out,
        )
        for each in batch.scans
    ]
    show_table(("scan", "role", "check", "registration", "left out"), rows)
    out.print(f"{batch.state}, subject {batch.subject_id}")
    if batch.fit and batch.fit.rig_id:
        out.print(f"rig {batch.fit.rig_id}")
