"""What a scan has beyond its registered mesh: a normal map and a map of displacement.

At every texel, h is the height of the scan over the skin as programs subdivide it (Loop), along
its normal, and d = n' - n how much the scan's normal n' is off the one that a viewer draws there,
of the mesh itself. Registration errs smoothly, and of both the smooth part is taken away,

    h - S h,    n + d - S d,

with S of :mod:`.detail_fields`. What is left counts by the scan's confidence, by how much finer
the scan is than the mesh there, and by how far it rises above the scan's noise: the share V / (V +
noise^2) of what is found with the local variance V + noise^2 (Lee 1980).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial import cKDTree

from solver.anatomy.tangents import frames, vertex_tangents
from solver.anatomy.texture_coordinates import TextureCoordinates
from solver.registration.detail_fields import SmoothFields
from solver.registration.normal_maps import write_normals
from solver.registration.placed_scan import PlacedScan, ScanTrust, Shown
from solver.registration.scan_noise import QuietScan, quieten
from solver.registration.skin_images import made_for
from solver.registration.subdivided import Subdivided
from solver.registration.texels import Texels
from solver.registration.topology import Topology
from solver.surface import (
    Floats,
    Ints,
    Surface,
    directed_edges,
    part_of,
    unit_rows,
    vertex_areas,
    vertex_normals,
)

DETAIL_TRUST = ScanTrust(farthest=5.0, trusted=2.5, least_cosine=0.5)


@dataclass(frozen=True)
class DetailOptions:
    """Fineness and limits of what is baked; lengths in mm."""

    size: int = 2048  # px of a side
    levels: int = 2  # of subdivision of the mesh over which heights are taken
    trust: ScanTrust = DETAIL_TRUST
    surest: float = 0.5  # confidence from which on detail counts fully
    width: float = 25.0  # waves of this length are halved: longer ones are the mesh's
    # what rises by this over the smooth part counts half for it, so that furrows keep their depth
    sharp: float = 0.1
    rounds: int = 2  # of weighing that
    most: float = 1.0  # height; what is twice as high is no detail
    steepest: float = 0.5  # least cosine of a normal with the mesh's
    # edges of the mesh by those of the scan, from which on it counts, and counts fully: normals of
    # a scan with edges twice as long still tell more of a face than a template's
    finer: tuple[float, float] = (0.5, 1.0)
    # the same from which on a scan is finer, as it has to be on that share of the face
    least_finer: float = 1.25
    least_share: float = 0.1
    margin: float = 15.0  # around the skin within which the scan is looked at
    steps: int = 1  # to where a normal of the skin meets the scan
    chunk: int = 200_000  # texels that are looked up at a time


DETAIL = DetailOptions()
LEAST_COSINE = 0.3  # of the scan's normal and the skin's, where the one meets the other
HIGHEST = 32767  # of a displacement's numbers, on either side of the middle
MIDDLE = 32768  # the number that stands for none


@dataclass(frozen=True, eq=False)
class Detail:
    """A skin's detail at the texels (t) of an image."""

    texels: Texels
    normals: Floats  # (t, 3) unit, by tangent, second axis and normal of the mesh
    heights: Floats  # (t,) mm over the subdivided mesh
    known: Floats  # (t,) from 0, nothing is known of it, to 1
    most: float  # mm, that a height may have
    coordinates: TextureCoordinates
    figures: dict[str, Any]  # of registration.json

    def write(self, normals: Path, displacement: Path) -> None:
        """Write the normal map, 8 bits a channel, and the displacement, 16 bits of grey, as PNG.

        Millimetres are ``offset_mm`` + ``scale_mm`` times a number of the second, as the figures
        have them.
        """
        write_normals(normals, self.texels, self.normals, self.coordinates)
        numbers = np.round(self.heights / self.most * HIGHEST) + MIDDLE
        image = Image.fromarray(self.texels.spread(numbers.astype(np.uint16)))
        image.save(displacement, pnginfo=made_for(self.coordinates))


