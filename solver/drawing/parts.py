"""Which parts a scan topology is made of: skin, eyeballs, teeth, the rest of the mouth, lashes.

A subject model does not name them, so they are told apart by shape: they are separate components,
eyeballs are spheres, and what is small lies at an eye or is a tooth.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse.csgraph import connected_components

from solver.surface import Floats, Ints, Surface
from solver.triangles import adjacency

EYE_RADIUS_MM = (9.0, 18.0)
ROUNDNESS = 0.07  # deviation from the best sphere, by its radius (the cornea's bulge gives 0.04)
NEAR_EYE = 2.2  # radii: lashes and tear film lie within
TOOTH_MM = 34.0  # crown and root


def skin_parts(skin: Surface) -> dict[str, Ints]:
    """Return part -> face numbers for ``skin``, ``eyes``, ``teeth``, ``mouth`` and ``lashes``.

    Every face belongs to one part; parts that are not there are left out. ``mouth`` is gums and
    tongue, ``lashes`` is everything else about the eyes.
    """
    kinds = np.array(_kinds(skin))
    label = _components(skin)[skin.faces[:, 0]]
    names = ("skin", "eyes", "teeth", "mouth", "lashes")
    faces = {name: np.flatnonzero(kinds[label] == name) for name in names}
    return {name: numbers for name, numbers in faces.items() if len(numbers)}


def _components(skin: Surface) -> Ints:
    count = len(skin.vertices)
    edges = adjacency(skin.faces, count)
    return np.asarray(connected_components(edges, directed=False)[1], np.int64)


def _kinds(skin: Surface) -> list[str]:
    """Return the part of every component."""
    label = _components(skin)
    points = [skin.vertices[label == number] for number in range(label.max() + 1)]
    spheres = [_sphere(component) for component in points]
    eyes = [sphere for sphere in spheres if sphere is not None]
    largest = int(np.argmax([len(component) for component in points]))
    kinds = []
    for number, component in enumerate(points):
        centre = component.mean(axis=0)
        if number == largest:
            kinds.append("skin")
        elif spheres[number] is not None:
            kinds.append("eyes")
        elif any(np.linalg.norm(centre - eye) < NEAR_EYE * radius for eye, radius in eyes):
            kinds.append("lashes")
        elif np.ptp(component, axis=0).max() < TOOTH_MM:
            kinds.append("teeth")
        else:
            kinds.append("mouth")
    if "teeth" not in kinds:  # rows of teeth in one piece: wider than deep, as no tongue is
        sizes = [np.ptp(component, axis=0) for component in points]
        kinds = [
            "teeth" if kind == "mouth" and size[0] > size[2] else kind
            for kind, size in zip(kinds, sizes, strict=True)
        ]
    return kinds


def _sphere(points: Floats) -> tuple[Floats, float] | None:
    """Return centre and radius if the points lie on most of a sphere of an eye's size."""
    if len(points) < 12:
        return None
    system = np.column_stack([2 * points, np.ones(len(points))])
    solution = np.linalg.lstsq(system, (points**2).sum(axis=1), rcond=None)[0]
    centre = solution[:3]
    distance = np.linalg.norm(points - centre, axis=1)
    radius = float(distance.mean())
    round_enough = distance.std() < ROUNDNESS * radius
    whole = np.ptp(points, axis=0).min() > 1.6 * radius
    if EYE_RADIUS_MM[0] < radius < EYE_RADIUS_MM[1] and round_enough and whole:
        return centre, radius
    return None
