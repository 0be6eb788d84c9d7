"""The built-in skull under the outer skin, by published soft-tissue depths at landmarks."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from typing import Any

import igl
import numpy as np
import scipy.sparse as sp
import trimesh
from scipy import interpolate
from scipy.ndimage import gaussian_filter
from scipy.sparse.linalg import splu

from solver.anatomy.bones import largest_piece, level_set
from solver.anatomy.data import read_json, read_table
from solver.anatomy.domain import grid_quads, split_quads
from solver.anatomy.embedding import barycentric
from solver.anatomy.template import Depth
from solver.surface import Floats, Ints, Surface, adjacency, inside
from solver.templates.builtin.head import Head

NO_BONE = "aperture"  # source of rows where there is no bone, which only say that it is not near
UNCHECKED = " Not yet compared with the printed table."


@dataclass(frozen=True)
class VisibilityOptions:
    """Rays that tell the skin seen from outside from its linings."""

    # Skin that sees less than 3 % of its hemisphere is lining: mouth, eye sockets, nostrils.
    hidden: float = 0.97
    directions: int = 400  # of rays from every vertex, over the whole sphere
    # Rays start above the skin, so that they do not meet the vertex's own triangles.
    off_skin_mm: float = 0.05


VISIBILITY = VisibilityOptions()


class OuterSkin:
    """The skin that is seen from outside, with the openings of mouth and eyes closed in effect.

    The generalised winding number (Jacobson et al. 2013) of the visible faces alone is near one
    inside the head and near zero outside, also across the small openings, so that the mouth's
    cavity counts as inside.
    """

    def __init__(self, head: Head) -> None:
        self.vertices = head.neutral
        skin = head.faces[head.part_faces["skin"]]
        self.normals: Floats = np.nan_to_num(igl.per_vertex_normals(self.vertices, skin))
        hidden = _hidden_part(head, self.normals)
        hidden = np.minimum(hidden, hidden[head.mirror])
        self.visible_vertices: Ints = np.intersect1d(
            np.flatnonzero(hidden < VISIBILITY.hidden), head.part_vertices["skin"]
        )
        self.faces: Ints = skin[np.isin(skin, self.visible_vertices).all(axis=1)]

    def stretched_over(self, vertices: Ints) -> OuterSkin:
        """Return this skin with some vertices drawn tight between the others (harmonic).

        Muscles beside the ear run under the head's side, not along the ear.
        """
        edges = adjacency(self.faces, len(self.vertices))
        laplacian = sp.csc_array(sp.diags_array(edges.sum(axis=1)) - edges)
        free = np.intersect1d(vertices, self.visible_vertices)
        given = ~np.isin(np.arange(len(self.vertices)), free)
        tight = copy(self)
        tight.vertices = self.vertices.copy()
        # by SuperLU: the built-in template's hash hangs on the last bit
        pull = -laplacian[:, given] @ self.vertices[given]
        inner = splu(sp.csc_array(laplacian[free][:, free]))
        tight.vertices[free] = inner.solve(np.ascontiguousarray(pull[free]))
        tight.normals = np.nan_to_num(igl.per_vertex_normals(tight.vertices, self.faces))
        return tight

    def closest(self, points: Floats) -> tuple[Floats, Ints, Floats]:
        """Return distance (k,), face (k,) and closest point (k, 3) of the visible skin."""
        squared, face, closest = igl.point_mesh_squared_distance(points, self.vertices, self.faces)
        return np.sqrt(squared), face, closest

    def interpolate(self, values: Floats, face: Ints, point: Floats) -> Floats:
        """Interpolate vertex ``values`` (n, d) linearly at points (k, 3) of faces (k,)."""
        corners = self.faces[face]
        weights = igl.barycentric_coordinates(point, *self.vertices[corners].transpose(1, 0, 2))
        return np.asarray((values[corners] * weights[:, :, None]).sum(axis=1))

    def depth(self, points: Floats) -> tuple[Floats, Ints, Floats]:
        """Return the depth under the skin (k,), positive inside, and the face and point above."""
        distance, face, closest = self.closest(points)
        within = inside(Surface(self.vertices, self.faces), points)
        return np.where(within, distance, -distance), face, closest


def _hidden_part(head: Head, normals: Floats) -> Floats:
    """Return for each vertex the part (n,) of directions above the skin that meet the head.

    Eyes, teeth and tongue hide the linings behind them.
    """
    number = np.arange(VISIBILITY.directions)
    height = 1 - (2 * number + 1) / VISIBILITY.directions
    turn = np.pi * (3 - np.sqrt(5)) * number
    around = np.sqrt(1 - height**2)
    sphere = np.stack([around * np.cos(turn), height, around * np.sin(turn)], -1)
    vertex, direction = np.nonzero(normals @ sphere.T > 0)
    rays = trimesh.Trimesh(head.neutral, head.faces, process=False).ray
    origins = head.neutral[vertex] + VISIBILITY.off_skin_mm * normals[vertex]
    meets = rays.intersects_any(origins, sphere[direction])  # type: ignore[no-untyped-call]
    counts = np.bincount(vertex, minlength=len(normals)).clip(1)
    return np.asarray(np.bincount(vertex, meets, minlength=len(normals)) / counts)


def depth_fields(head: Head) -> dict[str, Callable[[Floats], Floats]]:
    """Return bone name -> function from skin points (k, 3) to the depth of that bone (k,), mm.

    The table's means are interpolated with the radial kernel r, which passes through them.
    """
    fields: dict[str, Callable[[Floats], Floats]] = {}
    for bone in ("cranium", "mandible"):
        depths = {
            head.landmarks[name]: float(row["depth_mm"])
            for row in read_table("soft_tissue_depths")
            if row["bone"] == bone
            for name in sides(head, row["landmark"])
        }
        values = np.array(list(depths.values()))
        fields[bone] = interpolate.RBFInterpolator(
            head.neutral[list(depths)], values, kernel="linear"
        )
    return fields


def depth_table(head: Head) -> tuple[Depth, ...]:
    """Return the depths with their references, one a landmark, where there is bone.

    Most were entered from memory of the cited tables: the reference says so until a row has been
    compared with the printed one (``checked``).
    """
    references = {row["key"]: row["reference"] for row in read_table("sources")}
    depths = []
    for row in read_table("soft_tissue_depths"):
        if row["source"] != NO_BONE:
            source = references[row["source"]] + UNCHECKED * (row["checked"] == "no")
            names = sides(head, row["landmark"])
            depth = float(row["depth_mm"])
            depths += [Depth(name, row["bone"], depth, None, source) for name in names]
    return tuple(depths)


def sides(head: Head, landmark: str) -> list[str]:
    """Return a mid-line landmark itself, or the left and right names of a paired one."""
    names = (landmark, f"{landmark}_l", f"{landmark}_r")
    return [name for name in names if name in head.landmarks]


# The built-in skull: cranium and mandible as watertight surfaces under the skin.
#
# The skull is a set of implicit solids on a grid, in mm and positive inside: where published soft-
# tissue depths say how deep the bone lies, the distance to the skin gives it; the fossae, orbits,
# dental arches and the mandible's shape come from ``data/skull.json``. One half is computed and
# mirrored.

# the grid, mm
LOWEST = np.array([-81.0, -76.0, -100.0])
HIGHEST = np.array([81.0, 154.5, 117.0])


@dataclass(frozen=True)
class SkullOptions:
    """Fineness of the bones, and the room over them."""

    grid_mm: float = 1.5
    smoothing_voxels: float = 0.8  # deviation of the Gaussian before marching cubes
    clearance_mm: float = 2.4  # least soft tissue on a bone
    cranium_faces: int = 11000
    mandible_faces: int = 5000
    relaxations: int = 8  # steps that even the vertices out after decimation


SKULL = SkullOptions()


@dataclass(frozen=True)
class Skull:
    """Both bones and the centres (2, 3) of the left and right condyle."""

    cranium: Surface
    mandible: Surface
    condyles: Floats


def build_skull(head: Head, skin: OuterSkin) -> Skull:
    """Build cranium and mandible for the head at rest."""
    shape = read_json("skull")
    grid = _HalfGrid()
    # The bone behind the ear does not follow its relief.
    smooth = skin.stretched_over(head.ears)
    depth, face, _ = smooth.depth(grid.points)
    under = {}
    for bone, field in depth_fields(head).items():
        least = field(smooth.vertices).clip(SKULL.clearance_mm)
        under[bone] = depth - least[skin.faces[face]].mean(axis=1)
    depth = np.minimum(depth, skin.depth(grid.points)[0])
    bones = {
        "mandible": np.minimum(_mandible(grid.points, shape), under["mandible"]),
        "cranium": _cranium(grid.points, shape, under["cranium"]),
    }
    for bone, jaw in (("mandible", "lower"), ("cranium", "upper")):
        with_teeth = np.maximum(bones[bone], _teeth(grid.points, shape, jaw))
        bones[bone] = np.minimum(with_teeth, depth - SKULL.clearance_mm)
    mandible = bones["mandible"]
    cranium = np.minimum(bones["cranium"], -shape["joint_gap_mm"] - mandible)
    centre = np.array(shape["mandible"]["condyle"]["centre"])
    return Skull(
        cranium=grid.surface(cranium, SKULL.cranium_faces),
        mandible=grid.surface(mandible, SKULL.mandible_faces),
        condyles=np.stack([centre, centre * [-1, 1, 1]]),
    )


class _HalfGrid:
    """Grid points of the left half (x >= 0), and surfaces of fields over both halves."""

    def __init__(self) -> None:
        side = SKULL.grid_mm
        self.axes = [
            np.arange(low, high + side / 2, side) for low, high in zip(LOWEST, HIGHEST, strict=True)
        ]
        left = self.axes[0][self.axes[0] >= -side / 4]
        grid = np.stack(np.meshgrid(left, *self.axes[1:], indexing="ij"), -1)
        self.shape = grid.shape[:3]
        self.points = grid.reshape(-1, 3)

    def surface(self, field: Floats, faces: int) -> Surface:
        """Return the zero surface of the mirrored field's largest solid, decimated."""
        side = SKULL.grid_mm
        half = field.reshape(self.shape)
        whole = np.concatenate([half[:0:-1], half]).clip(-4 * side, 4 * side)
        whole = gaussian_filter(whole, SKULL.smoothing_voxels)
        whole = np.pad(whole[1:-1, 1:-1, 1:-1], 1, constant_values=-side)
        whole[(whole > 0) & ~largest_piece(whole > 0)] = -side / 2
        vertices, triangles = level_set(whole, self.axes, 0.0)
        return _decimate(vertices, triangles[:, ::-1], faces, SKULL.relaxations)


