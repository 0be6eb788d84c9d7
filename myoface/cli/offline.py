"""Commands that solve in this process, without a service."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from myoface.cli.app import NewFolder, Scan
from myoface.cli.console import JobView, out

solve = typer.Typer(help="Solve here, without a service.", no_args_is_help=True)

Model = Annotated[Path, typer.Argument(exists=True, dir_okay=False, help="model.npz")]
Scans = Annotated[list[Path], typer.Argument(exists=True, dir_okay=False, help="expression scans")]


# The solver is imported where it is used: compiled numerics take seconds to load.


@solve.command("build-model")
def build_model(
    neutral: Scan,
    output: NewFolder = Path("model"),
    template: Annotated[
        Path | None, typer.Option(exists=True, help="template NPZ; default: built-in")
    ] = None,
    edge_mm: Annotated[
        float | None, typer.Option(min=3, max=30, help="edge length of the tetrahedra")
    ] = None,
) -> None:
    """Build a person's model from the neutral scan."""
    from solver.pipeline import build_model as build

    options = {} if edge_mm is None else {"edge_mm": edge_mm}
    with JobView("build-model") as view:
        build(neutral, _made(output), template=template, options=options, progress=view)
    out.print(f"{output / 'model.npz'}", markup=False)


@solve.command("geometry")
def fit_geometry(model: Model, scans: Scans, output: NewFolder = Path("rig")) -> None:
    """Fit muscle geometry, activations and jaw to several expressions at once."""
    from solver.pipeline import fit_geometry as fit

    with JobView("geometry") as view:
        fit(model, _named(scans), _made(output), progress=view)
    out.print(f"{output / 'rig.glb'}", markup=False)


@solve.command("activations")
def fit_activations(
    model: Model,
    rig: Annotated[
        Path, typer.Argument(exists=True, file_okay=False, help="a fitted rig's folder")
    ],
    scans: Scans,
    output: NewFolder = Path("rig-new"),
) -> None:
    """Fit activations and jaw of further expressions with a rig's muscle geometry."""
    from solver.pipeline import fit_activations as fit

    weights = rig / "muscle_weights.npz"
    with JobView("activations") as view:
        fit(model, weights, _named(scans), _made(output), rig=rig, progress=view)
    out.print(f"{output / 'rig.glb'}", markup=False)


def _named(scans: list[Path]) -> dict[str, Path]:
    named = {path.stem: path for path in scans}
    if len(named) < len(scans):
        raise typer.BadParameter("two scans have the same name: an expression is named by its file")
    return named


def _made(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder
