"""``report.html``: the certificate for a person to read, in one file that needs no network.

``report.html`` and ``report_parts.html`` beside this module lay out the values of ``report.json``;
here is what takes more than a template's words.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from PIL import Image

from solver.anatomy.physiology import JAW_RANGES, JAW_SOURCE, MUSCLE_SOURCE
from solver.drawing.head import both_sides
from solver.fitting.contraction import STILL
from solver.rig.expression import ROLES
from solver.rig.report import CONTACTS
from solver.rig.report.checks import overall

FILES = {
    "rig.npz": "the rig in one file: model, matrix S and expressions",
    "rig.glb": "the skin with one named morph target per expression",
    "rig.usdc": "the same for programs that read USD",
    "systems.glb": "the same skin by every system, side by side",
    "activations.npz": "muscle activations, jaw and flesh of every expression",
    "activations.csv": "the same activations as a table",
    "muscle_weights.npz": "the matrix S, tetrahedra × muscles",
    "report.json": "the figures of this page",
}
PICTURE_WIDTH = 1400  # pixels of a fit's picture: sharp on a large screen
JPEG_QUALITY = 86  # of 100
LITTLE = 0.5  # information of a muscle below which most of what is to be known is not
MOST = 6  # muscles that contract most, shown with an expression
LONG = 200  # letters of a detail that is only told with its expression


def write_page(path: Path, figures: dict[str, Any]) -> None:
    """Write the page of a rig's ``report.json`` values, with the pictures found beside ``path``."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.tests["still"] = STILL.is_still
    environment.filters |= {
        "faulty": _faulty,
        "figure": _figure,
        "little_known": _little_known,
        "minus": lambda text: text.replace("-", "−"),
        "mover_words": _mover_words,
        "movers": _movers,
        "overall": overall,
        "told": _told,
    }
    expressions = figures["expressions"]
    pictured = {**expressions, **figures.get("systems", {})}
    groups: dict[str, list[dict[str, Any]]] = {}
    for check in figures["checks"]:
        groups.setdefault(check["group"], []).append(check)
    page = environment.get_template("report.html").render(
        figures,
        anchors={name: f"e{number}" for number, name in enumerate(expressions)},
        contacts=CONTACTS,
        files={name: words for name, words in FILES.items() if (path.parent / name).exists()},
        groups=groups,
        jaw_ranges=JAW_RANGES,
        jaw_source=JAW_SOURCE,
        muscle_source=MUSCLE_SOURCE,
        pictures={name: _picture(path.parent / f"fit_{name}.png") for name in pictured},
        roles=ROLES,
        whole_muscles=_whole_muscles(expressions),
    )
    path.write_text(page, encoding="utf-8")


def _figure(value: float | None, decimals: int | None = None) -> str:
    """Return a figure in words, with three digits or so many decimals; None is ``not known``."""
    if value is None:
        return "not known"
    if decimals is not None:
        return f"{value:,.{decimals}f}"
    if value != 0.0 and abs(value) < 1e-3:
        return f"{value:.0e}".replace("e-0", "e-")
    return f"{value:,.3g}"


def _told(check: dict[str, Any]) -> str:
    """Return the detail of a check's worst expression, unless it is too long to stand beside it."""
    told: str = check["detail"] if len(check["detail"]) < LONG else check.get("says", "")
    return told if len(told) < LONG else ""


class _Picture(NamedTuple):
    width: int
    height: int
    data: str  # a JPEG, in base64


def _picture(path: Path) -> _Picture | None:
    if not path.exists():
        return None
    image = Image.open(path)
    image.thumbnail((PICTURE_WIDTH, PICTURE_WIDTH))
    stream = BytesIO()
    image.convert("RGB").save(stream, "JPEG", quality=JPEG_QUALITY)
    return _Picture(image.width, image.height, base64.b64encode(stream.getvalue()).decode())


def _little_known(information: dict[str, Any]) -> list[tuple[str, float]]:
    """Return muscles that the scans tell little of, with their information, the least first."""
    known = sorted(information["muscles"].items(), key=lambda item: item[1])
    return [(name, part) for name, part in known if part < LITTLE]


# Muscles: compartments under their whole.


class _Whole(NamedTuple):
    name: str
    parts: list[str]  # its muscles; alone it is its own
    shown: list[dict[str, Any]]  # ``fibres`` and ``faults`` of the whole, by expression


