"""The part of a face that a scan covers: what is missing, where, and how large holes are."""

from __future__ import annotations

from dataclasses import dataclass, replace

import igl
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from solver.anatomy.contact_regions import stomia
from solver.anatomy.template import Template
from solver.drawing.render import Camera, look
from solver.registration.scan_surface import Samples, orient_outward, sample
from solver.registration.search import FacePoints, FacePose, face_points, find_pose
from solver.surface import Floats, Ints, Surface

FAR_MM = 4000.0  # so far away that the view is nearly parallel
SIDE_MM = 8.0  # from the middle begins a side of the face


@dataclass(frozen=True)
class Relief:
    """Heights of a surface in mm over a grid, whose rows go down from the top."""

    height: Floats  # z (rows, columns), NaN where there is nothing
    x: Floats  # (columns,)
    y: Floats  # (rows,)


def relief(surface: Surface, centre: Floats, size: tuple[float, float], step: float) -> Relief:
    """Return the relief of a mesh or, without faces, of points.

    ``centre`` (3,) and ``size`` (width, height) in mm say which part, ``step`` how fine.
    """
    columns, rows = (max(round(length / step), 1) for length in size)
    x = centre[0] + (np.arange(columns) + 0.5 - columns / 2) * step
    y = centre[1] + (rows / 2 - np.arange(rows) - 0.5) * step
    height = np.full((rows, columns), np.nan)
    if len(surface.faces):
        seen = look(Camera(centre, rows * step, distance=FAR_MM), surface, columns, rows)
        if seen.mask.any():
            height[seen.mask] = seen.interpolate(surface.vertices[:, 2:])[:, 0]
        return Relief(height, x, y)
    column = np.floor((surface.vertices[:, 0] - x[0]) / step + 0.5).astype(np.int64)
    row = np.floor((y[0] - surface.vertices[:, 1]) / step + 0.5).astype(np.int64)
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    np.fmax.at(height, (row[inside], column[inside]), surface.vertices[inside, 2])
    return Relief(height, x, y)


@dataclass(frozen=True)
class CoverOptions:
    """The part of a face that a scan should show, half a face, and a second one; lengths in mm."""

    points: int = 5000  # of the face that are looked for
    border: float = 12.0  # so near the rim of the template's face, scans may end
    opening: float = 4.0  # so near lids, lips and nostrils, scans may be torn
    hidden: float = 2.0  # behind what is seen from the front
    least_gap: float = 3.5  # to the scan from a point in a hole, or four spacings
    rim: float = 5.0  # a hole this near the border is the scan's end
    misfit: float = 15.0  # of a fitted face along its normals
    slides: int = 4  # along the normal to the height of the scan
    nearby: tuple[float, ...] = (-6.0, -3.0, 3.0, 6.0)  # where a slide may swing between layers
    mouth: float = 32.0  # radius of the mouth
    behind: tuple[float, ...] = (8.0, 14.0, 20.0, 26.0, 32.0)  # depths of teeth and tongue
    half_share: float = 0.8  # of a half that is covered at least
    half_cost: float = 1.9  # at most; other persons' cost up to 1.5, balls and skulls 2.2 and more
    nothing: float = 18.0  # about the other half without a scan
    other_share: float = 0.08  # of the scan outside the head that may hold another


COVER = CoverOptions()


@dataclass(frozen=True)
class Hole:
    """A hole in the face."""

    area_mm2: float
    region: str  # that it is in, with its side
    at_rim: bool  # of the face: the scan ends there
    points: Ints  # of the cover that lie in it


