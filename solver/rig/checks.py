"""The checks of a rig: what is measured, where it is good, and what to do where it is not.

Limits are the project's own, from what fits of captured faces reach, unless a source is named.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from solver.contact.crossing import Crossing
from solver.errors import Notice
from solver.mechanics.newton import NewtonOptions
from solver.model import SubjectModel
from solver.rig.certificate import Certificate, ExpressionCheck
from solver.rig.result import ExpressionFit
from solver.rig.rig import Rig

Verdict = Literal["good", "usable", "bad"]
ORDER: tuple[Verdict, ...] = ("good", "usable", "bad")


@dataclass(frozen=True)
class RigCheck:
    """A figure with its limits: good up to ``good``, usable up to ``usable``, else bad.

    With ``least`` the figure is good from ``good`` upwards. ``meaning`` and ``advice`` are for the
    person who reads the page; ``{longer}`` in an advice is the option that lets the fit go on.
    """

    code: str
    group: str
    title: str
    unit: str
    good: float
    usable: float
    meaning: str
    advice: str
    least: bool = False

    def verdict(self, value: float) -> Verdict:
        """Judge a figure; what is not a number is bad."""
        sign = -1.0 if self.least else 1.0
        if sign * value <= sign * self.good:
            return "good"
        return "usable" if sign * value <= sign * self.usable else "bad"

    def advise(self, settings: Mapping[str, Any]) -> str:
        """Return the advice to somebody whose job had these ``settings``."""
        longer = "more iterations"
        for option in ("rounds", "max_iterations"):
            if option in settings:
                longer = f"{option} {2 * settings[option]} instead of {settings[option]}"
        return self.advice.format(longer=longer)


CHECKS = (
    RigCheck(
        "skin.mean",
        "Skin",
        "Mean distance",
        "mm",
        0.45,
        1.0,
        "between scan and fit, over the part of the face that the scan shows",
        "Look at the expression's picture. If the error is all over the face, the scan is not"
        " registered to this neutral: register it again. If it is in one place, look there.",
    ),
    RigCheck(
        "skin.p95",
        "Skin",
        "Distance of the worst twentieth",
        "mm",
        1.3,
        2.5,
        "19 of 20 vertices of the face are nearer to the scan than this",
        "Look at the red patches in the picture: hair, a shadow or a hole in the scan shows as a"
        " patch with a sharp rim. Mask it or scan again.",
    ),
    RigCheck(
        "skin.region",
        "Skin",
        "Mean distance in the worst region",
        "mm",
        1.0,
        2.0,
        "the region of the face that fits worst",
        "Run fit_geometry again with one more scan, of an expression that moves this region.",
    ),
    RigCheck(
        "skin.coverage",
        "Skin",
        "Face that the scan shows",
        "%",
        95.0,
        60.0,
        "share of the face's vertices with confidence in the scan",
        "The rest of the face follows the muscles and is not measured. Scan again if it matters.",
        least=True,
    ),
    RigCheck(
        "flesh.inverted",
        "Flesh",
        "Inverted tets",
        "",
        0,
        0,
        "tets that are turned inside out",
        "Do not simulate with this expression. Fit it again with {longer}.",
    ),
    RigCheck(
        "flesh.flattest",
        "Flesh",
        "Flattest tet",
        "of its volume",
        0.05,
        0.005,
        "the smallest volume of a tet by its volume at rest",
        "The skin may be used. A simulation that starts here takes small steps; if it fails, run"
        " build_model with edge_mm 16 instead of 9 and fit again: the flattest tet then keeps about"
        " ten times as much of its volume.",
        least=True,
    ),
    RigCheck(
        "flesh.volume",
        "Flesh",
        "Change of volume",
        "%",
        5.0,
        10.0,
        "of the flesh as a whole; living flesh keeps its volume",
        "The skin is not touched by this. Do not take masses or volumes from this expression.",
    ),
    RigCheck(
        "flesh.residual",
        "Flesh",
        "Residual force",
        "",
        10 * NewtonOptions.tolerance,
        NewtonOptions.stalled,
        "what is left of the forces, by the forces at unit strain",
        "The flesh has not come to rest. Fit this expression again with {longer}.",
    ),
    RigCheck(
        "flesh.minimum",
        "Flesh",
        "Unstable equilibrium",
        "",
        0,
        0,
        "1 if the flesh could snap into another shape",
        "The skin may be used. Simulations may snap away from this shape: leave it out of them.",
    ),
    RigCheck(
        "muscles.inside_out",
        "Muscles and jaw",
        "Muscles turned inside out",
        "",
        0,
        0,
        "muscles whose activation has no physical shape",
        "The skin is right, the muscles are not: play the expression back, but do not edit its"
        " activations. A training scan that moves these muscles differently helps.",
    ),
    RigCheck(
        "muscles.beyond",
        "Muscles and jaw",
        "Muscles beyond what muscles can do",
        "",
        0,
        np.inf,
        "shrinking below half, growing beyond double, pushing, or losing volume",
        "The expression may be played back and blended. Do not read these activations as effort; no"
        " option changes that.",
    ),
    RigCheck(
        "jaw.range",
        "Muscles and jaw",
        "Jaw beyond what jaws can do",
        "",
        0,
        np.inf,
        "figures of its motion that are outside the range of adults' jaws",
        "RigCheck the neutral scan: with parted or clenched teeth there, every jaw angle is off.",
    ),
    RigCheck(
        "contact.lips",
        "Contact",
        "Lips in each other",
        "mm",
        0.5,
        3.0,
        "greatest depth of a lip in the other one",
        "A fit follows its scan: correct the scan if its lips cross by as much, else fit it again"
        " with {longer}.",
    ),
    RigCheck(
        "contact.teeth",
        "Contact",
        "Lips in teeth",
        "mm",
        0.5,
        3.0,
        "greatest depth of a lip in the teeth",
        "Seen from the side, teeth may show through a lip. Sculpt it, or leave the expression out.",
    ),
    RigCheck(
        "contact.bite",
        "Contact",
        "Teeth in teeth",
        "mm",
        1.0,
        3.0,
        "greatest depth of lower teeth in upper ones",
        "The jaw closes too far or goes back too far: see its motion.",
    ),
    RigCheck(
        "trip.skin",
        "Round trip",
        "Simulated from rest",
        "mm",
        0.05,
        0.3,
        "mean distance between the fitted skin and the one simulated from its activations",
        "The skin may be used. This pose has two shapes of rest: blend into it from a neighbouring"
        " expression instead of from rest.",
    ),
    RigCheck(
        "trip.snap",
        "Round trip",
        "Simulated from rest, greatest",
        "mm",
        0.5,
        2.0,
        "where the fitted and the simulated skin are furthest apart",
        "A patch of skin snaps into another shape. Look there in the picture; blend into this pose"
        " from a neighbouring expression.",
    ),
    RigCheck(
        "trip.refit",
        "Round trip",
        "Fitted again",
        "mm",
        0.05,
        0.3,
        "mean distance between the simulated skin and a new fit to it",
        "The solver stops before the minimum: fit with {longer}.",
    ),
    RigCheck(
        "trip.activations",
        "Round trip",
        "Activations found again",
        "%",
        10.0,
        30.0,
        "difference of the excited muscles' activations by their distance from rest",
        "Other activations give the same skin: do not compare single muscles between expressions.",
    ),
    RigCheck(
        "solver.failed",
        "Solver",
        "Fits that broke down",
        "",
        0,
        0,
        "the best state on the way was kept",
        "Do not use this expression. Mend what its warnings say of its scan, and fit it again.",
    ),
    RigCheck(
        "solver.stopped",
        "Solver",
        "Fits that ended early",
        "",
        0,
        np.inf,
        "stopped before the minimum",
        "If the picture shows errors, fit this expression again with {longer}.",
    ),
    RigCheck(
        "solver.warnings",
        "Solver",
        "Warnings",
        "",
        0,
        np.inf,
        "what the solver noticed about scan, model or solve",
        "Read them with the expression.",
    ),
)


def overall(verdicts: list[Verdict]) -> Verdict:
    """Return the worst of the verdicts; good without any."""
    return max(verdicts, key=ORDER.index, default="good")


def use(verdict: Verdict, bad: Sequence[str], expressions: int) -> str:
    """Say whether a rig may be used whose ``bad`` expressions fail a check, of so many."""
    if verdict == "good":
        return "The rig may be used."
    if verdict == "usable":
        return "The rig may be used. What it is not good for stands under What to do."
    why = "What to do says why, and what they are still good for."
    if len(bad) == expressions:
        return f"The rig may not be used as it is: every expression fails a check. {why}"
    return f"The rig may be used, but not {', '.join(bad)}. {why}"


# The verdict on a rig: its figures against the limits of :mod:`solver.rig.checks`.


@dataclass(frozen=True)
class Measure:
    """A check's figure for one expression, with ``detail`` in words where there is more to say."""

    value: float
    detail: str = ""