def bake_detail(
    scan: Surface,
    skin: Surface,
    topology: Topology,
    coordinates: TextureCoordinates,
    options: DetailOptions = DETAIL,
) -> Detail | None:
    """Return the detail of a mended ``scan`` in mm that lies on its registered ``skin``.

    None: on hardly any of the face is it finer than the skin.
    """
    near = _around(scan, skin.vertices[topology.outer], options.margin)
    apart, _ = cKDTree(skin.vertices[topology.face]).query(
        near.vertices, distance_upper_bound=options.trust.farthest
    )
    on_face = np.flatnonzero(np.isfinite(apart))
    if not len(on_face):
        return None
    quiet = quieten(near, on_face)
    placed = PlacedScan(quiet.surface, skin, topology.face, options.trust)
    shown = placed.look_up(skin.vertices, vertex_normals(skin))
    fineness = _fineness(skin, quiet.surface, shown)
    area = vertex_areas(skin.vertices, skin.faces)[topology.face]
    is_finer = fineness[topology.face] > options.least_finer
    if np.average(is_finer, weights=area) < options.least_share:
        return None
    least, most = options.finer
    finer = np.clip((fineness - least) / (most - least), 0.0, 1.0)
    texels = Texels.of(skin, coordinates, options.size)
    own = texels.within(topology.outer)
    own = own[_with_a_ring(skin, shown.confidence > 0.0)[texels.faces[own]]]
    compared = _compare(texels, own, placed, coordinates, options)
    heights = np.zeros(len(texels.rows))
    normals = np.tile([0.0, 0.0, 1.0], (len(texels.rows), 1))
    known = np.zeros(len(texels.rows))
    believed = np.clip(compared.confidence / options.surest, 0.0, 1.0)
    believed *= texels.at(finer[:, None], own)[:, 0]
    heights[own], normals[own], known[own] = _kept(compared, believed, quiet, options)
    face = texels.within(topology.face)
    seen = known[face] > 0.5
    share = np.average(seen, weights=texels.areas(face))
    figures = {
        "size": options.size,
        "share": round(float(share), 4),
        "noise_mm": round(quiet.noise_mm, 4),
        "smoothed_steps": quiet.steps,
        "displacement": {
            "offset_mm": -options.most / HIGHEST * MIDDLE,
            "scale_mm": options.most / HIGHEST,
            "p95_mm": round(_p95(heights[face][seen]), 4),
        },
    }
    return Detail(texels, normals, heights, known, options.most, coordinates, figures)


def _around(scan: Surface, points: Floats, margin: float) -> Surface:
    """Return the triangles of a scan that lie in the box around ``points`` (k, 3)."""
    low = points.min(axis=0) - margin
    high = points.max(axis=0) + margin
    is_near = ((scan.vertices > low) & (scan.vertices < high)).all(axis=1)
    return part_of(scan, np.flatnonzero(is_near[scan.faces].all(axis=1)))


def _fineness(skin: Surface, scan: Surface, shown: Shown) -> Floats:
    """Return the edges (n,) at a skin's vertices by those of the scan there; 0: it shows none."""
    at_scan = _edge_lengths(scan)[scan.faces[shown.faces]]
    ratio = _edge_lengths(skin) / np.maximum(np.einsum("nc,nc->n", shown.shares, at_scan), 1e-9)
    return np.where(shown.confidence > 0.0, ratio, 0.0)


def _edge_lengths(surface: Surface) -> Floats:
    """Return the mean length (n,) of the edges at each vertex."""
    ends = directed_edges(surface.faces)
    length = np.linalg.norm(surface.vertices[ends[:, 0]] - surface.vertices[ends[:, 1]], axis=1)
    count = len(surface.vertices)
    sums = np.bincount(ends.ravel(), np.repeat(length, 2), count)
    return np.asarray(sums / np.maximum(np.bincount(ends.ravel(), minlength=count), 1))


