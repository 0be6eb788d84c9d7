"""A scan's colours on its registered skin: an image by the template's texture coordinates.

Every texel of the image is a place on the skin. It gets the colour of the closest place of the scan
that faces the same way, with a confidence by distance, angle and how near the scan ends there; what
no scan shows is filled by :mod:`.texture_fill`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import igl
import numpy as np
from numpy.typing import NDArray
from PIL import Image, PngImagePlugin
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from solver.anatomy.template import Template
from solver.anatomy.texture_coordinates import TextureCoordinates, unwrap
from solver.drawing.head import skin_parts
from solver.drawing.render import rasterise
from solver.meshio.colours import ScanColours
from solver.meshio.mesh import weld
from solver.registration.texture_fill import Texels, fill
from solver.registration.topology import Topology
from solver.similarity import Similarity
from solver.surface import (
    Floats,
    Ints,
    Surface,
    area_normals,
    directed_edges,
    faces_within,
    vertex_normals,
)

MADE_FOR = "Texture coordinates"  # key of a PNG's text: the hash of those it was made for


@dataclass(frozen=True)
class TextureOptions:
    """Fineness of an image of colours, and what a scan is trusted with; lengths in mm."""

    size: int = 2048  # px of a side
    farthest: float = 8.0  # a place of the scan farther off is none of this skin
    trusted: float = 3.0  # distance at which confidence has fallen to 1/e
    least_cosine: float = 0.3  # of the normals
    surest_cosine: float = 0.8  # from which on the angle costs nothing
    border: float = 3.0  # to the scan's edge, within which confidence fades to nothing
    around: float = 1.5  # px around a chart that are looked up as well
    least_seen: float = 0.05  # confidence from which on a texel counts as seen
    chunk: int = 200_000  # texels that are looked up at a time


TEXTURE = TextureOptions()
STEEP = 4.0  # barycentric shares beyond this are of a triangle too thin to go on from


@dataclass(frozen=True, eq=False)
class Texture:
    """A square image of a skin's colours."""

    colours: NDArray[np.uint8]  # (s, s, 3) sRGB
    confidence: NDArray[np.uint8]  # (s, s), 0 where no scan shows the skin
    coordinates: TextureCoordinates
    figures: dict[str, Any]  # of registration.json

    def write(self, path: Path, confidence: Path) -> None:
        """Write both images as PNG."""
        about = PngImagePlugin.PngInfo()
        about.add_text(MADE_FOR, self.coordinates.sha256)
        about.add(b"sRGB", b"\0")
        Image.fromarray(self.colours).save(path, pnginfo=about)
        Image.fromarray(self.confidence).save(confidence)


def texture_coordinates(template: Template) -> TextureCoordinates:
    """Return a template's own coordinates, or such as can be made of its skin.

    Raises :class:`InputError` (``texture.coordinates``).
    """
    own = template.texture
    return own if own is not None else unwrap(template.skin, skin_parts(template.skin)["skin"])


def bake(
    colours: ScanColours,
    motion: Similarity,
    skin: Surface,
    topology: Topology,
    coordinates: TextureCoordinates,
    options: TextureOptions = TEXTURE,
) -> Texture:
    """Return the colours of a scan on the ``skin`` to which ``motion`` takes its file's points."""
    texels = _texels(skin, coordinates, options)
    _look_up(texels, _PlacedScan(colours, motion, skin, topology.face), topology, options)
    filled, mirrored = fill(texels, topology)
    return _image(texels, filled, mirrored, topology, coordinates, options)


def _texels(skin: Surface, coordinates: TextureCoordinates, options: TextureOptions) -> Texels:
    """Return the texels of all charts as places on the skin, without colours.

    Those around a chart lie in the planes of its outermost triangles, so that an image's values
    between texels are right up to a seam.
    """
    size = options.size
    places = coordinates.pixels(size)
    flat = np.column_stack([places, np.ones(len(places))])
    mapped = coordinates.mapped
    corners = coordinates.corners[mapped].astype(np.int64)
    seen = rasterise(flat, corners, size, size)
    apart, nearest = distance_transform_edt(~seen.mask, return_indices=True)
    rows, columns = np.nonzero(apart <= options.around)
    inner = nearest[0][rows, columns], nearest[1][rows, columns]
    triangle = seen.triangle[inner]
    shares = seen.weights[inner].astype(np.float64)
    around = np.flatnonzero(apart[rows, columns] > 0.0)
    middles = np.column_stack([columns, rows])[around].astype(np.float64) + 0.5
    beyond = _plane_shares(middles, places[corners[triangle[around]]])
    shares[around] = np.where(np.abs(beyond).max(axis=1) < STEEP, beyond.T, shares[around].T).T
    faces = mapped[triangle]
    count = len(rows)
    return Texels(rows, columns, faces, shares, skin, np.zeros((count, 3)), np.zeros(count))


def _plane_shares(points: Floats, triangles: Floats) -> Floats:
    """Return barycentric shares (n, 3) of ``points`` (n, 2) in their ``triangles`` (n, 3, 2)."""
    one = triangles[:, 1] - triangles[:, 0]
    two = triangles[:, 2] - triangles[:, 0]
    own = points - triangles[:, 0]
    with np.errstate(all="ignore"):  # a flat triangle's are not finite
        area = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]
        second = (own[:, 0] * two[:, 1] - own[:, 1] * two[:, 0]) / area
        third = (one[:, 0] * own[:, 1] - one[:, 1] * own[:, 0]) / area
    return np.column_stack([1.0 - second - third, second, third])


