"""Actions of muscles by anatomy texts, and whether the skin goes that way.

The table is ``solver/anatomy/data/muscle_actions.csv``: a place of the face and the ways that it
goes when all of a muscle contracts on one side; a ring contracts on both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from benchmarks.documents import Figures
from solver.anatomy.action_units import is_one_of
from solver.anatomy.data import read_table, split_cell
from solver.drawing.head import muscle_side
from solver.model import SubjectModel
from solver.surface import Floats, Ints

SIDE = "left"  # of the face that is looked at
WAYS = {  # in x, y and z on the left
    "lateral": (1.0, 0.0, 0.0),
    "medial": (-1.0, 0.0, 0.0),
    "up": (0.0, 1.0, 0.0),
    "down": (0.0, -1.0, 0.0),
    "forward": (0.0, 0.0, 1.0),
    "back": (0.0, 0.0, -1.0),
}


@dataclass(frozen=True)
class ActionOptions:
    """Limits of going the way that texts say, and the size of places."""

    most_off_deg: float = 60.0  # between the place's mean motion and the way
    least_mm: float = 0.1  # of that motion: with less the place stays
    near_mm: float = 8.0  # of the corner of the mouth, and of the glabella
    end: float = 1.0 / 3.0  # part of a brow that is its inner or outer end, of the nose its wing
    column_mm: float = 4.0  # of an eye, in which the gap of its lids is taken
    columns: int = 5  # of them, about the middle


@dataclass(frozen=True)
class MuscleAction:
    """The action of a muscle by anatomy texts: a place on its side goes in some ``ways``."""

    muscle: str
    place: str
    ways: tuple[str, ...]
    is_ring: bool

    @property
    def direction(self) -> Floats:
        """Return the unit vector (3,) of all ways together, on the left."""
        whole = np.sum([WAYS[way] for way in self.ways], axis=0)
        return np.asarray(whole / np.linalg.norm(whole))


def muscle_actions() -> tuple[MuscleAction, ...]:
    """Return the table."""
    return tuple(
        MuscleAction(row["muscle"], row["place"], split_cell(row["ways"]), row["ring"] == "yes")
        for row in read_table("muscle_actions")
    )


def named_muscles(model: SubjectModel, muscle: str, *, both: bool = False) -> Ints:
    """Return the numbers (k,) of all parts of a muscle of anatomy texts that a model has.

    They are those of the left and the middle unless of ``both`` sides.
    """
    sides = {SIDE, ""} | ({"right"} if both else set())
    named = zip(model.muscle_names, model.muscle_groups, strict=True)
    return np.flatnonzero(
        [is_one_of(name, [muscle]) and muscle_side(whole) in sides for name, whole in named]
    )


def find_place(model: SubjectModel, place: str, options: ActionOptions = ActionOptions()) -> Ints:
    """Return the face's vertices (k,) of a place, on the left; none where its region is missing."""
    return PLACES[place](model, options)


def goes_as_said(
    action: MuscleAction, motion: Floats, options: ActionOptions = ActionOptions()
) -> Figures:
    """Return how a place goes, whose vertices move by ``motion`` (k, 3), and if texts say so."""
    mean = motion.mean(axis=0)
    size = float(np.linalg.norm(mean))
    cosine = float(mean @ action.direction) / size if size > 0.0 else 0.0
    return {
        "place": action.place,
        "ways": list(action.ways),
        "lateral_mm": float(mean[0]),
        "up_mm": float(mean[1]),
        "forward_mm": float(mean[2]),
        "as_texts": size >= options.least_mm
        and cosine >= float(np.cos(np.radians(options.most_off_deg))),
    }


def lid_gap(model: SubjectModel, skin: Floats, options: ActionOptions = ActionOptions()) -> float:
    """Return the gap of the left eye's lids in ``skin`` (v, 3), mm, 0 if they meet or overlap.

    It is the greatest of some columns about the middle of the eye.
    """
    middle = float(model.skin.vertices[model.region(f"{SIDE}_eyeball"), 0].mean())
    upper, lower = (skin[model.region(f"{SIDE}_{lid}_lid")] for lid in ("upper", "lower"))
    gaps = []
    for column in range(options.columns):
        at = middle + (column - 0.5 * (options.columns - 1)) * options.column_mm
        above, below = (
            lid[np.abs(lid[:, 0] - at) <= 0.5 * options.column_mm, 1] for lid in (upper, lower)
        )
        if len(above) and len(below):
            gaps.append(float(above.min() - below.max()))
    return max(0.0, *gaps)


