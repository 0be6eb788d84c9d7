"""Where the triangles of a template's skin lie in an image of its colours."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from solver.errors import InputError
from solver.storage import Arrays
from solver.surface import Floats, Ints, Surface, adjacency, own_numbers

CHART_GAP = 0.004  # between charts and around them, by the width of all
NOWHERE = -1  # a corner that no image has a place for


@dataclass(frozen=True, eq=False)
class TextureCoordinates:
    """Places of triangles' corners in an image; a vertex at a seam has several.

    Coordinates are 0 to 1 from the image's left edge, and from its lower one, as in OBJ and USD.
    """

    places: NDArray[np.float32]  # (k, 2)
    corners: NDArray[np.int32]  # (f, 3) numbers of places of the skin's triangles, or NOWHERE

    @property
    def mapped(self) -> Ints:
        """Return the triangles (m,) that lie in the image."""
        return np.flatnonzero((self.corners != NOWHERE).all(axis=1))

    @property
    def charts(self) -> Ints:
        """Return the chart (f,) that each triangle lies in, which hangs together, or NOWHERE."""
        mapped = self.mapped
        corners = self.corners[mapped].astype(np.int64)
        label = connected_components(adjacency(corners, len(self.places)), directed=False)[1]
        charts = np.full(len(self.corners), NOWHERE, np.int64)
        charts[mapped] = label[corners[:, 0]]
        return charts

    @property
    def sha256(self) -> str:
        """Return the hash of all coordinates, by which an image knows what it was made for."""
        digest = hashlib.sha256(np.ascontiguousarray(self.places, "<f4").tobytes())
        digest.update(np.ascontiguousarray(self.corners, "<i4").tobytes())
        return digest.hexdigest()

    def pixels(self, size: int) -> Floats:
        """Return column and row (k, 2) of the places in a square image of ``size`` px."""
        places = self.places.astype(np.float64)
        return np.column_stack([places[:, 0], 1.0 - places[:, 1]]) * size

    def split(self, skin: Surface, faces: Ints) -> SplitFaces:
        """Return some ``faces`` (f,) of the skin with its vertices split where the image is cut."""
        most = len(self.places) + 1
        corners = skin.faces[faces] * most + self.corners[faces] - NOWHERE
        used, own = own_numbers(corners)
        vertices, place = np.divmod(used, most)
        somewhere = np.vstack([np.zeros(2), self.places])  # a corner without a place has the first
        return SplitFaces(vertices, own, somewhere[place])

    def arrays(self) -> Arrays:
        """Return the coordinates as named arrays, for a file."""
        return {"places": self.places, "corners": self.corners}

    @classmethod
    def from_arrays(cls, arrays: Arrays) -> TextureCoordinates:
        """Return the coordinates that :meth:`arrays` described."""
        return cls(arrays["places"].astype(np.float32), arrays["corners"].astype(np.int32))

    @classmethod
    def packed(cls, places: Floats, corners: Ints) -> TextureCoordinates:
        """Return charts of any places (k, 2) that do not overlap, laid out to fill the image.

        A chart is what hangs together. The largest lies across the image, turned a quarter if it is
        higher than wide, the others in rows over it, at the same scale.
        """
        faces = corners[(corners != NOWHERE).all(axis=1)].astype(np.int64)
        count, label = connected_components(adjacency(faces, len(places)), directed=False)
        charts = [np.flatnonzero(label == number) for number in range(count)]
        sizes = [np.ptp(places[chart], axis=0) for chart in charts]
        laid = places.astype(np.float64)
        order = sorted(range(count), key=lambda number: -float(sizes[number].prod()))
        width = float(sizes[order[0]].max())
        gap = CHART_GAP * width
        column = row = height = 0.0
        for number in order:
            chart = charts[number]
            own = laid[chart] - laid[chart].min(axis=0)
            if number == order[0] and sizes[number][1] > sizes[number][0]:
                own = np.column_stack([own[:, 1], sizes[number][0] - own[:, 0]])
            across, up = np.ptp(own, axis=0)
            if column + across > width * (1.0 + 1e-9):
                row += height + gap
                column = height = 0.0
            laid[chart] = own + np.array([column, row])
            column += across + gap
            height = max(height, float(up))
        extent = np.array([width, row + height])
        inner = 1.0 - 2.0 * CHART_GAP
        return cls((CHART_GAP + inner * laid / extent).astype(np.float32), corners.astype(np.int32))


@dataclass(frozen=True, eq=False)
class SplitFaces:
    """Triangles whose vertices have one place each in an image."""

    vertices: Ints  # (k,) of the skin; one at a seam is there once for each of its places
    faces: Ints  # (f, 3) by these
    places: Floats  # (k, 2)


def unwrap(skin: Surface, faces: Ints) -> TextureCoordinates:
    """Return coordinates of some ``faces`` (m,) of a skin that has none, cut into charts.

    Charts are those of xatlas (the extra ``texture``), which gives the same for the same skin.
    Raises :class:`InputError` (``texture.coordinates``) where it is not installed.
    """
    try:
        import xatlas  # an extra
    except ModuleNotFoundError:
        reason = "the template has no texture coordinates; xatlas makes them: pip install"
        reason = f"{reason} 'myoface[texture]'"
        raise InputError("texture.coordinates", reason) from None
    used, own = own_numbers(skin.faces[faces])
    _, corners, places = xatlas.parametrize(
        skin.vertices[used].astype(np.float32), own.astype(np.uint32)
    )
    chosen = np.full(skin.faces.shape, NOWHERE, np.int32)
    chosen[faces] = corners.astype(np.int32)
    return TextureCoordinates(np.asarray(places, np.float32), chosen)
