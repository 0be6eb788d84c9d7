"""What colours the triangles of a scan: colours of vertices, or images by coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from solver.meshio.texture_images import Texels
from solver.surface import Floats, Ints

BARE = -1  # no image lies on a triangle: its vertices' colours count, if there are any


@dataclass(frozen=True, eq=False)
class Paint:
    """Colours of f triangles with n vertices."""

    images: tuple[Texels, ...]
    images_of: Ints  # (f,) number of the image on each triangle, or BARE
    # (f, 3, 2) its corners' places in the image: parts of the width from the left edge, and of the
    # height from the upper one; beyond 0 to 1 the image repeats
    coordinates: Floats
    vertices: Floats | None = None  # (n, 3) colours, sRGB in [0, 1]
    missing: tuple[str, ...] = ()  # tiles that triangles lie on and the file's folder has not

    def flipped(self) -> Paint:
        """Return the same with every image upside down."""
        turned = self.coordinates * np.array([1.0, -1.0]) + np.array([0.0, 1.0])
        return replace(self, coordinates=turned)

    @classmethod
    def of_vertices(cls, colours: Floats | None, faces: int) -> Paint:
        """Return the colours (n, 3) of vertices alone, or none at all."""
        return cls((), np.full(faces, BARE), np.zeros((faces, 3, 2)), colours)


def join_paint(parts: Sequence[Paint], sizes: Sequence[int]) -> Paint | None:
    """Return the paint of meshes that become one, of ``sizes`` vertices; None: there is no colour.

    Where one mesh among others has no colours, those of its vertices are not-a-number.
    """
    images = tuple(image for part in parts for image in part.images)
    starts = np.cumsum([0, *(len(part.images) for part in parts)])
    has_colours = any(part.vertices is not None for part in parts)
    if not images and not has_colours:
        return None
    return Paint(
        images,
        np.concatenate(
            [
                np.where(part.images_of == BARE, BARE, part.images_of + start)
                for part, start in zip(parts, starts, strict=False)
            ]
        ),
        np.concatenate([part.coordinates for part in parts]),
        np.concatenate(
            [
                np.full((size, 3), np.nan) if part.vertices is None else part.vertices
                for part, size in zip(parts, sizes, strict=True)
            ]
        )
        if has_colours
        else None,
    )
