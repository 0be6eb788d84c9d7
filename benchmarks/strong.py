"""Mixtures of a template's expressions: strong ones, which fits find hard, and drawn ones.

They are weights of ARKit's shapes, which any template may have.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np

from solver.anatomy.action_units import Action, actions_of, template_wholes, units_of
from solver.anatomy.template import ShapeBasis, Template, split_side
from solver.errors import InputError
from solver.surface import Surface


@dataclass(frozen=True)
class Expression:
    """Weights by ARKit's names without their sides, and the sides of the face that move."""

    weights: Mapping[str, float]
    sides: tuple[str, ...] = ("left", "right")


LAUGH = {
    "jawOpen": 0.35,
    "mouthSmile": 1.0,
    "cheekSquint": 0.8,
    "eyeSquint": 0.6,
    "mouthUpperUp": 0.4,
}
SCREAM = {"jawOpen": 0.9, "browDown": 0.8, "mouthStretch": 0.5, "noseSneer": 0.4}
WHISTLE = {"mouthPucker": 1.0, "browOuterUp": 0.5}
POUT = {"mouthShrugLower": 0.9, "mouthFrown": 0.6, "browInnerUp": 0.5}
SNARL = {"noseSneer": 1.0, "mouthUpperUp": 0.9, "browDown": 0.9, "mouthSmile": 0.3}

STRONG = {
    "laugh": Expression(LAUGH),
    "scream": Expression(SCREAM),
    "whistle": Expression(WHISTLE),
    "pout": Expression(POUT),
    "snarl": Expression(SNARL, sides=("left",)),
}

# Unseen expressions that ask much of one part of the face: its regions, by which each is judged.
LIPS = ("upper_lip", "lower_lip")
NOSE = ("nose",)
BEAM = {"mouthSmile": 1.0, "mouthUpperUp": 0.5, "cheekSquint": 0.5, "jawOpen": 0.15}
HARD = {
    "funnel": Expression({"mouthFunnel": 1.0, "jawOpen": 0.15}),
    "beam": Expression(BEAM),
    "sniff": Expression({"noseSneer": 1.0, "mouthUpperUp": 0.3}),
}
HARD_REGIONS = {"funnel": LIPS, "beam": LIPS, "sniff": NOSE}


def strong_scans(
    template: Template, neutral: Surface, expressions: Mapping[str, Expression] = STRONG
) -> dict[str, Surface]:
    """Return ``expressions`` of a person whose ``neutral`` has the template's topology.

    Raises :class:`InputError` (``captures.expression``) for a shape that the template lacks.
    """
    shapes = template.shapes
    if shapes is None:
        raise InputError("captures.expression", f"template '{template.name}' has no expressions")
    names = shapes.expression_names
    return {
        name: mixed(neutral, shapes, shape_weights(each, names))
        for name, each in expressions.items()
    }


def strong_mixtures(shapes: Sequence[str]) -> dict[str, dict[str, float]]:
    """Return the strong expressions by the names of a template's ``shapes``.

    Raises as :func:`strong_scans`.
    """
    return {name: shape_weights(each, shapes) for name, each in STRONG.items()}


def mixed(neutral: Surface, basis: ShapeBasis, weights: Mapping[str, float]) -> Surface:
    """Return the skin of a person with this ``neutral`` in a mixture of a template's shapes."""
    moved = neutral.vertices.copy()
    number = basis.expression_names.index
    for name, weight in weights.items():
        moved += weight * basis.expressions[number(name)]
    return neutral.with_vertices(moved)


def shape_weights(expression: Expression, shapes: Sequence[str]) -> dict[str, float]:
    """Return the weights by the names of a template's ``shapes``, of which some are of one side.

    Raises as :func:`strong_scans`.
    """
    sided = {shape: split_side(shape) for shape in shapes}
    found: dict[str, float] = {}
    for wanted, weight in expression.weights.items():
        # templates differ in which shapes are of both sides
        sides = ("", *expression.sides)
        own = [name for name, (base, side) in sided.items() if base == wanted and side in sides]
        if not own:
            raise InputError("captures.expression", f"the template has no expression {wanted}")
        found |= dict.fromkeys(own, weight)
    return found


@dataclass(frozen=True)
class DrawOptions:
    """Mixtures that are drawn at random."""

    count: int = 30
    units: tuple[int, int] = (2, 5)  # the fewest and the most of a mixture
    weight: tuple[float, float] = (0.3, 1.0)
    one_sided: float = 0.2  # part of the units of two sides that are made on one of them
    seed: int = 0


def draw_mixtures(
    shapes: Sequence[str], options: DrawOptions = DrawOptions()
) -> dict[str, dict[str, float]]:
    """Return mixtures of ``shapes`` that are one unit each: name -> shape -> weight.

    No mixture has a unit twice, or units of which one's muscles are the other's antagonists.
    """
    rng = np.random.default_rng(options.seed)
    found = {}
    fewest, most = options.units
    sides: dict[str, list[str]] = {}
    for shape in shapes:
        sides.setdefault(split_side(shape)[0], []).append(shape)
    bases = list(sides)
    for number in range(options.count):
        count = int(rng.integers(fewest, most + 1))
        chosen: list[str] = []
        for base in rng.permutation(bases).tolist():
            if len(chosen) < count and _go_together([*chosen, base]):
                chosen.append(base)
        weights: dict[str, float] = {}
        for base in chosen:
            own = sides[base]
            if len(own) > 1 and rng.uniform() < options.one_sided:
                own = [own[rng.integers(len(own))]]
            weights |= dict.fromkeys(own, float(rng.uniform(*options.weight)))
        found[f"mixture {number + 1}"] = weights
    return found


def _go_together(bases: Sequence[str]) -> bool:
    """Tell whether one face can make all shapes, given without sides, at once."""
    units = [unit for base in bases for unit in units_of(base)]
    made, hindered = (
        {whole for muscle in chain.from_iterable(muscles) for whole in template_wholes(muscle)}
        for muscles in ([each.muscles for each in units], [each.antagonists for each in units])
    )
    return len(set(units)) == len(units) and not made & hindered


def called_actions(weights: Mapping[str, float]) -> tuple[Action, ...]:
    """Return the action units, with their sides, of all shapes of a mixture."""
    return tuple(dict.fromkeys(action for shape in weights for action in actions_of(shape)))
