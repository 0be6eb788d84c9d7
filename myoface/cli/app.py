"""The root command, and options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import ValidationError
from pydantic_settings import SettingsError

from service.settings import Settings

app = typer.Typer(
    name="myoface",
    help="Anatomical, muscle-driven faces from 3D scans.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)

Url = Annotated[str, typer.Option("--url", envvar="MYOFACE_URL", help="the service")]
Scan = Annotated[Path, typer.Argument(exists=True, dir_okay=False, help="OBJ, PLY, GLB or STL")]
NewFile = Annotated[Path, typer.Option("--output", "-o", dir_okay=False, help="file to write")]
NewFolder = Annotated[Path, typer.Option("--output", "-o", file_okay=False, help="folder to fill")]


def read_settings(**given: Any) -> Settings:
    """Return the settings of the environment, with those that are ``given`` in their place."""
    try:
        return Settings(**given)
    except ValidationError as error:
        faults = (
            f"MYOFACE_{fault['loc'][0]}".upper() + f": {fault['msg']}" for fault in error.errors()
        )
        raise typer.BadParameter("; ".join(faults)) from error
    except SettingsError as error:  # a value that should be JSON
        raise typer.BadParameter(str(error)) from error
