"""The job that calibrates fibre muscles to the scans of a rig."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from solver.errors import InputError
from solver.fitting.calibration import (
    CalibrationOptions,
    calibrate,
    fibre_muscles,
    fit_all,
    save_muscles,
    with_fibres,
)
from solver.fitting.contact import terms
from solver.fitting.face import Face, PosedFace
from solver.fitting.fallback import FallbackFit
from solver.fitting.objective import Target, distances
from solver.fitting.strips import StripOptions, strip_names
from solver.jobs import Task
from solver.jobs.fits import Targets
from solver.kinds.fit_fibres import FitFibres
from solver.mechanics.flesh import MOONEY_RIVLIN
from solver.progress import Step
from solver.rig.rig import Rig

DECIMALS = 4  # of figures in mm


def run(task: Task[FitFibres]) -> list[Path]:
    """Calibrate the muscles of ``rig``; write ``fibre_muscles.npz`` and the figures of it.

    The fractions to begin with are those of the model, by volume: a fitted S is of other muscles.
    Raises :class:`InputError` (``fibres.no_scans``, ``model.fibres``).
    """
    given, progress = task.options, task.progress
    progress(Step("read", 0.0))
    rig = Rig.load(task.inputs)
    model = rig.model
    face = Face(model, material=MOONEY_RIVLIN, linear=given.linear_solver)
    plain = fibre_muscles(face)
    roles = {fit.name: fit.role for fit in rig.expressions}
    make = Targets(model, given.distance)
    seen = [fit for fit in rig.expressions if np.isfinite(fit.error_mm[model.face]).any()]
    targets = {}
    for fit in seen:
        known = np.isfinite(fit.error_mm[model.face])
        points = np.where(known[:, None], fit.target[model.face], np.nan)
        targets[fit.name] = make.of_points(points, known.astype(np.float64))
    train = {name: target for name, target in targets.items() if roles[name] == "train"}
    if not train:
        message = "the rig has no expression that it was fitted to: fit its muscle geometry first"
        raise InputError("fibres.no_scans", message)
    strips = StripOptions(breadth_mm=given.strips_mm) if given.strips_mm else None
    options = replace(CalibrationOptions(), rounds=given.rounds, strips=strips)
    begin = time.perf_counter()

    def listen(number: int, states: Mapping[str, PosedFace]) -> None:
        skins = {name: face.face_points(state.estimate) for name, state in states.items()}
        error = float(np.mean([np.nanmean(train[name].distances(skins[name])) for name in skins]))
        part = 0.1 + 0.7 * number / options.rounds
        progress(Step("calibration", part, number + 1, mean_error_mm=error))

    before = fit_all(with_fibres(face, plain), distances(face, targets), options)
    found = calibrate(face, distances(face, train), options, listen, ends=terms(face, train))
    progress(Step("unseen", 0.8))
    others = {name: target for name, target in targets.items() if name not in train}
    endings = {**found.endings, **fit_all(found.face, terms(face, others), options)}
    save_muscles(task.out / "fibre_muscles.npz", face, found.muscles)
    expressions = {
        name: {
            "role": roles[name],
            **_figures(face, target, endings[name]),
            "uncalibrated_mm": _error(face, target, before[name]),
        }
        for name, target in targets.items()
    }
    for fit in seen:
        error = fit.measured_error(model.face)
        expressions[fit.name]["blended_mm"] = round(float(error.mean()), DECIMALS)
    names = strip_names(model.muscle_names, found.muscles)
    strengths = found.muscles.strengths / face.flesh.material.mu
    report = {
        "means": {
            f"{role}_{kind}": _mean(expressions, role, kind)
            for role in ("train", "test")
            for kind in ("fibre_mm", "uncalibrated_mm", "blended_mm")
        },
        "expressions": expressions,
        "strengths": dict(zip(names, strengths.round(2).tolist(), strict=True)),
        "seconds": round(time.perf_counter() - begin, 1),
    }
    file = task.out / "fibre_muscles.json"
    file.write_text(json.dumps(report, indent=1), encoding="utf-8")
    progress(Step("done", 1.0))
    return [task.out / "fibre_muscles.npz", file]


def _error(face: Face, target: Target, ending: FallbackFit) -> float:
    """Return the mean distance over what the scan shows, mm."""
    points = face.face_points(ending.state.x)
    return round(float(np.nanmean(target.distances(points))), DECIMALS)


def _figures(face: Face, target: Target, ending: FallbackFit) -> dict[str, Any]:
    state = ending.state
    return {
        "fibre_mm": _error(face, target, ending),
        "status": ending.status,
        "inverted": face.flesh.inverted(state.x),
        "activations": state.pose.a.round(DECIMALS).tolist(),
        "jaw": state.pose.b.round(DECIMALS).tolist(),
    }


def _mean(expressions: Mapping[str, Mapping[str, Any]], role: str, kind: str) -> float | None:
    found = [each[kind] for each in expressions.values() if each["role"] == role]
    return round(float(np.mean(found)), DECIMALS) if found else None
