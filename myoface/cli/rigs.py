"""Commands about the rigs of a service."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from myoface.cli.app import (
    Labels,
    NewFolder,
    OfSubject,
    Unlabel,
    Url,
    WithLabels,
    read_label_changes,
    read_label_filter,
    require_change,
)
from myoface.cli.commands import Argument, Group, Option, UsageError
from myoface.cli.console import label_words, moment, out, show_table, span, transfer_bar
from myoface.cli.lookup import find_rig, find_subject
from myoface.client import DEFAULT_URL, Client
from myoface.client.archive import RIG_NOTE
from myoface.resources import RigItem

rigs = Group("Fitted faces.")

RigId = Annotated[str, Argument(help="rig: its id, the start of it, or the name")]


@rigs.command("list")
def list_rigs(subject: OfSubject = None, label: WithLabels = None, url: Url = DEFAULT_URL) -> None:
    """List rigs."""
    labels = read_label_filter(label)
    with Client(url) as client:
        whose = subject and find_subject(client, subject)
        show_rigs(client.rigs(subject_id=whose, labels=labels))


@rigs.command("edit")
def edit_rig(
    rig: RigId,
    name: Annotated[str | None, Option(help="what it is called from now on")] = None,
    label: Labels = None,
    unlabel: Unlabel = None,
    url: Url = DEFAULT_URL,
) -> None:
    """Give a rig a name, or other labels."""
    changes = read_label_changes(label, unlabel)
    require_change(name=name, label=changes)
    with Client(url) as client:
        client.change_rig(find_rig(client, rig), name=name, labels=changes)


@rigs.command("download")
def download_rig(
    rig: RigId,
    output: NewFolder = Path("rig"),
    packed: Annotated[bool, Option("--zip", help="leave it packed: OUTPUT.zip")] = False,
    url: Url = DEFAULT_URL,
) -> None:
    """Download a rig whole, with its model, into a folder; what it has of this rig stays.

    rig.json, which comes last, says whose rig it is, of which template, and lists the files with
    their jobs.
    """
    with Client(url) as client, transfer_bar("rig") as progress:
        rig_id = find_rig(client, rig)
        if packed:
            if not output.name:
                raise UsageError(f"--output {output}: an archive needs a name")
            is_named = output.suffix.lower() == ".zip"
            archive = output if is_named else output.with_name(f"{output.name}.zip")
            client.download_archive(rig_id, archive, progress=progress)
            out.print(f"{archive}")
            return
        found = client.download_rig(rig_id, output, progress=progress)
    for name in [*(each.name for each in found.artifacts), RIG_NOTE]:
        out.print(f"{output / name}")


def show_rigs(found: list[RigItem]) -> None:
    """Print a table of rigs."""
    rows = [
        (
            each.id,
            each.name,
            each.subject_name,
            each.verdict,
            moment(each.created_at),
            span(each.seconds),
            ", ".join(each.expressions),
            label_words(each.labels),
        )
        for each in found
    ]
    columns = ("rig", "name", "person", "verdict", "date", "took", "expressions", "labels")
    show_table(columns, rows)