def _look_up(
    texels: Texels, scan: _PlacedScan, topology: Topology, options: TextureOptions
) -> None:
    """Write colours and confidence of the texels that the scan shows into ``texels``."""
    skin = texels.skin
    asked = np.flatnonzero(faces_within(skin.faces, topology.outer)[texels.faces])
    normals = vertex_normals(skin)
    for start in range(0, len(asked), options.chunk):
        own = asked[start : start + options.chunk]
        found = scan.look_up(texels.at(skin.vertices, own), texels.at(normals, own), options)
        texels.colours[own], texels.confidence[own] = found


class _PlacedScan:
    """A scan with colours, laid on a skin by a ``motion``; the ``face`` (k,) tells its outside."""

    def __init__(self, colours: ScanColours, motion: Similarity, skin: Surface, face: Ints) -> None:
        vertices = motion(colours.vertices)
        finite = np.asarray(np.isfinite(vertices).all(axis=1))
        doubled = np.linalg.norm(area_normals(np.nan_to_num(vertices), colours.faces), axis=1)
        whole = np.asarray(finite[colours.faces].all(axis=1))
        self._numbers = np.flatnonzero(whole & (doubled > 0.0))
        self._colours = colours
        self._vertices = np.ascontiguousarray(np.where(finite[:, None], vertices, 0.0))
        self._faces = np.ascontiguousarray(colours.faces[self._numbers])
        self._tree = igl.AABB()
        self._tree.init(self._vertices, self._faces)
        first, place = weld(self._vertices)  # vertices that are there twice for their colours' sake
        joined = place[self._faces]
        smooth = vertex_normals(Surface(self._vertices[first], joined))
        self._normals = smooth[place]
        edges = np.sort(directed_edges(joined), axis=1)
        kinds, counts = np.unique(edges, axis=0, return_counts=True)
        rim = np.unique(kinds[counts == 1])
        self._rim = cKDTree(self._vertices[first][rim]) if len(rim) else None
        _, near, shares, _ = self._closest(skin.vertices[face])
        cosines = np.einsum("nd,nd->n", self._normal(near, shares), vertex_normals(skin)[face])
        if cosines.sum() < 0.0:  # it is wound inward
            self._normals = -self._normals

    def _closest(self, points: Floats) -> tuple[Floats, Ints, Floats, Floats]:
        """Return distance, triangle, barycentric shares and place of the closest places."""
        squared, face, near = self._tree.squared_distance(self._vertices, self._faces, points)
        corners = self._vertices[self._faces[face]].swapaxes(0, 1)
        shares = igl.barycentric_coordinates(near, *map(np.ascontiguousarray, corners))
        shares = np.clip(np.nan_to_num(shares), 0.0, 1.0)
        return np.sqrt(squared), face, shares, near

    def _normal(self, face: Ints, shares: Floats) -> Floats:
        return np.asarray(np.einsum("nc,ncd->nd", shares, self._normals[self._faces[face]]))

    def look_up(
        self, points: Floats, normals: Floats, options: TextureOptions
    ) -> tuple[Floats, Floats]:
        """Return colours (n, 3) and confidence (n,) at ``points`` (n, 3) of the skin, in mm."""
        distance, face, shares, near = self._closest(points)
        found, known = self._colours.at(self._numbers[face], shares)
        cosine = np.einsum("nd,nd->n", self._normal(face, shares), normals)
        span = options.surest_cosine - options.least_cosine
        confidence = np.exp(-((distance / options.trusted) ** 2))
        confidence *= np.clip((cosine - options.least_cosine) / span, 0.0, 1.0)
        if self._rim is not None:
            confidence *= np.clip(self._rim.query(near)[0] / options.border, 0.0, 1.0)
        confidence[~known | (distance > options.farthest)] = 0.0
        return found, confidence


def _image(
    texels: Texels,
    filled: Floats,
    mirrored: NDArray[np.bool_],
    topology: Topology,
    coordinates: TextureCoordinates,
    options: TextureOptions,
) -> Texture:
    """Return the image; beyond the charts it goes on with the colour of the nearest texel."""
    size = options.size
    colours = np.zeros((size, size, 3), np.uint8)
    confidence = np.zeros((size, size), np.uint8)
    inside = np.zeros((size, size), bool)
    place = texels.rows, texels.columns
    colours[place] = np.round(255.0 * np.clip(filled, 0.0, 1.0))
    confidence[place] = np.round(255.0 * texels.confidence)
    inside[place] = True
    row, column = distance_transform_edt(~inside, return_distances=False, return_indices=True)
    figures = _figures(texels, mirrored, topology, options)
    return Texture(colours[row, column], confidence, coordinates, figures)


def _figures(
    texels: Texels, mirrored: NDArray[np.bool_], topology: Topology, options: TextureOptions
) -> dict[str, Any]:
    """Return shares of the face's area: seen, and filled from the other side."""
    skin = texels.skin
    own = np.flatnonzero(faces_within(skin.faces, topology.face)[texels.faces])
    faces = texels.faces[own]
    area = np.linalg.norm(area_normals(skin.vertices, skin.faces), axis=1)
    weight = area[faces] / np.bincount(faces, minlength=len(skin.faces))[faces]
    total = weight.sum()
    seen = texels.confidence[own] >= options.least_seen
    return {
        "size": options.size,
        "coverage": round(float(weight[seen].sum() / total), 4),
        "mirrored": round(float(weight[mirrored[own] & ~seen].sum() / total), 4),
        "mean_confidence": round(float((weight * texels.confidence[own]).sum() / total), 4),
    }
