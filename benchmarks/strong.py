"""Strong expressions of any template, which fits find hard: weights of ARKit's shapes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from solver.anatomy.template import Template, split_side
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


def strong_scans(template: Template, neutral: Surface) -> dict[str, Surface]:
    """Return the strong expressions of a person whose ``neutral`` has the template's topology.

    Raises :class:`InputError` (``captures.expression``) for a shape that the template lacks.
    """
    shapes = template.shapes
    if shapes is None:
        raise InputError("captures.expression", f"template '{template.name}' has no expressions")
    deltas = dict(zip(shapes.expression_names, shapes.expressions, strict=True))

    def scan(weights: Mapping[str, float]) -> Surface:
        moved = neutral.vertices.copy()
        for name, weight in weights.items():
            moved += weight * deltas[name]
        return neutral.moved(moved)

    return {name: scan(shape_weights(each, list(deltas))) for name, each in STRONG.items()}


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
