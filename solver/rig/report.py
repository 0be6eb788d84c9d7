"""``report.json``: the certificate's figures, as docs/reference/rig-format.md describes them."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp

from solver.contact.crossing import Crossing
from solver.model import SubjectModel
from solver.rig.certificate import Certificate, ExpressionCheck, FleshCheck, Muscles
from solver.rig.checks import Judgement, Verdict, judge, overall, use
from solver.rig.result import ExpressionFit
from solver.rig.rig import Rig
from solver.surface import Floats

PACKAGES = ("myoface", "numpy", "scipy", "numba")


def report(rig: Rig, certificate: Certificate) -> dict[str, Any]:
    """Return the figures of a rig as plain JSON values; distances in mm, times in seconds.

    Means are over the part of ``model.face`` that the scan shows (``coverage``), ``train_mean_mm``
    and ``test_mean_mm`` are the means of the expressions' means (None without any). ``inverted`` is
    the sum over the expressions.
    """
    model = rig.model
    judgements = judge(rig, certificate)
    noticed: list[Verdict] = ["usable"] if rig.notices else []
    verdict = overall([judgement.verdict for judgement in judgements] + noticed)
    expressions = {
        fit.name: _expression(model, fit, certificate.expressions[fit.name], judgements)
        for fit in rig.expressions
    }
    bad = [name for name, found in expressions.items() if found["verdict"] == "bad"]
    return {
        "verdict": verdict,
        "use": use(verdict, bad, len(expressions)),
        "checks": [_judgement(judgement, certificate.settings) for judgement in judgements],
        "expressions": expressions,
        "warnings": [notice.as_dict() for notice in rig.notices],
        "train_mean_mm": _role_mean(rig, "train"),
        "test_mean_mm": _role_mean(rig, "test"),
        "inverted": sum(fit.inverted for fit in rig.expressions),
        "tets": len(model.tets),
        "vertices": len(model.rest),
        "muscles": model.muscle_count,
        "seconds": {phase: round(seconds, 3) for phase, seconds in rig.seconds.items()},
        "settings": certificate.settings,
        "made_with": {
            "template": model.anatomy,
            "model_sha256": model.sha256,
            "weights_sha256": weights_hash(rig.weights),
            "versions": {name: _version(name) for name in PACKAGES},
        },
    }


def write_report(path: Path, figures: dict[str, Any]) -> None:
    """Write :func:`report` as strict JSON (no NaN)."""
    path.write_text(json.dumps(figures, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def weights_hash(S: sp.csr_array) -> str:
    """Return the sha256 of S (n, m + 1)."""
    digest = hashlib.sha256(np.ascontiguousarray(S.indptr, dtype="<i8").tobytes())
    digest.update(np.ascontiguousarray(S.indices, dtype="<i8").tobytes())
    digest.update(np.ascontiguousarray(S.data, dtype="<f8").tobytes())
    return digest.hexdigest()


def _judgement(judgement: Judgement, settings: dict[str, Any]) -> dict[str, Any]:
    check = judgement.check
    worst = judgement.measures[judgement.worst]
    failed = [name for name in judgement.measures if judgement.of(name) != "good"]
    return {
        "code": check.code,
        "group": check.group,
        "title": check.title,
        "verdict": judgement.verdict,
        "value": float(f"{worst.value:.4g}") if math.isfinite(worst.value) else None,
        "unit": check.unit,
        "good": check.good,
        "usable": None if math.isinf(check.usable) else check.usable,
        "least": check.least,
        "worst": judgement.worst,
        "detail": worst.detail,
        "failed": failed,
        "meaning": check.meaning,
        "advice": check.advise(settings),
    }


def _expression(
    model: SubjectModel, fit: ExpressionFit, check: ExpressionCheck, judgements: list[Judgement]
) -> dict[str, Any]:
    error = fit.measured_error(model.face)
    regions = {
        name: (ids, fit.measured_error(ids))
        for name, every in model.regions.items()
        if len(fit.measured_error(ids := np.intersect1d(every, model.face)))
    }
    mine = [judgement for judgement in judgements if fit.name in judgement.measures]
    return {
        "role": fit.role,
        "verdict": overall([judgement.of(fit.name) for judgement in mine]),
        "failed": [each.check.code for each in mine if each.of(fit.name) != "good"],
        "coverage": _figure(len(error) / len(model.face)),
        **_distances(error),
        "inverted": fit.inverted,
        "solver": fit.solver,
        "status": fit.status,
        "warnings": [notice.as_dict() for notice in fit.notices],
        "iterations": fit.iterations,
        "seconds": round(fit.seconds, 3),
        "jaw": [round(float(value), 6) for value in fit.jaw],
        "regions": {name: _figure(seen.mean()) for name, (_, seen) in regions.items()},
        "by_region": {
            name: {"coverage": _figure(len(seen) / len(ids)), **_distances(seen)}
            for name, (ids, seen) in regions.items()
        },
        "flesh": None if check.flesh is None else _flesh(check.flesh),
        "crossing": _crossing(check.crossing),
        "scan_crossing": _crossing(check.scan_crossing),
        "jaw_motion": {
            **{name: _plain(value) for name, value in asdict(check.jaw).items()},
            "faults": check.jaw.faults(),
        },
        "muscles": _muscles(model, check.muscles),
        "round_trip": None
        if fit.round_trip is None
        else {
            "reached": fit.round_trip.is_reached,
            **{name: _figure(value) for name, value in asdict(fit.round_trip).items()},
        },
    }


def _distances(error: Floats) -> dict[str, float | None]:
    return {
        "mean_mm": _figure(error.mean()),
        "p95_mm": _figure(np.percentile(error, 95)),
        "max_mm": _figure(error.max()),
    }


def _flesh(flesh: FleshCheck) -> dict[str, Any]:
    return {name: _plain(value) for name, value in asdict(flesh).items()} | {
        "residual": float(f"{flesh.residual:.3e}")
    }


def _crossing(found: Crossing | None) -> dict[str, float | None] | None:
    if found is None:
        return None
    depths = (found.lips, found.upper_teeth, found.lower_teeth, found.bite)
    return {
        f"{name}_mm": None if depth is None else _figure(depth)
        for name, depth in zip(("lips", "upper_teeth", "lower_teeth", "bite"), depths, strict=True)
    }


def _muscles(model: SubjectModel, found: Muscles) -> dict[str, dict[str, Any]]:
    return {
        name: {
            "fibres": _figure(found.fibres[number]),
            "shortest": _figure(found.shortest[number]),
            "longest": _figure(found.longest[number]),
            "volume": _figure(found.volume[number]),
            "flesh_mm3": _figure(found.flesh_mm3[number]),
            "faults": found.faults(number),
        }
        for number, name in enumerate(model.muscle_names)
    }


def _role_mean(rig: Rig, role: str) -> float | None:
    means = [
        fit.measured_error(rig.model.face).mean() for fit in rig.expressions if fit.role == role
    ]
    return _figure(np.mean(means)) if means else None


def _plain(value: float | str) -> Any:
    return _figure(value) if isinstance(value, float) else value


def _figure(value: float | np.floating) -> float | None:
    """Return a figure with four decimals; None for what is not finite."""
    return round(float(value), 4) if math.isfinite(value) else None


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
