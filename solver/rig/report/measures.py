"""Measures of fitted expressions and of the neutral: figures that the checks of a rig judge.

There is one figure of an expression by each code of a check; :mod:`solver.rig.report.checks` has
the limits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from solver.anatomy.action_units import action_units, is_one_of
from solver.contact.crossing import Crossing
from solver.errors import Finding, make_warning
from solver.fitting.face import Face
from solver.mechanics.boundary import FreeJaw
from solver.model import SubjectModel
from solver.rig.expression import ExpressionFit
from solver.rig.report.certificate import (
    SYMMETRY,
    Certificate,
    ExpressionCheck,
    FleshCheck,
    StrayOptions,
    jaw_motion,
    muscles,
)
from solver.rig.report.prime_movers import MoverOptions, Said
from solver.rig.rig import Rig
from solver.rig.round_trip import RoundTrip
from solver.surface import Floats, Ints


@dataclass(frozen=True)
class Measure:
    """A check's figure for one expression, with ``detail`` in words where there is more to say.

    ``worst`` is the worst of the ``muscles`` that a check of muscles finds fault with.
    """

    value: float
    detail: str = ""
    worst: Said | None = None
    muscles: tuple[str, ...] = ()


def rounded(value: float | np.floating) -> float | None:
    """Return a figure with four decimals; None for what is not finite."""
    return round(float(value), 4) if math.isfinite(value) else None


def distances(error: Floats) -> dict[str, float | None]:
    """Return mean, 95th percentile and greatest of distances in mm; None of no distance at all."""
    if not error.size:
        return dict.fromkeys(("mean_mm", "p95_mm", "max_mm"))
    return {
        "mean_mm": rounded(error.mean()),
        "p95_mm": rounded(np.percentile(error, 95)),
        "max_mm": rounded(error.max()),
    }


def measured_regions(model: SubjectModel, fit: ExpressionFit) -> dict[str, tuple[Ints, Floats]]:
    """Return the face's regions of which the scan shows something: vertices and errors in mm."""
    on_face = {name: np.intersect1d(ids, model.face) for name, ids in model.regions.items()}
    found = {name: (ids, fit.measured_error(ids)) for name, ids in on_face.items()}
    return {name: (ids, seen) for name, (ids, seen) in found.items() if len(seen)}


def measures(rig: Rig, fit: ExpressionFit, check: ExpressionCheck) -> dict[str, Measure]:
    """Return code -> figure of one expression."""
    notices = (*rig.warnings, *fit.notices)
    return {
        **_skin(rig.model, fit),
        **_flesh(fit, check.flesh),
        **_muscles_and_jaw(rig.model, check),
        **_contact(check.crossing, check.scan_crossing),
        **_trip(fit.round_trip),
        **_solve(fit),
        "solver.warnings": Measure(len(notices), "; ".join(each.message for each in notices)),
    }


def measures_of_rig(model: SubjectModel, certificate: Certificate) -> dict[str, Measure]:
    """Return code -> figure of what all expressions of a rig have in common, its S."""
    said = [
        Said(whole, f"has {100.0 * part:.0f} % of its flesh outside", part)
        for whole, part in certificate.strayed.items()
    ]
    if not said:
        return {}
    worst, *_ = said
    beyond = [each for each in said if each.amount > StrayOptions.most]
    names = {each.muscle for each in beyond}
    parts = [
        name
        for name, whole in zip(model.muscle_names, model.muscle_groups, strict=True)
        if whole in names
    ]
    words = "; ".join(map(str, beyond or said[:1]))
    return {"muscles.strayed": Measure(100.0 * worst.amount, words, worst, tuple(parts))}


def _skin(model: SubjectModel, fit: ExpressionFit) -> dict[str, Measure]:
    error = fit.measured_error(model.face)
    found = {
        "skin.mean": Measure(error.mean()),
        "skin.p95": Measure(np.percentile(error, 95)),
        "skin.coverage": Measure(100.0 * len(error) / len(model.face)),
    }
    means = {name: seen.mean() for name, (_, seen) in measured_regions(model, fit).items()}
    if means:
        worst = max(means, key=lambda name: means[name])
        found["skin.region"] = Measure(means[worst], worst.replace("_", " "))
    return found