def _decimate(vertices: Floats, triangles: Ints, faces: int, relaxations: int) -> Surface:
    """Smooth away the grid's steps and keep about ``faces`` triangles, most where it curves."""
    mesh = trimesh.Trimesh(vertices, triangles, process=False)
    trimesh.smoothing.filter_taubin(mesh, iterations=6)  # type: ignore[no-untyped-call]
    fine = np.asarray(mesh.vertices)
    fine_faces = np.asarray(mesh.faces)
    coarse, kept, _, _ = igl.qslim(fine, fine_faces, faces)
    kept = np.ascontiguousarray(kept)
    # Where bone is flat, quadrics may put a vertex anywhere, and triangles fold over: even the
    # vertices out on the surface.
    neighbours = adjacency(kept, len(coarse))
    count = neighbours.sum(axis=1)[:, None]
    for _ in range(relaxations):
        even = (coarse + neighbours @ coarse / count) / 2
        _, _, coarse = igl.point_mesh_squared_distance(even, fine, fine_faces)
    return Surface(np.ascontiguousarray(coarse), kept)


def _cranium(points: Floats, shape: dict[str, Any], under_skin: Floats) -> Floats:
    x, y, z = points.T
    limit = shape["lateral_limit"]
    base = np.array(shape["base_height"]["points"])
    side = interpolate.RegularGridInterpolator(
        (limit["y"], limit["z"]), limit["x"], bounds_error=False, fill_value=None
    )
    solid = np.minimum(under_skin, y - np.interp(z, base[:, 0], base[:, 1]))
    solid = np.minimum(solid, side(np.stack([y, z], -1)) - x)
    solid = np.maximum(solid, _bar(points, np.array(shape["zygomatic_arch"]["points"])))
    for hollow in ("piriform_aperture", "palate"):
        ellipsoid = _ellipsoid(points, shape[hollow]["centre"], shape[hollow]["radii"])
        solid = np.minimum(solid, -ellipsoid)
    return np.asarray(np.minimum(solid, -_orbit(points, shape["orbit"])))


