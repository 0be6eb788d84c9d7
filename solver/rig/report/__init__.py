"""The certificate's figures, ``report.json`` (docs/reference/rig-format.md)."""

from __future__ import annotations

import math
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from solver.contact.crossing import Crossing
from solver.errors import Verdict
from solver.fitting.geometry_information import MuscleInformation
from solver.model import SubjectModel, weights_hash
from solver.rig.expression import ExpressionFit
from solver.rig.report.certificate import (
    Certificate,
    ExpressionCheck,
    ExpressionMuscles,
    FleshCheck,
    JawFigures,
)
from solver.rig.report.checks import (
    Judgement,
    expression_verdict,
    judge,
    limits_of,
    overall,
    ready,
    use,
)
from solver.rig.report.measures import distances, measured_regions, rounded, uneven_sides
from solver.rig.report.prime_movers import ActionCheck
from solver.rig.report.systems import system_figures
from solver.rig.rig import Rig
from solver.rig.round_trip import RoundTrip

PACKAGES = ("myoface", "numpy", "scipy", "numba")
CONTACTS = {
    "lips_mm": "lips in each other",
    "upper_teeth_mm": "lips in upper teeth",
    "lower_teeth_mm": "lips in lower teeth",
    "bite_mm": "teeth in teeth",
}


def report(rig: Rig, certificate: Certificate) -> dict[str, Any]:
    """Return the figures of a rig as plain JSON values; distances in mm, times in seconds.

    Means are over the part of ``model.face`` that the scan shows (``coverage``), ``train_mean_mm``
    and ``test_mean_mm`` are the means of the expressions' means (None without any). ``inverted`` is
    the sum over the expressions.
    """
    model = rig.model
    found = certificate.information
    judgements = judge(rig, certificate)
    noticed: list[Verdict] = ["usable"] if rig.warnings else []
    verdict = overall([*(judgement.verdict for judgement in judgements), *noticed])
    expressions = {
        fit.name: _expression(model, fit, certificate.expressions[fit.name], judgements)
        for fit in rig.expressions
    }
    return {
        "verdict": verdict,
        "use": use(judgements, list(expressions)),
        "ready": ready(judgements, list(expressions)),
        "limits": [asdict(limit) for limit in limits_of(judgements)],
        "checks": [_judgement(judgement, certificate.settings) for judgement in judgements],
        "expressions": expressions,
        "system": rig.default_system,
        "systems": system_figures(rig),
        "strayed": {whole: rounded(part) for whole, part in certificate.strayed.items()},
        "information": found and information_figures(model, found),
        "warnings": [notice.as_dict() for notice in rig.warnings],
        "train_mean_mm": _role_mean(rig, "train"),
        "test_mean_mm": _role_mean(rig, "test"),
        "inverted": sum(fit.inverted for fit in rig.expressions),
        "tets": len(model.tets),
        "vertices": len(model.rest),
        "muscles": model.muscle_count,
        "seconds": {phase: round(seconds, 3) for phase, seconds in rig.seconds.items()},
        "rounds": [
            {
                "number": each.number,
                "loosened": each.loosened,
                "objective": float(f"{each.objective:.5g}"),
                "mean_mm": rounded(each.mean_mm),
                "seconds": round(each.seconds, 2),
            }
            for each in rig.rounds
        ],
        "settings": certificate.settings,
        "made_with": {
            "template": model.anatomy,
            "model_sha256": model.sha256,
            "weights_sha256": weights_hash(rig.weights),
            "versions": {name: _version(name) for name in PACKAGES},
        },
    }


def _judgement(judgement: Judgement, settings: dict[str, Any]) -> dict[str, Any]:
    check = judgement.check
    limits = judgement.check.limits
    worst = judgement.measures[judgement.worst]
    return {
        "code": check.code,
        "group": check.group,
        "title": check.title,
        "verdict": judgement.verdict,
        "value": float(f"{worst.value:.4g}") if math.isfinite(worst.value) else None,
        "unit": limits.unit,
        "good": limits.good,
        "usable": None if math.isinf(limits.usable) else limits.usable,
        "least": limits.least,
        "worst": judgement.worst,
        "detail": worst.detail,
        "says": str(worst.worst or worst.detail),
        "failed": [name for name in judgement.measures if judgement.of(name) != "good"],
        "meaning": check.meaning,
        "advice": check.advise(settings),
    }


