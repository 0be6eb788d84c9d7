"""The unit of a raw scan: what was said of it, what the face's size speaks for, and what is told.

A size is never guessed in silence. A unit that was given, or that the format declares, is believed
as long as it makes a face of a person's size. Others are guessed only where they make one of about
the template's size; where none does, the scan takes the template's size and its millimetres are
estimates.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import isclose
from typing import Any, Literal

from solver.errors import Finding, InputError, advise
from solver.kinds.kind import MM_A_UNIT
from solver.model import SIZE_WORDS, SizeFrom

UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4, "foot": 304.8}  # name -> mm
COMMON = ("mm", "cm", "m")  # units that a scanner's software writes without being asked
LIKELY = (*COMMON, "inch")  # units that a scan is tried in first
AXES = {  # name -> direction in the file's frame
    "x": (1.0, 0.0, 0.0),
    "-x": (-1.0, 0.0, 0.0),
    "y": (0.0, 1.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "z": (0.0, 0.0, 1.0),
    "-z": (0.0, 0.0, -1.0),
}
# The options of every job that reads a raw scan, with their defaults.
FRAME = {"unit": "auto", "eye_distance_mm": None, "up": "auto", "forward": "auto"}
# Origin of a size: the unit that was given; how far apart the eyes are; the format says
# it; mm, as nothing says otherwise; the face speaks for another unit; no unit fits, and the face
# takes the template's size.
Source = Literal["given", "eyes", "declared", "assumed", "found", "template"]
SAY_UNIT = "Give the unit, or how far apart the person's eyes are (eye_distance_mm)."
ADVICE = {
    "scan.scale": f"If that is not its unit, the face has a wrong size. {SAY_UNIT}",
    "scan.size": (
        "Nothing to do if the person has such a face, as a child has. Else: give another unit, or "
        "measure again how far apart the person's eyes are (eye_distance_mm)."
    ),
    "scan.unit_unknown": SAY_UNIT,
}


@dataclass(frozen=True)
class UnitOptions:
    """Sizes of scans and faces that are likely, for finding a scan's unit."""

    extent_mm: tuple[float, float] = (90.0, 1100.0)  # a bare face to two people's shoulders
    slips: tuple[float, ...] = (0.001, 0.1, 10.0, 1000.0)  # factors of a unit that is mixed up
    ladder_mm: tuple[float, ...] = (310.0, 230.0, 420.0, 170.0, 570.0)  # scans, likely ones first
    face_sizes: tuple[float, float] = (0.77, 1.3)  # of persons, by the template's face
    unusual: float = 0.12  # off the template's size: it is told, and no unit guessed for it


UNIT_OPTIONS = UnitOptions()


@dataclass(frozen=True)
class ScanUnit:
    """The size of a scan's file."""

    mm_per_unit: float
    source: Source

    @property
    def name(self) -> str | None:
        """Return the unit's name, if it has one."""
        found = (name for name, mm in UNITS.items() if isclose(mm, self.mm_per_unit))
        return next(found, None)

    @property
    def words(self) -> str:
        """Return how the file is read."""
        return f"in {self.name}" if self.name else f"at {self.mm_per_unit:.4g} mm a unit"


