"""A scan's colours on its registered skin: an image by the template's texture coordinates.

Every texel of the image is a place on the skin. It gets the colour of the closest place of the scan
that faces the same way, with a confidence by distance, angle and how near the scan ends there; what
no scan shows is filled by :mod:`.texture_fill`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from solver.anatomy.template import Template
from solver.anatomy.texture_coordinates import TextureCoordinates, unwrap
from solver.drawing.head import skin_parts
from solver.meshio.colours import ScanColours
from solver.registration.placed_scan import TRUST, PlacedScan, ScanTrust
from solver.registration.skin_images import add_figures, made_for
from solver.registration.texels import Texels, to_bytes
from solver.registration.texture_fill import ColouredTexels, fill
from solver.registration.topology import Topology
from solver.similarity import Similarity
from solver.surface import Floats, Surface, vertex_normals


@dataclass(frozen=True)
class TextureOptions:
    """Fineness of an image of colours, and what a scan is trusted with."""

    size: int = 2048  # px of a side
    trust: ScanTrust = TRUST
    least_seen: float = 0.05  # confidence from which on a texel counts as seen
    chunk: int = 200_000  # texels that are looked up at a time


TEXTURE = TextureOptions()


@dataclass(frozen=True, eq=False)
class Texture:
    """A square image of a skin's colours."""

    colours: NDArray[np.uint8]  # (s, s, 3) sRGB
    confidence: NDArray[np.uint8]  # (s, s), 0 where no scan shows the skin
    coordinates: TextureCoordinates
    figures: dict[str, Any]  # of registration.json

    def write(self, path: Path, confidence: Path) -> None:
        """Write both images as PNG."""
        about = made_for(self.coordinates)
        about.add(b"sRGB", b"\0")
        add_figures(about, self.figures, self.colours)
        Image.fromarray(self.colours).save(path, pnginfo=about)
        Image.fromarray(self.confidence).save(confidence)


def texture_coordinates(template: Template) -> TextureCoordinates:
    """Return a template's own coordinates, or such as can be made of its skin.

    Raises :class:`InputError` (``texture.coordinates``).
    """
    own = template.texture
    return own if own is not None else unwrap(template.skin, skin_parts(template.skin)["skin"])


def bake(
    colours: ScanColours,
    motion: Similarity,
    skin: Surface,
    topology: Topology,
    coordinates: TextureCoordinates,
    options: TextureOptions = TEXTURE,
) -> Texture:
    """Return the colours of a scan on the ``skin`` to which ``motion`` takes its file's points."""
    texels = ColouredTexels.bare(Texels.of(skin, coordinates, options.size))
    placed = Surface(motion(colours.vertices), colours.faces)
    scan = PlacedScan(placed, skin, topology.face, options.trust)
    _look_up(texels, colours, scan, topology, options)
    filled, mirrored = fill(texels, topology)
    return _image(texels, filled, mirrored, topology, coordinates, options)


def _look_up(
    texels: ColouredTexels,
    colours: ScanColours,
    scan: PlacedScan,
    topology: Topology,
    options: TextureOptions,
) -> None:
    """Write colours and confidence of the texels that the scan shows into ``texels``."""
    skin = texels.skin
    asked = texels.within(topology.outer)
    normals = vertex_normals(skin)
    for start in range(0, len(asked), options.chunk):
        own = asked[start : start + options.chunk]
        found = scan.look_up(texels.at(skin.vertices, own), texels.at(normals, own))
        texels.colours[own], known = colours.at(found.faces, found.shares)
        texels.confidence[own] = np.where(known, found.confidence, 0.0)


def _image(
    texels: ColouredTexels,
    filled: Floats,
    mirrored: NDArray[np.bool_],
    topology: Topology,
    coordinates: TextureCoordinates,
    options: TextureOptions,
) -> Texture:
    """Return the image; beyond the charts it goes on with the colour of the nearest texel."""
    colours = texels.spread(to_bytes(filled))
    confidence = texels.image(to_bytes(texels.confidence))
    figures = _figures(texels, mirrored, topology, options)
    return Texture(colours, confidence, coordinates, figures)


def _figures(
    texels: ColouredTexels, mirrored: NDArray[np.bool_], topology: Topology, options: TextureOptions
) -> dict[str, Any]:
    """Return shares of the face's area: seen, and filled from the other side."""
    own = texels.within(topology.face)
    weight = texels.areas(own)
    total = weight.sum()
    seen = texels.confidence[own] >= options.least_seen
    return {
        "size": options.size,
        "coverage": round(float(weight[seen].sum() / total), 4),
        "mirrored": round(float(weight[mirrored[own] & ~seen].sum() / total), 4),
        "mean_confidence": round(float((weight * texels.confidence[own]).sum() / total), 4),
    }
