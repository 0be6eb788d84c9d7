"""Parts that no scan shows: eyeballs, teeth, gums and tongue go where the skin takes them."""

from __future__ import annotations

import numpy as np

from solver.anatomy.template import Template
from solver.anatomy.warp import interpolate, spread
from solver.drawing.parts import skin_parts
from solver.similarity import weighted_motion
from solver.surface import Floats, Ints

GUIDES = 500
SMOOTHING_MM = 5.0


def rigid_groups(template: Template) -> list[Ints]:
    """Return the vertices of what moves as one: each eye with its lashes, each jaw's teeth."""
    skin = template.skin
    parts = skin_parts(skin)
    groups = []
    eyes = [parts[name] for name in ("eyes", "lashes") if name in parts]
    if eyes:
        vertices = np.unique(skin.faces[np.concatenate(eyes)])
        is_left = skin.vertices[vertices, 0] > 0
        groups += [vertices[is_left], vertices[~is_left]]
    mouth = [parts[name] for name in ("teeth", "mouth") if name in parts]
    if mouth:
        vertices = np.unique(skin.faces[np.concatenate(mouth)])
        lower = np.isin(vertices, template.attached_mandible)
        groups += [vertices[lower], vertices[~lower]]
    return [group for group in groups if len(group)]


def carry_hidden(
    groups: list[Ints], rest: Floats, start: Floats, fitted: Floats, outer: Ints
) -> Floats:
    """Return ``fitted`` (n, 3) with every group moved rigidly from ``rest`` (n, 3).

    A group goes where the shapes have put it in ``start`` (n, 3), and from there with the outer
    skin around it, vertices ``outer`` (k,), which free-form registration took to ``fitted``.
    """
    guides = outer[spread(start[outer], GUIDES)]
    warp = interpolate(start[guides], fitted[guides], SMOOTHING_MM)
    result = fitted.copy()
    for group in groups:
        motion = weighted_motion(rest[group], warp(start[group]), np.ones(len(group)))
        result[group] = motion(rest[group])
    return result
