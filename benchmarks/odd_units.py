"""Scans in odd units, by check and registration: verdict, size error and role, in one table.

    python -m benchmarks.odd_units --faces ICT_FACEKIT --json -

A size error is told, by a finding about the size, or below 3 %. The persons are ICT-FaceKit's, whom
the built-in template does not know; without their folder it is the template's own person.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import igl
import numpy as np
import trimesh

from benchmarks import report
from benchmarks.documents import Section, Table
from myoface.names import by_files
from solver.errors import InputError
from solver.jobs import run_job
from solver.registration.landmarks import landmark_vertices
from solver.surface import Surface
from solver.templates.builtin.build import builtin_capture_set, builtin_template
from solver.templates.ict_facekit import EYEBALLS, ict_capture_set

TOLD = ("scan.scale", "scan.size", "scan.unit_unknown")  # findings about the size
MOST_PERCENT = 3.0  # of an error that nothing is said of


@dataclass(frozen=True)
class Case:
    """A scan's file and true unit, and what is said of it."""

    file: str
    mm_per_unit: float
    role: str
    person: str = "A"
    options: dict[str, Any] = field(default_factory=dict)
    eyes: bool = False  # whether the person's eye distance is given


CASES = (
    Case("neutral.obj", 1.0, "neutral"),
    Case("James Neutral 01.obj", 10.0, "neutral", "B"),
    Case("NEUTRAL.glb", 1000.0, "neutral", "C"),
    Case("Rest pose.obj", 25.4, "neutral"),
    Case("James Smile 02.obj", 25.4, "expression", "B", {"unit": "inch"}),
    Case("Grün neutre.ply", 0.0437, "neutral", "C"),
    Case("neutral-2.obj", 0.0437, "neutral", "A", {"unit": 0.0437}),
    Case("Lächeln.obj", 0.0437, "expression", "B", eyes=True),
    Case("30 neutral.ply", 30.0, "neutral", "A", eyes=True),
    Case("relaxed.obj", 22.9, "neutral", "B"),
    Case("1000 neutral.obj", 1000.0, "neutral", "A", {"unit": 1000}),
    Case("pixels_surprise.obj", 0.001, "expression", "B"),
    Case("large.obj", 1.25, "expression", "C"),
    Case("wrong neutral.obj", 1.0, "neutral", "A", {"unit": 14.0}),
)


def main() -> None:
    """Run the benchmark."""
    parser = report.parser("verdict, size error and role of scans in odd units")
    parser.add_argument("--faces", type=Path, help="folder of ICT-FaceKit")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        figures = run(Path(folder), options)
    report.finish(figures, options, section)