@dataclass(frozen=True)
class FaceSize:
    """Size of a face in the unit that was chosen for its scan, and how sure it is."""

    unit: ScanUnit
    share: float  # by the template's face
    eyes_mm: float | None  # from the middle of an eye to the other's; None where it is not known
    template_eyes_mm: float | None  # the same in the template

    @property
    def words(self) -> str:
        """Return the size as it may end a sentence."""
        off = self.share - 1.0
        by = f"{abs(off):.0%} {'larger' if off > 0 else 'smaller'} than the template's"
        if abs(off) < 0.005:
            by = "as large as the template's"
        if self.eyes_mm is None or self.template_eyes_mm is None:
            return f"the face is {by}"
        apart = f"the eyes are {self.eyes_mm:.1f} mm apart (template: {self.template_eyes_mm:.1f})"
        return f"{apart} and the face is {by}"

    @property
    def is_known(self) -> bool:
        """Tell whether the size is the scan's own; it is else the template's."""
        return self.unit.source != "template"

    @property
    def is_measured(self) -> bool:
        """Tell whether the size comes from the face in the scan and not from a unit."""
        return self.unit.source in ("eyes", "template")

    @property
    def taken_from(self) -> SizeFrom:
        """Return where the size of all that is made of the scan comes from."""
        if not self.is_known:
            return "template"
        is_rare = self.unit.source == "found" and self.unit.name not in COMMON
        is_guess = is_rare or (self.unit.source == "assumed" and self.is_unusual())
        return "guess" if is_guess else "scan"

    @property
    def figures(self) -> dict[str, Any]:
        """Return the size as a check and a registration have it among their figures."""
        return {
            "unit": self.unit.name,
            "mm_per_unit": self.unit.mm_per_unit,
            "size_from": self.taken_from,
            "eye_distance_mm": self.eyes_mm and round(self.eyes_mm, 1),
        }

    def is_a_persons(self) -> bool:
        """Tell whether anybody has a face of such a size, a child or a giant."""
        least, most = UNIT_OPTIONS.face_sizes
        return least <= self.share <= most

    def is_unusual(self) -> bool:
        """Tell whether few adults have a face of such a size."""
        return abs(self.share - 1.0) > UNIT_OPTIONS.unusual


def check_frame(frame: Mapping[str, Any]) -> None:
    """Raise :class:`InputError` (``options.unit``, ``options.axes``) for what does not exist."""
    unit = frame["unit"]
    eyes = frame.get("eye_distance_mm")
    if isinstance(unit, str) and unit not in ("auto", *UNITS):
        known = ["auto", *UNITS]
        message = f"unit is {unit!r}, not one of {', '.join(known)}, nor a number of mm"
        raise InputError("options.unit", message, expected=known)
    least, most = MM_A_UNIT
    for name, number in (("unit", unit), ("eye_distance_mm", eyes)):
        if isinstance(number, (int, float)) and not least <= number <= most:
            message = f"{name} is {number}, not a number of mm from {least:g} to {most:g}"
            raise InputError("options.unit", message, found=str(number))
    if unit != "auto" and eyes is not None:
        raise InputError("options.unit", "give unit or eye_distance_mm, not both")
    for name in ("up", "forward"):
        if frame[name] not in ("auto", *AXES):
            message = f"{name} is {frame[name]!r}, not one of auto, {', '.join(AXES)}"
            raise InputError("options.axes", message, expected=["auto", *AXES])
    up = str(frame["up"])
    forward = str(frame["forward"])
    if "auto" not in (up, forward) and up.lstrip("-") == forward.lstrip("-"):
        raise InputError("options.axes", "up and forward must be two different axes")


def given_unit(frame: Mapping[str, Any]) -> float | None:
    """Return the mm per unit that a frame gives; None for auto."""
    unit = frame["unit"]
    if isinstance(unit, str):
        return UNITS.get(unit)
    return float(unit)


def candidate_scales(
    extent: float, given: float | None, declared: float | None
) -> list[list[float]]:
    """Return lists of mm per unit to try for a scan of this ``extent``, the likelier ones first.

    ``declared`` is the mm per unit of the file's format. Known units come first, then those that
    are wrong by a decimal slip, then sizes of heads whatever the unit.
    """
    low, high = UNIT_OPTIONS.extent_mm
    first = declared if given is None else given
    known = [first] if first is not None else [UNITS[name] for name in LIKELY]
    slips = {(first or 1.0) * factor for factor in UNIT_OPTIONS.slips}
    odd = sorted((slips | set(UNITS.values())) - set(known))
    ladder = [size / extent for size in UNIT_OPTIONS.ladder_mm]
    rounds = [
        [scale for scale in scales if low <= scale * extent <= high]
        for scales in (known, odd, ladder)
    ]
    return [scales for scales in rounds if scales]


