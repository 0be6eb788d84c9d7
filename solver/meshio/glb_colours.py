"""Colours of a GLB: ``baseColorTexture`` by ``TEXCOORD_n``, or ``COLOR_0`` of vertices."""

from __future__ import annotations

import base64
import binascii
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from solver.errors import file_error, quote
from solver.meshio.glb import NOT_VALID, GlbSource, read_chunks
from solver.meshio.mesh import Mesh
from solver.meshio.paint import Paint, join_paint
from solver.meshio.texture_images import ImageReader, Texels, read_sidecar, sidecar
from solver.surface import Floats

TRANSFORM = "KHR_texture_transform"
DATA = re.compile(r"data:image/[a-z+.-]+;base64,", re.IGNORECASE)
WHITE = (1.0, 1.0, 1.0, 1.0)  # the factor that leaves a colour and its opacity as they are


def to_srgb(linear: Floats) -> Floats:
    """Return sRGB values in [0, 1] of linear ones (IEC 61966-2-1)."""
    bounded = np.clip(linear, 0.0, 1.0)
    high = 1.055 * bounded ** (1 / 2.4) - 0.055
    return np.where(bounded <= 0.0031308, 12.92 * bounded, high)


def to_linear(srgb: Floats) -> Floats:
    """Return linear values of sRGB ones in [0, 1] (IEC 61966-2-1)."""
    bounded = np.clip(srgb, 0.0, 1.0)
    return np.where(bounded <= 0.04045, bounded / 12.92, ((bounded + 0.055) / 1.055) ** 2.4)


def paint_of_glb(path: Path, content: bytes) -> Paint | None:
    """Return the colours of what a GLB that can be read shows; None: it has none.

    Images are in the file or beside it. Raises :class:`InputError`: ``texture.unreadable``,
    ``texture.path`` or ``texture.missing``.
    """
    reader = _Materials(path, read_chunks(path.name, content))
    try:
        shown = list(reader.source.shown_parts())
        parts = [reader.paint(primitive, mesh) for primitive, mesh in shown]
    except NOT_VALID as error:
        reason = f"its materials are not valid ({quote(repr(error))})"
        raise file_error("texture.unreadable", path.name, reason) from None
    return join_paint(parts, [len(mesh.vertices) for _, mesh in shown])


@dataclass
class _Materials:
    """Materials of a file; each image is read once for every factor that it is multiplied with."""

    path: Path
    source: GlbSource
    reader: ImageReader = field(default_factory=ImageReader)
    images: dict[tuple[Any, ...], Texels] = field(default_factory=dict)

    def paint(self, primitive: dict[str, Any], mesh: Mesh) -> Paint:
        """Return the colours of a primitive with its ``mesh`` as it is placed."""
        colours = None if mesh.colours is None else to_srgb(mesh.colours)
        bare = Paint.of_vertices(colours, len(mesh.faces))
        if "material" not in primitive:
            return bare
        material = self.source.item("materials", primitive["material"])
        surface = material.get("pbrMetallicRoughness", {})
        if "baseColorTexture" not in surface:
            return bare
        used = surface["baseColorTexture"]
        moved = used.get("extensions", {}).get(TRANSFORM, {})
        number = moved.get("texCoord", used.get("texCoord", 0))
        attribute = f"TEXCOORD_{number}"
        if attribute not in primitive["attributes"]:
            return bare
        places = self.source.unit_rows(primitive["attributes"][attribute])
        if places.shape != (len(mesh.vertices), 2):
            reason = f"{attribute} does not fit its positions"
            raise file_error("texture.unreadable", self.path.name, reason)
        image = self._image(used["index"], tuple(surface.get("baseColorFactor", WHITE)))
        coordinates = _transform(places, moved)[mesh.faces]
        return Paint((image,), np.zeros(len(mesh.faces), np.int64), coordinates, colours)

    def _image(self, texture: int, factor: tuple[float, ...]) -> Texels:
        used = self.source.item("textures", texture)
        if "source" not in used:
            reason = f"texture {texture} has no image in one of glTF's own formats"
            raise file_error("texture.unreadable", self.path.name, reason)
        number = used["source"]
        key = (number, *factor)
        if key not in self.images:
            found = self.reader.read(*self._content(number))
            if factor != WHITE:
                values = to_linear(np.arange(256) / 255.0)[:, None] * np.array(factor[:3])
                table = np.round(255.0 * to_srgb(values)).astype(np.uint8)
                for channel in range(3):
                    found[:, :, channel] = table[found[:, :, channel], channel]
            self.images[key] = found
        return self.images[key]

    def _content(self, number: int) -> tuple[str, bytes]:
        """Return an image's name in messages and its bytes."""
        image = self.source.item("images", number)
        name = f"{self.path.name}, image {number}"
        if "bufferView" in image:
            return name, self.source.view(image["bufferView"])
        uri = image["uri"]
        if found := DATA.match(uri):
            try:
                return name, base64.b64decode(uri[found.end() :], validate=True)
            except binascii.Error:
                raise file_error("texture.unreadable", name, "its data are not base64") from None
        path = sidecar(self.path, unquote(uri), self.path.name)
        return path.name, read_sidecar(path)


def _transform(places: Floats, moved: dict[str, Any]) -> Floats:
    """Return texture coordinates (n, 2) as ``KHR_texture_transform`` moves them."""
    scale = np.array(moved.get("scale", (1.0, 1.0)), np.float64)
    offset = np.array(moved.get("offset", (0.0, 0.0)), np.float64)
    turn = float(moved.get("rotation", 0.0))
    cosine = np.cos(turn)
    sine = np.sin(turn)
    rotation = np.array([[cosine, sine], [-sine, cosine]])
    return np.asarray((places * scale) @ rotation.T + offset)
