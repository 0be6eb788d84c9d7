"""Commands that make template anatomies."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from myoface.cli.app import NewFile
from myoface.cli.console import out
from solver.anatomy.template import Template

template = typer.Typer(help="Make template anatomies.", no_args_is_help=True)

Folder = Annotated[Path, typer.Option(exists=True, file_okay=False)]


@template.command()
def build(anatomy: Folder, faces: Folder, output: NewFile = Path("template.npz")) -> None:
    """Build a template from a BodyParts3D and an ICT-FaceKit folder."""
    from solver.anatomy.ict_template import build_ict_template

    with out.status("fitting skull and muscles into the head (about a minute)"):
        made = build_ict_template(anatomy, faces)
    _save(made, output)


@template.command()
def builtin(output: NewFile = Path("template.npz")) -> None:
    """Write the built-in template."""
    from solver.anatomy.builtin import builtin_template

    _save(builtin_template(), output)


def _save(made: Template, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    digest = made.save(path)
    out.print(
        f"{path}: {made.name} {made.version}, {len(made.muscles)} muscles, sha256 {digest}",
        markup=False,
    )
