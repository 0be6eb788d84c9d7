"""Wrinkles of expressions beside a light rig, and which of its weights bring them.

An expression e is made of shapes with weights c, that of the template that it is called after, or
the c in [0, 1] that come closest to the skin of the rig's expression of that name. At weights w of
the shapes its wrinkles have the strength min(max(w . c, 0) / c . c, 1).
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import lsq_linear

from solver.anatomy.texture_coordinates import TextureCoordinates
from solver.errors import InputError, quote
from solver.rig import Rig
from solver.rig.studio.shapes import StudioShapes
from solver.rig.studio.skin_texture import read_skin_image
from solver.surface import Floats, Ints

LEAST = 0.1  # weight of a shape that an expression is told to be made of
RIDGE_MM = 0.05  # root mean square over the face that a weight of 1 costs


@dataclass(frozen=True, eq=False)
class WrinkleMap:
    """A normal map, with its mask for opacity, and the weights that bring it."""

    name: str  # of the expression
    file: str
    content: bytes  # of the PNG
    driven_by: dict[str, float]  # c by shapes

    def told(self) -> dict[str, Any]:
        """Return what studio.json says of it."""
        return {"file": self.file, "driven_by": self.driven_by}


def read_wrinkle_images(
    files: Mapping[str, Path], rig: Rig, shapes: Collection[str], coordinates: TextureCoordinates
) -> dict[str, bytes]:
    """Return the images of ``files`` by the names of their expressions; ``shapes`` are names, too.

    Raises :class:`InputError`: ``wrinkles.unknown`` for a name that is no shape's and no
    expression's of the rig, ``texture.unreadable``, ``texture.template``.
    """
    known = sorted(each.name for each in rig.shown)
    found = {}
    for name, path in files.items():
        if name not in shapes and name not in known:
            reason = (
                f"{path.name}: no shape and no expression of the rig is called {quote(name)}; its "
                f"expressions are {', '.join(known) or 'none'}"
            )
            raise InputError("wrinkles.unknown", reason, file=path.name, expected=known)
        found[name] = read_skin_image(path, coordinates, len(rig.model.skin.faces))
    return found


def drive_wrinkles(
    images: Mapping[str, bytes], rig: Rig, shapes: StudioShapes
) -> Iterator[WrinkleMap]:
    """Yield wrinkle maps by their ``images``, of names that :func:`read_wrinkle_images` knows."""
    skins = {each.name: each.skin for each in rig.shown}
    for number, (name, content) in enumerate(images.items(), start=1):
        if name in shapes.names:
            driven_by = {name: 1.0}
        else:
            driven_by = _made_of(skins[name] - rig.model.skin.vertices, rig.model.face, shapes)
        yield WrinkleMap(name, f"studio_wrinkles_{number}.png", content, driven_by)


def _made_of(motion: Floats, face: Ints, shapes: StudioShapes) -> dict[str, float]:
    """Return the weights of shapes that come closest to a ``motion`` (V, 3) of the ``face``."""
    columns = shapes.motions[:, face].reshape(len(shapes.names), -1).T
    ridge = RIDGE_MM * np.sqrt(len(face)) * np.eye(len(shapes.names))
    wanted = np.concatenate([motion[face].ravel(), np.zeros(len(shapes.names))])
    found = lsq_linear(np.vstack([columns, ridge]), wanted, bounds=(0.0, 1.0)).x
    return {
        name: round(float(weight), 3)
        for name, weight in zip(shapes.names, found, strict=True)
        if weight >= LEAST
    }