def _flesh(fit: ExpressionFit, flesh: FleshCheck | None) -> dict[str, Measure]:
    found = {"flesh.inverted": Measure(fit.inverted)}
    if flesh is not None:
        found |= {
            "flesh.flattest": Measure(flesh.det_least, f"tet {flesh.flattest}"),
            "flesh.volume": Measure(abs(flesh.volume_percent), f"{flesh.volume_percent:+.2f} %"),
            "flesh.residual": Measure(flesh.residual),
            "flesh.minimum": Measure(0 if flesh.minimum else 1),
        }
    return found


def _muscles_and_jaw(model: SubjectModel, check: ExpressionCheck) -> dict[str, Measure]:
    names = model.muscle_names
    movers = check.movers
    faults = [said for j, name in enumerate(names) if (said := check.muscles.said(name, j))]
    inside_out = tuple(names[muscle] for muscle in check.muscles.inside_out)
    worst = Said(inside_out[0], "is turned inside out", np.inf) if inside_out else None
    jaw = check.jaw.faults()
    found = {
        "muscles.inside_out": Measure(len(inside_out), ", ".join(inside_out), worst, inside_out),
        "muscles.beyond": _count(faults),
        "muscles.movers": _count([[each] for each in movers.contradictions()]),
        "muscles.idle": _count([[each] for each in movers.idle()]),
        "jaw.range": Measure(len(jaw), ", ".join(jaw)),
    }
    if _is_symmetric(check):
        found["muscles.sides"] = _sides(movers.uneven(), uneven_sides(check))
    return found


def _is_symmetric(check: ExpressionCheck) -> bool:
    return check.asymmetry_mm is not None and check.asymmetry_mm <= SYMMETRY.most_mm


def uneven_sides(check: ExpressionCheck, most: float = MoverOptions.uneven) -> list[Said]:
    """Return the muscles that contract more than the other side's, where the scan is symmetric."""
    uneven = check.movers.uneven() if _is_symmetric(check) else []
    return [each for each in uneven if each.amount > most]


def _count(found: Sequence[Sequence[Said]]) -> Measure:
    """Return how many muscles something is said about; each entry has all of one muscle."""
    words = [", ".join([str(said[0]), *(each.words for each in said[1:])]) for said in found]
    every = [each for said in found for each in said]
    worst = max(every, key=lambda each: each.amount, default=None)
    muscles = tuple(dict.fromkeys(each.muscle for each in every))
    return Measure(len(found), "; ".join(words), worst, muscles)


def _sides(uneven: Sequence[Said], beyond: Sequence[Said]) -> Measure:
    """Return the greatest difference of both sides, in percent, and what is beyond the limit."""
    if not uneven:
        return Measure(0.0)
    words = "; ".join(map(str, beyond or uneven[:1]))
    return Measure(
        100.0 * uneven[0].amount, words, uneven[0], tuple(each.muscle for each in beyond)
    )


def _contact(fitted: Crossing | None, scan: Crossing | None) -> dict[str, Measure]:
    """Return code -> depth; the detail is the depth in the scan."""
    scanned = _depths(scan)
    return {
        code: Measure(depth, f"{scanned[code]:.2f} mm in the scan" if code in scanned else "")
        for code, depth in _depths(fitted).items()
    }


def _depths(found: Crossing | None) -> dict[str, float]:
    if found is None:
        return {}
    depths: dict[str, list[float | None]] = {
        "contact.lips": [found.lips],
        "contact.teeth": [found.upper_teeth, found.lower_teeth],
        "contact.bite": [found.bite],
    }
    known = {code: [each for each in some if each is not None] for code, some in depths.items()}
    return {code: max(each) for code, each in known.items() if each}


def _trip(trip: RoundTrip | None) -> dict[str, Measure]:
    if trip is None:
        return {}
    if not trip.is_reached:
        return {"trip.skin": Measure(trip.skin_mean_mm, "the pose cannot be reached from rest")}
    failed = "" if np.isfinite(trip.refit_mean_mm) else "the new fit did not come to rest"
    found = {
        "trip.skin": Measure(trip.skin_mean_mm),
        "trip.snap": Measure(trip.skin_max_mm),
        "trip.refit": Measure(trip.refit_mean_mm, failed),
    }
    if np.isfinite(trip.activation_error):
        found["trip.activations"] = Measure(100.0 * trip.activation_error)
    return found