def has_lids(model: SubjectModel) -> bool:
    """Tell whether a model names the left eye and its lids."""
    parts = ("eyeball", "upper_lid", "lower_lid")
    return all(len(model.region(f"{SIDE}_{part}")) for part in parts)


# Places, by the regions that both templates name.


def _of_face(model: SubjectModel, *regions: str) -> Ints:
    """Return the face's vertices of regions, those of the left side."""
    ids = np.concatenate([model.region(region) for region in regions])
    ids = np.intersect1d(ids, model.face).astype(np.int64)
    return np.asarray(ids[_across(model, ids) > 0.0])


def _across(model: SubjectModel, ids: Ints) -> Floats:
    """Return how far vertices are on the left of the jaw's middle, mm."""
    return np.asarray(model.skin.vertices[ids, 0] - model.jaw.origin[0])


def _near(model: SubjectModel, point: Floats, near_mm: float) -> Ints:
    """Return the face's vertices near a point."""
    off = np.linalg.norm(model.skin.vertices[model.face] - point, axis=1)
    return np.asarray(model.face[off <= near_mm])


def _corner(model: SubjectModel, options: ActionOptions) -> Ints:
    """Return the skin about the corner of the mouth, where edges lead from lip to lip."""
    upper, lower = (
        np.isin(model.skin.faces, model.region(f"{lip}_lip")) for lip in ("upper", "lower")
    )
    both = model.skin.faces[upper.any(axis=1) & lower.any(axis=1)]
    ids = np.intersect1d(both, _of_face(model, "upper_lip", "lower_lip"))
    if not len(ids):
        return ids
    return _near(model, model.skin.vertices[ids].mean(axis=0), options.near_mm)


def _glabella(model: SubjectModel, options: ActionOptions) -> Ints:
    inner = _inner_brow(model, options)
    if not len(inner):
        return inner
    point = model.skin.vertices[inner].mean(axis=0)
    point[0] = model.jaw.origin[0]
    ids = model.face[np.abs(_across(model, model.face)) <= options.near_mm]
    off = np.abs(model.skin.vertices[ids, 1] - point[1])
    return np.asarray(ids[off <= options.near_mm])


def _inner_brow(model: SubjectModel, options: ActionOptions) -> Ints:
    return _part(model, _of_face(model, "brows"), 0.0, options.end)


def _outer_brow(model: SubjectModel, options: ActionOptions) -> Ints:
    # beyond the eye's corner the region runs on to the temple, where no brow is
    brow = _of_face(model, "brows")
    eye = _across(model, _of_face(model, "eyes"))
    within = brow[_across(model, brow) <= eye.max()] if len(eye) else brow
    return _part(model, within, 1.0 - options.end, 1.0)


def _part(model: SubjectModel, ids: Ints, first: float, last: float) -> Ints:
    """Return the vertices within parts of a place's width, from its inner end."""
    if not len(ids):
        return ids
    across = _across(model, ids)
    part = (across - across.min()) / np.ptp(across)
    return np.asarray(ids[(part >= first) & (part <= last)])


def _wing(model: SubjectModel, options: ActionOptions) -> Ints:
    """Return the outer part of the lower half of the nose."""
    nose = _of_face(model, "nose")
    if not len(nose):
        return nose
    height = model.skin.vertices[nose, 1]
    return _part(model, nose[height <= np.median(height)], 1.0 - options.end, 1.0)


def _tip(model: SubjectModel, options: ActionOptions) -> Ints:
    """Return the skin about the foremost point of the nose."""
    nose = np.intersect1d(model.region("nose"), model.face).astype(np.int64)
    if not len(nose):
        return nose
    points = model.skin.vertices[nose]
    return _near(model, points[points[:, 2].argmax()], options.near_mm)


def _region(*names: str) -> Callable[[SubjectModel, ActionOptions], Ints]:
    return lambda model, _: _of_face(model, *names)


PLACES: dict[str, Callable[[SubjectModel, ActionOptions], Ints]] = {
    "inner brow": _inner_brow,
    "outer brow": _outer_brow,
    "glabella": _glabella,
    "upper lid": _region(f"{SIDE}_upper_lid"),
    "wing of the nose": _wing,
    "tip of the nose": _tip,
    "upper lip": _region("upper_lip"),
    "lower lip": _region("lower_lip"),
    "corner of the mouth": _corner,
    "chin": _region("chin"),
}