def _whole_muscles(expressions: dict[str, Any]) -> list[_Whole]:
    """Return the muscles that a row of expressions shows, both sides of a muscle together."""
    names = next(iter(expressions.values()))["muscles"] if expressions else {}
    by_whole = _by_whole(names, sorted(names, key=lambda name: (both_sides(name), name)))
    return [
        _Whole(
            whole,
            parts,
            [
                _shown([(name, found["muscles"][name]) for name in parts])
                for found in expressions.values()
            ],
        )
        for whole, parts in by_whole.items()
    ]


def _shown(parts: list[tuple[str, dict[str, Any]]]) -> dict[str, Any]:
    """Return what is shown of a whole: its part that contracts most, and the faults of all."""
    if len(parts) == 1:
        return parts[0][1]
    fibres = [part["fibres"] for _, part in parts if part["fibres"] is not None]
    faults = [f"{name} {fault}" for name, part in parts for fault in part["faults"]]
    return {"fibres": min(fibres, default=None), "faults": faults}


def _by_whole(muscles: dict[str, Any], names: Iterable[str]) -> dict[str, list[str]]:
    """Return each whole among the ``names`` of muscles with its parts; alone it is its own."""
    found: dict[str, list[str]] = {}
    for name in names:
        # reports from before compartments have whole muscles only
        found.setdefault(muscles[name].get("whole", name), []).append(name)
    return found


class _Faulty(NamedTuple):
    muscles: int
    words: list[str]  # of each whole


def _faulty(muscles: dict[str, Any]) -> _Faulty:
    """Return what muscles of an expression cannot do."""
    faulty = [name for name, muscle in muscles.items() if muscle["faults"]]
    words = [
        "; ".join(f"{name} {', '.join(muscles[name]['faults'])}" for name in parts)
        for parts in _by_whole(muscles, faulty).values()
    ]
    return _Faulty(len(faulty), words)


# Who contracts, against the muscles that an expression's name speaks for.


class _Mover(NamedTuple):
    muscle: str
    contraction: float
    makes: str  # action units, in words
    against: str  # what contradicts them, in words


def _movers(contractions: list[dict[str, Any]], actions: list[dict[str, Any]]) -> list[_Mover]:
    """Return who contracts most, and all whom literature names or excludes."""
    by_muscle = {each["muscle"]: each["contraction"] for each in contractions}
    notes = _mover_notes(actions)
    most = [name for name, by in by_muscle.items() if by > 0.0][:MOST]
    return [
        _Mover(name, by, *notes.get(name, ("", "")))
        for name, by in by_muscle.items()
        if name in most or name in notes
    ]


def _mover_words(actions: list[dict[str, Any]]) -> str:
    """Return which action units an expression's name speaks for, and which are not judged."""
    words = "Who contracts most, by compartment: shortening of the fibres."
    if not actions:
        return f"{words} The expression's name speaks for no action unit that it is compared with."
    judged = {each["unit"] for each in actions if each["muscles"]}
    named = {each["unit"]: each["name"] for each in actions}
    words += f" By its name: {', '.join(f'{unit} {name}' for unit, name in named.items())}."
    words += " No. is the place on its side of the face."
    for unit in (unit for unit in named if unit not in judged):
        [lacking, *_] = [each["missing"] for each in actions if each["unit"] == unit]
        reason = f"the anatomy has no {' or '.join(lacking)}" if lacking else "no muscle makes it"
        words += f" {unit} is not judged: {reason}."
    return words


def _mover_notes(actions: list[dict[str, Any]]) -> dict[str, tuple[str, str]]:
    """Return muscle -> which units it makes, and what contradicts them, in words."""
    muscles = [m for each in actions for m in (*each["muscles"], *each["opposed"])]

    def units(name: str, key: str) -> str:
        return ", ".join(dict.fromkeys(each["unit"] for each in actions if name in each[key]))

    places = {
        each["muscles"][0]: f" (no. {each['rank']})" for each in actions if each["rank"] is not None
    }
    notes = {}
    for name in dict.fromkeys(muscles):
        makes = units(name, "muscles")
        lengthens = units(name, "lengthened")
        against = units(name, "opposed")
        idle = units(name, "idle")
        faults = [f"lengthens in {lengthens}"] if lengthens else []
        faults += [f"holds still in {idle}"] if idle else []
        faults += [f"works against {against}"] if against else []
        notes[name] = (f"makes {makes}{places.get(name, '')}" if makes else "", "; ".join(faults))
    return notes