def _solve(fit: ExpressionFit) -> dict[str, Measure]:
    """Return how the solve went, unless the rig is from before that was kept."""
    if fit.status == "unknown":
        return {}
    how = f"after {fit.iterations} steps by {fit.solver}"
    return {
        f"solver.{end}": Measure(1, how) if fit.status == end else Measure(0)
        for end in ("failed", "stopped")
    }


# Neutrals that are none, by what every expression asks for: a smile as rest, parted teeth.
#
# A fit counts from the neutral. Was it scanned with a smile, then the muscles that smile lengthen
# wherever the person does not smile more; was it scanned with parted teeth, then the jaw closes
# beyond rest wherever the mouth is shut. One expression says nothing of that, most of them together
# do. Only neutrals of the whole topology show their teeth, so that these are looked at, too.


@dataclass(frozen=True)
class NeutralLimits:
    """Bounds of what a neutral may ask of expressions."""

    least: int = 5  # expressions that are known, to judge by
    most: float = 0.6  # part of them from which they speak for the neutral
    unit: str = "AU 12"  # that a neutral may have: the corners of the mouth drawn up
    lengthened: float = 0.02  # of the unit's muscles, both sides together
    contracted: float = 0.05  # from which an expression has the unit
    closed_mm: float = 3.0  # that the jaw closes beyond rest
    apart_mm: float = 1.5  # between the rows of teeth; less is the freeway space of a relaxed jaw


def check_neutral(
    face: Face, fits: Sequence[ExpressionFit], options: NeutralLimits = NeutralLimits()
) -> list[Finding]:
    """Return what expressions fitted by ``face``, with its S, say against the neutral."""
    fits = [fit for fit in fits if fit.status != "failed"]
    known = len(fits) >= options.least
    parted = _find_parted_teeth(face.model, options)
    if known and not parted:
        parted = _find_closing_jaw(face.model, fits, options)
    return [*parted, *(_find_smile(face, fits, options) if known else [])]


def _find_parted_teeth(model: SubjectModel, options: NeutralLimits) -> list[Finding]:
    """Find rows of teeth that are apart in the neutral."""
    rows = [model.region(f"{name}_teeth") for name in ("upper", "lower")]
    upper, lower = (model.skin.vertices[row] for row in rows)
    if not (len(upper) and len(lower)):
        return []
    apart = float(cKDTree(upper).query(lower)[0].min())
    if apart <= options.apart_mm:
        return []
    message = f"the neutral's teeth are {apart:.1f} mm apart"
    return [_report_parted(message, apart)]


def _find_closing_jaw(
    model: SubjectModel, fits: Sequence[ExpressionFit], options: NeutralLimits
) -> list[Finding]:
    """Find a jaw that closes beyond rest in most expressions."""
    closings = {
        fit.name: -jaw_motion(model, FreeJaw(model.jaw).matrix(fit.jaw)).opening_mm for fit in fits
    }
    names = [name for name, closing in closings.items() if closing > options.closed_mm]
    if len(names) < options.most * len(fits):
        return []
    typical = float(np.median([closings[name] for name in names]))
    message = f"the jaw closes {typical:.1f} mm beyond the neutral in {', '.join(names)}"
    return [_report_parted(message, typical)]


def _report_parted(message: str, mm: float) -> Finding:
    advice = "it was scanned with parted teeth: scan a neutral with closed ones"
    return make_warning("neutral.parted_teeth", f"{message}: {advice}", {"mm": round(mm, 1)})


def _find_smile(face: Face, fits: Sequence[ExpressionFit], options: NeutralLimits) -> list[Finding]:
    """Find a unit whose muscles lengthen in most expressions and contract in none."""
    unit = action_units()[options.unit]
    found = {}
    model = face.model
    of_unit = np.array([is_one_of(whole, unit.muscles) for whole in model.muscle_groups])
    for fit in fits:
        each = muscles(model, face.flesh.volumes, face.S, fit.activations)
        mine = each.contraction[of_unit & each.is_judged & np.isfinite(each.contraction)]
        if not len(mine):
            return []
        found[fit.name] = float(mine.mean())
    names = [name for name, by in found.items() if by <= -options.lengthened]
    if max(found.values()) > options.contracted or len(names) < options.most * len(fits):
        return []
    message = (
        f"{' and '.join(unit.muscles)} lengthen in {', '.join(names)} and contract in no "
        f"expression: the neutral has {unit.code} ({unit.name}), it smiles; scan a relaxed one"
    )
    return [make_warning("neutral.smiles", message, {"expressions": names})]
