"""Images that lie on a template's skin, and for which texture coordinates they were made."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, PngImagePlugin

from solver.anatomy.texture_coordinates import NOWHERE, TextureCoordinates
from solver.errors import InputError, file_error, quote
from solver.meshio.colours import ScanColours
from solver.meshio.paint import BARE, Paint
from solver.meshio.texture_images import MOST_SIDE, UNREADABLE, Texels
from solver.surface import Surface

# Keys of a PNG's text.
MADE_FOR = "Texture coordinates"  # the hash of those it was made for
FIGURES = "Texture figures"  # what the registration says of it, and the hash of its colours


def wear(skin: Surface, coordinates: TextureCoordinates, image: Texels) -> ScanColours:
    """Return a ``skin`` with the colours of an image by its texture coordinates."""
    corners = coordinates.corners
    mapped = np.asarray((corners != NOWHERE).all(axis=1))
    places = coordinates.pixels(1)[np.maximum(corners, 0)]
    return ScanColours(
        skin.vertices, skin.faces, Paint((image,), np.where(mapped, 0, BARE), places)
    )


def made_for(coordinates: TextureCoordinates) -> PngImagePlugin.PngInfo:
    """Return what a PNG says of the coordinates that it was made for."""
    about = PngImagePlugin.PngInfo()
    about.add_text(MADE_FOR, coordinates.sha256)
    return about


def add_figures(
    about: PngImagePlugin.PngInfo, figures: Mapping[str, Any], colours: NDArray[np.uint8]
) -> None:
    """Let a PNG of ``colours`` (h, w, 3) say how good it is."""
    told = {"sha256": _sha256(colours), "figures": dict(figures)}
    about.add_text(FIGURES, json.dumps(told))


def read_figures(content: bytes, colours: NDArray[np.uint8]) -> dict[str, float]:
    """Return what a PNG that can be read says of its ``colours`` (h, w, 3).

    Nothing is returned of one that says none, or was painted over since.
    """
    with Image.open(io.BytesIO(content), formats=("PNG",)) as image:
        text = str(image.info.get(FIGURES, ""))
    try:
        told = json.loads(text)
        is_same = told["sha256"] == _sha256(colours)
        return {str(name): float(told["figures"][name]) for name in told["figures"] if is_same}
    except (ValueError, LookupError, TypeError, AttributeError):
        return {}


def _sha256(colours: NDArray[np.uint8]) -> str:
    return hashlib.sha256(np.ascontiguousarray(colours).tobytes()).hexdigest()


def check_made_for(path: Path, coordinates: TextureCoordinates) -> None:
    """Refuse what is no PNG, and one that was made for other coordinates.

    One that was painted over may have lost the word what it was made for, and is taken. Raises
    :class:`InputError`: ``texture.unreadable``, ``texture.template``.
    """
    try:
        with Image.open(path, formats=("PNG",)) as image:
            size = image.size
            found = str(image.info.get(MADE_FOR, coordinates.sha256))
    except UNREADABLE as error:
        reason = f"no PNG that can be read: {quote(error)}"
        raise file_error("texture.unreadable", path.name, reason) from None
    if max(size) > MOST_SIDE:
        reason = f"a side has at most {MOST_SIDE} px, this one {max(size)}"
        raise file_error("texture.unreadable", path.name, reason)
    if found != coordinates.sha256:
        reason = f"{path.name} was made for another template's texture coordinates"
        raise InputError("texture.template", reason, file=path.name)
