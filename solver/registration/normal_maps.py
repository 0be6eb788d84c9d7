"""Normal maps as glTF has them: (n + 1) / 2 in 8 bits, by tangent (red), second axis and normal.

The slopes (p, q) of a normal n = (-p, -q, 1) / |(-p, -q, 1)| add up, normals do not.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from solver.anatomy.texture_coordinates import TextureCoordinates
from solver.meshio.colours import bilinear
from solver.meshio.texture_images import ImageReader, read_sidecar
from solver.registration.skin_images import check_made_for, made_for
from solver.registration.texels import Texels, to_bytes
from solver.surface import Floats, unit_rows

LEAST_UP = 0.1  # part of a normal along the mesh's, where its slopes are read


def write_normals(
    path: Path, texels: Texels, normals: Floats, coordinates: TextureCoordinates
) -> None:
    """Write unit ``normals`` (t, 3) at texels as PNG."""
    image = texels.spread(to_bytes(0.5 * (normals + 1.0)))
    Image.fromarray(image).save(path, pnginfo=made_for(coordinates))


def read_normals(path: Path, texels: Texels, coordinates: TextureCoordinates) -> Floats:
    """Return unit normals (t, 3) of a map of any size at texels.

    Raises :class:`solver.errors.InputError`: ``texture.unreadable``, ``texture.template``.
    """
    check_made_for(path, coordinates)
    image = ImageReader().read(path.name, read_sidecar(path))
    places = np.column_stack([texels.columns, texels.rows]) + 0.5
    return unit_rows(2.0 * bilinear(image, places / texels.size)[:, :3] - 1.0)


def slopes(normals: Floats) -> Floats:
    """Return the slopes (n, 2) of unit normals (n, 3)."""
    return np.asarray(-normals[:, :2] / np.maximum(normals[:, 2:], LEAST_UP))


def by_slopes(slopes: Floats) -> Floats:
    """Return the unit normals (n, 3) of slopes (n, 2)."""
    return unit_rows(np.column_stack([-slopes, np.ones(len(slopes))]))
