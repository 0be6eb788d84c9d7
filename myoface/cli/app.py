"""The root command, and options that several commands share."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from myoface import __version__

app = typer.Typer(
    name="myoface",
    help="Anatomical, muscle-driven faces from 3D scans.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


def _show_version(is_asked: bool) -> None:
    if is_asked:
        typer.echo(__version__)
        raise typer.Exit


Version = Annotated[
    bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print it and end.")
]


@app.callback()
def _root(_version: Version = False) -> None:
    pass


# The exit code of a check whose verdict is bad; 1 says that there was no verdict.
BAD_SCAN = 3

UnitName = Literal["auto", "mm", "cm", "m", "inch"]
Axis = Literal["auto", "x", "-x", "y", "-y", "z", "-z"]

SubjectId = Annotated[str, typer.Argument(help="subject id")]
Unit = Annotated[UnitName, typer.Option(help="unit of a raw scan's coordinates")]
Up = Annotated[Axis, typer.Option(help="a raw scan's axis to the top of the head")]
Forward = Annotated[Axis, typer.Option(help="a raw scan's axis out of the face")]
LandmarksFile = Annotated[
    Path | None, typer.Option("--landmarks", exists=True, dir_okay=False, help="JSON, LJSON or CSV")
]
Url = Annotated[str, typer.Option("--url", envvar="MYOFACE_URL", help="the service")]
Scan = Annotated[Path, typer.Argument(exists=True, dir_okay=False, help="OBJ, PLY, GLB or STL")]
RawScan = Annotated[
    Path, typer.Argument(exists=True, dir_okay=False, help="OBJ, PLY, STL, GLB or point cloud")
]
NewFile = Annotated[Path, typer.Option("--output", "-o", dir_okay=False, help="file to write")]
NewFolder = Annotated[Path, typer.Option("--output", "-o", file_okay=False, help="folder to fill")]


def frame_options(unit: UnitName, up: Axis, forward: Axis) -> dict[str, str]:
    """Return how a raw scan lies in space, as options of ``check_scan`` and ``register_scan``."""
    return {"unit": unit, "up": up, "forward": forward}


def read_scene(file: Path) -> Any:
    """Return what a scene's file holds."""
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise typer.BadParameter(f"{file.name} is not JSON: {error}") from error
