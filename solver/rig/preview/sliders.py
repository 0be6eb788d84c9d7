"""The sliders: every muscle's contraction, the jaw's ways, what else each expression uses.

All are numbers from 0 to 1 that change (a, b) linearly. A muscle's slider contracts it along its
fibres. The jaw has two, one each way, for each of its degrees of freedom that is used. One number
per muscle cannot tell all of a fit with six: what is left of each expression is a control of its
own, so that every fit can be reached.

Sliders that markers drive live are a template's expressions instead: they span what faces do, and
few numbers are fast.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.linalg
import scipy.optimize
from numpy.typing import NDArray

from solver.fitting.activation import rest_curvature
from solver.fitting.face import Face, Pose
from solver.fitting.joints import JAW_UNITS
from solver.fitting.prior import fitted_changes
from solver.fitting.stretches import FROBENIUS, fibre_tensors, shorten
from solver.mechanics.flesh import IDENTITY
from solver.rig.rig import ExpressionFit
from solver.surface import Floats

# What a muscle's slider does: the muscle shortens along its fibres, as muscles do.
#
# A fit has six numbers a muscle, and uses them freely: seen by itself, a fitted activation may push
# where the muscle would pull. So a slider is not the fit's but the muscle's: C_j, its contraction.
# The amounts of an expression's activations A_e (m, 6), as differences from rest, are those that
# come nearest to it,
#
#     min over 0 <= c <= 1 of |sum_j c_j C_j - A_e|^2 in the norm J^T J + w I,
#
# J being the skin's linear response at rest: what matters of an activation is what is seen of it.
# The small w keeps what is hardly seen near the fits too.


@dataclass(frozen=True)
class SliderOptions:
    """Ends of the sliders, and weights that split fits between them."""

    # length to which a slider at 1 shortens a muscle's fibres: well within what muscles can (half:
    # solver.rig.certificate.MUSCLE_SOURCE), and on the straight line from rest to there the
    # muscle's volume is never off by more than 5 %
    full_stretch: float = 0.6
    unseen: float = 1e-2  # the weight w, mm^2
    jitter: float = 1e-9  # part of the mean diagonal that makes a Gram matrix definite
    margin: float = 1.25  # the jaw's sliders go so many times as far as the fitted expressions
    least_opening: float = 0.2  # rad, by which the jaw opens at least
    # way of the condyles per radian of opening (Muto and Kanazawa 1996: 20.5 mm and 39.1 degrees)
    condyle_path_mm: float = 30.0
    least_jaw_mm: float = 0.3  # motion of the chin from which on a degree of freedom is used


def nearest_amounts(
    activations: Floats,
    contractions: Floats,
    seen: Floats,
    options: SliderOptions = SliderOptions(),
) -> Floats:
    """Return the amounts (e, k), from 0 to 1, that come nearest to fitted activations.

    ``activations`` (e, 6 m) are differences from rest, ``contractions`` (6 m, k) the changes at 1,
    ``seen`` (6 m, 6 m) is J^T J in mm^2.
    """
    if not contractions.size:
        return np.zeros((len(activations), 0))
    norm = seen + options.unseen * np.diag(np.tile(FROBENIUS, len(seen) // 6))
    gram = contractions.T @ norm @ contractions
    jitter = np.eye(len(gram)) * options.jitter * np.trace(gram) / len(gram)
    root = np.linalg.cholesky(gram + jitter).T
    right = scipy.linalg.solve_triangular(root, contractions.T @ norm @ activations.T, trans="T")
    return np.array([scipy.optimize.lsq_linear(root, each, (0.0, 1.0)).x for each in right.T])


# b's entries, and where each leads when it grows and when it falls
JAW_WAYS = (
    ("jaw opens", "jaw closes"),
    ("jaw turns left", "jaw turns right"),
    ("jaw moves left", "jaw moves right"),
    ("jaw moves up", "jaw moves down"),
    ("jaw moves forward", "jaw moves back"),
)

Kind = Literal["muscle", "jaw", "expression"]


@dataclass(frozen=True)
class Control:
    """One slider; ``muscle`` is the name of the muscle that a control of that kind contracts."""

    name: str
    kind: Kind
    title: str
    muscle: str | None = None


@dataclass(frozen=True)
class Sliders:
    """The k sliders."""

    each: tuple[Control, ...]
    rest: Pose
    directions: Floats  # (6 m + 5, k) change of (a, b) from ``rest`` that each makes at 1
    presets: dict[str, Floats]  # values (k,) of every fitted expression

    def __len__(self) -> int:
        """Return k."""
        return len(self.each)

    def pose(self, values: Floats) -> Pose:
        """Return the pose of slider ``values`` (k,)."""
        return self.rest.add(self.directions @ values)

    def of_kind(self, kind: Kind) -> list[int]:
        """Return the numbers of the controls of a kind."""
        return [number for number, control in enumerate(self.each) if control.kind == kind]


def controls_of(
    face: Face, fits: Sequence[ExpressionFit], options: SliderOptions = SliderOptions()
) -> Sliders:
    """Return the controls of a face with one fitted expression or more."""
    layout = face.layout
    in_a, in_b = layout["activations"], layout["jaw"]
    fitted = np.array([Pose(fit.activations, fit.jaw).vector() for fit in fits]) - layout.rest
    muscles, changes = _muscles(face, options.full_stretch)
    # the curvature of a mean square is twice J^T J
    seen = 0.5 * rest_curvature(face)[in_a, in_a]
    contracted = nearest_amounts(fitted[:, in_a], changes, seen, options)
    jaws, ways, opened = _jaw(fitted[:, in_b], options)
    directions = np.zeros((layout.size, len(muscles) + len(jaws)))
    directions[in_a, : len(muscles)] = changes
    directions[in_b, len(muscles) :] = ways
    values = np.hstack([contracted, opened])
    left = fitted - values @ directions.T
    others = tuple(
        Control(f"{fit.name}, the rest", "expression", f"What else {fit.name} uses") for fit in fits
    )
    whole = np.hstack([values, np.eye(len(fits))])
    return Sliders(
        (*muscles, *jaws, *others),
        face.rest_pose(),
        np.hstack([directions, left.T]),
        {fit.name: row for fit, row in zip(fits, whole, strict=True)},
    )


def controls_of_shapes(
    face: Face,
    names: Sequence[str],
    shapes: NDArray[np.floating],
    listen: Callable[[float], None] = lambda _done: None,
) -> Sliders:
    """Return a control for each of a template's expressions: the change of (a, b) that makes it.

    ``shapes`` (e, v, 3) are motions of the whole skin, mm; see
    :func:`solver.fitting.prior.fitted_changes`.
    """
    changes = [each[-1] for each in fitted_changes(face, shapes, listen=listen)]
    amounts = np.eye(len(names))
    return Sliders(
        tuple(Control(name, "expression", name) for name in names),
        face.rest_pose(),
        np.array(changes).T,
        dict(zip(names, amounts, strict=True)),
    )


def _muscles(face: Face, full_stretch: float) -> tuple[list[Control], Floats]:
    """Return controls and changes of a (6 m, .) of the muscles that have fibres in S."""
    model, count = face.model, face.model.muscle_count
    tensors = fibre_tensors(model, face.flesh.volumes, face.S)
    kept = np.flatnonzero(np.isfinite(tensors).all(axis=(1, 2)))
    changes = np.zeros((count, 6, len(kept)))
    for column, muscle in enumerate(kept):
        changes[muscle, :, column] = shorten(tensors[muscle], full_stretch) - IDENTITY
    names = [model.muscle_names[muscle] for muscle in kept]
    return [Control(name, "muscle", name, name) for name in names], changes.reshape(6 * count, -1)


def _jaw(fitted: Floats, options: SliderOptions) -> tuple[list[Control], Floats, Floats]:
    """Return the jaw's controls, their changes of b (5, .) and the values (e, .) of ``fitted``."""
    along = np.eye(5)
    # an opening jaw takes its condyles along: the fits count from there
    along[4, 0] = options.condyle_path_mm
    places = fitted @ np.linalg.inv(along).T
    listed, columns, values = [], [], []
    for axis, ways in enumerate(JAW_WAYS):
        for sign, title in zip((1.0, -1.0), ways, strict=True):
            there = np.maximum(sign * places[:, axis], 0.0)
            least = options.least_opening if title == "jaw opens" else 0.0
            most = max(options.margin * there.max(initial=0.0), least)
            if most * JAW_UNITS[axis] >= options.least_jaw_mm:
                listed.append(Control(title.replace(" ", "_"), "jaw", title.capitalize()))
                columns.append(sign * most * along[:, axis])
                values.append(there / most)
    return listed, np.array(columns).T, np.array(values).T
