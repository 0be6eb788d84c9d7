"""Round trip: known activations are simulated, and fitted again to the skin alone.

The parts, of which ``--parts`` names some:

``plausible``: by the geometric S. Every set excites both sides of some muscles, unlike each other,
    by contractions along their fibres that keep the muscle's volume, and opens the jaw. ``skin_mm``
    is the mean distance between the simulated and the fitted skin, ``activation_error`` the
    difference of the excited muscles' activations by their distance from rest; the worst set is at
    top level. The fit starts at rest and is the one of a rig's certificate. The same of fibre
    muscles, without and with noise, is part of :mod:`benchmarks.fibres`.
``named``: by the S of ``--rig``, or one that is fitted to the training scans and left there. The
    muscles contract that texts name for drawn mixtures of units (:mod:`benchmarks.strong`), the
    skin gets noise, and is fitted as a scan is that S was not fitted to. ``found_again`` has, for
    what the fit was told of, the ``correlation`` of contractions over all muscles, the mean of the
    mixtures, and of the worst the root mean square of what contractions are off.
``refitted``: the same by a face that does not know the true S: its own is fitted, from the
    anatomy's, to five other such skins.
"""

from __future__ import annotations

import argparse
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from benchmarks import report, subject_fits, subjects
from benchmarks.documents import Figures, Section, Table
from benchmarks.prime_movers import drawn_shapes
from benchmarks.strong import DrawOptions, called_actions, draw_mixtures
from benchmarks.subject_fits import Fits
from benchmarks.subjects import COARSE_EDGE_MM, EDGE_MM
from solver.anatomy.action_units import is_one_of
from solver.animation.blendshapes import keep_within
from solver.drawing.head import both_sides, muscle_side
from solver.errors import SolveError
from solver.fitting import activation
from solver.fitting.activation import ActivationOptions
from solver.fitting.face import Face, Pose
from solver.fitting.known import FaceMuscles
from solver.fitting.objective import Regulariser, SkinDistance, Target
from solver.fitting.stretches import fibre_tensors, isochoric_activation
from solver.mechanics.flesh import IDENTITY
from solver.rig.report.certificate import muscles
from solver.rig.round_trip import round_trip
from solver.scans.known_activations import KnownMuscles
from solver.surface import Floats, Surface

log = logging.getLogger(__name__)

SETS = 3
MIXTURES = 15
QUICK_MIXTURES = 3
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
    subjects.add_controls(parser)
    report.add_list(parser, "--parts", PARTS)
    parser.add_argument(
        "--rig", type=Path, help="rig.npz of S: read if there, else S is left in it"
    )
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    figures: Figures = {}
    for part in options.parts:
        figures |= PARTS[part](options)
    report.finish(figures, options, section)


def _plausible(options: argparse.Namespace) -> Figures:
    model, _ = subjects.load(options, COARSE_EDGE_MM if options.quick else EDGE_MM)
    face = Face(model)
    sets = [_measure(face, seed) for seed in range(SETS)]
    return {
        "vertices": len(model.rest),
        "tets": len(model.tets),
        "skin_mm": max(each["skin_mm"] for each in sets),
        "activation_error": max(each["activation_error"] for each in sets),
        "sets": sets,
    }


def _named(options: argparse.Namespace) -> Figures:
    face = subject_fits.face_of_rig(options, options.rig)
    trip = _trip(options)
    simulated = simulate(face, _draw(face, options, trip.draw), trip)
    return {"found_again": found_again(face, simulated)}


def _refitted(options: argparse.Namespace) -> Figures:
    face = subject_fits.face_of_rig(options, options.rig)
    trip = _trip(options)
    draw = replace(trip.draw, count=trip.draw.count + trip.trained)
    train, test = simulate(face, _draw(face, options, draw), trip).divided(trip.trained)
    schedule = subjects.schedule(options, face.model, quick=options.quick)
    fits = subject_fits.by_geometry(Face(face.model), train.scans, schedule)
    return {"refitted_mm": fits.mean_mm, "refitted": found_again(fits.face, test)}


def _trip(options: argparse.Namespace) -> NamedTripOptions:
    return NamedTripOptions(draw=DrawOptions(count=QUICK_MIXTURES if options.quick else MIXTURES))


