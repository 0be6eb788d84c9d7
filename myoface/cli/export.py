"""The command that writes a rig in another format."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from myoface.cli.console import out

Rig = Annotated[Path, typer.Argument(exists=True, help="rig.npz, or a rig's folder")]
Name = Annotated[str, typer.Argument(help="the exporter: glb, usd, csv, npz ...")]


def export_rig(
    rig: Rig,
    name: Name,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", dir_okay=False, help="file to write; default: its usual"),
    ] = None,
    options: Annotated[str, typer.Option(help="JSON, see the exporter's Options")] = "{}",
) -> None:
    """Write a rig with an exporter, for other programs."""
    from solver.rig.exporters import export
    from solver.rig.rig import Rig

    try:
        given = json.loads(options)
    except ValueError as error:
        raise typer.BadParameter(f"no JSON: {error}", param_hint="--options") from error
    out.print(f"{export(Rig.load(rig), name, output, given)}", markup=False)