def run(folder: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Return all figures; ``folder`` takes the files."""
    template = builtin_template()
    cases = []
    _tell(COLUMNS)
    for case in CASES[:: 4 if options.quick else 1]:
        cases.append(_tried(case, folder, options.faces))
        _tell(_row(cases[-1]))
    return {
        "template": template.name,
        "scans": cases,
        "quiet_errors": [each["file"] for each in cases if not each["honest"]],
        "wrong_roles": [each["file"] for each in cases if each["role"] != each["true_role"]],
    }


COLUMNS = ["file", "mm a unit", "said", "role", "verdict", "read", "error", "registered", "told"]


def _row(scan: dict[str, Any]) -> list[Any]:
    return [
        *(scan[name] for name in ("file", "mm_per_unit", "said", "role", "verdict", "read")),
        *("refused" if scan[name] is None else f"{scan[name]:+.1f} %" for name in ERRORS),
        ", ".join(scan["told"]),
    ]


def _tell(row: list[Any]) -> None:
    """Show a row while the others are still tried."""
    sys.stderr.write("  ".join(map(str, row)) + "\n")
    sys.stderr.flush()


ERRORS = ("check_error_percent", "registered_error_percent")


def section(figures: dict[str, Any]) -> Section:
    """Return the document's section."""
    return Section(
        title="Scans in odd units",
        compared=(
            f"Persons that the template {figures['template']} does not know, in units that a "
            f"scanner may write: an error of the size is told or below {MOST_PERCENT:g} %. Quiet "
            f"errors: {len(figures['quiet_errors'])}, wrong roles: {len(figures['wrong_roles'])}."
        ),
        parts=[
            Table(
                COLUMNS,
                [_row(each) for each in figures["scans"]],
                "Size by check and registration:",
            )
        ],
    )


def _tried(case: Case, folder: Path, faces: Path | None) -> dict[str, Any]:
    """Return what check and registration make of a case."""
    captures = builtin_capture_set() if faces is None else ict_capture_set(faces, case.person)
    expressions = {**captures.train, **captures.test}
    neutral = case.role == "neutral"
    surface = captures.neutral if neutral else expressions[sorted(expressions)[0]]
    path = _written(folder / case.file, surface, case.mm_per_unit)
    options = dict(case.options)
    if case.eyes:
        options["eye_distance_mm"] = round(_eye_distance(captures.neutral), 1)
    (_, role), *_ = by_files([case.file])
    out = folder / "out"
    check_file, _ = run_job("check_scan", out, scan=path, role=role, options=options)
    found = json.loads(check_file.read_text(encoding="utf-8"))
    read = found["figures"].get("mm_per_unit")
    told = {each["code"]: each["severity"] for each in found["findings"] if each["code"] in TOLD}
    registered, words = _registered(path, out, options)
    errors = [
        None if mm is None or "error" in told.values() else 100.0 * (mm / case.mm_per_unit - 1.0)
        for mm in (read, registered)
    ]
    return {
        "file": case.file,
        "mm_per_unit": case.mm_per_unit,
        "said": ", ".join(f"{name} {value}" for name, value in options.items()) or "nothing",
        "true_role": case.role,
        "role": role,
        "verdict": found["verdict"],
        "read": f"{read:.4g}" if read else "",
        **dict(zip(ERRORS, errors, strict=True)),
        "told": list(told),
        "told_by_registration": words,
        "honest": bool(told and words) or all(e is None or abs(e) < MOST_PERCENT for e in errors),
    }


def _registered(path: Path, out: Path, options: dict[str, Any]) -> tuple[float | None, list[str]]:
    """Return the mm per unit of a registered scan, None if it is refused, and what was told."""
    try:
        _, report_file, _ = run_job("register_scan", out, scan=path, options=options)
    except InputError as error:
        return None, [error.code]
    found = json.loads(report_file.read_text(encoding="utf-8"))
    codes = [each["code"] for each in found["findings"] if each["code"] in TOLD]
    return found["motion"]["scale"], codes


def _eye_distance(surface: Surface) -> float:
    """Return how far apart the eyeballs' middles are, as a person's pupils are measured."""
    if len(surface.vertices) > EYEBALLS.stop:
        balls = surface.vertices[list(EYEBALLS)]
        left, right = (balls[side].mean(axis=0) for side in (balls[:, 0] > 0, balls[:, 0] < 0))
        return float(np.linalg.norm(left - right))
    known = landmark_vertices(builtin_template())
    corners = [[known[f"{corner}canthion_{side}"] for corner in ("endo", "exo")] for side in "lr"]
    left, right = surface.vertices[np.array(corners)].mean(axis=1)
    return float(np.linalg.norm(left - right))


def _written(path: Path, surface: Surface, mm_per_unit: float) -> Path:
    """Write a scan with a vertex every 2 mm or so, as a scanner leaves it, turned and moved."""
    used, faces = np.unique(surface.faces, return_inverse=True)
    vertices, triangles = igl.upsample(surface.vertices[used], faces.reshape(-1, 3))
    vertices = (np.asarray(vertices) + np.array([12.0, -40.0, 7.0])) / mm_per_unit
    trimesh.Trimesh(vertices, triangles, process=False).export(path)
    return path


if __name__ == "__main__":
    main()
