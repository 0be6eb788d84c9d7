"""Raw scans into a template's topology: real ones, and spoilt ones whose vertices are known.

``raw`` are the scans in ``--data``/scans: distances from the registered face to the scan over the
part that the scan shows, the worst scan. ``corrupted`` are subjects of the capture sets, scanned
by :mod:`benchmarks.corruption`: distances of the face skin's vertices from where they are known to
be, without any alignment afterwards (``aligned`` with a rigid one), and errors of the displacement
from neutral to expression. These subjects are made of the very shapes that the ICT-FaceKit template
knows, so they are registered again with a template that knows only every second identity and
expression (``..._with_half_the_shapes``), and all with one that knows none
(``..._without_shapes``).
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import igl
import numpy as np

from benchmarks import report
from benchmarks.corruption import Corruption, corrupted
from benchmarks.documents import Section, Table
from solver.anatomy.template import ShapeBasis, Template
from solver.meshio.raw import RawScan, mend, read_raw
from solver.registration.register import RegisteredFace, register
from solver.registration.topology import Topology, topology
from solver.similarity import weighted_motion
from solver.surface import Floats, Surface
from solver.templates.ict_facekit import ict_capture_set
from solver.templates.ict_template import build_ict_template

RAW = ("meshmonk/DemoFace_10K.obj", "menpo3d/james.obj")
UNITS_MM = (1.0, 10.0, 1000.0, 25.4)
Figures = dict[str, Any]


def main() -> None:
    """Run from the command line."""
    parser = report.parser(__doc__ or "")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--faces", type=Path, help="folder of ICT-FaceKit (default: in --data)")
    parser.add_argument("--anatomy", type=Path, help="folder of BodyParts3D (default: in --data)")
    parser.add_argument("--template", type=Path, help="a template that is already built")
    parser.add_argument("--subjects", default="A,B,C", help="of the capture sets")
    parser.add_argument("--expressions", type=int, default=4, help="of each subject")
    parser.add_argument("--seed", type=int, default=0, help="of noise, holes and poses")
    options = parser.parse_args()
    report.finish(run(options), options, section)


def run(options: argparse.Namespace) -> Figures:
    """Register every scan and return the figures."""
    faces = options.faces or options.data / "ict_facekit"
    if options.template is not None:
        template = Template.load(options.template)
    else:
        template = build_ict_template(options.anatomy or options.data / "bodyparts3d", faces)
    known = topology(template)
    plain = topology(replace(template, shapes=None))
    half = topology(replace(template, shapes=_half(template.shapes)))
    subjects = options.subjects.split(",")[: 1 if options.quick else None]
    count = 1 if options.quick else options.expressions
    scans = options.data / "scans"

    def spoilt(into: Topology) -> Figures:
        people = {
            name: _subject(into, faces, name, number, count, options.seed)
            for number, name in enumerate(subjects)
        }
        return _together(people)

    return {
        "template": template.name,
        "raw": raw_scans(known, scans),
        "raw_without_shapes": raw_scans(plain, scans),
        "corrupted": spoilt(known),
        "corrupted_with_half_the_shapes": spoilt(half),
        "corrupted_without_shapes": spoilt(plain),
    }


def section(figures: Figures) -> Section:
    """Return the document's section."""
    raw = {
        "mean_surface_mm": "mean, mm",
        "p95_surface_mm": "95 % below, mm",
        "scan_to_face_mean_mm": "scan to face, mm",
        "coverage": "covered",
        "folded": "folds",
        "seconds": "seconds",
    }
    corrupted = {
        "mean_vertex_mm": "mean, mm",
        "worst_vertex_mm": "worst scan, mm",
        "aligned_vertex_mm": "aligned, mm",
        "expression_displacement_error_mm": "displacement, mm",
        "folded": "folds",
        "seconds": "seconds",
    }

    def table(kind: str, columns: dict[str, str], caption: str) -> Table:
        known = {
            f"{kind}": "all",
            f"{kind}_with_half_the_shapes": "every second",
            f"{kind}_without_shapes": "none",
        }
        rows = [
            [words, *(figures[run][key] for key in columns)]
            for run, words in known.items()
            if run in figures
        ]
        return Table(["the template's shapes", *columns.values()], rows, caption)

    return Section(
        title="Registration",
        compared=(
            f"Raw scans into the topology of `{figures['template']}`, by a template that knows "
            "shapes of identities and expressions, every second one of them, or none. Real scans "
            "are compared with the registered surface; corrupted ones (noise, holes, pose, unit) "
            "with where every vertex of the face is known to be, without any alignment "
            "(`aligned`: with a rigid one)."
        ),
        parts=[
            table("raw", raw, "Two real scans, the worse of both:"),
            table("corrupted", corrupted, "Corrupted scans of subjects:"),
        ],
    )


def _half(shapes: ShapeBasis | None) -> ShapeBasis | None:
    if shapes is None:
        return None
    return ShapeBasis(shapes.identity[::2], shapes.expressions[::2], shapes.expression_names[::2])


