"""A scene's ``edits``: from JSON, as ``edit.schema.json`` describes it, to what they do."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from solver.edits.bones import Bone
from solver.edits.edit import Edit
from solver.edits.fat import SOFTENING, Fat
from solver.edits.filler import RADIUS_MM, Filler, under_skin
from solver.edits.paralysis import Paralysis
from solver.edits.tissue import Density, Stiffness
from solver.scene.places import Places

Entry = Mapping[str, Any]


def edits_of(entries: Sequence[Entry], places: Places) -> list[Edit]:
    """Return the edits of entries that their schema has found good.

    Raises :class:`~solver.errors.InputError` as :class:`~solver.scene.places.Places` for places,
    regions and maps that the person does not have.
    """
    return [KINDS[entry["kind"]](entry, places) for entry in entries]


def _fat(entry: Entry, places: Places) -> Edit:
    softening = entry.get("softening", SOFTENING)
    return Fat(entry["f_min"], entry["f_max"], places.painted(entry.get("map")), softening)


def _filler(entry: Entry, places: Places) -> Edit:
    points = np.array([places.point(stop["at"]) for stop in entry["path"]])
    depths = np.array([stop.get("depth_mm", 0.0) for stop in entry["path"]])
    path = under_skin(places.model, points, depths)
    return Filler(path, entry["ml"], entry.get("radius_mm", RADIUS_MM))


def _bone(entry: Entry, places: Places) -> Edit:
    at, move = places.point(entry["at"]), np.array(entry["move_mm"], np.float64)
    return Bone(entry["bone"], at, entry["radius_mm"], move)


def _stiffness(entry: Entry, places: Places) -> Edit:
    return Stiffness(entry["factor"], places.painted(entry.get("map")))


def _density(entry: Entry, places: Places) -> Edit:
    return Density(entry["factor"], places.painted(entry.get("map")))


def _paralysis(entry: Entry, _places: Places) -> Edit:
    muscles = entry.get("muscles")
    return Paralysis(
        None if muscles is None else tuple(muscles), entry.get("side"), entry.get("strength", 0.0)
    )


KINDS: Mapping[str, Callable[[Entry, Places], Edit]] = {
    "fat": _fat,
    "filler": _filler,
    "bone": _bone,
    "stiffness": _stiffness,
    "density": _density,
    "paralysis": _paralysis,
}
