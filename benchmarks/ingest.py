"""Speed of the ingest check, faults that it names, and false alarms.

    python -m benchmarks.ingest --json -
    python -m benchmarks.ingest --faces ICT_FACEKIT --scans SCANS --json -

Without folders everything is made from the built-in head.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import igl
import numpy as np
import trimesh

from benchmarks import report
from benchmarks.bad_scans import BAD_SCANS, BadScan, Subject
from benchmarks.documents import Section, Table
from solver.jobs import run_job
from solver.meshio.obj import write_obj
from solver.surface import Surface
from solver.templates.builtin.build import builtin_capture_set, builtin_expression, builtin_template
from solver.templates.ict_facekit import ict_capture_set

SIZES = (200_000, 1_000_000)
SUBJECTS = ("A", "B", "C")
BLINK = {"eyeBlinkLeft": 1.0, "eyeBlinkRight": 1.0}


def main() -> None:
    """Run the benchmark."""
    parser = report.parser("speed, faults named and false alarms of the ingest check")
    parser.add_argument("--faces", type=Path, help="folder of ICT-FaceKit, for more good scans")
    parser.add_argument("--scans", type=Path, help="folder of raw scans, whose findings are listed")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        figures = run(Path(folder), options)
    report.finish(figures, options, section)


def run(folder: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Return all figures; ``folder`` takes the files."""
    subject = builtin_subject()
    faults = []
    for fault, make in BAD_SCANS.items():
        bad = make(subject, folder)
        seconds, found = checked(bad.path, folder / "out", bad.landmarks, role="neutral")
        codes = [finding["code"] for finding in found["findings"]]
        named = is_named(bad, found)
        faults.append(
            {
                "fault": fault,
                "expected": bad.code,
                "named": named,
                "verdict": found["verdict"],
                "found": codes,
                "seconds": round(seconds, 2),
            }
        )
    good = [
        {"scan": name, "verdict": found["verdict"], "alarms": _alarms(found)}
        for name, role, surface in good_scans(options.faces)
        for _, found in [checked(_written(folder, name, surface), folder / "out", None, role=role)]
    ]
    raw = [
        {"scan": path.name, "verdict": found["verdict"], "findings": _alarms(found)}
        for path in sorted(options.scans.glob("*/*.obj") if options.scans else [])
        for _, found in [checked(path, folder / "out", None, role="unknown")]
    ]
    return {
        "faults": faults,
        "not_named": [entry["fault"] for entry in faults if not entry["named"]],
        "good": good,
        "false_alarms": sum(len(entry["alarms"]) for entry in good),
        "raw": raw,
        "seconds": {str(size): round(timed(subject, size, folder), 2) for size in SIZES},
    }


def section(figures: dict[str, Any]) -> Section:
    """Return the document's section."""
    faults = [
        [entry["fault"], f"`{entry['expected']}`", entry["named"], entry["verdict"]]
        for entry in figures["faults"]
    ]
    seconds = [[int(size), value] for size, value in figures["seconds"].items()]
    alarmed = sum(bool(entry["alarms"]) for entry in figures["good"])
    return Section(
        title="The check of raw scans",
        compared=(
            "One bad scan for every fault, made from the built-in head: the check has to name the "
            f"fault and give the verdict. {len(figures['good'])} good scans, in which it has to "
            f"find nothing: it found something in {alarmed}."
        ),
        parts=[
            Table(["vertices", "seconds"], seconds, "Time of a check:"),
            Table(["fault", "finding", "named", "verdict"], faults, "Faults:"),
        ],
    )


def builtin_subject() -> Subject:
    """Return the built-in person for making bad scans from."""
    return Subject(
        head=builtin_expression({}),
        closed_eyes=builtin_expression(BLINK),
        open_mouth=builtin_expression({"jawOpen": 0.5}),
        template=builtin_template(),
    )


def is_named(bad: BadScan, found: dict[str, Any]) -> bool:
    """Return whether a check's report has the fault, as grave as it is, and the verdict."""
    severity = {"usable": "warning", "bad": "error"}[bad.verdict]
    told = {(finding["code"], finding["severity"]) for finding in found["findings"]}
    return (bad.code, severity) in told and found["verdict"] == bad.verdict


def dense(surface: Surface, times: int) -> Surface:
    """Return a surface with its edges halved so many times, as dense as a scanner leaves it."""
    used, faces = np.unique(surface.faces, return_inverse=True)
    fine = igl.upsample(surface.vertices[used], faces.reshape(-1, 3).astype(np.int64), times)
    return Surface(np.asarray(fine[0]), np.asarray(fine[1], np.int64))


def good_scans(faces: Path | None) -> Iterator[tuple[str, str, Surface]]:
    """Return name, role and surface of scans without a fault, a vertex every 1.5 mm or so."""
    sets = {"built-in": (builtin_capture_set(), 2)}
    if faces is not None:
        sets |= {subject: (ict_capture_set(faces, subject), 1) for subject in SUBJECTS}
    for name, (captures, times) in sets.items():
        yield f"{name}-neutral", "neutral", dense(captures.neutral, times)
        for expression, surface in {**captures.train, **captures.test}.items():
            yield f"{name}-{expression}", "expression", dense(surface, times)


def checked(
    scan: Path, out: Path, landmarks: Path | None, *, role: str
) -> tuple[float, dict[str, Any]]:
    """Return the seconds of a check and its report."""
    start = time.perf_counter()
    report_file, _ = run_job("check_scan", out, scan=scan, landmarks=landmarks, role=role)
    seconds = time.perf_counter() - start
    return seconds, json.loads(report_file.read_text(encoding="utf-8"))


def timed(subject: Subject, vertices: int, folder: Path) -> float:
    """Return the seconds of a check of a head with at least that many ``vertices``."""
    mesh = trimesh.Trimesh(subject.head.vertices, subject.head.faces, process=False)
    while len(mesh.vertices) < vertices:
        mesh = mesh.subdivide()
    noise = np.random.default_rng(1).normal(0, 0.1, mesh.vertices.shape)
    keep = vertices / len(mesh.vertices)
    surface = Surface(np.asarray(mesh.vertices) + noise, np.asarray(mesh.faces, np.int64))
    if keep < 0.7:  # points nearest the size asked for: leave out the back of the head
        depth = surface.vertices[surface.faces].mean(axis=1)[:, 2]
        surface = Surface(surface.vertices, surface.faces[depth > np.quantile(depth, 1 - keep)])
    path = _written(folder, f"timed-{vertices}", surface)
    return checked(path, folder / "out", None, role="unknown")[0]


def _written(folder: Path, name: str, surface: Surface) -> Path:
    path = folder / f"{name}.obj"
    used, faces = np.unique(surface.faces, return_inverse=True)
    write_obj(path, Surface(surface.vertices[used], faces.reshape(-1, 3)))
    return path


def _alarms(found: dict[str, Any]) -> list[dict[str, Any]]:
    return [finding for finding in found["findings"] if finding["severity"] != "info"]


if __name__ == "__main__":
    main()
