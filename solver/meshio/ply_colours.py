"""Images on a PLY: ``comment TextureFile`` lines, and coordinates of corners or of vertices."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from solver.errors import file_error
from solver.meshio.mesh import fan
from solver.meshio.paint import BARE, Paint
from solver.meshio.ply import Columns, Lists, corner_lists, read_rows
from solver.meshio.texture_images import ImageReader, read_sidecar, sidecar
from solver.surface import Floats, Ints

HEADER = re.compile(rb"^end_header[ \t\r]*$", re.MULTILINE)
IMAGE = re.compile(rb"^comment[ \t]+TextureFile[ \t]+(.+?)[ \t\r]*$", re.MULTILINE)
OF_CORNERS = "texcoord"  # of a face: two numbers a corner
NUMBER = "texnumber"  # of a face: which of the images
OF_VERTICES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"), ("texture_s", "texture_t"))


def paint_of_ply(path: Path, content: bytes) -> Paint | None:
    """Return the images on a PLY that can be read; None: it names none, or no places in them.

    Images are those beside it. Raises :class:`InputError`: ``texture.path``, ``texture.missing`` or
    ``texture.unreadable``.
    """
    end = HEADER.search(content)
    names = [
        name.decode("utf-8", "replace") for name in IMAGE.findall(content[: end and end.start()])
    ]
    if not names:
        return None
    rows = read_rows(path.name, content)
    columns, lists = rows["face"]
    corners, counts = corner_lists(path.name, lists)
    places = _places(path.name, rows["vertex"][0], lists, corners, counts)
    if places is None:
        return None
    triangles = fan(np.arange(len(corners)), counts)
    numbers = np.nan_to_num(columns.get(NUMBER, np.zeros(len(counts))), nan=-1.0).astype(np.int64)
    images_of = np.repeat(numbers, np.maximum(counts - 2, 0))
    is_known = (images_of >= 0) & (images_of < len(names))
    coordinates = places[triangles]
    coordinates[:, :, 1] = 1.0 - coordinates[:, :, 1]  # v goes up from the lower edge
    reader = ImageReader()
    files = [sidecar(path, name, f"a comment of {path.name}") for name in names]
    images = tuple(reader.read(file.name, read_sidecar(file)) for file in files)
    return Paint(images, np.where(is_known, images_of, BARE), coordinates)


def _places(
    file: str, vertex: Columns, lists: dict[str, Lists], corners: Ints, counts: Ints
) -> Floats | None:
    """Return the places (c, 2) of all corners in their images; None: there are none."""
    if OF_CORNERS in lists:
        values, numbers = lists[OF_CORNERS]
        if (numbers != 2 * counts).any():
            reason = f"a face has {OF_CORNERS} for other corners than its own"
            face = int(np.argmax(numbers != 2 * counts))
            raise file_error("texture.unreadable", file, reason, face=face)
        return np.asarray(values, np.float64).reshape(-1, 2)
    for names in OF_VERTICES:
        if set(names) <= vertex.keys():
            return np.column_stack([vertex[name] for name in names])[corners]
    return None