@dataclass(frozen=True)
class Judgement:
    """A check over all expressions that it could be made for; ``worst`` names one of them."""

    check: RigCheck
    worst: str
    measures: dict[str, Measure]

    @property
    def verdict(self) -> Verdict:
        """Return the verdict on the worst expression."""
        return self.of(self.worst)

    def of(self, expression: str) -> Verdict:
        """Return the verdict on an expression."""
        return self.check.verdict(self.measures[expression].value)


def judge(rig: Rig, certificate: Certificate) -> list[Judgement]:
    """Judge every check that could be made, in the order of :data:`CHECKS`."""
    made = {
        fit.name: {
            **_measures(rig.model, fit, certificate.expressions[fit.name]),
            "solver.warnings": _warnings((*rig.notices, *fit.notices)),
        }
        for fit in rig.expressions
    }
    judgements = []
    for check in CHECKS:
        measures = {name: found[check.code] for name, found in made.items() if check.code in found}
        if measures:
            sign = -1.0 if check.least else 1.0
            worst = max(measures, key=lambda name: _rank(sign * measures[name].value))
            judgements.append(Judgement(check, worst, measures))
    return judgements


def _rank(value: float) -> float:
    return np.inf if np.isnan(value) else value


def _measures(
    model: SubjectModel, fit: ExpressionFit, check: ExpressionCheck
) -> dict[str, Measure]:
    """Return code -> figure of one expression."""
    error = fit.measured_error(model.face)
    inside_out = check.muscles.inside_out
    found = {
        "skin.mean": Measure(error.mean()),
        "skin.p95": Measure(np.percentile(error, 95)),
        "skin.coverage": Measure(100.0 * len(error) / len(model.face)),
        "flesh.inverted": Measure(fit.inverted),
        "muscles.inside_out": Measure(
            len(inside_out), ", ".join(model.muscle_names[muscle] for muscle in inside_out)
        ),
        "jaw.range": Measure(len(check.jaw.faults()), ", ".join(check.jaw.faults())),
    }
    regions = {
        name: fit.measured_error(np.intersect1d(ids, model.face))
        for name, ids in model.regions.items()
    }
    means = {name: seen.mean() for name, seen in regions.items() if len(seen)}
    if means:
        worst = max(means, key=lambda name: means[name])
        found["skin.region"] = Measure(means[worst], worst.replace("_", " "))
    faulty = [
        f"{name} {', '.join(faults)}"
        for number, name in enumerate(model.muscle_names)
        if (faults := check.muscles.faults(number))
    ]
    found["muscles.beyond"] = Measure(len(faulty), "; ".join(faulty))
    if check.flesh is not None:
        flesh = check.flesh
        found |= {
            "flesh.flattest": Measure(flesh.det_least, f"tet {flesh.flattest}"),
            "flesh.volume": Measure(abs(flesh.volume_percent), f"{flesh.volume_percent:+.2f} %"),
            "flesh.residual": Measure(flesh.residual),
            "flesh.minimum": Measure(0 if flesh.minimum else 1),
        }
    found |= _solve(fit)
    found |= _contact(check.crossing, check.scan_crossing)
    if fit.round_trip is not None:
        trip = fit.round_trip
        unreached = "" if trip.is_reached else "the pose cannot be reached from rest"
        found["trip.skin"] = Measure(trip.skin_mean_mm, unreached)
        if trip.is_reached:
            found["trip.snap"] = Measure(trip.skin_max_mm)
            failed = "" if np.isfinite(trip.refit_mean_mm) else "the new fit did not come to rest"
            found["trip.refit"] = Measure(trip.refit_mean_mm, failed)
        if np.isfinite(trip.activation_error):
            found["trip.activations"] = Measure(100.0 * trip.activation_error)
    return found


