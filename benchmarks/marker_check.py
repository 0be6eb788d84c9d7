"""The check of takes of markers: how long it takes, what it finds, and what it tells falsely.

Real takes have nothing wrong that matters but an unclear rest, so that all else told of them is
false. Twenty faults are planted into a copy of each that is long enough, one at a time, and have to
be named with the right label and frame (``bad_takes.py``). A made take of the template's face, 80
markers in 60 s of expressions with a turning head, is written as TRC, the slowest format, and
checked as a job.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import tempfile
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks import report
from benchmarks.bad_takes import BAD_TAKES
from benchmarks.documents import Figures, Section, Table
from benchmarks.speed.clock import Stopwatch
from solver.anatomy.template import Template
from solver.anatomy.warp import spread
from solver.jobs import run_job
from solver.registration.locate import face_surface
from solver.scans.markers.check import check_take
from solver.scans.markers.places.bind import Reference
from solver.scans.markers.readers.take import read_take
from solver.surface import Floats, vertex_normals
from solver.templates.builtin.build import builtin_template

MARKERS = 80
SECONDS = 60
RATE = 60
HEIGHT_MM = 2.0
NOISE_MM = 0.15
TURN_DEG = 15.0
SHAPES = 12  # expressions that the made face moves through
LEAST_FRAMES = 960  # of a real take in which faults are planted
TRUE = ("markers.unclear_rest",)  # of real takes: the jaw goes back for a third of one

log = logging.getLogger(__name__)


def main() -> None:
    """Run from the command line."""
    data = Path(os.environ.get("MYOFACE_DATA", Path(__file__).parents[2] / "shared" / "data"))
    parser = report.parser(__doc__ or "")
    parser.add_argument("--takes", type=Path, help="folder of real takes, C3D")
    if data.is_dir():
        parser.set_defaults(takes=data / "markers" / "animface")
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    report.finish(run(options), options, section)


def run(options: argparse.Namespace) -> Figures:
    """Measure everything and return the figures."""
    template = builtin_template()
    seconds, verdict = _time_job(template, SECONDS // 6 if options.quick else SECONDS)
    log.info("a made take: %s after %.1f s", verdict, seconds)
    reference = Reference(face_surface(template))
    takes = [read_take(path) for path in sorted(options.takes.glob("*.c3d"))]
    clean = {take.file: check_take(take, reference).findings for take in takes}
    told = [
        f"{file}: {each.message}"
        for file, findings in clean.items()
        for each in findings
        if each.severity != "info" and each.code not in TRUE
    ]
    log.info("false: %s", told)
    faults: dict[str, dict[str, bool]] = {name: {} for name in BAD_TAKES}
    beside: list[str] = []
    for take in takes[:1] if options.quick else takes:
        if len(take) < LEAST_FRAMES:
            continue
        for name, bad in BAD_TAKES.items():
            findings = check_take(bad.spoil(take), reference).findings
            faults[name][take.file] = bad.is_found(take, findings)
            others = [each for each in bad.others(findings) if each.code not in TRUE]
            beside += [f"{take.file}, {name}: {each.message}" for each in others]
            if not faults[name][take.file]:
                log.info("%s: %s not found: %s", take.file, name, [e.message for e in findings])
    return {
        "check": {
            "seconds": round(seconds, 2),
            "verdict": verdict,
            "planted": len(faults),
            "found": sum(all(each.values()) for each in faults.values()),
            "false": len(told),
            "false_beside": len(beside),  # told in spoilt takes, and not of what was planted
            "takes": sorted(clean),
        },
        "faults": faults,
        "told": told + beside,
    }


def _time_job(template: Template, seconds: int) -> tuple[float, str]:
    """Return how long a job takes to read and check a made take, and its verdict."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = folder / "made.trc"
        _write_trc(path, _made_positions(template, seconds * RATE))
        with Stopwatch() as watch:
            run_job("check_markers", folder / "out", markers=path)
        return watch.seconds, json.loads((folder / "out" / "check.json").read_text())["verdict"]


def _made_positions(template: Template, frames: int) -> Floats:
    """Return markers (f, k, 3) spread over the face, moving through expressions."""
    assert template.shapes is not None
    rng = np.random.default_rng(0)
    time_ = np.arange(frames) / RATE
    skin = template.skin
    candidates = np.unique(face_surface(template).faces)
    sites = candidates[spread(skin.vertices[candidates], MARKERS)]
    rest = (skin.vertices + HEIGHT_MM * vertex_normals(skin))[sites]
    shapes = template.shapes.expressions[:SHAPES, sites].astype(float)
    moving = np.clip(time_ - 2.0, 0.0, 1.0)  # at rest for two seconds
    phases = 2 * np.pi * (time_[:, None] / rng.uniform(2.0, 5.0, SHAPES) + rng.random(SHAPES))
    weights = moving[:, None] * np.clip(np.sin(phases), 0.0, None) ** 2
    face = rest + np.einsum("fs,skd->fkd", weights, shapes)
    angles = moving[:, None] * TURN_DEG * np.sin(np.outer(time_, [0.9, 0.5, 0.7]))
    turns = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    moved = np.einsum("fij,fkj->fki", turns, face) + np.array([120.0, 900.0, 60.0])
    return np.asarray(moved + NOISE_MM * rng.standard_normal(moved.shape))


def _write_trc(path: Path, points: Floats) -> None:
    frames, count = points.shape[:2]
    names = [f"M{number:03d}" for number in range(count)]
    axes = [f"{axis}{number + 1}" for number in range(count) for axis in "XYZ"]
    lines = [
        "PathFileType\t4\t(X/Y/Z)\tmade.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits",
        f"{RATE}\t{RATE}\t{frames}\t{count}\tmm",
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t",
        "\t\t" + "\t".join(axes),
    ]
    for number, row in enumerate(points.reshape(frames, -1)):
        lines.append(f"{number + 1}\t{number / RATE:.6f}\t" + "\t".join(f"{v:.4f}" for v in row))
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def section(figures: Figures) -> Section:
    """Return the section of docs/science/benchmarks.md."""
    check = figures["check"]
    words = {
        "seconds": f"s for {SECONDS} s of {MARKERS} markers",
        "found": f"found of {check['planted']} planted faults",
        "false": "told falsely of real takes",
        "false_beside": "told beside a planted fault",
    }
    takes = check["takes"]
    rows = [
        [name, *(found.get(take) for take in takes)] for name, found in figures["faults"].items()
    ]
    return Section(
        title="The check of markers",
        compared="Real takes of one man's face (40 markers, 60 Hz), which have nothing wrong, as "
        "they are and with faults planted: each has to be named with its label and the frame in "
        "which it begins.",
        parts=[
            Table([*words.values()], [[check[key] for key in words]]),
            Table(["planted", *takes], rows),
        ],
    )


if __name__ == "__main__":
    main()
