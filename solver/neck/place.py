"""A neck put under a person: by the condyles of the skull, and the rim in which the skin ends.

The head's joint lies behind and below the middle of the jaw's condyles. The neck is scaled by how
far apart these are, and leans about its head's joint until its lowest joint lies on the way to the
middle of the rim: x -> s R (x - 0) + t, with R about the x axis alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from solver.errors import InputError
from solver.model import SubjectModel
from solver.neck.anatomy import BODIES, Neck
from solver.similarity import Similarity
from solver.surface import Floats, Ints, Surface, directed_edges


@dataclass(frozen=True)
class PlaceOptions:
    """Where the spine of a person is, by what a scan shows."""

    # From the middle of the mandible's condyles to the joint of occiput and C1, mm: 19 and 18.6 on
    # the bones of BodyParts3D; by cephalograms the basion is 8 to 20 behind, 12 to 20 below.
    behind_jaw_mm: float = 19.0
    below_jaw_mm: float = 18.0
    condyles_mm: float = 105.0  # apart, in the adult whose neck has its own size
    least_scale: float = 0.75
    most_scale: float = 1.25
    from_nape: float = 0.45  # of the way from the skin of the nape to that of the throat
    most_lean_deg: float = 25.0  # a scanned head looks straight ahead, a neck leans by less


@dataclass(frozen=True)
class PlacedNeck:
    """A ``neck`` in a person's frame, mm, and how it got there."""

    neck: Neck
    placed: Similarity  # from the neck's own axes

    def report(self) -> dict[str, Any]:
        """Return the scale, the lean (degrees, positive with the shoulders behind), and places."""
        lean = Rotation.from_matrix(self.placed.rotation).as_rotvec(degrees=True)[0]
        joints = dict(zip(BODIES[1:], self.neck.centres.round(1).tolist(), strict=True))
        return {
            "source": self.neck.source,
            "scale": round(self.placed.scale, 4),
            "lean_deg": round(float(lean), 2),
            "joints_mm": joints,
        }


def place_neck(
    model: SubjectModel, neck: Neck, rim: Ints | None, options: PlaceOptions = PlaceOptions()
) -> PlacedNeck:
    """Put a neck under a person, whose skin ends in the vertices ``rim``, see :func:`find_rim`.

    Without a rim it stays as upright as it is.
    """
    tracks = model.jaw.tracks
    scale = 1.0 if tracks is None else tracks.apart / options.condyles_mm
    scale = float(np.clip(scale, options.least_scale, options.most_scale))
    joint = head_joint(model, options)
    lean = 0.0
    if rim is not None:
        wanted = _middle(model.skin.vertices[rim], options.from_nape) - joint
        lean = _angle(wanted) - _angle(neck.centres[0])
    most = np.radians(options.most_lean_deg)
    turn = Rotation.from_rotvec([float(np.clip(lean, -most, most)), 0.0, 0.0]).as_matrix()
    placed = Similarity(scale, turn, joint)
    return PlacedNeck(neck.moved(placed), placed)


def head_joint(model: SubjectModel, options: PlaceOptions = PlaceOptions()) -> Floats:
    """Return the joint of occiput and C1 (3,) of a person, mm."""
    jaw = model.jaw
    offset = np.array([0.0, -options.below_jaw_mm, -options.behind_jaw_mm])
    return np.asarray(jaw.origin + offset @ jaw.axes)


def find_rim(model: SubjectModel, joint: Floats) -> Ints:
    """Return the skin vertices (k,) in which a neck ends, all round and below the head's ``joint``.

    Raises :class:`InputError` (``neck.skin``) for a skin without such a rim, as of a face alone.
    """
    skin = model.skin
    loops = open_edges(skin)
    found = [loop for loop in loops if _is_rim(skin.vertices[loop], joint)]
    if not found:
        if not loops:
            reason = "it is closed"
        else:
            highest = min(float(skin.vertices[loop, 1].max()) for loop in loops)
            reason = f"none of its {len(loops)} open edges runs around the neck below the skull"
            reason += f" (at {joint[1]:.0f} mm; the lowest one reaches up to {highest:.0f} mm)"
        message = f"the skin of {model.template['name']} ends in no neck: {reason}"
        raise InputError("neck.skin", message, found=len(loops))
    return min(found, key=lambda loop: float(skin.vertices[loop, 1].mean()))


def open_edges(skin: Surface) -> list[Ints]:
    """Return the vertices of each connected open edge of a surface."""
    sides = directed_edges(skin.faces)
    count = len(skin.vertices)
    codes = sides[:, 0] * count + sides[:, 1]
    open_ = sides[~np.isin(codes, sides[:, 1] * count + sides[:, 0])]
    graph = coo_array((np.ones(len(open_)), tuple(open_.T)), shape=(count, count))
    _, part = connected_components(graph, directed=False)
    ends = np.unique(open_)
    return [ends[part[ends] == number] for number in np.unique(part[ends])]


def _is_rim(points: Floats, joint: Floats) -> bool:
    """Tell whether an open edge lies below the ``joint`` and is all round it, seen from above."""
    if points[:, 1].max() > joint[1]:
        return False
    around = np.sort(np.arctan2(points[:, 0] - joint[0], points[:, 2] - joint[2]))
    gaps = np.diff(np.append(around, around[0] + 2.0 * np.pi))
    return bool(gaps.max() < np.pi)


def _middle(rim: Floats, from_nape: float) -> Floats:
    """Return the point (3,) of a rim (k, 3) where the spine goes through it."""
    near = np.abs(rim[:, 0] - np.median(rim[:, 0])) < 0.25 * np.ptp(rim[:, 0])
    inner = rim[near]
    nape = inner[inner[:, 2].argmin()]
    throat = inner[inner[:, 2].argmax()]
    return np.asarray((1.0 - from_nape) * nape + from_nape * throat)


def _angle(down: Floats) -> float:
    """Return the lean of a direction down the neck, rad, about x: positive towards the back."""
    return float(np.arctan2(-down[2], -down[1]))
