"""The sliders: every muscle's contraction, the jaw's ways, what else each expression uses.

All are numbers from 0 to 1 that change (a, b) linearly. A muscle's slider contracts it along its
fibres, in the pattern of the person's expressions. The jaw has two, one each way, for each of its
degrees of freedom that is used. One number per muscle cannot tell all of a fit with six: what is
left of each expression is a control of its own, so that every fit can be reached.

Sliders that markers drive live are a template's expressions instead: they span what faces do, and
few numbers are fast.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from solver.anatomy.physiology import CONDYLE_PATH_MM, JAW_FREEDOM, SHORTEST
from solver.fitting.contraction import Contraction
from solver.fitting.controls import JAW_UNITS
from solver.fitting.expression_basis import ExpressionBasis
from solver.fitting.face import Face, Pose
from solver.mechanics.boundary import JawMotion
from solver.mechanics.flesh import IDENTITY
from solver.rig.expression import ExpressionFit
from solver.rig.preview.patterns import contract_in_full
from solver.surface import Floats

# What a muscle's slider does: the muscle shortens along its fibres, as muscles do.
#
# A fit has six numbers a muscle, and uses them freely: seen by itself, a fitted activation may push
# where the muscle would pull. So a slider is not that of one fit but the muscle's: what goes along
# with its contraction in all of them (solver.rig.preview.patterns). An expression sets it to the
# muscle's contraction there (solver.fitting.contraction) by that at 1: the certificate, the tables
# of takes and the sliders say the same of who pulls.


@dataclass(frozen=True)
class SliderOptions:
    """Ends of the sliders."""

    # length to which a slider at 1 shortens parallel fibres: well within what muscles can
    full_stretch: float = 1.2 * SHORTEST
    margin: float = 1.25  # the jaw's sliders go so many times as far as the fitted expressions ...
    # ... and at least this part of what jaws do, so that a jaw which an expression hardly moves is
    # hardly moved on its slider
    least_part: float = 0.25
    condyle_path_mm: float = CONDYLE_PATH_MM
    least_jaw_mm: float = 0.3  # motion of the chin from which on a degree of freedom is used


# b's entries: where each leads when it grows and when it falls, and how far a jaw gets
OPEN, LEFT = (np.radians(JAW_FREEDOM[name]) for name in ("open_deg", "left_deg"))
MOVE = np.array(JAW_FREEDOM["move_mm"])
JAW_WAYS = (
    ("jaw opens", "jaw closes", OPEN),
    ("jaw turns left", "jaw turns right", LEFT),
    ("jaw moves left", "jaw moves right", MOVE),
    ("jaw moves up", "jaw moves down", MOVE),
    ("jaw moves forward", "jaw moves back", MOVE),
)

Kind = Literal["muscle", "jaw", "expression"]


@dataclass(frozen=True)
class Control:
    """One slider; ``muscle`` is the name of the muscle that a control of that kind contracts.

    A muscle that contracts by c is at c / ``full`` on its slider, a jaw with the numbers b on those
    of its ways at ``by_jaw`` . b, both between 0 and 1.
    """

    name: str
    kind: Kind
    title: str
    muscle: str | None = None
    full: float | None = None
    by_jaw: tuple[float, ...] | None = None


@dataclass(frozen=True)
class Sliders:
    """The k sliders."""

    each: tuple[Control, ...]
    rest: Pose
    directions: Floats  # (size, k) change of (a, b) from ``rest`` that each makes at 1
    presets: dict[str, Floats]  # values (k,) of every fitted expression
    jaw: JawMotion  # the mandible's motion by b

    def __len__(self) -> int:
        """Return k."""
        return len(self.each)

    def pose(self, values: Floats) -> Pose:
        """Return the pose of slider ``values`` (k,)."""
        return self.rest.add(self.directions @ values)

    def jaw_numbers(self, values: Floats) -> Floats:
        """Return the jaw's numbers b in that pose, without the muscles: they take longer."""
        layout = self.rest.layout
        own = layout.joint_places
        b = self.rest.b + self.directions[own] @ values
        return np.asarray(np.clip(b, layout.lower[own], layout.upper[own]))

    def of_kind(self, kind: Kind) -> list[int]:
        """Return the numbers of the controls of a kind."""
        return [number for number, control in enumerate(self.each) if control.kind == kind]


