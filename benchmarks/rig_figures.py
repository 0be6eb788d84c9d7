"""Figures of fitted rigs for the benchmarks: what their certificates say, over all expressions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

import numpy as np

from benchmarks.documents import Figures
from benchmarks.strong import HARD_REGIONS, LIPS
from benchmarks.subject_fits import Fits, Method, rig_of
from solver.anatomy.action_units import is_one_of
from solver.contact.crossing import Crossing, crossing
from solver.contact.mouth import Mouth
from solver.fitting.contraction import STILL
from solver.fitting.drives.admissible import Admissible
from solver.fitting.face import Face
from solver.mechanics.flesh import IDENTITY
from solver.mechanics.jaw_tracks import JawTracks
from solver.model import SubjectModel
from solver.rig.report.certificate import (
    SYMMETRY,
    ExpressionCheck,
    ExpressionMuscles,
    JawFigures,
    certify,
    muscles,
)
from solver.rig.report.checks import Judgement, expression_verdict, judge
from solver.rig.report.prime_movers import rank_contractions
from solver.rig.round_trip import activation_error
from solver.surface import Floats


@dataclass(frozen=True)
class NoiseOptions:
    """White noise on scans."""

    sd_mm: float = 0.2  # of each coordinate of each vertex
    seed: int = 7


@dataclass(frozen=True)
class BoundOptions:
    """Limits from which a muscle counts as being at a bound of what muscles can do."""

    drive: Admissible = field(default_factory=Admissible)
    # of the way from rest to the bound, what is left: at rest no muscle is at a bound, though that
    # of lengthening is 2 % away
    part: float = 0.1


BOUNDS = ("at_bound", "at_fibre_bound")


@dataclass(frozen=True)
class EvennessOptions:
    """Expressions by which both sides are compared."""

    least: float = 0.05  # contraction that some muscle has in them


@dataclass(frozen=True)
class CloserOptions:
    """Muscles that close the jaw, and when they have nothing to do."""

    muscles: tuple[str, ...] = ("masseter", "temporalis", "medial pterygoid")  # of anatomy texts
    open_mm: float = 5.0  # of the incisors, beyond which the jaw is open
    silent: float = 0.05  # contraction up to which they are silent


# a figure -> the certificate's check, and how it is taken over the expressions
Checked = Mapping[str, tuple[str, Callable[[list[Any]], Any]]]
CHECKED: Checked = {
    "inverted": ("flesh.inverted", sum),
    "det_least": ("flesh.flattest", min),
    "beyond": ("muscles.beyond", sum),
    "beyond_worst": ("muscles.beyond", max),
    "inside_out": ("muscles.inside_out", sum),
    "jaw_beyond": ("jaw.range", sum),
    "lip_crossing_max_mm": ("contact.lips", max),
    "snap_max_mm": ("trip.snap", max),
}
ROUND_TRIP: Checked = {
    "skin_mean_mm": ("trip.skin", max),
    "refit_mean_mm": ("trip.refit", max),
    "refit_activations_percent": ("trip.activations", max),
}


def rig_figures(train: Fits, test: Fits, tracks: JawTracks) -> Figures:
    """Return the figures of a rig of both, by the certificate that a job would leave.

    Fits that failed count as bad certificates; ``unreached`` are the expressions that cannot be
    simulated from rest.
    """
    rig = rig_of(train, test)
    certificate = certify(train.face, rig, {})
    checks = certificate.expressions
    judgements = judge(rig, certificate)
    expressions = {**train.figures("train"), **test.figures("test")}
    beyond = next(each.measures for each in judgements if each.check.code == "muscles.beyond")
    for name, found in expressions.items():
        fits = train if name in train.states else test
        motion = fits.face.jaw.matrix(fits.states[name].pose.b)
        check = checks[name]
        found |= {
            "verdict": expression_verdict(judgements, name),
            "beyond": beyond[name].value,
            **muscle_figures([check.muscles]),
            **bound_figures(fits.face, fits.states[name].pose.a, check.muscles),
            "lengthened": lengthened(check.muscles),
            "asymmetry": asymmetry(check),
            "closers": pulling_closers(rig.model, check.muscles, check.jaw),
            "lips_mm": fits.region_mean(name, LIPS),
            "condyle_out_mm": tracks.departure(motion),
            "contractions": rank_contractions(
                rig.model.muscle_names, check.muscles.contraction, check.muscles.is_judged
            ),
        }
    failed = {**train.failed, **test.failed}
    uneven = [it["asymmetry"] for it in expressions.values() if it["asymmetry"] is not None]
    bad = sum(found["verdict"] == "bad" for found in expressions.values())
    trips = [fit.round_trip for fit in rig.expressions if fit.round_trip]
    return {
        "train_mean_mm": train.mean_mm,
        "test_mean_mm": test.mean_mm,
        **over_expressions(judgements, CHECKED),
        "bite_max_mm": bite_beyond_neutral(
            rig.model, [check.crossing for check in checks.values()]
        ),
        **muscle_figures([check.muscles for check in checks.values()]),
        **{key: max(found[key] for found in expressions.values()) for key in BOUNDS},
        "lengthened": sum(found["lengthened"] for found in expressions.values()),
        "asymmetry": max(uneven, default=None),
        "closers": sum(len(found["closers"]) for found in expressions.values()),
        "strayed": max(certificate.strayed.values(), default=None),
        "strayed_by_muscle": certificate.strayed,
        "condyle_out_mm": max(found["condyle_out_mm"] for found in expressions.values()),
        "certificates_bad": bad + len(failed),
        "certificates": len(expressions) + len(failed),
        "round_trip": {
            **over_expressions(judgements, ROUND_TRIP),
            "unreached": sum(not trip.is_reached for trip in trips),
        },
        "rounds": train.rounds,
        "geometry_seconds": train.seconds,
        "geometry_cpu_seconds": train.cpu_seconds,
        "test_seconds": test.seconds,
        "round_trip_seconds": rig.seconds["round_trip"],
        "failed": failed,
        "expressions": expressions,
    }


def over_expressions(judgements: Sequence[Judgement], wanted: Checked) -> Figures:
    """Return the ``wanted`` figures over all expressions; None where nothing is known."""
    known = {each.check.code: each.measures.values() for each in judgements}
    found: Figures = {}
    for key, (code, over) in wanted.items():
        values = [each.value for each in known.get(code, ()) if np.isfinite(each.value)]
        found[key] = over(values) if values else None
    return found


def bite_beyond_neutral(model: SubjectModel, crossings: Sequence[Crossing | None]) -> float | None:
    """Return how much deeper teeth lie in teeth than in the neutral, mm; None without teeth.

    Teeth of scanned neutrals lie in each other by half a millimetre and more.
    """
    mouth = Mouth.of(model)
    rest = None if mouth is None else crossing(mouth, model.skin.vertices).bite
    bites = [found.bite for found in crossings if found and found.bite is not None]
    return max(max(bites) - rest, 0.0) if bites and rest is not None else None


def muscle_figures(expressions: Sequence[ExpressionMuscles]) -> Figures:
    """Return the worst of what muscles with flesh enough to be judged do; None without any."""
    columns: dict[str, Callable[[ExpressionMuscles], Any]] = {
        "volume_worst_percent": lambda found: 100.0 * np.abs(found.volume - 1.0),
        "fibres_longest": lambda found: found.fibres,
        "stretch_longest": lambda found: found.longest,
    }
    figures: Figures = {}
    for key, column in columns.items():
        values = np.concatenate([column(found)[found.is_judged] for found in expressions])
        known = values[np.isfinite(values)]
        figures[key] = float(known.max()) if len(known) else None
    return figures


def bound_figures(
    face: Face, a: Floats, found: ExpressionMuscles, options: BoundOptions = BoundOptions()
) -> Figures:
    """Return how many muscles are at a bound of what muscles can do, or beyond it.

    ``at_fibre_bound`` are those whose fibres lengthen up to theirs.
    """
    limits = options.drive.feasible(face.model, face.flesh.volumes, face.S)
    at_rest = limits.margins(np.tile(IDENTITY, (len(a), 1)))
    near = limits.margins(a)[found.is_judged] < options.part * at_rest[found.is_judged]
    return {"at_bound": int(near.any(axis=1).sum()), "at_fibre_bound": int(near[:, 0].sum())}


def lengthened(found: ExpressionMuscles) -> int:
    """Return how many muscles lengthen, more than one at rest may."""
    return int((found.is_judged & (found.contraction <= -STILL.lengthened)).sum())


def asymmetry(check: ExpressionCheck, options: EvennessOptions = EvennessOptions()) -> float | None:
    """Return the greatest difference of both sides' contractions by the greatest contraction.

    None of expressions whose scan is not alike on both sides, and where next to nothing contracts.
    """
    most = max(check.movers.contractions.values(), default=0.0)
    even = check.asymmetry_mm is not None and check.asymmetry_mm <= SYMMETRY.most_mm
    if not even or most < options.least:
        return None
    return max((each.amount for each in check.movers.uneven()), default=0.0) / most


def pulling_closers(
    model: SubjectModel,
    found: ExpressionMuscles,
    jaw: JawFigures,
    options: CloserOptions = CloserOptions(),
) -> dict[str, float]:
    """Return the muscles that close the jaw and contract while it is open, with how much."""
    if jaw.opening_mm <= options.open_mm:
        return {}
    return {
        name: float(by)
        for name, whole, by, judged in zip(
            model.muscle_names, model.muscle_groups, found.contraction, found.is_judged, strict=True
        )
        if judged and by > options.silent and is_one_of(whole, options.muscles)
    }


def same_muscle_other_person(people: Sequence[Figures]) -> float | None:
    """Return the correlation of the muscles' contractions in two people's same expression.

    It is the mean over all expressions and pairs of ``people``, whose figures are those of
    :func:`rig_figures`; None without any pair.
    """
    found = []
    for one, other in combinations((person["expressions"] for person in people), 2):
        for name in one.keys() & other.keys():
            ours, theirs = (each[name]["contractions"] for each in (one, other))
            both = sorted(ours.keys() & theirs.keys())
            pairs = np.array([(ours[muscle], theirs[muscle]) for muscle in both])
            if len(pairs) > 1 and pairs.std(axis=0).all():
                found.append(np.corrcoef(pairs.T)[0, 1])
    return float(np.mean(found)) if found else None


def hard_figures(fits: Fits) -> Figures:
    """Return the means over the regions by which :data:`~benchmarks.strong.HARD` are judged, mm.

    ``lips_mm`` and ``nose_mm`` are the worst expression's.
    """
    means = {name: fits.region_mean(name, HARD_REGIONS[name]) for name in fits.states}

    def worst(is_of_lips: bool) -> float | None:
        known = [
            mean
            for name, mean in means.items()
            if mean is not None and (HARD_REGIONS[name] == LIPS) == is_of_lips
        ]
        return max(known, default=None)

    return {
        "lips_mm": worst(is_of_lips=True),
        "nose_mm": worst(is_of_lips=False),
        "expressions": means,
        "failed": fits.failed,
    }


def noise_figures(method: Method, test: Fits, noise: NoiseOptions = NoiseOptions()) -> Figures:
    """Return how much noise on the scans changes activations, and the contraction of any muscle.

    ``activation_error`` is that of the round trip, the mean over the expressions,
    ``contraction_change`` the greatest of all muscles and expressions; None without any.
    """
    rng = np.random.default_rng(noise.seed)
    face = test.face
    spoilt = {
        name: scan.with_vertices(
            scan.vertices + noise.sd_mm * rng.standard_normal(scan.vertices.shape)
        )
        for name, scan in test.scans.items()
    }
    again = method.test(face, spoilt)
    rest = face.rest_pose().a
    pairs = [
        (state.pose.a, again.states[name].pose.a)
        for name, state in test.states.items()
        if name in again.states
    ]
    errors = [activation_error(*pair, rest=rest) for pair in pairs]
    known = [error for error in errors if np.isfinite(error)]
    changes = [_contraction_change(face, *pair) for pair in pairs]
    return {
        "activation_error": float(np.mean(known)) if known else None,
        "contraction_change": max(changes, default=None),
    }


def _contraction_change(face: Face, a: Floats, other: Floats) -> float:
    """Return the greatest change of a judged muscle's contraction between two activations."""
    one, two = (muscles(face.model, face.flesh.volumes, face.S, each) for each in (a, other))
    change = np.abs(one.contraction - two.contraction)[one.is_judged]
    return float(np.nanmax(change, initial=0.0))