def _orbit(points: Floats, orbit: dict[str, Any]) -> Floats:
    """Half an ellipsoid behind the rim, and a cylinder before it."""
    turn = np.radians(orbit["medial_turn_deg"])
    backwards = np.array([-np.sin(turn), 0, -np.cos(turn)])
    sideways = np.array([np.cos(turn), 0, -np.sin(turn)])
    from_rim = points - orbit["rim"]
    local = np.stack([from_rim @ sideways, from_rim[:, 1], (from_rim @ backwards).clip(0)], -1)
    return _ellipsoid(local, 0.0, orbit["radii"])


def _mandible(points: Floats, shape: dict[str, Any]) -> Floats:
    bone = shape["mandible"]
    body = np.array(bone["body"])
    other_side = body[:0:-1] * [-1, 1, 1, 1]
    solid = _thick_patch(points, np.concatenate([other_side, body]))
    solid = np.maximum(solid, _thick_patch(points, np.array(bone["ramus"])))
    for process in ("neck", "coronoid"):
        solid = np.maximum(solid, _bar(points, np.array(bone["processes"][process])))
    condyle = _ellipsoid(points, bone["condyle"]["centre"], bone["condyle"]["radii"])
    return np.maximum(solid, condyle)


def _thick_patch(points: Floats, controls: Floats, samples: int = 40) -> Floats:
    """Return half thickness minus distance for a smooth patch of (x, y, z, half thickness)."""
    rows, columns = controls.shape[:2]
    u = np.linspace(0, rows - 1, samples)
    v = np.linspace(0, columns - 1, samples)
    places = (np.arange(rows), np.arange(columns))
    degree = min(3, rows - 1)
    splines = [
        interpolate.RectBivariateSpline(*places, controls[..., i], kx=degree, ky=2)(u, v)
        for i in range(4)
    ]
    patch = np.stack(splines, -1).reshape(-1, 4)
    faces = split_quads(grid_quads(samples, samples)[:, [0, 3, 2, 1]])
    surface = Surface(np.ascontiguousarray(patch[:, :3]), faces)
    face, _, distance = barycentric(points, surface)
    return np.asarray(patch[faces[face], 3].mean(axis=1) - distance)


