"""Round trip: random plausible activations are simulated, and fitted again to the skin alone.

Every set excites both sides of some muscles, unlike each other, by contractions along their fibres
that keep the muscle's volume, and opens the jaw. ``skin_mm`` is the mean distance between the
simulated and the fitted skin, ``activation_error`` the difference of the excited muscles'
activations by their distance from rest; the worst set is at top level. The fit starts at rest and
is the one of a rig's certificate. The same of fibre muscles, without and with noise, is part of
:mod:`benchmarks.fibres`.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np

from benchmarks import report, subjects
from benchmarks.documents import Figures, Section, Table
from benchmarks.subjects import COARSE_EDGE_MM, EDGE_MM
from solver.drawing.head import both_sides
from solver.fitting import activation
from solver.fitting.activation import ActivationOptions
from solver.fitting.face import Face, Pose
from solver.fitting.objective import Regulariser, SkinDistance, Target
from solver.fitting.stretches import fibre_tensors, shorten
from solver.mechanics.flesh import IDENTITY
from solver.rig.round_trip import round_trip

log = logging.getLogger(__name__)

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


@dataclass(frozen=True)
class FibreTripOptions:
    """Random poses of fibre muscles, and the second fit's light regulariser by the noise."""

    sets: int = 4
    excited: int = 8  # kinds of muscles of a set, both sides counting as one
    activation: tuple[float, float] = (0.2, 0.8)
    asymmetry: float = 0.1
    opening: tuple[float, float] = (0.0, 0.2)
    noise_mm: tuple[float, float] = (0.0, 0.3)
    w_a: tuple[float, float] = (1e-7, 1e-4)
    w_b: float = 1e-9


def fibre_round_trip(
    face: Face, names: tuple[str, ...], trip: FibreTripOptions = FibreTripOptions()
) -> Figures:
    """Return what comes back of random activations of fibre muscles with these names."""
    found: dict[float, list[float]] = {noise: [] for noise in trip.noise_mm}
    skin, outside, sets = [], 0, []
    for seed in range(trip.sets):
        rng = np.random.default_rng(seed)
        pose = _fibre_pose(face, names, rng, trip)
        truth = face.continuation(face.rest, pose)
        points = face.face_points(truth.x)
        row: Figures = {"seed": seed}
        for noise, w_a in zip(trip.noise_mm, trip.w_a, strict=True):
            seen = points + noise * rng.standard_normal(points.shape)
            data = SkinDistance(face, Target.from_points(seen))
            light = Regulariser(w_a, 0.0, trip.w_b, face.rest_pose())
            stop = ActivationOptions(40, tolerance=1e-6)
            state = activation.fit(face, data, light, options=stop).state
            a = state.pose.a
            error = float(np.sqrt(np.mean((a - pose.a) ** 2)))
            found[noise].append(error)
            off = float(np.linalg.norm(face.face_points(state.x) - points, axis=1).mean())
            outside += int(((a < 0.0) | (a > 1.0)).sum())
            row[f"noise_{noise:g}"] = {"activation_rms": error, "skin_mm": off}
            if noise == 0.0:
                skin.append(off)
                worst = np.argsort(-np.abs(a - pose.a))[:3]
                row["worst"] = {names[k]: [float(pose.a[k]), float(a[k])] for k in worst}
        log.info("%s", row)
        sets.append(row)
    without, noisy = (max(found[noise]) for noise in trip.noise_mm)
    return {
        "activation_rms": without,
        "noisy_activation_rms": noisy,
        "skin_mm": max(skin),
        "out_of_bounds": outside,
        "sets": sets,
    }


def _fibre_pose(
    face: Face, names: tuple[str, ...], rng: np.random.Generator, trip: FibreTripOptions
) -> Pose:
    """Return a pose of some muscles, both sides alike but for a little, with the jaw open."""
    kinds = list(dict.fromkeys(both_sides(name) for name in names))
    chosen = rng.choice(kinds, trip.excited, replace=False)
    depth = {str(kind): rng.uniform(*trip.activation) for kind in chosen}
    a = np.zeros(len(names))
    for muscle, name in enumerate(names):
        if (kind := both_sides(name)) in depth:
            a[muscle] = depth[kind] + rng.uniform(-trip.asymmetry, trip.asymmetry)
    b = np.zeros(5)
    b[0] = rng.uniform(*trip.opening)
    return Pose(a, b, face.layout)


if __name__ == "__main__":
    main()
