"""The verdict on a rig: its figures against the limits of :mod:`solver.rig.checks`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from solver.contact.crossing import Crossing
from solver.fitting.notices import Notice
from solver.model import SubjectModel
from solver.rig.certificate import Certificate, ExpressionCheck
from solver.rig.checks import CHECKS, Check, Verdict
from solver.rig.result import ExpressionFit, Rig


@dataclass(frozen=True)
class Measure:
    """A check's figure for one expression, with ``detail`` in words where there is more to say."""

    value: float
    detail: str = ""


@dataclass(frozen=True)
class Judgement:
    """A check over all expressions that it could be made for; ``worst`` names one of them."""

    check: Check
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
        unreached = "" if trip.reached else "the pose can not be reached from rest"
        found["trip.skin"] = Measure(trip.skin_mean_mm, unreached)
        if trip.reached:
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
