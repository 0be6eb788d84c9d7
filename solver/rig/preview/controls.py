"""The sliders: every muscle's contraction, the jaw's ways, and what else each expression uses.

All are numbers from 0 to 1 that change (a, b) linearly. The contraction of a muscle and its range
come from the fitted expressions (:mod:`~solver.rig.preview.directions`); a muscle that none of them
uses shortens along its fibres and keeps its volume. The jaw has two controls, one each way, for
each of its degrees of freedom that is used. One number per muscle can not tell all of a fit with
six: what is left of each expression is a control of its own, so that every fit can be reached.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.sparse as sp

from solver.fitting.face import Face, Pose
from solver.fitting.objective import JAW_UNITS, LEAST_STRETCH
from solver.fitting.resting import Resting
from solver.fitting.stretches import COLUMN, FROBENIUS, ROW, matrices
from solver.mechanics.flesh import IDENTITY
from solver.rig.plausibility import fibre_tensors
from solver.rig.preview.directions import used_directions
from solver.rig.result import ExpressionFit
from solver.surface import Floats

MARGIN = 1.25
"""A slider goes so many times as far as the fitted expressions do."""

IDLE_STRETCH = 0.8
"""Length to which a muscle's fibres shorten that no expression uses."""

IDLE = 0.02
"""Change of the activation below which no expression uses a muscle."""

LEAST_OPENING = 0.2
"""The jaw opens by so many radians at least."""

CONDYLE_PATH_MM = 30.0
"""The condyles' way forward per radian of opening (Muto and Kanazawa 1996: 20.5 mm and 39.1°)."""

LEAST_JAW_MM = 0.3
"""Motion of the chin from which on a degree of freedom counts as used."""

JAW_WAYS = (
    ("jaw opens", "jaw closes"),
    ("jaw turns left", "jaw turns right"),
    ("jaw moves left", "jaw moves right"),
    ("jaw moves up", "jaw moves down"),
    ("jaw moves forward", "jaw moves back"),
)
"""b's entries, and where each leads when it grows and when it falls."""

Kind = Literal["muscle", "jaw", "expression"]


@dataclass(frozen=True)
class Control:
    """One slider; ``muscle`` is the name of the muscle that a control of that kind contracts."""

    name: str
    kind: Kind
    title: str
    muscle: str | None = None


@dataclass(frozen=True)
class Controls:
    """The k sliders.

    ``directions`` (6 m + 5, k) is the change of (a, b) from rest that each makes at 1, ``presets``
    the values (k,) of every fitted expression.
    """

    each: tuple[Control, ...]
    directions: Floats
    presets: dict[str, Floats]

    def __len__(self) -> int:
        """Return k."""
        return len(self.each)

    def pose(self, values: Floats) -> Pose:
        """Return the pose of slider ``values`` (k,)."""
        change = self.directions @ values
        return Pose(IDENTITY + change[:-5].reshape(-1, 6), change[-5:])

    def of_kind(self, kind: Kind) -> list[int]:
        """Return the numbers of the controls of a kind."""
        return [number for number, control in enumerate(self.each) if control.kind == kind]


def controls_of(
    face: Face, S: sp.csr_array, rest: Resting, fits: Sequence[ExpressionFit]
) -> Controls:
    """Return the controls of a face with one fitted expression or more."""
    muscles, contraction, contracted = _muscles(face, S, rest, fits)
    jaw, ways, opened = _jaw(np.array([fit.jaw for fit in fits]))
    directions = np.zeros((6 * face.model.muscle_count + 5, len(muscles) + len(jaw)))
    directions[:-5, : len(muscles)] = contraction
    directions[-5:, len(muscles) :] = ways
    values = np.hstack([contracted, opened])
    fitted = np.array([[*(fit.activations - IDENTITY).ravel(), *fit.jaw] for fit in fits])
    left = fitted - values @ directions.T
    others = tuple(
        Control(f"{fit.name}, the rest", "expression", f"What else {fit.name} uses") for fit in fits
    )
    whole = np.hstack([values, np.eye(len(fits))])
    return Controls(
        (*muscles, *jaw, *others),
        np.hstack([directions, left.T]),
        {fit.name: row for fit, row in zip(fits, whole, strict=True)},
    )