def _with_a_ring(skin: Surface, vertices: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which triangles (f,) have a corner among ``vertices`` (n,), or lie beside one."""
    wider = vertices.copy()
    wider[skin.faces[vertices[skin.faces].any(axis=1)]] = True
    return np.asarray(wider[skin.faces].any(axis=1))


@dataclass(frozen=True, eq=False)
class Compared:
    """A scan and a skin at c texels."""

    fine: Texels  # on the subdivided skin
    axes: Floats  # (c, 3, 3) rows: tangent, second axis and normal of the mesh as it is drawn
    heights: Floats  # (c,) mm of the scan over the subdivided skin
    offset: Floats  # (c, 3) its unit normals less those of the mesh
    confidence: Floats  # (c,)
    faces: Ints  # (c,) of the scan
    shares: Floats  # (c, 3) of their corners

    def of_scan(self, scan: Surface, values: Floats) -> Floats:
        """Return the values (c,) of the scan's vertices (n,) at the texels."""
        return np.asarray(np.einsum("nc,nc->n", self.shares, values[scan.faces[self.faces]]))


def _compare(
    texels: Texels,
    own: Ints,
    placed: PlacedScan,
    coordinates: TextureCoordinates,
    options: DetailOptions,
) -> Compared:
    """Compare a placed scan with the skin at some texels, ``own`` (c,)."""
    skin = texels.skin
    divided = Subdivided.of(skin, options.levels)
    place = divided.locate(texels.faces[own], texels.shares[own])
    at = texels.size, texels.rows[own], texels.columns[own]
    fine = Texels(*at, *place, divided.surface)
    smooth = vertex_normals(divided.surface)
    parts = [
        _look_along(fine, smooth, chosen, placed, options.steps)
        for chosen in np.array_split(np.arange(len(own)), len(own) // options.chunk + 1)
    ]
    heights, normals, confidence, faces, shares = map(np.concatenate, zip(*parts, strict=True))
    axes = mesh_axes(texels, own, coordinates)
    return Compared(fine, axes, heights, normals - axes[:, 2], confidence, faces, shares)


def _look_along(
    fine: Texels, smooth: Floats, chosen: Ints, placed: PlacedScan, steps: int
) -> tuple[Floats, Floats, Floats, Ints, Floats]:
    """Return where the skin's normals at ``chosen`` texels meet the scan.

    That is the height, the scan's unit normal there, confidence, triangle and shares. A normal
    meets the plane at the closest place, and then those at the places closest to where it did.
    """
    start = fine.at(fine.skin.vertices, chosen)
    up = unit_rows(fine.at(smooth, chosen))
    shown = placed.look_up(start, up)
    confidence = shown.confidence
    heights = _meeting(start, up, shown)
    for _ in range(steps):
        shown = placed.look_up(start + heights[:, None] * up, up)
        heights = _meeting(start, up, shown)
    return heights, unit_rows(shown.normals), confidence, shown.faces, shown.shares


def _meeting(start: Floats, up: Floats, shown: Shown) -> Floats:
    """Return how far (n,) along unit vectors ``up`` the planes at the places shown are."""
    facing = unit_rows(shown.normals)
    cosine = np.maximum(np.einsum("nd,nd->n", facing, up), LEAST_COSINE)
    return np.asarray(np.einsum("nd,nd->n", shown.places - start, facing) / cosine)


def mesh_axes(texels: Texels, own: Ints, coordinates: TextureCoordinates) -> Floats:
    """Return the axes (c, 3, 3) that a viewer has at texels, by vertices' normals and tangents."""
    skin = texels.skin
    mapped = coordinates.mapped
    cut = coordinates.split(skin, mapped)
    normals = vertex_normals(skin)[cut.vertices]
    tangents = vertex_tangents(skin.vertices[cut.vertices], normals, cut.places, cut.faces)
    corners = cut.faces[np.searchsorted(mapped, texels.faces[own])]
    return frames(texels.blend(tangents[corners], own), texels.blend(normals[corners], own))


def _kept(
    compared: Compared, known: Floats, quiet: QuietScan, options: DetailOptions
) -> tuple[Floats, Floats, Floats]:
    """Return heights (c,), normals (c, 3) by the mesh's axes, and how far (c,) they are known.

    ``known`` (c,) is how far what was found is to be believed, whatever it is.
    """
    smooth = SmoothFields(compared.fine, compared.confidence, options.width / (2.0 * np.pi))
    heights = compared.heights - smooth(compared.heights[:, None])[:, 0]
    for _ in range(options.rounds):
        smooth.weigh(1.0 / (1.0 + (heights / options.sharp) ** 2))
        heights = compared.heights - smooth(compared.heights[:, None])[:, 0]
    offset = compared.offset - smooth(compared.offset)
    known = known * np.clip(2.0 - np.abs(heights) / options.most, 0.0, 1.0)

    def above(squares: Floats, noise: Floats) -> Floats:
        """Return the share (c,) of values with these squares that rises above a variance (n,)."""
        variance = np.maximum(smooth(squares[:, None])[:, 0], 1e-30)
        return 1.0 - np.minimum(compared.of_scan(quiet.surface, noise) / variance, 1.0)

    risen = known * above(heights**2, quiet.height_noise)
    turned = known * above(np.einsum("nd,nd->n", offset, offset), quiet.turn_noise)
    directions = unit_rows(compared.axes[:, 2] + turned[:, None] * offset)
    normals = np.einsum("nij,nj->ni", compared.axes, directions)
    up = np.maximum(normals[:, 2:], options.steepest)
    across = unit_rows(normals[:, :2]) * np.sqrt(np.maximum(1.0 - up**2, 0.0))
    is_steep = normals[:, 2:] < options.steepest
    normals = np.where(is_steep, np.column_stack([across, up]), normals)
    return np.clip(risen * heights, -options.most, options.most), normals, known


def _p95(values: Floats) -> float:
    return float(np.percentile(np.abs(values), 95)) if len(values) else 0.0
