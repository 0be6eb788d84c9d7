"""A scene's ``forces``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from solver.fitting.face import Face
from solver.scene.places import Places
from solver.simulation.forces import GRAVITY, Force, Gravity, Pull, Wind
from solver.surface import Floats


def forces_of(
    entries: Sequence[Mapping[str, Any]], face: Face, masses: Floats, places: Places
) -> list[Force]:
    """Return the forces of entries that their schema has found good; ``masses`` (p,) are in g.

    Raises :class:`~solver.errors.InputError` as :meth:`Places.vertex`, and ``force.point``.
    """
    return [_force(entry, face, masses, places) for entry in entries]


def _force(entry: Mapping[str, Any], face: Face, masses: Floats, places: Places) -> Force:
    if entry["kind"] == "gravity":
        return Gravity(masses, entry.get("mm_s2", GRAVITY))
    if entry["kind"] == "wind":
        return Wind(face, entry["m_s"], entry.get("gusts", 0.0), entry.get("seed", 0))
    return Pull(
        face.model,
        places.vertex(entry["at"]),
        entry["mn"],
        radius_mm=entry.get("radius_mm", 5.0),
        ramp=entry.get("ramp", 0.0),
    )
