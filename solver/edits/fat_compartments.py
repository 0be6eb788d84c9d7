"""Fat compartments of the face: where a person gains or loses when their weight changes.

``fat_compartments.csv`` in ``solver/anatomy/data`` places each by landmarks that the built-in
template and that of ICT-FaceKit share: by a path (:mod:`solver.anatomy.data`), brought
onto the face. Its share of a change is the mean change of the soft-tissue depths at its ``sites``
(``depths_by_weight.csv``), over that of the compartment with the most. Nose, lips and lids are rows
without sites: they have no compartment, and a share of 0.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from solver.anatomy.data import SIDES, LandmarkPath, read_table
from solver.anatomy.data import missing_landmarks as landmarks_missing
from solver.model import SubjectModel
from solver.surface import Floats, distance_to_path

Sex = Literal["female", "male"]
SEXES: tuple[Sex, ...] = ("female", "male")


@dataclass(frozen=True)
class FatCompartment:
    """One line of the table of compartments."""

    name: str
    paired: bool  # whether there is one on each side
    path: LandmarkPath
    radius_mm: float  # from the path, where it weighs 1/e
    sites: tuple[str, ...]  # of the depths that tell its share


@dataclass(frozen=True)
class MapOptions:
    """Reach of fat beyond its compartments, and under the skin."""

    # weight of bare skin, whose share is 0, everywhere: the map ends at twice a radius, about
    bare: float = 0.1
    depth_mm: float = 6.0  # on which fat falls to 1/e: it lies over the muscles, not in the mouth


FAT_MAP = MapOptions()


@cache
def read_compartments() -> tuple[FatCompartment, ...]:
    """Return the table of compartments."""
    return tuple(
        FatCompartment(
            row["name"],
            row["paired"] == "yes",
            LandmarkPath.read(row["path"]),
            float(row["radius_mm"]),
            tuple(row["sites"].split()),
        )
        for row in read_table("fat_compartments")
    )


def missing_landmarks(landmarks: Mapping[str, int]) -> list[str]:
    """Return what compartments are placed by that is not among ``landmarks``, without sides."""
    return landmarks_missing([each.path for each in read_compartments()], landmarks)


def shares(*, gain: bool, sex: Sex | None = None) -> dict[str, float]:
    """Return what each compartment takes of a gain or loss of weight: 1 for that with the most.

    No ``sex`` is the mean of both.
    """
    sexes: Sequence[Sex] = SEXES if sex is None else (sex,)
    more, less = ("obese_mm", "normal_mm") if gain else ("normal_mm", "slender_mm")
    changes: dict[str, list[float]] = {}  # in mm, by site, one for each sex
    for row in read_table("depths_by_weight"):
        if row["sex"] in sexes:
            changes.setdefault(row["site"], []).append(float(row[more]) - float(row[less]))
    means = {
        each.name: float(np.mean([changes[site] for site in each.sites])) if each.sites else 0.0
        for each in read_compartments()
    }
    return {name: mean / max(means.values()) for name, mean in means.items()}


def fat_map(
    model: SubjectModel,
    landmarks: Mapping[str, int],
    *,
    gain: bool,
    sex: Sex | None = None,
    options: MapOptions = FAT_MAP,
) -> Floats:
    """Return the map (V,) of a gain or loss of fat over the skin, in [0, 1].

    It is sum_c w_c s_c / (bare + sum_c w_c) with the :func:`shares` s_c and w_c = exp(-d_c^2 /
    radius_c^2), d_c being the distance to a compartment's path: smooth, without edges between
    neighbours. ``landmarks`` are skin vertices by name, with none of :func:`missing_landmarks`.
    """
    skin = model.skin.vertices
    taken = shares(gain=gain, sex=sex)
    nearest = cKDTree(skin[model.face])
    weighed = np.zeros(len(skin))
    weights = np.full(len(skin), options.bare)
    for each in read_compartments():
        for sides in [(side,) for side in SIDES] if each.paired else [SIDES]:
            points = each.path.places(skin, landmarks, sides)
            path = skin[model.face[nearest.query(points)[1]]]
            weight = np.exp(-((distance_to_path(skin, path) / each.radius_mm) ** 2))
            weighed += taken[each.name] * weight
            weights += weight
    return np.asarray(weighed / weights)
