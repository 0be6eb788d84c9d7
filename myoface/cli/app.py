"""The root command, and options that several commands share."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated, Any, Literal

from myoface.cli.commands import Argument, Option, UsageError

# The exit code of a check whose verdict is bad; 1 says that there was no verdict.
BAD_SCAN = 3

UNITS = ("auto", "mm", "cm", "m", "inch")
Axis = Literal["auto", "x", "-x", "y", "-y", "z", "-z"]

SubjectId = Annotated[str, Argument(help="subject: its id, the start of it, or the name")]
Unit = Annotated[
    str | float,
    Option(
        parser=lambda word: read_unit(word),
        metavar="UNIT",
        help="unit of a raw scan's coordinates: mm, cm, m, inch, auto, or mm per unit as a number",
    ),
]
EyeDistance = Annotated[
    float | None,
    Option(
        "--eye-distance-mm",
        parser=lambda word: read_positive(word),
        metavar="MM",
        help="from the middle of one eye to the other's, where a raw scan's unit is not known",
    ),
]
Up = Annotated[Axis, Option(help="a raw scan's axis to the top of the head")]
Forward = Annotated[Axis, Option(help="a raw scan's axis out of the face")]
LandmarksFile = Annotated[
    Path | None, Option("--landmarks", exists=True, dir_okay=False, help="JSON, LJSON or CSV")
]
Url = Annotated[str, Option("--url", envvar="MYOFACE_URL", help="the service")]
Scan = Annotated[Path, Argument(exists=True, dir_okay=False, help="OBJ, PLY, GLB or STL")]
RawScan = Annotated[
    Path, Argument(exists=True, dir_okay=False, help="OBJ, PLY, STL, GLB or point cloud")
]
NewFile = Annotated[Path, Option("--output", "-o", dir_okay=False, help="file to write")]
NewFolder = Annotated[Path, Option("--output", "-o", file_okay=False, help="folder to fill")]


def frame_options(
    unit: str | float, up: Axis, forward: Axis, eye_distance_mm: float | None = None
) -> dict[str, Any]:
    """Return how a raw scan lies in space, as options of ``check_scan`` and ``register_scan``."""
    if eye_distance_mm is None:
        return {"unit": unit, "up": up, "forward": forward}
    if unit != "auto":
        raise UsageError("--unit and --eye-distance-mm exclude one another")
    return {"up": up, "forward": forward, "eye_distance_mm": eye_distance_mm}


def read_unit(word: str) -> str | float:
    """Return the name of a unit, or how many mm one is."""
    return word if word in UNITS else read_positive(word, f"{', '.join(UNITS)} or a number of mm")


def read_positive(word: str, needed: str = "a number of mm") -> float:
    """Return a number above 0."""
    try:
        number = float(word)
    except ValueError:
        number = math.nan
    if not 0 < number < math.inf:
        raise ValueError(f"{word!r} is not {needed} above 0")
    return number


def read_scene(file: Path) -> Any:
    """Return what a scene's file holds."""
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise UsageError(f"{file.name} is not JSON: {error}") from error


def read_object(text: str, option: str) -> dict[str, Any]:
    """Return the JSON object that an option was given."""
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise UsageError(f"{option} is not JSON: {error}") from error
    if not isinstance(found, dict):
        raise UsageError(f"{option} must be a JSON object")
    return found