@dataclass(frozen=True)
class Cover:
    """The part of a face that a scan should show, and what of it the scan does show."""

    points: Floats  # (n, 3) of the face
    covered: NDArray[np.bool_]  # (n,)
    holes: list[Hole]  # the largest first

    def share(self, side: str = "all") -> float:
        """Return the share covered of the ``left``, ``right``, ``upper`` or ``lower`` face."""
        x, y, _ = self.points.T
        chosen = {
            "all": np.ones(len(x), bool),
            "left": x > SIDE_MM,
            "right": x < -SIDE_MM,
            "upper": y > np.median(y),
            "lower": y <= np.median(y),
        }[side]
        return float(self.covered[chosen].mean())

    def without_mouth(self) -> Cover:
        """Return the cover of a face with its lips apart: the gap between them is no hole.

        A rough fit may have the chin where the mouth is.
        """
        is_mouth = [
            not hole.at_rim and hole.region.endswith(("lip", "chin")) for hole in self.holes
        ]
        covered = self.covered.copy()
        for hole in (hole for hole, leaves in zip(self.holes, is_mouth, strict=True) if leaves):
            covered[hole.points] = True
        kept = [hole for hole, leaves in zip(self.holes, is_mouth, strict=True) if not leaves]
        return Cover(self.points, covered, kept)


def cover(scan: Samples, skin: Floats, template: Template, face: Surface) -> Cover:
    """Return what ``scan``, in the template's frame, covers of the fitted ``skin`` (n, 3).

    ``face`` is the part of the template's skin that is fitted, in its numbers.
    """
    fitted = Surface(skin, face.faces)
    samples = sample(skin, face.faces, None, COVER.points)
    loops = [skin[np.asarray(loop)] for loop in igl.boundary_loop_all(face.faces)]
    loops.sort(key=lambda loop: -float(np.ptp(loop, axis=0).sum()))
    rim, *openings = map(KDTree, loops)
    looked_for = _seen_from_front(fitted, samples.points, COVER.hidden)
    looked_for &= rim.query(samples.points)[0] >= COVER.border
    for opening in openings:
        looked_for &= opening.query(samples.points)[0] >= COVER.opening
    points = samples.points[looked_for]
    normals = samples.normals[looked_for]
    area = float(igl.doublearea(skin, face.faces).sum() / 2) / COVER.points
    tree = scan.tree
    spacing = float(np.median(tree.query(scan.points[::7], k=2)[0][:, 1]))
    gap = _sideways_gap(points, normals, _at_mouth(points, skin, template), tree)
    limit = max(COVER.least_gap, 4 * spacing)
    covered = np.asarray(gap < limit)
    missing = np.flatnonzero(~covered)
    at_rim = rim.query(points[missing])[0] < COVER.border + COVER.rim
    holes = _holes(points[missing], at_rim, (area, limit), skin, template)
    holes = [replace(hole, points=missing[hole.points]) for hole in holes]
    return Cover(points, covered, holes)


def _at_mouth(points: Floats, skin: Floats, template: Template) -> NDArray[np.bool_]:
    known = stomia(template.landmarks)
    if not known:
        return np.zeros(len(points), bool)
    away = np.linalg.norm(points - skin[known].mean(axis=0), axis=1)
    return np.asarray(away < COVER.mouth)


def _sideways_gap(
    points: Floats, normals: Floats, mouth: NDArray[np.bool_], tree: KDTree
) -> Floats:
    """Return how far (n,) the scan is beside each point's normal: in a hole, not where it misfits.

    Each point slides along its normal to the height of its closest scan point, and again from
    there, up to a misfit. At the ``mouth`` what lies straight behind counts too: teeth and tongue
    between open lips.
    """
    height = np.zeros(len(points))
    gap = np.full(len(points), np.inf)
    for _ in range(COVER.slides):
        beside, near = tree.query(points + height[:, None] * normals)
        gap = np.minimum(gap, beside)
        height = ((tree.data[near] - points) * normals).sum(axis=1)
        height = height.clip(-COVER.misfit, COVER.misfit)
    for depth in COVER.nearby:  # where a slide swings between two layers, as lashes and brow
        gap = np.minimum(gap, tree.query(points - depth * normals)[0])
    for depth in COVER.behind:
        gap[mouth] = np.minimum(gap[mouth], tree.query((points - depth * normals)[mouth])[0])
    return np.asarray(gap)