def _warnings(notices: Sequence[Notice]) -> Measure:
    """Return how many warnings there are, those of the whole job among them."""
    return Measure(len(notices), "; ".join(notice.message for notice in notices))


def _solve(fit: ExpressionFit) -> dict[str, Measure]:
    """Return how the solve went, as code -> figure."""
    found = {}
    if fit.status != "unknown":
        for code, status in (("solver.failed", "failed"), ("solver.stopped", "stopped")):
            steps = f"after {fit.iterations} steps by {fit.solver}" if fit.status == status else ""
            found[code] = Measure(int(fit.status == status), steps)
    return found


def _contact(fitted: Crossing | None, scan: Crossing | None) -> dict[str, Measure]:
    """Return code -> depth; the detail is the depth in the scan."""
    depths = {} if fitted is None else _depths(fitted)
    scanned = {} if scan is None else _depths(scan)
    return {
        code: Measure(depth, f"{scanned[code]:.2f} mm in the scan" if code in scanned else "")
        for code, depth in depths.items()
    }


def _depths(found: Crossing) -> dict[str, float]:
    teeth = [depth for depth in (found.upper_teeth, found.lower_teeth) if depth is not None]
    depths = {"contact.lips": found.lips}
    if teeth:
        depths["contact.teeth"] = max(teeth)
    if found.bite is not None:
        depths["contact.bite"] = found.bite
    return depths