def _expression(
    model: SubjectModel, fit: ExpressionFit, check: ExpressionCheck, judgements: list[Judgement]
) -> dict[str, Any]:
    error = fit.measured_error(model.face)
    regions = measured_regions(model, fit)
    mine = [judgement for judgement in judgements if fit.name in judgement.measures]
    flesh = check.flesh
    trip = fit.round_trip
    return {
        "role": fit.role,
        "verdict": expression_verdict(judgements, fit.name),
        "failed": [each.check.code for each in mine if each.of(fit.name) != "good"],
        "coverage": rounded(len(error) / len(model.face)),
        **distances(error),
        "inverted": fit.inverted,
        "solver": fit.solver,
        "status": fit.status,
        "warnings": [notice.as_dict() for notice in fit.notices],
        "iterations": fit.iterations,
        "seconds": round(fit.seconds, 3),
        "jaw": [round(float(value), 6) for value in fit.jaw],
        "regions": {name: rounded(seen.mean()) for name, (_, seen) in regions.items()},
        "by_region": {
            name: {"coverage": rounded(len(seen) / len(ids)), **distances(seen)}
            for name, (ids, seen) in regions.items()
        },
        "flesh": flesh and {**_plain_fields(flesh), "residual": float(f"{flesh.residual:.3e}")},
        "crossing": _crossing(check.crossing),
        "scan_crossing": _crossing(check.scan_crossing),
        "jaw_motion": _jaw(check.jaw),
        "muscles": _muscles(model, check.muscles),
        "movers": _movers(check),
        "known": [each.as_dict() for each in fit.known],
        "asymmetry_mm": None if check.asymmetry_mm is None else rounded(check.asymmetry_mm),
        "round_trip": trip and {"reached": trip.is_reached, **_plain_fields(trip)},
    }


def _jaw(found: JawFigures) -> dict[str, Any]:
    openers = {muscle: rounded(by) for muscle, by in found.openers.items()}
    return {**_plain_fields(found), "openers": openers, "faults": found.faults()}


def _crossing(found: Crossing | None) -> dict[str, float | None] | None:
    if found is None:
        return None
    depths = {name.removesuffix("_mm"): name for name in CONTACTS}
    return {key: _plain(getattr(found, name)) for name, key in depths.items()}


def _muscles(model: SubjectModel, found: ExpressionMuscles) -> dict[str, dict[str, Any]]:
    columns = ("fibres", "shortest", "longest", "volume", "flesh_mm3")
    return {
        name: {column: rounded(getattr(found, column)[number]) for column in columns}
        | {"whole": model.muscle_groups[number], "faults": found.faults(number)}
        for number, name in enumerate(model.muscle_names)
    }


def _movers(check: ExpressionCheck) -> dict[str, Any]:
    found = check.movers
    return {
        "contractions": [
            {"muscle": name, "contraction": rounded(each)}
            for name, each in found.contractions.items()
        ],
        "actions": [_action(check) for check in found.actions],
        "contradictions": [str(each) for each in found.contradictions()],
        "uneven": [str(each) for each in uneven_sides(check)],
    }


def _action(check: ActionCheck) -> dict[str, Any]:
    lists = ("muscles", "missing", "ahead", "idle", "lengthened", "opposed")
    return {
        "unit": check.action.unit.code,
        "name": check.action.unit.name,
        "side": check.action.side,
        "rank": check.rank,
        "prime": check.is_prime if check.is_judged else None,
        **{name: list(getattr(check, name)) for name in lists},
    }


def information_figures(model: SubjectModel, found: MuscleInformation) -> dict[str, Any]:
    """Return each muscle's information, and the pairs that the scans confuse, as JSON values."""
    names = model.muscle_names
    return {
        "scans": found.scans,
        "muscles": {name: rounded(found.information[j]) for j, name in enumerate(names)},
        "confused": [
            {"muscles": [names[i], names[j]], "correlation": rounded(correlation)}
            for i, j, correlation in found.confused
        ],
    }


def known_information(rig: Rig) -> MuscleInformation | None:
    """Return the information of :func:`information_figures` that a rig's report has, if any."""
    found = (rig.figures or {}).get("information")
    if not found:
        return None
    number = rig.model.muscle_names.index
    pairs = [(*pair["muscles"], pair["correlation"]) for pair in found["confused"]]
    confused = tuple((number(one), number(other), value) for one, other, value in pairs)
    each = np.array([found["muscles"][name] for name in rig.model.muscle_names])
    return MuscleInformation(each, confused, found["scans"])


def _role_mean(rig: Rig, role: str) -> float | None:
    face = rig.model.face
    means = [fit.measured_error(face).mean() for fit in rig.expressions if fit.role == role]
    return rounded(np.mean(means)) if means else None


def _plain(value: Any) -> Any:
    return rounded(value) if isinstance(value, float) else value


def _plain_fields(found: FleshCheck | JawFigures | RoundTrip) -> dict[str, Any]:
    return {name: _plain(value) for name, value in asdict(found).items()}


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