def _seen_from_front(fitted: Surface, points: Floats, hidden: float) -> NDArray[np.bool_]:
    """Return which points neither lie in a fold nor face sideways, where few scanners see."""
    used = fitted.vertices[np.unique(fitted.faces)]
    low = used.min(axis=0)
    high = used.max(axis=0)
    width, height, _ = high - low + 4.0
    front = relief(fitted, (low + high) / 2, (float(width), float(height)), 1.0)
    column = np.clip(np.rint(points[:, 0] - front.x[0]), 0, len(front.x) - 1)
    row = np.clip(np.rint(front.y[0] - points[:, 1]), 0, len(front.y) - 1)
    foremost = front.height[row.astype(int), column.astype(int)]
    return np.asarray(points[:, 2] > np.nan_to_num(foremost, nan=-1e9) - hidden)


def _holes(
    missing: Floats,
    at_rim: NDArray[np.bool_],
    measure: tuple[float, float],
    skin: Floats,
    template: Template,
) -> list[Hole]:
    """Return the clusters of missing points, the largest first.

    ``measure`` is the area of one point, and how near the edge of a hole points still count as
    covered: a round hole is larger than its points by that.
    """
    area, edge = measure
    if not len(missing):
        return []
    pairs = KDTree(missing).query_pairs(2.2 * np.sqrt(area), output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(missing), len(missing)))
    count, label = connected_components(graph, directed=False)
    holes = []
    for chosen in (np.flatnonzero(label == number) for number in range(count)):
        size = float(np.pi * (np.sqrt(len(chosen) * area / np.pi) + edge) ** 2)
        region = _region(missing[chosen].mean(axis=0), skin, template)
        holes.append(Hole(size, region, bool(at_rim[chosen].any()), chosen))
    return sorted(holes, key=lambda hole: -hole.area_mm2)


def _region(place: Floats, skin: Floats, template: Template) -> str:
    """Return the name of the region nearest to ``place`` (3,), with its side."""
    nearest = {
        name: float(np.linalg.norm(skin[ids] - place, axis=1).min())
        for name, ids in template.regions.items()
        if len(ids)
    }
    if not nearest:
        return "face"
    name = min(nearest, key=lambda region: nearest[region]).replace("_", " ")
    side = "left " if place[0] > SIDE_MM else "right " if place[0] < -SIDE_MM else ""
    return side + name


# More or less than one face in a scan: a second head, or only a part of a face.


# The box about a face's middle that its own head fills.
HEAD_MM = np.array([[-95.0, -210.0, -220.0], [95.0, 190.0, 120.0]])
# The half that is missing where the other is seen.
OPPOSITE = {"left": "right", "right": "left", "upper": "lower", "lower": "upper"}


def _halves(face: Surface) -> dict[str, FacePoints]:
    """Return the ``left``, ``right``, ``upper`` and ``lower`` halves of a template's face."""
    x, y, _ = face.vertices[face.faces].mean(axis=1).T
    middle = np.median(y)
    halves = {"left": x > 0, "right": x < 0, "upper": y > middle, "lower": y < middle}
    parts = {name: Surface(face.vertices, face.faces[kept]) for name, kept in halves.items()}
    return {name: face_points(part) for name, part in parts.items()}


def visible_part(scan: Samples, face: Surface, scales: list[float]) -> str | None:
    """Return which half of a face a scan shows that shows no whole one; else None."""
    parts = _halves(face)
    scan = orient_outward(scan)
    costs = {}
    for name, part in parts.items():
        pose = find_pose(part, scan, scales)
        if pose.coverage > COVER.half_share and pose.cost < COVER.half_cost:
            gap, _ = KDTree(pose.motion(scan.points)).query(parts[OPPOSITE[name]].points)
            if (gap > COVER.nothing).mean() > 0.5:  # most of the other half is not there
                costs[name] = pose.cost
    return min(costs, key=lambda name: costs[name], default=None)


def has_second_face(scan: Samples, face: FacePoints, pose: FacePose) -> bool:
    """Return whether there is another face in the scan than the one at ``pose``."""
    scan = orient_outward(scan)
    there = pose.motion(scan.points) - face.points.mean(axis=0)
    outside = ((there < HEAD_MM[0]) | (there > HEAD_MM[1])).any(axis=1)
    if outside.sum() < COVER.other_share * len(outside):
        return False
    rest = Samples(scan.points[outside], scan.normals[outside], scan.oriented)
    return find_pose(face, rest, [pose.motion.scale]).is_face