def controls_of(
    face: Face, fits: Sequence[ExpressionFit], options: SliderOptions = SliderOptions()
) -> Sliders:
    """Return the controls of a face with one fitted expression or more."""
    layout = face.layout
    in_a = layout["activations"]
    in_b = layout["jaw"]
    fitted = np.array([Pose(fit.activations, fit.jaw).vector() for fit in fits]) - layout.rest
    contraction = Contraction.of_face(face)
    assert contraction is not None, "the sliders of a rig contract muscles by S"
    activations = np.array([fit.activations for fit in fits])
    muscles, changes, contracted = _muscles(
        face.model.muscle_names, contraction, activations, options.full_stretch
    )
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
        face.jaw,
    )


def controls_of_basis(face: Face, names: Sequence[str], basis: ExpressionBasis) -> Sliders:
    """Return a control for each expression of a face's basis: its change of (a, b)."""
    return expression_controls(face, names, basis.whole.T)


def expression_controls(face: Face, names: Sequence[str], directions: Floats) -> Sliders:
    """Return a control for each expression, of which ``directions`` (size, k) are the changes."""
    return Sliders(
        tuple(Control(name, "expression", name) for name in names),
        face.rest_pose(),
        directions,
        dict(zip(names, np.eye(len(names)), strict=True)),
        face.jaw,
    )


def _muscles(
    names: Sequence[str], contraction: Contraction, fitted: Floats, full_stretch: float
) -> tuple[list[Control], Floats, Floats]:
    """Return controls of the muscles that have fibres in S, changes (6 m, .) and values (e, .).

    ``fitted`` (e, m, 6) are the activations of expressions, where a muscle that lengthens is at 0.
    """
    kept = np.flatnonzero(np.isfinite(contraction.tensors).all(axis=(1, 2)))
    pulled = contract_in_full(contraction, fitted, full_stretch)
    changes = np.zeros((len(names), 6, len(kept)))
    changes[kept, :, np.arange(len(kept))] = pulled[kept] - IDENTITY
    full = contraction(pulled)[kept]
    values = np.clip(contraction(fitted)[:, kept] / full, 0.0, 1.0)
    listed = [
        Control(name, "muscle", name, name, full=float(most))
        for name, most in zip([names[j] for j in kept.tolist()], full, strict=True)
    ]
    return listed, changes.reshape(6 * len(names), -1), np.asarray(values)


def _jaw(fitted: Floats, options: SliderOptions) -> tuple[list[Control], Floats, Floats]:
    """Return the jaw's controls, their changes of b (5, .) and the values (e, .) of ``fitted``."""
    along = np.eye(5)
    # an opening jaw takes its condyles along: the fits count from there
    along[4, 0] = options.condyle_path_mm
    reads = np.linalg.inv(along)
    places = fitted @ reads.T
    listed = []
    columns = []
    values = []
    for axis, (grows, falls, (low, high)) in enumerate(JAW_WAYS):
        for sign, title, farthest in ((1.0, grows, high), (-1.0, falls, -low)):
            there = np.maximum(sign * places[:, axis], 0.0)
            used = options.margin * there.max(initial=0.0)
            most = max(used, options.least_part * float(farthest))
            if used * JAW_UNITS[axis] >= options.least_jaw_mm or title == "jaw opens":
                by_jaw = tuple((sign / most * reads[axis]).tolist())
                name = title.replace(" ", "_")
                listed.append(Control(name, "jaw", title.capitalize(), by_jaw=by_jaw))
                columns.append(sign * most * along[:, axis])
                values.append(there / most)
    return listed, np.array(columns).T, np.array(values).T
