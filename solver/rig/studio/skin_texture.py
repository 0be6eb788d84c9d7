"""The image of a person's skin that a light rig wears."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from solver.anatomy.texture_coordinates import TextureCoordinates
from solver.errors import InputError
from solver.meshio.texture_images import read_sidecar
from solver.registration.skin_images import check_made_for


@dataclass(frozen=True, eq=False)
class SkinTexture:
    """A PNG and where the skin's triangles lie in it."""

    content: bytes  # of the PNG
    coordinates: TextureCoordinates

    @classmethod
    def read(cls, path: Path, coordinates: TextureCoordinates, faces: int) -> SkinTexture:
        """Return the image of a registration for a skin of so many ``faces``.

        Raises :class:`InputError`: ``texture.unreadable``, ``texture.template`` for an image that
        was made for other coordinates.
        """
        content = read_sidecar(path)
        check_made_for(path, coordinates)
        if len(coordinates.corners) != faces:
            reason = f"{path.name} was made for another template's texture coordinates"
            raise InputError("texture.template", reason, file=path.name)
        return cls(content, coordinates)
