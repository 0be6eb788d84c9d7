"""The image of a person's skin that a light rig wears."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from PIL import Image

from solver.anatomy.texture_coordinates import TextureCoordinates
from solver.errors import InputError, file_error, quote
from solver.meshio.texture_images import MOST_SIDE, UNREADABLE, read_sidecar
from solver.registration.texture import MADE_FOR


@dataclass(frozen=True, eq=False)
class SkinTexture:
    """A PNG and where the skin's triangles lie in it."""

    content: bytes  # of the PNG
    coordinates: TextureCoordinates

    @classmethod
    def read(cls, path: Path, coordinates: TextureCoordinates, faces: int) -> SkinTexture:
        """Return the image of a registration for a skin of so many ``faces``.

        One that was painted over may have lost the word what it was made for, and is taken as it
        is. Raises :class:`InputError`: ``texture.unreadable``, ``texture.template`` for an image
        that was made for other coordinates.
        """
        content = read_sidecar(path)
        try:
            with Image.open(path, formats=("PNG",)) as image:
                size = image.size
                made_for = str(image.info.get(MADE_FOR, coordinates.sha256))
        except UNREADABLE as error:
            reason = f"no PNG that can be read: {quote(error)}"
            raise file_error("texture.unreadable", path.name, reason) from None
        if max(size) > MOST_SIDE:
            reason = f"a side has at most {MOST_SIDE} px, this one {max(size)}"
            raise file_error("texture.unreadable", path.name, reason)
        if made_for != coordinates.sha256 or len(coordinates.corners) != faces:
            reason = f"{path.name} was made for another template's texture coordinates"
            raise InputError("texture.template", reason, file=path.name)
        return cls(content, coordinates)
