"""The root command, and options that several commands share."""

from __future__ import annotations

import json
from math import inf
from pathlib import Path
from typing import Annotated, Any, Literal

from myoface.cli.commands import Argument, Option, UsageError

Axis = Literal["auto", "x", "-x", "y", "-y", "z", "-z"]

SubjectId = Annotated[str, Argument(help="subject: its id, the start of it, or the name")]
OfSubject = Annotated[str | None, Option("--subject", help="subject: id, start of it, or name")]
UNITS = ("auto", "mm", "cm", "m", "inch", "foot")


def read_unit(word: str) -> str | float:
    """Return a unit's name, or a number of mm; the service says how large it may be."""
    if word in UNITS:
        return word
    try:
        if 0 < (number := float(word)) < inf:
            return number
    except ValueError:
        pass
    raise ValueError(f"{word!r} is not one of {', '.join(UNITS)}, nor a number of mm above 0")


Unit = Annotated[
    str | float,
    Option(
        metavar="UNIT",
        parser=read_unit,
        help=f"unit of a raw scan's coordinates: {', '.join(UNITS)}, or how many mm it has",
    ),
]
EyeDistance = Annotated[
    float | None,
    Option(
        "--eye-distance",
        "--eye-distance-mm",
        metavar="MM",
        help="instead of a unit: how far apart the person's pupils are, 35 to 90 mm",
        min=35,
        max=90,
    ),
]
Up = Annotated[Axis, Option(help="a raw scan's axis to the top of the head")]
Forward = Annotated[Axis, Option(help="a raw scan's axis out of the face")]
LandmarksFile = Annotated[
    Path | None,
    Option(
        "--landmarks", exists=True, dir_okay=False, help="JSON, LJSON or CSV; JSON of a photograph"
    ),
]
Options = Annotated[
    str, Option(metavar="JSON", help="JSON or @FILE, see `myoface jobs kinds KIND`")
]
Labels = Annotated[
    list[str] | None, Option("--label", metavar="KEY:VALUE", help="a label; repeat for more")
]
Unlabel = Annotated[
    list[str] | None, Option("--unlabel", metavar="KEY", help="take a label away; repeat for more")
]
WithLabels = Annotated[
    list[str] | None,
    Option("--label", metavar="KEY[:VALUE]", help="only with this label, of any value; repeat"),
]
Url = Annotated[str, Option("--url", envvar="MYOFACE_URL", help="the service")]
NewFile = Annotated[Path, Option("--output", "-o", dir_okay=False, help="file to write")]
NewFolder = Annotated[Path, Option("--output", "-o", file_okay=False, help="folder to fill")]


def scan_frame(
    unit: str | float, eye_distance: float | None, up: str, forward: str
) -> dict[str, Any]:
    """Return the options of a check and of a registration: how large a scan is and how it lies."""
    if eye_distance is None:
        return {"unit": unit, "up": up, "forward": forward}
    if unit != "auto":
        raise UsageError("give --unit or --eye-distance, not both")
    return {"eye_distance_mm": eye_distance, "up": up, "forward": forward}


def read_document(text: str, name: str) -> Any:
    """Return what JSON says; ``name`` is that of its file or option."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise UsageError(f"{name} is not JSON: {error}") from error


def read_file(file: Path) -> str:
    """Return a file's text; Windows' editors put a mark before UTF-8."""
    try:
        return file.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise UsageError(f"{file}: {error.strerror}") from error
    except ValueError as error:
        raise UsageError(f"{file} is not UTF-8: {error}") from error


def read_scene(file: Path) -> Any:
    """Return what a scene's file holds."""
    return read_document(read_file(file), file.name)


def read_object(given: str, option: str) -> dict[str, Any]:
    """Return the JSON object that an option was given, itself or as ``@FILE``."""
    text = read_file(Path(given[1:])) if given.startswith("@") else given
    return require_object(read_document(text, option), option)


def require_object(found: Any, name: str) -> dict[str, Any]:
    """Return a JSON object; refuse what is none."""
    if not isinstance(found, dict):
        raise UsageError(f"{name} must be a JSON object")
    return found


def read_labels(given: list[str] | None) -> dict[str, str] | None:
    """Return labels that were given as ``KEY:VALUE``; None: there are none."""
    found = dict(map(_read_label, given or ()))
    return found or None


def read_label_filter(given: list[str] | None) -> dict[str, str | None] | None:
    """Return labels that were given as ``KEY:VALUE`` or ``KEY``, which has any value (None)."""
    found: dict[str, str | None] = {}
    for each in given or ():
        key, value = _read_label(each) if ":" in each else (each.strip(), None)
        found[key] = value
    return found or None


def _read_label(given: str) -> tuple[str, str]:
    key, colon, value = (part.strip() for part in given.partition(":"))
    if not (key and colon and value):
        raise UsageError(f"--label {given}: KEY:VALUE is expected, such as session:Monday")
    return key, value


def read_label_changes(
    given: list[str] | None, taken: list[str] | None
) -> dict[str, str | None] | None:
    """Return the labels to be set, and those to be taken away as None; None: no change."""
    changes: dict[str, str | None] = {**dict.fromkeys(taken or ()), **(read_labels(given) or {})}
    return changes or None


def require_change(**changes: object) -> None:
    """Refuse a command that changes nothing."""
    if all(value is None for value in changes.values()):
        options = ", ".join(f"--{name}" for name in changes)
        raise UsageError(f"nothing is to be changed: give one of {options}")
