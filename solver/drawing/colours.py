"""Colours of pictures: what skin, eyes, bones and muscles look like, and the error's scale."""

from __future__ import annotations

import colorsys
import re

import numpy as np

from solver.surface import Floats

GAMMA = 2.2
SKIN = (0.62, 0.43, 0.34)  # linear, as all here except the muscles' and the error's
TEETH = (0.72, 0.66, 0.54)
MOUTH = (0.45, 0.16, 0.15)
SCLERA = (0.74, 0.72, 0.69)
IRIS = (0.10, 0.16, 0.17)
PUPIL = (0.008, 0.008, 0.01)
BONE = (0.72, 0.64, 0.50)
FAT = (0.80, 0.62, 0.33)
UNMEASURED = (0.60, 0.60, 0.61)
PARTS = {"skin": SKIN, "teeth": TEETH, "mouth": MOUTH, "eyes": SCLERA}
IRIS_MM, PUPIL_MM = 6.0, 2.4  # radii; an adult iris is 11.7 mm across (Rüfer et al. 2005)

HEAT_MAX_MM = 2.0
HEAT = np.array(  # sRGB at equal steps from 0 to HEAT_MAX_MM, ever darker
    [
        (0.84, 0.91, 0.94),
        (0.56, 0.79, 0.87),
        (0.97, 0.89, 0.58),
        (0.98, 0.66, 0.32),
        (0.88, 0.33, 0.20),
        (0.55, 0.05, 0.18),
    ]
)


def heat(error_mm: Floats, most_mm: float = HEAT_MAX_MM) -> Floats:
    """Return the sRGB colour (n, 3) of distances (n,) in mm, the last from ``most_mm`` on."""
    share = np.clip(error_mm / most_mm, 0, 1)
    steps = np.linspace(0, 1, len(HEAT))
    return np.column_stack([np.interp(share, steps, HEAT[:, k]) for k in range(3)])


def linear(srgb: Floats) -> Floats:
    """Return linear colours of sRGB colours."""
    return np.asarray(srgb, np.float64) ** GAMMA


def both_sides(muscle: str) -> str:
    """Return a muscle's name without its side: ``left buccinator`` -> ``buccinator``."""
    words = re.split(r"[\s_]+", muscle)
    return " ".join(word for word in words if word.lower() not in ("left", "right", "l", "r"))


def muscle_colours(names: tuple[str, ...]) -> dict[str, tuple[float, float, float]]:
    """Return muscle without side -> sRGB colour: hues by the golden ratio, alike in strength.

    Neighbours in the list get hues far apart, and the two sides of a muscle share one.
    """
    kinds = list(dict.fromkeys(both_sides(name) for name in names))
    colours = {}
    for number, kind in enumerate(kinds):
        hue = (0.985 + number * 0.381966) % 1.0
        lightness = (0.40, 0.56, 0.48, 0.66)[number % 4]
        colours[kind] = colorsys.hls_to_rgb(hue, lightness, 0.58)
    return colours
