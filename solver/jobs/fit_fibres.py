"""The job that calibrates fibre muscles to the scans of a rig."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from solver.errors import InputError
from solver.fitting import geometry
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
from solver.kinds.kind import Distance
from solver.mechanics.fibre_muscle import FibreMuscles
from solver.mechanics.flesh import MOONEY_RIVLIN
from solver.mechanics.linear import fastest
from solver.progress import Step
from solver.rig import Rig
from solver.rig.report import known_information, report
from solver.rig.report.certificate import certify
from solver.rig.report.web_page import write_page
from solver.storage import write_json

DECIMALS = 4  # of figures in mm


@dataclass(frozen=True)
class _Scans:
    """Targets of a rig's expressions, their roles, and how near S came to them, mm."""

    targets: dict[str, Target]
    roles: dict[str, str]
    blended_mm: dict[str, float]

    @classmethod
    def of(cls, rig: Rig, distance: Distance) -> _Scans:
        """Return the scans that a rig was fitted to, or tested by.

        Raises :class:`InputError` (``fibres.no_scans``) if it was fitted to none.
        """
        face = rig.model.face
        make = Targets(rig.model, distance)
        seen = [fit for fit in rig.expressions if np.isfinite(fit.error_mm[face]).any()]
        if not any(fit.role == "train" for fit in seen):
            message = "the rig has no expression that it was fitted to"
            raise InputError("fibres.no_scans", f"{message}: fit its muscle geometry first")
        targets = {}
        for fit in seen:
            confidence = fit.seen(face)
            points = np.where(confidence[:, None] > 0.0, fit.target[face], np.nan)
            targets[fit.name] = make.of_points(points, confidence)
        blended = {fit.name: float(fit.measured_error(face).mean()) for fit in seen}
        return cls(targets, {fit.name: fit.role for fit in seen}, blended)

    def of_role(self, role: str) -> dict[str, Target]:
        """Return the targets of a role."""
        return {name: target for name, target in self.targets.items() if self.roles[name] == role}


def run(task: Task[FitFibres]) -> list[Path]:
    """Calibrate the muscles of ``rig``; write ``fibre_muscles.npz`` and the figures of it.

    The rig's certificate is left once more, with the figures of these muscles beside those of S.
    The fractions to begin with are those of the model, by volume: a fitted S is of other muscles.
    Raises :class:`InputError` (``fibres.no_scans``, ``model.fibres``).
    """
    given = task.options
    progress = task.progress
    progress(Step("read", 0.0))
    rig = Rig.load(task.inputs)
    face = Face(rig.model, material=MOONEY_RIVLIN, linear=given.linear_solver)
    plain = fibre_muscles(face)
    scans = _Scans.of(rig, given.distance)
    train = scans.of_role("train")
    strips = StripOptions(breadth_mm=given.strips_mm) if given.strips_mm else None
    options = replace(CalibrationOptions(), rounds=given.rounds, strips=strips)
    begin = time.perf_counter()

    def listen(number: int, states: Mapping[str, PosedFace]) -> None:
        error = geometry.mean_error(face, train, states)
        part = 0.1 + 0.7 * number / options.rounds
        progress(Step("calibration", part, number + 1, mean_error_mm=error))

    # by the same terms as what comes out, contact among them
    before = fit_all(with_fibres(face, plain), terms(face, scans.targets), options)
    found = calibrate(face, distances(face, train), options, listen, ends=terms(face, train))
    progress(Step("unseen", 0.8))
    others = terms(face, scans.of_role("test"))
    endings = {**found.endings, **fit_all(found.face, others, options)}
    files = [task.out / "fibre_muscles.npz", task.out / "fibre_muscles.json"]
    save_muscles(files[0], face, found.muscles)
    figures = _figures(face, scans, found.muscles, before, endings)
    seconds = round(time.perf_counter() - begin, 1)
    write_json(files[1], figures | {"seconds": seconds})
    progress(Step("export", 0.95))
    files += _write_certificate(rig, figures, task.out)
    progress(Step("done", 1.0))
    return files


def _write_certificate(rig: Rig, fibres: dict[str, Any], out: Path) -> list[Path]:
    """Write ``report.json`` and ``report.html`` of a rig with the ``fibres`` of its person."""
    settings = (rig.figures or {}).get("settings", {})
    face = Face(rig.model, rig.weights, linear=fastest())
    certificate = certify(face, rig, settings, known_information(rig))
    figures = report(rig, certificate) | {"fibres": fibres}
    files = [out / "report.json", out / "report.html"]
    write_json(files[0], figures)
    write_page(files[1], figures)
    return files


def _figures(
    face: Face,
    scans: _Scans,
    muscles: FibreMuscles,
    before: Mapping[str, FallbackFit],
    endings: Mapping[str, FallbackFit],
) -> dict[str, Any]:
    """Return the figures of fits ``before`` and after calibration."""
    names = strip_names(face.model.muscle_names, muscles)
    expressions = {
        name: {
            "role": scans.roles[name],
            **_fit_figures(face, names, target, endings[name]),
            "uncalibrated_mm": _error(face, target, before[name]),
            "blended_mm": round(scans.blended_mm[name], DECIMALS),
        }
        for name, target in scans.targets.items()
    }
    strengths = (muscles.strengths / face.flesh.material.mu).round(2).tolist()
    return {
        "means": {
            f"{role}_{kind}": _mean(expressions, role, kind)
            for role in ("train", "test")
            for kind in ("fibre_mm", "uncalibrated_mm", "blended_mm")
        },
        "expressions": expressions,
        "strengths": dict(zip(names, strengths, strict=True)),
    }


def _error(face: Face, target: Target, ending: FallbackFit) -> float:
    """Return the mean distance over what the scan shows, mm."""
    points = face.face_points(ending.state.x)
    return round(float(np.nanmean(target.distances(points))), DECIMALS)


def _fit_figures(
    face: Face, names: Sequence[str], target: Target, ending: FallbackFit
) -> dict[str, Any]:
    state = ending.state
    return {
        "fibre_mm": _error(face, target, ending),
        "status": ending.status,
        "inverted": face.flesh.count_inverted(state.x),
        "activations": dict(zip(names, state.pose.a.round(DECIMALS).tolist(), strict=True)),
        "jaw": state.pose.b.round(DECIMALS).tolist(),
    }


def _mean(expressions: Mapping[str, Mapping[str, Any]], role: str, kind: str) -> float | None:
    found = [each[kind] for each in expressions.values() if each["role"] == role]
    return round(float(np.mean(found)), DECIMALS) if found else None
