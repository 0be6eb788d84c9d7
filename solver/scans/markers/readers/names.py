"""Places of markers on a face by their names: ``LBRO1``, ``Leyebrow_Inside``, ``Mouth_UpL1``.

Names have a region, a side and a part of it, in any order and with any signs between. Places
are of a middling face, in mm from the tip of the nose: x to the subject's left, y up, z forward;
they are as sure as names are, to a centimetre or three. Labels that are plain numbers are the 68
points of the iBUG scheme (Sagonas et al. 2013).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from solver.anatomy.data import read_json
from solver.kinds.marker_set import Part
from solver.surface import Floats

Place = tuple[float, float, float]

LOWER = frozenset({"chin", "jaw", "lower_lip", "lower_teeth"})  # regions that the jaw moves

TABLES = read_json("marker_names")
# Words for a region, the longer ones first, as ``eye`` is in ``eyebrow``.
REGIONS: dict[str, list[str]] = TABLES["regions"]
# A region whose part has a region of its own.
HALVES = {("mouth", "upper"): "upper_lip", ("mouth", "lower"): "lower_lip"}
# The part of a region in which a side's second marker and the further ones are.
FURTHER = {"chin": "outer"}
BODY = re.compile(
    r"^[lr]?(sho|shoulder|elb|elbow|wr[abi]|wrist|fin|hand|clav|strn|c7|t10|rbak|bak|asi|psi|thi"
    r"|kne|knee|tib|ank|hee|heel|toe|upa|frm|neck|hip|pelvis|spine|chest|arm|leg|foot|finger)\w{0,3}$"
)
# Where the left one of a region lies, or the one in the middle of the face, and its parts.
PLACES: dict[str, dict[str, Place]] = TABLES["places"]
PARTS: dict[str, Part] = {
    "head": "head",
    "back_of_head": "head",
    "upper_teeth": "upper_teeth",
    "lower_teeth": "lower_teeth",
}
WORDS: dict[str, list[str]] = TABLES["words"]  # for parts
# The 68 points: corners of chains, between which the others lie.
CHAINS: list[dict[int, Place]] = [
    {int(number): place for number, place in chain.items()} for chain in TABLES["chains"]
]
# Each point's twin on the other side.
TWINS_68 = {
    **{n: 16 - n for n in range(17)},
    **{n: 43 - n for n in range(17, 27)},
    **{n: 66 - n for n in range(31, 36)},
    **{36: 45, 37: 44, 38: 43, 39: 42, 40: 47, 41: 46},
    **{n: 102 - n for n in range(48, 55)},
    **{n: 114 - n for n in range(55, 60)},
    **{n: 124 - n for n in range(60, 65)},
    **{65: 67, 66: 66, 67: 65},
}


@dataclass(frozen=True)
class Named:
    """The place of a marker by its name."""

    region: str
    place: Place  # on a middling face, mm from the tip of the nose
    part: Part = "face"
    side: int = 0  # 1 the subject's left, -1 the right, 0 the middle or unknown


def read_names(labels: Sequence[str]) -> list[Named | None]:
    """Return the place by each label, None for one that names none."""
    numbers = [_number(label) for label in labels]
    known = [number for number in numbers if number is not None]
    if len(labels) >= 17 and len(known) == len(labels) and max(known) <= 68:
        scheme = _scheme_68()
        start = 1 if min(known) == 1 and max(known) in (68, 51, 17) else 0
        return [scheme.get(number - start) for number in known]
    return [read_name(label) for label in labels]


def read_name(label: str) -> Named | None:
    """Return the place by one label; what is named after the body has the part ``ignore``."""
    # the words in lower case: ``Mouth_UpL1`` is mouth, up, l, 1
    spaced = re.sub(r"(?<=[a-z])(?=[A-Z])|(?<=[A-Za-z])(?=\d)|(?<=\d)(?=[A-Za-z])", " ", label)
    parts = re.findall(r"[a-z]+|\d+", spaced.lower())
    joined = "".join(parts)
    if BODY.match(joined):
        return Named("body", (0.0, 0.0, 0.0), "ignore")
    found = next(
        ((name, word) for name, words in REGIONS.items() for word in words if word in joined), None
    )
    if found is None:
        return None
    region, word = found
    rest = _rest(parts, joined.index(word), len(word))
    side, marks = _side(rest)
    region = HALVES.get((region, marks[0] if marks else ""), region)
    table = PLACES[region]
    number = next((int(part) for part in rest if part.isdigit()), 1)
    chosen = next((mark for mark in marks if mark in table and not (side and mark == "tip")), "")
    if not chosen and side in (None, 0) and "middle" in table:
        chosen = "middle"
    if side and number > 1:
        chosen = FURTHER.get(region, chosen)
    x, y, z = table[chosen]
    part = PARTS.get(region, "face")
    if x and side in (None, 0):
        return None if part == "face" else Named(region, (0, y, z), part)
    return Named(region, (x * (side or 1), y, z), part, (side or 0) if x else 0)


def _rest(parts: list[str], start: int, length: int) -> list[str]:
    """Return the words without the letters of the region's word."""
    rest = []
    at = 0
    for part in parts:
        low = max(start - at, 0)
        high = min(start + length - at, len(part))
        kept = [part] if low >= high else [part[:low], part[high:]]
        rest += [piece for piece in kept if piece]
        at += len(part)
    return rest


def _side(rest: list[str]) -> tuple[int | None, list[str]]:
    """Return 1 for the left, -1 for the right, 0 for the middle, None if neither, and the marks."""
    side: int | None = None
    marks: list[str] = []
    by_word = {word: mark for mark, words in WORDS.items() for word in words}
    for part in rest:
        if part in ("l", "left", "r", "right"):
            side = 1 if part[0] == "l" else -1
            continue
        if part in ("m", "c"):
            marks.append("middle")
        elif part in by_word:
            marks.append(by_word[part])
        elif part[0] in "lr" and part[1:] in by_word:
            side = 1 if part[0] == "l" else -1
            marks.append(by_word[part[1:]])
        elif part[-1] in "lr" and part[:-1] in by_word:
            side = 1 if part[-1] == "l" else -1
            marks.append(by_word[part[:-1]])
    if side is None and "middle" in marks:
        side = 0
    return side, marks


def _number(label: str) -> int | None:
    found = re.fullmatch(r"[A-Za-z_ ]{0,12}?(\d{1,2})", label.strip())
    return int(found.group(1)) if found else None


def _scheme_68() -> dict[int, Named]:
    """Return the 68 points, those of the left mirrored from the right."""
    found: dict[int, Floats] = {}
    for chain in CHAINS:
        numbers = np.arange(min(chain), max(chain) + 1)
        corners = np.array([chain[each] for each in sorted(chain)], float)
        for number in numbers.tolist():
            found[number] = np.array(
                [np.interp(number, sorted(chain), corners[:, axis]) for axis in range(3)]
            )
    named = {}
    for number, place in found.items():
        x, y, z = place.tolist()
        twin = TWINS_68.get(number, number)
        named[number] = Named("68", (x, y, z), side=-1 if x else 0)
        named[twin] = Named("68", (-x, y, z), side=1 if x else 0)
    return named