def _bar(points: Floats, controls: Floats) -> Floats:
    """Return radius minus distance for a round bar along (x, y, z, radius)."""
    solid = np.full(len(points), -np.inf)
    for start, end in itertools.pairwise(controls):
        along = end[:3] - start[:3]
        t = ((points - start[:3]) @ along / (along @ along)).clip(0, 1)
        distance = np.linalg.norm(points - start[:3] - t[:, None] * along, axis=1)
        solid = np.maximum(solid, start[3] + t * (end[3] - start[3]) - distance)
    return solid


def _ellipsoid(points: Floats, centre: Any, radii: Any) -> Floats:
    """Return about the distance to an ellipsoid, positive inside."""
    away = points - centre
    scaled = np.linalg.norm(away / radii, axis=1)
    gradient = np.linalg.norm(away / np.square(radii), axis=1)
    return np.asarray((1 - scaled) * scaled / np.maximum(gradient, 1e-9))


def _teeth(points: Floats, shape: dict[str, Any], jaw: str) -> Floats:
    """Return the crowns of one jaw, set side by side along the dental arch."""
    arch = np.array(shape["dental_arch"][jaw], dtype=float)
    length = np.r_[0, np.cumsum(np.linalg.norm(np.diff(arch, axis=0), axis=1))]
    curve = interpolate.CubicSpline(length, arch)
    crowns = shape["teeth"][jaw]
    start = 0.0
    solid = np.full(len(points), -np.inf)
    for width in crowns["widths"]:
        (x, z), (dx, dz) = curve(start + width / 2), curve(start + width / 2, 1)
        along = np.array([dx, 0, dz]) / np.hypot(dx, dz)
        across = np.array([-along[2], 0, along[0]])
        offset = points - [x, crowns["y"], z]
        local = np.stack([offset @ along, offset[:, 1], offset @ across], -1)
        radii = [0.58 * width, crowns["half_height"], crowns["half_depth"]]
        solid = np.maximum(solid, _ellipsoid(local, 0.0, radii))
        start += width
    return solid