def _draw(
    face: Face, options: argparse.Namespace, draw: DrawOptions
) -> dict[str, dict[str, float]]:
    return draw_mixtures(drawn_shapes(face.model, subjects.shapes(options)), draw)


PARTS: dict[str, Callable[[argparse.Namespace], Figures]] = {
    "plausible": _plausible,
    "named": _named,
    "refitted": _refitted,
}


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
    parts: list[Table | str] = []
    if "sets" in figures:
        rows = [[each[key] for key in columns] for each in figures["sets"]]
        words = f"{figures['vertices']:,} vertices, {figures['tets']:,} tets"
        parts.append(Table(list(columns.values()), rows, f"By the geometric S ({words})"))
    by_S = {"found_again": "the true S", "refitted": "an S of five skins"}
    heads = ["by", "of", "correlation", "of the worst mixture", "contractions off, worst"]
    found = [
        [words, told, each["correlation"], each["correlation_least"], each["contraction_rms"]]
        for key, words in by_S.items()
        for told, each in figures.get(key, {}).items()
    ]
    if found:
        parts.append(Table(heads, found, "Muscles of mixtures of units found again"))
    return Section(
        title="Round trip",
        compared="Known activations are simulated, and fitted again to the simulated skin, from "
        "rest: random plausible ones by the geometric S, and by a rig's S those of the muscles "
        "that texts name for mixtures of action units, with noise on the skin.",
        parts=parts,
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
            a[muscle] = isochoric_activation(tensors[muscle], side)
    opening = rng.uniform(*OPENING)
    return Pose(a, np.array([opening, 0.0, 0.0, 0.0, FORWARD_MM * opening]))


@dataclass(frozen=True)
class NamedTripOptions:
    """Muscles that mixtures of units name, how far they contract, and the noise on the skin."""

    draw: DrawOptions = field(default_factory=DrawOptions)
    contraction: tuple[float, float] = (0.1, 0.3)
    asymmetry: float = 0.03  # difference of a side from that, at most
    opening: tuple[float, float] = OPENING  # of the jaw, where a unit opens it
    noise_mm: float = 0.2  # sd of each coordinate of each vertex
    trained: int = 5  # mixtures that S is fitted to anew
    seed: int = 0


@dataclass(frozen=True)
class EmgOptions:
    """Channels of EMG that a fit may be told, of the whole muscles that contract most."""

    channels: int = 6
    sd: float = 0.1
    seed: int = 1


def _by_emg(
    face: Face,
    scans: Mapping[str, Surface],
    truths: Mapping[str, Floats],
    emg: EmgOptions = EmgOptions(),
) -> Fits:
    """Fit with some muscles of each scan known, as channels of EMG have them."""
    rng = np.random.default_rng(emg.seed)
    known = {}
    own = FaceMuscles.of(face)
    wholes = tuple(dict.fromkeys(face.model.muscle_groups))
    for scan, contractions in truths.items():
        true = own.means(wholes, contractions)
        chosen = np.argsort(-true)[: emg.channels]
        values = true[chosen] + emg.sd * rng.standard_normal(len(chosen))
        names = tuple(wholes[number] for number in chosen)
        known[scan] = KnownMuscles(names, values, np.full(len(chosen), emg.sd))
    return subject_fits.by_activations(face, scans, known)


# What a fit is told -> the fit of scans, by the contractions (m,) that are true in each: it may be
# told some of them.
Told = Callable[[Face, Mapping[str, Surface], Mapping[str, Floats]], Fits]
TOLD: dict[str, Told] = {
    "skin alone": lambda face, scans, _: subject_fits.by_activations(_unexpecting(face), scans),
    "skin and anatomy": lambda face, scans, _: subject_fits.by_activations(face, scans),
    "skin, anatomy and EMG of six muscles": _by_emg,
}


def _unexpecting(face: Face) -> Face:
    """Return a face of whose muscles nothing is expected in any expression."""
    unknown = Face(replace(face.model, expressions=None), face.S)
    return unknown.driven_as(face.drive)


@dataclass(frozen=True)
class Simulated:
    """Noisy skins of known activations by name, with the true contractions (m,) in each.

    ``unreached`` mixtures are left out, as they are not reached from rest.
    """

    scans: dict[str, Surface]
    truths: dict[str, Floats]
    unreached: int = 0

    def divided(self, count: int) -> tuple[Simulated, Simulated]:
        """Return the first so many, and the others."""
        names = list(self.scans)
        return self._of(names[:count]), self._of(names[count:])

    def _of(self, names: list[str]) -> Simulated:
        scans = {name: self.scans[name] for name in names}
        return replace(self, scans=scans, truths={name: self.truths[name] for name in names})


def simulate(
    face: Face,
    mixtures: Mapping[str, Mapping[str, float]],
    trip: NamedTripOptions = NamedTripOptions(),
) -> Simulated:
    """Simulate the muscles of mixtures, name -> shape -> weight, with noise on the skin."""
    rng = np.random.default_rng(trip.seed)
    found = Simulated({}, {})
    for name, weights in mixtures.items():
        pose = named_pose(face, weights, rng, trip)
        noise = trip.noise_mm * rng.standard_normal(face.model.skin.vertices.shape)
        try:
            x = face.continuation(face.rest, pose).x
        except SolveError as error:
            log.warning("%s: %s", name, error)
            continue
        found.truths[name] = _contraction(face, pose.a)
        found.scans[name] = face.model.skin.with_vertices(face.whole_skin(x, pose.b) + noise)
    return replace(found, unreached=len(mixtures) - len(found.scans))


def found_again(face: Face, simulated: Simulated) -> Figures:
    """Return what comes back of known contractions by a face, and by all of :data:`TOLD`."""
    return {
        told: {
            **_compare(simulated.truths, fit(face, simulated.scans, simulated.truths)),
            "unreached": simulated.unreached,
        }
        for told, fit in TOLD.items()
    }


def named_pose(
    face: Face,
    weights: Mapping[str, float],
    rng: np.random.Generator,
    trip: NamedTripOptions = NamedTripOptions(),
) -> Pose:
    """Return a pose of the muscles that texts name for a mixture, within what the face's can do."""
    model = face.model
    actions = called_actions(weights)
    tensors = fibre_tensors(model, face.flesh.volumes, face.S)
    a = np.tile(IDENTITY, (model.muscle_count, 1))
    depth: dict[str, float] = {}  # of whole muscles, with their side and without
    for muscle, whole in enumerate(model.muscle_groups):
        side = muscle_side(whole)
        named = [unit.muscles for unit, of in actions if side in (of, "")]
        name = model.muscle_names[muscle]
        if not any(is_one_of(name, each) for each in named) or np.isnan(tensors[muscle]).any():
            continue
        kind = both_sides(whole)
        depth.setdefault(kind, rng.uniform(*trip.contraction))
        depth.setdefault(whole, depth[kind] + rng.uniform(-trip.asymmetry, trip.asymmetry))
        a[muscle] = isochoric_activation(tensors[muscle], 1.0 - depth[whole])
    opens = "jawOpen" in weights
    opening = rng.uniform(*trip.opening) if opens else 0.0
    jaw = np.array([opening, 0.0, 0.0, 0.0, FORWARD_MM * opening])
    limits = face.drive.feasible(model, face.flesh.volumes, face.S)
    return face.pose_of(keep_within(a, limits)[0], jaw)


def _contraction(face: Face, a: Floats) -> Floats:
    """Return the contractions (m,); NaN of muscles that are not judged."""
    found = muscles(face.model, face.flesh.volumes, face.S, a)
    return np.where(found.is_judged, found.contraction, np.nan)


def _compare(truths: Mapping[str, Floats], fits: Fits) -> Figures:
    """Return how near the contractions of fits are to the true ones."""
    each: Figures = {}
    for name, state in fits.states.items():
        pair = np.array([truths[name], _contraction(fits.face, state.pose.a)])
        pair = pair[:, np.isfinite(pair).all(axis=0)]
        each[name] = {
            "correlation": float(np.corrcoef(pair)[0, 1]) if pair.std(axis=1).all() else 0.0,
            "contraction_rms": float(np.sqrt(np.mean((pair[0] - pair[1]) ** 2))),
            "mean_mm": float(fits.distances(name).mean()),
        }
    correlations = [found["correlation"] for found in each.values()]
    return {
        "correlation": float(np.mean(correlations)) if each else None,
        "correlation_least": min(correlations, default=None),
        "contraction_rms": max((found["contraction_rms"] for found in each.values()), default=None),
        "mixtures": each,
        "failed": fits.failed,
    }


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
    skin = []
    outside = 0
    sets = []
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
