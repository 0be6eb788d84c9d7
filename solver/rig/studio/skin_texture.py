"""The images of a person's skin that a light rig wears: colours, and normals of its detail."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from solver.anatomy.texture_coordinates import TextureCoordinates
from solver.errors import InputError
from solver.meshio.colours import ScanColours
from solver.meshio.texture_images import ImageReader, Texels, read_sidecar
from solver.registration.skin_images import check_made_for, read_figures, wear
from solver.surface import Surface

COLOURS = "studio_skin.png"  # beside a USD file, which names it
NORMALS = "studio_normals.png"


@dataclass(frozen=True, eq=False)
class SkinTexture:
    """PNGs and where the skin's triangles lie in them; either may be missing."""

    coordinates: TextureCoordinates
    colours: bytes | None = None
    normals: bytes | None = None  # by tangents, as solver.registration.normal_maps has them

    @classmethod
    def read(
        cls,
        coordinates: TextureCoordinates,
        faces: int,
        colours: Path | None = None,
        normals: Path | None = None,
    ) -> SkinTexture:
        """Return the images of a registration for a skin of so many ``faces``.

        Raises :class:`InputError`: ``texture.unreadable``, ``texture.template`` for an image that
        was made for other coordinates.
        """

        def content(path: Path | None) -> bytes | None:
            return None if path is None else read_skin_image(path, coordinates, faces)

        return cls(coordinates, content(colours), content(normals))

    @cached_property
    def texels(self) -> Texels | None:
        """The colours' texels; None: there are none. Raises ``texture.unreadable``."""
        return None if self.colours is None else ImageReader().read("texture.png", self.colours)

    @property
    def figures(self) -> dict[str, float]:
        """What the registration said of the colours: nothing of such as are not its own."""
        if self.colours is None or self.texels is None:
            return {}
        return read_figures(self.colours, self.texels[:, :, :3])

    def on(self, skin: Surface) -> ScanColours | None:
        """Return a ``skin`` with its colours; None: it has none."""
        return None if self.texels is None else wear(skin, self.coordinates, self.texels)

    @property
    def files(self) -> dict[str, bytes]:
        """The images by the names that files beside them call them by."""
        found = {COLOURS: self.colours, NORMALS: self.normals}
        return {name: content for name, content in found.items() if content is not None}


def read_skin_image(path: Path, coordinates: TextureCoordinates, faces: int) -> bytes:
    """Return a PNG that was made for the ``coordinates`` of a skin of so many ``faces``.

    Raises :class:`InputError`: ``texture.unreadable``, ``texture.template``.
    """
    content = read_sidecar(path)
    check_made_for(path, coordinates)
    if len(coordinates.corners) != faces:
        reason = f"{path.name} was made for another template's texture coordinates"
        raise InputError("texture.template", reason, file=path.name)
    return content
