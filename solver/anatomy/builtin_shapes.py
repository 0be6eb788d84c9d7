"""How the built-in head varies: MakeHuman's face shapes as identities, ARKit's expressions.

The shapes come without statistics. Sex and origin are those of a population with equal shares; the
standard deviations of all others are set by eye, so that two of them still make a common face.
"""

from __future__ import annotations

import itertools

import numpy as np

from solver.anatomy.builtin_head import Head
from solver.anatomy.shapes import ShapeBasis

ORIGINS = ("african", "asian", "caucasian")
SEXES = ("female", "male")
FACE_FOLDERS = (
    "head",
    "forehead",
    "eyebrows",
    "eyes",
    "ears",
    "nose",
    "mouth",
    "cheek",
    "chin",
    "neck",
)
OPPOSITES = (
    ("decr", "incr"),
    ("down", "up"),
    ("backward", "forward"),
    ("in", "out"),
    ("concave", "convex"),
    ("compress", "uncompress"),
)
PAIR_SD = 0.3
"""Strength of one of two opposite shapes in somebody one standard deviation from the average."""
AGE_SD, BUILD_SD = 0.3, 0.5
"""Parts of the way from 25 to 90 years, and from average to the greatest weight or muscle."""


def shape_basis(head: Head) -> ShapeBasis:
    """Return the identities (macro shapes, then pairs of face shapes) and the 52 expressions.

    Shapes of the left and the right side count as one; those that make a face askew are identities
    of their own.
    """
    identities = np.stack([head.identity(weights) for weights in [*_macros(), *_pairs(head)]])
    # A taller body lifts the head: where the head is, is not part of its shape.
    skin = head.part_vertices["skin"]
    identities -= identities[:, skin].mean(axis=1, keepdims=True)
    names = head.expression_names
    expressions = np.stack([head.expression({name: 1.0}) for name in names])
    return ShapeBasis(identities.astype(np.float32), expressions.astype(np.float32), names)


def _macros() -> list[dict[str, float]]:
    """Return the weights of shape targets for sex, origin (two), age, weight and muscle."""
    young = {
        (origin, sex): f"macrodetails/{origin}-{sex}-young" for origin in ORIGINS for sex in SEXES
    }
    sign = {"female": -1.0, "male": 1.0}
    body = "macrodetails/universal-{}-young-{}muscle-{}weight"
    sex = {name: sign[key[1]] / 6 for key, name in young.items()}
    sex |= {body.format(each, "average", "average"): sign[each] / 2 for each in SEXES}
    # Two orthonormal contrasts of three equal shares: each has the variance 1/3 (multinomial).
    contrasts = np.sqrt(1 / 3) * np.array([[1, -1, 0], [1, 1, -2]]) / np.sqrt([[2], [6]])
    origins = [
        {name: contrast[ORIGINS.index(key[0])] / 2 for key, name in young.items()}
        for contrast in contrasts
    ]
    age = dict.fromkeys(young.values(), -AGE_SD / 6)
    age |= {name.replace("young", "old"): AGE_SD / 6 for name in young.values()}
    for each in SEXES:
        average = body.format(each, "average", "average")
        age |= {average: -AGE_SD / 2, average.replace("young", "old"): AGE_SD / 2}
    # From the least to the greatest is twice the way from the average: hence a quarter a sex.
    weight, muscle = (
        {
            body.format(each, *levels(end)): BUILD_SD / 4 * (1 if end == "max" else -1)
            for each, end in itertools.product(SEXES, ("min", "max"))
        }
        for levels in (lambda end: ("average", end), lambda end: (end, "average"))
    )
    return [sex, *origins, age, weight, muscle]


def _pairs(head: Head) -> list[dict[str, float]]:
    """Return the weights of each pair of opposite shapes; moves of the whole head are left out."""
    names = set(head.target_names)
    pairs = []
    for name in sorted(names):
        folder, _, shape = name.partition("/")
        if folder == "asym" and shape.endswith("-l") and shape.startswith("asym-"):
            pairs.append({name: PAIR_SD / 2, f"{name[:-1]}r": -PAIR_SD / 2})
        if folder not in FACE_FOLDERS or shape.startswith(("r-", "head-trans")):
            continue
        for low, high in OPPOSITES:
            opposite = f"{name.removesuffix(low)}{high}"
            if name.endswith(f"-{low}") and opposite in names:
                pairs.append(_both_sides({name: -PAIR_SD / 2, opposite: PAIR_SD / 2}))
    return pairs


def _both_sides(weights: dict[str, float]) -> dict[str, float]:
    return weights | {name.replace("/l-", "/r-"): weight for name, weight in weights.items()}