def likely_unit(
    size: float, bounds: tuple[float, float], units: Iterable[float] = (1.0, *UNITS.values())
) -> float | None:
    """Return the first of ``units``, in mm, by which a size is within ``bounds``; None if none."""
    low, high = bounds
    return next((mm for mm in units if low <= mm * size <= high), None)


def choose_unit(
    scale: float,
    given: float | None,
    declared: float | None,
    options: UnitOptions = UNIT_OPTIONS,
    *,
    read_mm: float = 1.0,
) -> ScanUnit:
    """Return the unit of a scan whose face gets the template's size at ``scale`` mm a unit.

    What was given comes first, then what the format declares, else mm, if it makes a face of a
    person's size; then what makes one of about the template's: a unit, or a decimal slip of what
    comes first. If nothing does, it is ``scale``. The mm are those of a unit of the points, which
    are ``read_mm`` of the file's.
    """
    low, high = options.face_sizes
    first = given or declared or 1.0
    if low <= first / scale <= high:
        return ScanUnit(first, "given" if given else "declared" if declared else "assumed")
    others = [mm / read_mm for mm in UNITS.values()]
    others += [factor * first for factor in options.slips]
    if not given:  # what contradicts a given unit may be a child's face, what is guessed may not
        low = 1.0 - options.unusual
        high = 1.0 + options.unusual
    unit = likely_unit(1.0 / scale, (low, high), others)
    return ScanUnit(scale, "template") if unit is None else ScanUnit(unit, "found")


def unit_findings(
    file: str, frame: Mapping[str, Any], declared: float | None, size: FaceSize
) -> list[Finding]:
    """Return what is to be told of a scan's size, of the check and of the registration alike.

    An ``error`` is a unit that was given and cannot be.
    """
    given = given_unit(frame)
    unit = size.unit
    first = given or declared or 1.0
    figures = {
        "expected": first,
        "found": unit.mm_per_unit,
        "unit": unit.name,
        "eye_distance_mm": size.figures["eye_distance_mm"],
    }
    ratio = first / unit.mm_per_unit * size.share
    off = f"{ratio:.3g} times too large" if ratio > 1 else f"{1 / ratio:.3g} times too small"
    source = "as the format says" if declared else "in mm"
    if given:
        source = "as given" if isinstance(frame["unit"], str) else f"at {given:g} mm a unit"
    if unit.source == "template":
        if isinstance(frame["unit"], float | int):
            message = (
                f"Read {source}, the face in {file} would be {off}; a person's face has its size "
                f"at about {unit.mm_per_unit:.3g} mm a unit."
            )
            return [advise(ADVICE, "scan.scale", "error", message, **figures)]
        message = (
            f"{file}: {SIZE_WORDS['template']}. "
            f"Read {source}, the face would be {off}, and no other unit fits."
        )
        return [advise(ADVICE, "scan.unit_unknown", "warning", message, **figures)]
    if unit.source == "found" and given:
        said = frame["unit"] if isinstance(frame["unit"], str) else f"{given:g} mm a unit"
        message = f"You gave {said}: the face would be {off}; it fits {unit.words}: {size.words}."
        fitting = unit.name or f"{unit.mm_per_unit:.4g}"
        advice = f"Give {fitting} as the unit, or none."
        return [Finding("scan.scale", "error", message, advice, figures)]
    if unit.source == "found":
        message = f"Read {source}, the face would be {off}; it fits {unit.words}: {size.words}."
        return [advise(ADVICE, "scan.scale", "warning", message, **figures)]
    if size.is_unusual():
        message = f"{file}, read {unit.words}, has a face of an unusual size: {size.words}."
        # a distance that was measured wrongly says as little as no unit
        is_sure = unit.source not in ("assumed", "eyes") and size.is_a_persons()
        return [advise(ADVICE, "scan.size", "info" if is_sure else "warning", message, **figures)]
    return []
