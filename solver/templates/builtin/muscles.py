"""The built-in muscles: ribbons swept along published attachments, between skin and bone.

``data/muscles.csv`` names, for each muscle, the points it runs through (``landmark+x/y/z``, in mm,
x away from the mid-plane), its width at those points, its thickness and the depth of its middle
under the skin, from origin to insertion. ``layer`` is ``bed`` for a muscle that keeps between the
skin and what lies under it, ``under_arch`` for one that passes behind the zygomatic arch. ``cut``
and ``compartments`` divide it (:class:`solver.anatomy.template.Compartments`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter

from solver.anatomy.data import read_table
from solver.anatomy.domain import grid_quads, split_quads
from solver.anatomy.muscle_weights import signed_volume
from solver.anatomy.template import Compartments, Muscle
from solver.anatomy.warp import MIRROR
from solver.surface import Floats, Surface, adjacency, unit_rows
from solver.templates.builtin.head import Head
from solver.templates.builtin.skull import OuterSkin


@dataclass(frozen=True)
class SweepOptions:
    """Fineness of the ribbons, and the layers over and under them."""

    step_mm: float = 2.5
    skin_layer_mm: float = 1.0  # least thickness of skin over a muscle, where there is room
    bed_gap_mm: float = 0.3  # between a muscle and the bed it lies on
    deepest_mm: float = 40.0  # room for a muscle where no bed is under it
    # Rounds of averaging the skin's normals, along which muscles are sunk.
    normal_smoothing: int = 6


SWEEP = SweepOptions()


@dataclass(frozen=True)
class MuscleRow:
    """One line of the muscle table; ``path`` holds (landmark, offset) pairs."""

    name: str
    paired: bool
    path: tuple[tuple[str, Floats], ...]
    width: Floats
    thickness: float
    depth: Floats
    layer: str
    compartments: Compartments | None


def read_muscles() -> list[MuscleRow]:
    """Return the muscle table."""
    rows = []
    for line in read_table("muscles"):
        points = [point.split("+", 1) for point in line["path"].split()]
        path = tuple((mark, np.array(offset.split("/"), dtype=float)) for mark, offset in points)
        width, depth = (np.array(line[key].split(), float) for key in ("width_mm", "depth_mm"))
        thickness, paired = float(line["thickness_mm"]), line["paired"] == "yes"
        compartments = Compartments.read(line["cut"], line["compartments"])
        row = MuscleRow(
            line["name"], paired, path, width, thickness, depth, line["layer"], compartments
        )
        rows.append(row)
    return rows


def build_muscles(head: Head, skin: OuterSkin, bed: Surface) -> tuple[Muscle, ...]:
    """Sweep every muscle of the table; ``bed`` is all that muscles can lie on: bones and linings.

    Paired muscles get the suffixes ``_l`` and ``_r``, the right one being the mirror image.
    """
    sweep = _Sweep(head, skin.stretched_over(head.ears), bed)
    muscles = []
    for row in read_muscles():
        left = sweep.muscle(row)
        muscles += [left, _mirror(left)] if row.paired else [left]
    return tuple(muscles)


def _mirror(left: Muscle) -> Muscle:
    surface = Surface(left.surface.vertices * MIRROR, left.surface.faces[:, ::-1].copy())
    fibre, origin, insertion = left.axis * MIRROR
    name = left.name.removesuffix("_l") + "_r"
    return Muscle(name, surface, fibre, origin, insertion, compartments=left.compartments)


class _Sweep:
    """Lays ribbons into the soft tissue of one head."""

    def __init__(self, head: Head, skin: OuterSkin, bed: Surface) -> None:
        self._head, self._skin = head, skin
        self._bed = trimesh.Trimesh(bed.vertices, bed.faces, process=False)
        self._normals = _smooth_normals(skin, SWEEP.normal_smoothing)

    def muscle(self, row: MuscleRow) -> Muscle:
        """Return the left (or the mid-line) muscle of a row."""
        anchors = self._anchors(row)
        length = np.r_[0, np.cumsum(np.linalg.norm(np.diff(anchors, axis=0), axis=1))]
        rows = max(5, round(length[-1] / SWEEP.step_mm))
        columns = max(5, round(row.width.max() / SWEEP.step_mm))
        along = np.linspace(0, length[-1], rows)
        across = np.linspace(-1, 1, columns)
        curve = CubicSpline(length, anchors)
        centres, _ = self._on_skin(curve(along))
        _, normals = self._on_skin(centres)
        tangents = np.gradient(centres, axis=0)
        sideways = unit_rows(np.cross(normals, tangents))
        half_width = np.interp(along, length, row.width) / 2
        grid = centres[:, None] + (half_width[:, None] * across)[..., None] * sideways[:, None]
        above, normals = self._on_skin(grid.reshape(-1, 3))
        depth = np.interp(along, length, row.depth)
        half_thickness = row.thickness / 2 * _profile(along / length[-1], across)
        top = depth[:, None] - half_thickness
        bottom = depth[:, None] + half_thickness
        if row.layer == "bed":
            room = self._room(above, normals).reshape(top.shape)
            top, bottom = _fit_between(top, bottom, room)
        upper, lower = (above - sheet.reshape(-1, 1) * normals for sheet in (top, bottom))
        surface = _closed_sheet(np.concatenate([upper, lower]), rows, columns)
        middle = ((upper + lower) / 2).reshape(rows, columns, 3).mean(axis=1)
        fibre = middle[-1] - middle[0]
        name = f"{row.name}_l" if row.paired else row.name
        ends, fibre = (middle[0], middle[-1]), fibre / np.linalg.norm(fibre)
        return Muscle(name, surface, fibre, *ends, compartments=row.compartments)

    def _anchors(self, row: MuscleRow) -> Floats:
        marks = self._head.landmarks
        vertices = [marks[name] if name in marks else marks[f"{name}_l"] for name, _ in row.path]
        offsets = np.array([offset for _, offset in row.path])
        return self._on_skin(self._head.neutral[vertices] + offsets)[0]

    def _on_skin(self, points: Floats) -> tuple[Floats, Floats]:
        """Return the closest skin points (k, 3) and the smoothed normals there."""
        _, face, closest = self._skin.closest(np.ascontiguousarray(points))
        normals = self._skin.interpolate(self._normals, face, closest)
        return closest, unit_rows(normals)

    def _room(self, above: Floats, normals: Floats) -> Floats:
        """Return the soft-tissue thickness (k,) from the skin inwards to the bed, in mm."""
        room = np.full(len(above), SWEEP.deepest_mm)
        hits, ray, _ = self._bed.ray.intersects_location(
            above - 0.2 * normals, -normals, multiple_hits=False
        )
        room[ray] = np.minimum(room[ray], np.linalg.norm(hits - above[ray], axis=1))
        return room


def _profile(along: Floats, across: Floats) -> Floats:
    """Return the relative thickness (rows, columns): thinner towards the rim and the ends."""
    side = np.sqrt(1 - 0.85 * across**2)
    end = np.sqrt(1 - 0.7 * np.abs(2 * along - 1) ** 6)
    return np.outer(end, side)


def _fit_between(top: Floats, bottom: Floats, room: Floats) -> tuple[Floats, Floats]:
    """Move and, where there is no room, thin a ribbon so that it lies between skin and bed."""
    lowest = room - SWEEP.bed_gap_mm
    cover = np.minimum(SWEEP.skin_layer_mm, 0.35 * room)
    down = (cover - top).clip(0)
    top, bottom = top + down, bottom + down
    up = (bottom - lowest).clip(0)
    top, bottom = np.maximum(top - up, cover), bottom - up
    top, bottom = (gaussian_filter(sheet, 0.7, mode="nearest") for sheet in (top, bottom))
    bottom = np.minimum(bottom, lowest)
    return np.minimum(top, bottom - 0.1 * room.clip(0, 4)), bottom


def _closed_sheet(vertices: Floats, rows: int, columns: int) -> Surface:
    """Join an upper and a lower sheet of rows x columns vertices along their rims."""
    number = np.arange(rows * columns).reshape(rows, columns)
    rim = np.r_[number[0, :-1], number[:-1, -1], number[-1, :0:-1], number[:0:-1, 0]]
    following, lower = np.roll(rim, -1), rows * columns
    wall = np.stack([rim, following, following + lower, rim + lower], -1)
    upper = grid_quads(rows, columns)
    faces = split_quads(np.concatenate([upper, upper[:, ::-1] + lower, wall]))
    sheet = Surface(vertices, faces)
    return sheet if signed_volume(sheet) > 0 else Surface(vertices, faces[:, ::-1].copy())


def _smooth_normals(skin: OuterSkin, rounds: int) -> Floats:
    """Vertex normals averaged over neighbours, so that folds of lips and lids do not tear."""
    graph, normals = adjacency(skin.faces, len(skin.vertices)), skin.normals.copy()
    degree = graph.sum(axis=1)[:, None]
    for _ in range(rounds):
        normals = np.where(degree > 0, normals + graph @ normals / degree.clip(1), normals)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-9)
    return normals
