"""Round trip: random plausible activations are simulated, and fitted again to the skin alone.

Every set excites both sides of some muscles, unlike each other, by contractions along their fibres
that keep the muscle's volume, and opens the jaw. ``skin_mm`` is the mean distance between the
simulated and the fitted skin, ``activation_error`` the difference of the excited muscles'
activations by their distance from rest; the worst set is at top level. The fit starts at rest and
is the one of a rig's certificate.
"""

from __future__ import annotations

import numpy as np

from benchmarks import report, subjects
from benchmarks.documents import Figures, Section, Table
from benchmarks.subjects import COARSE_EDGE_MM, EDGE_MM
from solver.drawing.head import both_sides
from solver.fitting.face import Face, Pose
from solver.fitting.stretches import fibre_tensors, shorten
from solver.mechanics.flesh import IDENTITY
from solver.rig.round_trip import round_trip

SETS = 3
EXCITED = 8
"""Muscles of a set, both sides counting as one."""

CONTRACTION = (0.7, 0.95)
ASYMMETRY = 0.05
OPENING = (0.0, 0.2)
FORWARD_MM = 20.0
"""The condyles' path by the opening in radians."""


def main() -> None:
    """Run from the command line."""
    parser = report.parser(__doc__ or "")
    subjects.add_options(parser)
    options = parser.parse_args()
    model, _ = subjects.load(options, COARSE_EDGE_MM if options.quick else EDGE_MM)
    face = Face(model)
    sets = [_measure(face, seed) for seed in range(SETS)]
    figures: Figures = {
        "vertices": len(model.rest),
        "tets": len(model.tets),
        "skin_mm": max(each["skin_mm"] for each in sets),
        "activation_error": max(each["activation_error"] for each in sets),
        "sets": sets,
    }
    report.finish(figures, options, section)


def section(figures: Figures) -> Section:
    """Return the section of docs/science/benchmarks.md."""
    columns = {
        "seed": "set",
        "muscles": "excited muscles",
        "opening_deg": "jaw opens, degrees",
        "moved_mm": "skin moves, mm",
        "skin_mm": "skin error, mm",
        "skin_max_mm": "greatest, mm",
        "activation_error": "activation error",
    }
    rows = [[each[key] for key in columns] for each in figures["sets"]]
    return Section(
        title="Round trip",
        compared="Random plausible activations are simulated, and fitted again to the simulated "
        f"skin, from rest ({figures['vertices']:,} vertices, {figures['tets']:,} tets).",
        parts=[Table(list(columns.values()), rows)],
    )


def _measure(face: Face, seed: int) -> Figures:
    pose = plausible_pose(face, np.random.default_rng(seed))
    simulated = face.face_points(face.continuation(face.rest, pose).x)
    moved = np.linalg.norm(simulated - face.face_points(face.rest.x), axis=1)
    trip = round_trip(face, pose, simulated)
    return {
        "seed": seed,
        "muscles": int((pose.a != IDENTITY).any(axis=1).sum()),
        "opening_deg": float(np.degrees(pose.b[0])),
        "moved_mm": float(moved.mean()),
        "skin_mm": trip.refit_mean_mm,
        "skin_max_mm": trip.refit_max_mm,
        "activation_error": trip.activation_error,
    }


def plausible_pose(face: Face, rng: np.random.Generator) -> Pose:
    """Return a random pose that living muscles and jaws can take."""
    model = face.model
    tensors = fibre_tensors(model, face.flesh.volumes, model.weights)
    kinds = list(dict.fromkeys(both_sides(name) for name in model.muscle_names))
    chosen = rng.choice(kinds, EXCITED, replace=False)
    depth = {str(kind): rng.uniform(*CONTRACTION) for kind in chosen}
    a = np.tile(IDENTITY, (model.muscle_count, 1))
    for muscle, name in enumerate(model.muscle_names):
        if (kind := both_sides(name)) in depth:
            side = depth[kind] + rng.uniform(-ASYMMETRY, ASYMMETRY)
            a[muscle] = shorten(tensors[muscle], side)
    opening = rng.uniform(*OPENING)
    return Pose(a, np.array([opening, 0.0, 0.0, 0.0, FORWARD_MM * opening]))


if __name__ == "__main__":
    main()