def _muscles(
    face: Face, S: sp.csr_array, rest: Resting, fits: Sequence[ExpressionFit]
) -> tuple[list[Control], Floats, Floats]:
    """Return the muscles' controls, their changes of a (6 m, .) and the fits' values (e, .).

    A muscle that neither the fits use nor has fibres in S moves nothing, and has none.
    """
    model, count = face.model, face.model.muscle_count
    fitted = np.array([fit.activations - IDENTITY for fit in fits])
    # rest.matrix is the curvature of a mean square: twice J^T J
    axes, amounts = used_directions(fitted, 0.5 * rest.matrix[:-5, :-5])
    tensors = fibre_tensors(model, face.flesh.volumes, S)
    changes, values = np.zeros((count, count, 6)), np.zeros((len(fits), count))
    for muscle, most in enumerate(amounts.max(axis=0)):
        if most > IDLE:
            change = _upright(MARGIN * most * axes[muscle])
            changes[muscle, muscle] = change
            size = np.sqrt(FROBENIUS @ change**2)
            values[:, muscle] = np.minimum(amounts[:, muscle] / size, 1.0)
        elif np.isfinite(tensors[muscle]).all():
            changes[muscle, muscle] = _shortening(tensors[muscle], IDLE_STRETCH)
    kept = np.flatnonzero(changes.any(axis=(1, 2)))
    names = [model.muscle_names[muscle] for muscle in kept]
    listed = [Control(name, "muscle", name, name) for name in names]
    return listed, changes.reshape(count, -1)[kept].T, values[:, kept]


def _upright(change: Floats) -> Floats:
    """Return as much of an activation's ``change`` (6,) as shrinks it to a tenth at most."""
    shrinks = -float(np.linalg.eigvalsh(matrices(change[None]))[0, 0])
    return change * min(1.0, (1.0 - LEAST_STRETCH) / shrinks) if shrinks > 0.0 else change


def _shortening(tensor: Floats, stretch: float) -> Floats:
    """Return the change (6,) that shortens fibres to ``stretch`` and keeps the muscle's volume.

    ``tensor`` (3, 3) is the mean of d d^T over the fibre directions d. Its deviator is the
    logarithmic strain, so that a ring shortens in its plane and thickens across.
    """
    values, axes = np.linalg.eigh(tensor)
    strain = 1.5 * np.log(stretch) * (values - values.mean()) / values.max()
    matrix = (axes * np.exp(strain)) @ axes.T
    return np.asarray(matrix[ROW, COLUMN] - IDENTITY)


def _jaw(fitted: Floats) -> tuple[list[Control], Floats, Floats]:
    """Return the jaw's controls, their changes of b (5, .) and the values (e, .) of ``fitted``.

    An opening jaw takes its condyles along, ``fitted`` (e, 5) counts from there.
    """
    along = np.eye(5)
    along[4, 0] = CONDYLE_PATH_MM
    places = fitted @ np.linalg.inv(along).T
    listed, columns, values = [], [], []
    for axis, ways in enumerate(JAW_WAYS):
        for sign, title in zip((1.0, -1.0), ways, strict=True):
            there = np.maximum(sign * places[:, axis], 0.0)
            most = MARGIN * there.max(initial=0.0)
            if title == "jaw opens":
                most = max(most, LEAST_OPENING)
            if most * JAW_UNITS[axis] < LEAST_JAW_MM:
                continue
            listed.append(Control(title.replace(" ", "_"), "jaw", title.capitalize()))
            columns.append(sign * most * along[:, axis])
            values.append(there / most)
    return listed, np.array(columns).T, np.array(values).T
