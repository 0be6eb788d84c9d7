"""What is checked of a rig's expressions beyond their distance to the scans."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse as sp

from solver.contact.crossing import Crossing, crossing
from solver.contact.mouth import Mouth
from solver.fitting.face import Face, Pose
from solver.fitting.resting import Resting
from solver.mechanics.equilibrium import factorise
from solver.mechanics.linear import LinearSolver, analyse
from solver.rig.plausibility import JawMotion, Muscles, jaw_motion, muscles
from solver.rig.result import ExpressionFit, Rig
from solver.rig.round_trip import round_trip
from solver.surface import Floats


@dataclass(frozen=True)
class FleshCheck:
    """The tets of one expression.

    ``inverted`` counts det F <= 0; ``det_least`` and ``det_most`` are the volumes of the flattest
    and the most swollen tet by their rest volumes, ``flattest`` and ``swollen`` their numbers.
    ``volume_percent`` is the change of the whole flesh's volume. ``residual`` is |grad E| over the
    nodal forces at unit strain, ``minimum`` tells whether the Hessian is positive definite.
    """

    inverted: int
    det_least: float
    det_most: float
    flattest: int
    swollen: int
    volume_percent: float
    residual: float
    minimum: bool


@dataclass(frozen=True)
class ExpressionCheck:
    """The checks of one expression.

    ``flesh`` is None where the rig does not hold the tets. ``crossing`` is of the fitted skin,
    ``scan_crossing`` of the scan; both are None where the model names no lips, the latter too where
    the scan has holes.
    """

    muscles: Muscles
    jaw: JawMotion
    flesh: FleshCheck | None
    crossing: Crossing | None
    scan_crossing: Crossing | None


@dataclass(frozen=True)
class Certificate:
    """The checks of a rig: expression -> check, and the ``settings`` of the job that made it."""

    expressions: dict[str, ExpressionCheck]
    settings: dict[str, Any]


Listener = Callable[[str, int], None]
"""Called before each expression with its name and number."""


def with_round_trips(
    face: Face, S: sp.csr_array, fits: tuple[ExpressionFit, ...], listen: Listener | None = None
) -> tuple[ExpressionFit, ...]:
    """Return the fits with their round trips; those that have one keep it."""
    rest = Resting(face, S)
    done = []
    for number, fit in enumerate(fits):
        if fit.round_trip is None:
            if listen:
                listen(fit.name, number)
            pose, skin = Pose(fit.activations, fit.jaw), fit.skin[face.model.face]
            done.append(replace(fit, round_trip=round_trip(face, S, pose, skin, rest)))
        else:
            done.append(fit)
    return tuple(done)


def certify(face: Face, rig: Rig, settings: dict[str, Any]) -> Certificate:
    """Check every expression of a rig of ``face``; ``settings`` are JSON values."""
    mouth = Mouth.of(face.model)
    # the signs of pivots near buckling take double precision, whatever the fit had
    linear = analyse(face.flesh.hessian(face.model.rest, face.flesh.passive()))
    checks = {fit.name: _check(face, rig.weights, fit, mouth, linear) for fit in rig.expressions}
    return Certificate(checks, settings)


def _check(
    face: Face, S: sp.csr_array, fit: ExpressionFit, mouth: Mouth | None, linear: LinearSolver
) -> ExpressionCheck:
    model = face.model
    whole = np.isfinite(fit.target).all()
    return ExpressionCheck(
        muscles(model, face.flesh.volumes, S, fit.activations),
        jaw_motion(model, fit.jaw),
        None
        if fit.x is None
        else check_flesh(face, face.tet_activations(S, fit.activations), fit.x, linear),
        None if mouth is None else crossing(mouth, fit.skin),
        None if mouth is None or not whole else crossing(mouth, fit.target),
    )


def check_flesh(face: Face, a: Floats, x: Floats, linear: LinearSolver) -> FleshCheck:
    """Check vertices ``x`` (p, 3) under activations ``a`` (n, 6); ``linear`` finds the inertia."""
    flesh = face.flesh
    det = flesh.openings(x)
    residual = np.linalg.norm(flesh.gradient(x, a)) / flesh.force_scale
    _, share = factorise(flesh, linear, x, a)
    return FleshCheck(
        inverted=int((det <= 0.0).sum()),
        det_least=float(det.min()),
        det_most=float(det.max()),
        flattest=int(det.argmin()),
        swollen=int(det.argmax()),
        volume_percent=float(100.0 * (det @ flesh.volumes / flesh.volumes.sum() - 1.0)),
        residual=float(residual),
        minimum=share == 0,
    )
