"""Sizes are told, never guessed in silence, by check and registration alike."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import igl
import numpy as np
import pytest

from solver.errors import Finding, InputError
from solver.jobs import run_job
from solver.meshio.obj import write_obj
from solver.meshio.raw import mend, read_raw
from solver.registration.locate import Location
from solver.registration.register import find_start
from solver.registration.units import (
    FRAME,
    FaceSize,
    ScanUnit,
    check_frame,
    choose_unit,
    unit_findings,
)
from solver.scans.check import check
from solver.surface import Surface
from solver.templates.builtin.build import builtin_expression, builtin_template

HERE = 1.0  # mm a unit at which a face has the template's size


@pytest.mark.parametrize(
    ("scale", "given", "declared", "read", "source"),
    [
        (HERE, None, None, 1.0, "assumed"),
        (1.25, None, None, 1.0, "assumed"),
        (9.5, None, None, 10.0, "found"),
        (22.9, None, None, 25.4, "found"),
        (22.4, None, None, 22.4, "template"),
        (290.0, None, None, 304.8, "found"),
        (30.0, None, None, 30.0, "template"),
        (0.0437, None, None, 0.0437, "template"),
        (0.0437, 0.0437, None, 0.0437, "given"),
        (1000.0, None, 1000.0, 1000.0, "declared"),
        (1.0, None, 1000.0, 1.0, "found"),
        (1.2, 10.0, None, 1.0, "found"),  # an unlikely face speaks against a unit all the same
        (14.0, 200.0, None, 14.0, "template"),
    ],
)
def test_no_unit_is_guessed_for_a_face_of_another_size(
    scale: float, given: float | None, declared: float | None, read: float, source: str
) -> None:
    unit = choose_unit(scale, given, declared)
    assert (unit.mm_per_unit, unit.source) == (read, source)


def told(scale: float, unit: Any = "auto", declared: float | None = None) -> list[Finding]:
    given = None if unit == "auto" else 10.0 if unit == "cm" else float(unit)
    chosen = choose_unit(scale, given, declared)
    size = FaceSize(chosen, chosen.mm_per_unit / scale, 62.0 * chosen.mm_per_unit / scale, 62.0)
    return unit_findings("a.obj", {**FRAME, "unit": unit}, declared, size)


def test_inches_are_never_quiet() -> None:
    (finding,) = told(22.9)
    assert (finding.code, finding.severity) == ("scan.scale", "warning")
    assert "fits in inch" in finding.message
    assert "68.8 mm apart" in finding.message
    assert "11% larger" in finding.message


def test_a_unit_that_does_not_fit_is_answered_with_the_one_that_does() -> None:
    (finding,) = told(1.0, "cm")
    assert (finding.code, finding.severity) == ("scan.scale", "error")
    assert finding.message.startswith("You gave cm: the face would be 10 times too large")
    assert "it fits in mm" in finding.message
    assert finding.advice == "Give mm as the unit, or none."


def test_a_face_of_an_unusual_size_is_told_with_its_eyes() -> None:
    (finding,) = told(1.25)
    assert (finding.code, finding.severity) == ("scan.size", "warning")
    assert "49.6 mm apart" in finding.message
    (known,) = told(12.5, "cm")
    assert (known.code, known.severity) == ("scan.size", "info")
    assert told(1.1) == []


@pytest.mark.parametrize(("eyes_mm", "severities"), [(50.0, ["warning"]), (61.0, [])])
def test_eyes_too_near_each_other_are_told(eyes_mm: float, severities: list[str]) -> None:
    share = eyes_mm / 62.0
    size = FaceSize(ScanUnit(share, "eyes"), share, eyes_mm, 62.0)
    findings = unit_findings("a.obj", {**FRAME, "eye_distance_mm": eyes_mm}, None, size)
    assert [each.severity for each in findings] == severities


def test_a_number_that_makes_no_face_is_refused_in_a_sentence() -> None:
    (finding,) = told(14.0, 200.0)
    assert (finding.code, finding.severity) == ("scan.scale", "error")
    assert "at 200 mm a unit" in finding.message
    assert "14.3 times too large" in finding.message


@pytest.mark.parametrize(
    "wrong",
    [
        {"unit": "mile"},
        {"unit": 0},
        {"unit": -3.0},
        {"unit": float("nan")},
        {"eye_distance_mm": 0.0},
        {"eye_distance_mm": float("inf")},
        {"unit": "mm", "eye_distance_mm": 62.0},
    ],
)
def test_a_unit_that_is_none_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(InputError) as caught:
        check_frame({**FRAME, **wrong})
    assert caught.value.code == "options.unit"


# With a scan.


@cache
def head() -> Surface:
    """Return the built-in head with a vertex every 2 mm or so."""
    surface = builtin_expression({})
    vertices, faces = igl.upsample(surface.vertices, surface.faces)
    return Surface(np.asarray(vertices), np.asarray(faces, np.int64))


def written(folder: Path, mm_per_unit: float, scan: Surface) -> Path:
    path = folder / "scan.obj"
    write_obj(path, scan.with_vertices(scan.vertices / mm_per_unit))
    return path


def both(path: Path, frame: dict[str, Any]) -> tuple[Location, Location, list[str], list[str]]:
    """Return places and messages of check and registration."""
    template = builtin_template()
    found = check(path, template, frame, "unknown", None)
    _, start, findings = find_start(mend(read_raw(path))[0], template, frame, None)
    assert found.location is not None
    codes = [finding.message for finding in found.findings if finding.code.startswith("scan.unit")]
    return found.location, start, codes, [finding.message for finding in findings]


@pytest.mark.long
def test_a_size_that_fits_no_unit_is_unknown_to_both(tmp_path: Path) -> None:
    checked, registered, told, again = both(written(tmp_path, 31.0, head()), FRAME)
    assert checked.size.taken_from == registered.size.taken_from == "template"
    assert told == again
    assert "size unknown: taken from the template, millimetres are estimates" in told[0]


@pytest.mark.long
@pytest.mark.parametrize("frame", [{"unit": 31.0}, {"eye_distance_mm": 61.0}])
def test_a_number_or_the_eyes_give_a_scan_its_size(frame: dict[str, Any], tmp_path: Path) -> None:
    checked, registered, told, again = both(written(tmp_path, 31.0, head()), {**FRAME, **frame})
    assert told == again == []
    assert checked.size.taken_from == registered.size.taken_from == "scan"
    assert registered.mm_per_unit == checked.mm_per_unit
    if "unit" in frame:
        assert checked.mm_per_unit == 31.0
    else:
        assert checked.size.eyes_mm == pytest.approx(61.0)


@pytest.mark.long
def test_a_rig_knows_that_its_size_is_an_estimate(tmp_path: Path) -> None:
    coarse = builtin_expression({})  # it shows nothing beyond its mesh that would be baked
    files = run_job("register_scan", tmp_path, scan=written(tmp_path, 31.0, coarse))
    found = json.loads(files[1].read_text(encoding="utf-8"))
    assert found["size_from"] == "template"
    assert "scan.unit_unknown" in [finding["code"] for finding in found["findings"]]
    head = files[0].read_bytes()[:200]
    assert b"comment myoface size from template\n" in head
