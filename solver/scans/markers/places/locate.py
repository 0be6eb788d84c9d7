"""Location of the face under markers: its pose, their unit, and which way round they are.

Names give it roughly, and whether left and right are where they should be; without them the
markers' own shape is looked for on the face, as a face is in a scan. Either way they slide onto the
skin then, all at one height over it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from solver.anatomy.embedding import barycentric
from solver.anatomy.warp import spread
from solver.registration.scan_surface import Samples, sample
from solver.registration.search import (
    FacePoints,
    RefinementOptions,
    find_pose,
    nose_tip,
    refine_pose,
)
from solver.registration.units import ScanUnit, UnitOptions, choose_unit, likely_unit
from solver.scans.markers.readers.names import Named
from solver.scans.markers.signal.motion import rms_of_seen
from solver.similarity import IDENTITY, Similarity, fit_similarity, robust_motion, weighted_motion
from solver.surface import Floats, Ints, Surface, nearest_sphere, unit_rows

FLIP = np.diag([-1.0, 1.0, 1.0])  # left and right exchanged
# Names give a size roughly, but units are far apart.
NAMES_UNIT = UnitOptions(face_sizes=(0.65, 1.5), unusual=0.35)


@dataclass(frozen=True)
class LocateOptions:
    """Limits and rounds of locating; lengths in mm."""

    least: int = 4  # markers that locate a face ...
    most: int = 100  # ... and of more these, spread over it: time grows with them
    trims: int = 5  # rounds in which names that fit badly lose their weight
    kept: float = 2.0  # times the median misfit of names: what counts
    name_misfit: float = 22.0  # of most names; with more the shape is looked for
    mirrored: float = 0.6  # of the misfit: sides the other way round fit that much better
    clearly: float = 0.87  # of the first way's miss: the other way round fits better
    exchanged: float = 800.0  # mm2 that two names gain by changing places
    samples: int = 20_000  # points of the skin
    heights: tuple[float, ...] = (0.0, 1.0, 2.0, 3.0, 4.5, 6.0, 8.0)  # of markers over the skin
    flat: float = 0.1  # heights whose misfits differ by less are alike: the usual is taken
    usual_height: float = 2.0
    rounds: int = 3  # of normals and motion
    extents: tuple[float, float] = (60.0, 420.0)  # of the markers of one head
    usual_extent: float = 180.0  # where no unit gives any of these
    off_skin: float = 15.0  # farther from the skin it is no marker of the face ...
    on_skin: float = 0.75  # ... and with fewer of all on it no other height is tried


LOCATE = LocateOptions()


@dataclass(frozen=True)
class Located:
    """The face under markers, in their own axes and unit."""

    session: Similarity  # takes the markers to the face's frame; it mirrors if ``mirrored``
    unit: ScanUnit
    by_names: bool  # or by the markers' shape
    mirrored: bool
    sides_exchanged: bool  # all left labels lie on the right, as the face is not mirrored
    exchanged: tuple[tuple[int, int], ...]  # markers that lie where the other should by its name
    height_mm: float  # of most over the skin
    off_skin: Floats  # (k,) farther from the skin than that, in mm; NaN where not seen
    # takes another actor's markers to their places by name, in a size of its own
    similar: Similarity | None = None

    def miss(self) -> float:
        """Return the rms of how far markers miss the skin at that height, in mm."""
        return rms_of_seen(self.off_skin)


def locate(
    points: Floats, named: Sequence[Named | None], face: Surface, *, read_mm: float = 1.0
) -> Located | None:
    """Return where ``face`` lies under markers (k, 3), NaN where not seen; None if they are few.

    ``read_mm`` are the mm that a unit of their file was read as: it may be another unit.
    """
    seen = np.isfinite(points[:, 0])
    may_be = np.array([each is None or each.part == "face" for each in named], bool)
    used = np.flatnonzero(seen & may_be)
    if len(used) < LOCATE.least:
        return None
    few = used[np.sort(spread(points[used], LOCATE.most))]
    skin = sample(face.vertices, face.faces, None, LOCATE.samples)
    by_names = _by_names(points, named, face)
    if by_names is not None:
        starts, turned = by_names
        unit = choose_unit(starts[0].scale, None, None, NAMES_UNIT, read_mm=read_mm)
    else:
        unit = _unit_of(points[used])
        turned = False
        starts = _by_shape(points[few], skin, unit.mm_per_unit)
    found = [_slide(start, unit, points, (few, used), face, skin) for start in starts]
    best = 0
    if len(found) > 1:  # a mirrored face, or sides exchanged: the first, unless it fits worse
        best = int(found[1].miss() < LOCATE.clearly * found[0].miss())
    chosen = found[best]
    chosen = replace(chosen, sides_exchanged=turned and not chosen.mirrored)
    if by_names is None:
        return chosen
    chosen = replace(chosen, by_names=True, similar=starts[best])
    if turned:
        return chosen
    return replace(chosen, exchanged=_find_exchanges(chosen, points, named, face))


def _by_names(
    points: Floats, named: Sequence[Named | None], face: Surface
) -> tuple[list[Similarity], bool] | None:
    """Return motions onto the face by names, and whether sides are the wrong way round.

    None if names do not agree. Either the markers are mirrored then, or the labels are: the
    motions of both come back.
    """
    known, goal = _goals(points, named, face)
    if len(known) < LOCATE.least or len(np.unique(goal, axis=0)) < LOCATE.least:
        return None
    plain, misfit = fit_most(points[known], goal)
    other, other_misfit = fit_most(points[known] @ FLIP, goal)
    turned = other_misfit < LOCATE.mirrored * misfit
    if min(misfit, other_misfit) > LOCATE.name_misfit:
        return None
    if not turned:
        return [plain], False
    across = (goal - nose_tip(face)) @ FLIP + nose_tip(face)
    mirrored = replace(other, rotation=other.rotation @ FLIP)  # of the points, not of their images
    return [mirrored, fit_most(points[known], across)[0]], True


def _goals(
    points: Floats, named: Sequence[Named | None], face: Surface
) -> tuple[list[int], Floats]:
    """Return the markers that are seen and have a place on the face by their names, and these."""
    places = {n: each.place for n, each in enumerate(named) if each and each.part == "face"}
    known = [number for number in places if np.isfinite(points[number, 0])]
    goal = np.array([places[number] for number in known], float).reshape(-1, 3)
    return known, goal + nose_tip(face)


def fit_most(points: Floats, goal: Floats) -> tuple[Similarity, float]:
    """Return the motion that most points agree with, and the median misfit in mm."""
    kept = np.ones(len(points), bool)
    motion = fit_similarity(points, goal)
    off = np.zeros(len(points))
    for _ in range(LOCATE.trims):
        off = np.linalg.norm(motion(points) - goal, axis=1)
        closer = off <= max(LOCATE.kept * float(np.median(off)), 1.0)
        if closer.sum() < LOCATE.least or (closer == kept).all():
            break
        kept = closer
        motion = fit_similarity(points[kept], goal[kept])
    return motion, float(np.median(off))


def _unit_of(points: Floats) -> ScanUnit:
    """Return the unit that makes markers as large as those of a head; mm if it does."""
    extent = float(np.ptp(points, axis=0).max())
    mm = likely_unit(extent, LOCATE.extents)
    if mm is None:
        return ScanUnit(LOCATE.usual_extent / max(extent, 1e-9), "template")
    return ScanUnit(mm, "assumed" if mm == 1.0 else "found")


def _by_shape(points: Floats, skin: Samples, mm_per_unit: float) -> list[Similarity]:
    """Return motions of markers and of their mirror image onto the face, by their shape alone."""
    found = []
    for flip in (np.eye(3), FLIP):
        placed = mm_per_unit * points @ flip
        centre, _ = nearest_sphere(placed)
        outward = unit_rows(placed - centre)
        tip = int(np.argmax(np.linalg.norm(placed - centre, axis=1)))
        forward = unit_rows(outward.mean(axis=0))
        cloud = FacePoints(placed, outward, placed[tip], forward)
        motion = find_pose(cloud, skin, [1.0]).motion.inverse()
        found.append(Similarity(mm_per_unit * motion.scale, motion.rotation @ flip, motion.shift))
    return found


def _slide(
    start: Similarity,
    unit: ScanUnit,
    points: Floats,
    chosen: tuple[Ints, Ints],
    face: Surface,
    skin: Samples,
) -> Located:
    """Return ``start`` after its markers slid onto the skin, all at one height over it.

    ``chosen`` are the numbers of the markers that slide, and of all that lie on the skin.
    """
    few, used = chosen
    size = start.scale if unit.source == "template" else unit.mm_per_unit
    rough = start(points[few])
    handed = points[few] * size @ _hand(start)
    even = np.ones(len(few))
    begin = robust_motion(handed, rough, even, 10.0, 3, weighted_motion(handed, rough, even))
    begin = Similarity(size, begin.rotation @ _hand(start), begin.shift)
    tries = []
    for height in sorted(LOCATE.heights, key=lambda each: abs(each - LOCATE.usual_height)):
        raised = Samples(skin.points + height * skin.normals, skin.normals, True)
        session = _onto(begin, points[few], raised)
        over = heights_over(session(points[few]), face) - height
        near = over[np.abs(over) <= LOCATE.off_skin]
        miss = float(np.sqrt(np.median(near**2))) if len(near) else np.inf
        tries.append((miss, height, session))
        if len(near) < LOCATE.on_skin * len(over):
            break
    least = min(miss for miss, _, _ in tries)
    alike = [each for each in tries if each[0] <= least + LOCATE.flat]
    _, height, session = min(alike, key=lambda each: abs(each[1] - LOCATE.usual_height))
    off = np.full(len(points), np.nan)
    off[used] = heights_over(session(points[used]), face) - height
    mirrored = bool(np.linalg.det(session.rotation) < 0)
    return Located(session, unit, False, mirrored, False, (), height, off)


def _hand(motion: Similarity) -> Floats:
    return FLIP if np.linalg.det(motion.rotation) < 0 else np.eye(3)


def _onto(start: Similarity, points: Floats, skin: Samples) -> Similarity:
    """Return the motion after the markers slid onto the skin; the size stays."""
    session = start
    stiff = RefinementOptions(
        kept=0.85, sizes=(1.0, 1.0), least_points=LOCATE.least, close=LOCATE.off_skin, still=0.01
    )
    for _ in range(LOCATE.rounds):
        placed = session(points)
        normals = skin.normals[skin.tree.query(placed)[1]]
        cloud = FacePoints(placed, normals, placed[0], normals[0])
        back = refine_pose(cloud, skin, IDENTITY, 1.0, stiff)
        session = session.then(back.motion.inverse())
    return session


def heights_over(placed: Floats, face: Surface) -> Floats:
    """Return how far (n,) points lie over a face, below 0 inside of it."""
    triangles, shares, distance = barycentric(placed, face)
    corners = face.vertices[face.faces[triangles]]
    nearest = np.einsum("nc,ncd->nd", shares, corners)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outward = np.einsum("nd,nd->n", placed - nearest, normals)
    return np.asarray(distance * np.sign(outward + 1e-30))


def _find_exchanges(
    located: Located, points: Floats, named: Sequence[Named | None], face: Surface
) -> tuple[tuple[int, int], ...]:
    """Return pairs of markers that lie where the other should by its name."""
    known, goal = _goals(points, named, face)
    placed = located.session(points[known])
    cost = ((placed[:, None] - goal[None]) ** 2).sum(axis=2)
    _, chosen = linear_sum_assignment(cost)
    pairs = []
    for row, column in enumerate(chosen.tolist()):
        if row < column and chosen[column] == row:
            gain = cost[row, row] + cost[column, column] - cost[row, column] - cost[column, row]
            if gain > LOCATE.exchanged:
                pairs.append((known[row], known[column]))
    return tuple(pairs)
