"""Images that lie on a template's skin, and for which texture coordinates they were made."""

from __future__ import annotations

from pathlib import Path

from PIL import Image, PngImagePlugin

from solver.anatomy.texture_coordinates import TextureCoordinates
from solver.errors import InputError, file_error, quote
from solver.meshio.texture_images import MOST_SIDE, UNREADABLE

MADE_FOR = "Texture coordinates"  # key of a PNG's text: the hash of those it was made for


def made_for(coordinates: TextureCoordinates) -> PngImagePlugin.PngInfo:
    """Return what a PNG says of the coordinates that it was made for."""
    about = PngImagePlugin.PngInfo()
    about.add_text(MADE_FOR, coordinates.sha256)
    return about


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