def raw_scans(known: Topology, folder: Path) -> Figures:
    """Register the raw scans in ``folder``; return figures of each and of the worst."""
    scans = {}
    for name in RAW:
        found, seconds = _timed(read_raw(folder / name), known)
        scans[Path(name).stem] = {**_distances(found, known), "seconds": seconds}
    values = list(scans.values())
    worst = ("mean_surface_mm", "p95_surface_mm", "scan_to_face_mean_mm", "folded", "seconds")
    return {
        **{key: max(value[key] for value in values) for key in worst},
        "coverage": min(value["coverage"] for value in values),
        "scans": scans,
    }


def _distances(found: RegisteredFace, known: Topology) -> Figures:
    seen = known.face[found.trust.covered[known.face]]
    distance = found.trust.distance_mm[seen]
    return {
        "mean_surface_mm": float(distance.mean()),
        "p95_surface_mm": float(np.percentile(distance, 95)),
        "max_surface_mm": float(distance.max()),
        "scan_to_face_mean_mm": _scan_to_face(found, known),
        "coverage": len(seen) / len(known.face),
        "folded": len(found.folded),
    }


def _scan_to_face(found: RegisteredFace, known: Topology) -> float:
    """Return the mean distance of the scan's points that lie on the inside of the face."""
    is_face = np.zeros(len(found.skin.vertices), dtype=bool)
    is_face[known.face] = True
    faces = found.skin.faces[is_face[found.skin.faces].all(axis=1)]
    points = found.motion(found.scan.vertices)
    squared, face, _ = igl.point_mesh_squared_distance(points, found.skin.vertices, faces)
    rim = np.unique(igl.boundary_facets(faces)[0])
    inside = ~np.isin(faces[face], rim).any(axis=1) & (squared < 10.0**2)
    return float(np.sqrt(squared[inside]).mean())


def _subject(
    known: Topology, folder: Path, name: str, number: int, count: int, seed: int
) -> Figures:
    captures = ict_capture_set(folder, name)
    # a different part of the expressions for every subject, seen and unseen ones
    everything = list({**captures.train, **captures.test}.items())
    turned = everything[number * count :] + everything[: number * count]
    first = 1000 * seed + 100 * number
    face = known.template.face_vertices
    truth = captures.neutral.vertices
    raw = _spoilt(captures.neutral, first)
    neutral, seconds = _timed(raw, known)
    figures = {"neutral": {**_errors(neutral, truth, known), "seconds": seconds}}
    for turn, (expression, surface) in enumerate(islice(turned, count), start=1):
        raw = _spoilt(surface, first + turn)
        found, seconds = _timed(raw, known, neutral.skin.vertices)
        moved = found.skin.vertices - neutral.skin.vertices
        error = np.linalg.norm(moved - (surface.vertices - truth), axis=1)[face]
        figures[expression] = {
            **_errors(found, surface.vertices, known),
            "displacement_error_mm": float(error.mean()),
            "seconds": seconds,
        }
    return figures


def _spoilt(surface: Surface, seed: int) -> RawScan:
    unit = UNITS_MM[seed % len(UNITS_MM)]
    return corrupted(surface, seed, Corruption(unit_mm=unit))


def _errors(found: RegisteredFace, truth: Floats, known: Topology) -> Figures:
    face = known.template.face_vertices
    vertices = found.skin.vertices
    motion = weighted_motion(vertices[face], truth[face], np.ones(len(face)))
    error = np.linalg.norm(vertices - truth, axis=1)[face]
    aligned = np.linalg.norm(motion(vertices[face]) - truth[face], axis=1)
    return {
        "mean_vertex_mm": float(error.mean()),
        "aligned_vertex_mm": float(aligned.mean()),
        "max_vertex_mm": float(error.max()),
        "coverage": float(found.trust.covered[known.face].mean()),
        "folded": len(found.folded),
    }


def _together(people: dict[str, Figures]) -> Figures:
    scans = [figures for person in people.values() for figures in person.values()]
    moved = [scan["displacement_error_mm"] for scan in scans if "displacement_error_mm" in scan]
    vertex = [scan["mean_vertex_mm"] for scan in scans]
    return {
        "mean_vertex_mm": float(np.mean(vertex)),
        "worst_vertex_mm": max(vertex),
        "aligned_vertex_mm": float(np.mean([scan["aligned_vertex_mm"] for scan in scans])),
        "expression_displacement_error_mm": float(np.mean(moved)),
        "worst_displacement_error_mm": max(moved),
        "folded": sum(scan["folded"] for scan in scans),
        "seconds": max(scan["seconds"] for scan in scans),
        "subjects": people,
    }


def _timed(
    raw: RawScan, known: Topology, neutral: Floats | None = None
) -> tuple[RegisteredFace, float]:
    start = time.perf_counter()
    found = register(mend(raw)[0], known, neutral)
    return found, time.perf_counter() - start


if __name__ == "__main__":
    main()
