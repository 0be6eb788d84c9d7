"""The colours of a raw scan, as its vertices or images have them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from solver.errors import Finding, InputError
from solver.meshio.glb_colours import paint_of_glb, to_srgb
from solver.meshio.mesh import read_content, weld
from solver.meshio.obj_colours import paint_of_obj
from solver.meshio.paint import BARE, Paint
from solver.meshio.ply_colours import paint_of_ply
from solver.meshio.raw import MAX_BYTES, RawScan
from solver.meshio.texture_images import Texels
from solver.surface import Floats, Ints, directed_edges, side_pairs


@dataclass(frozen=True, eq=False)
class ScanColours:
    """A surface with colours, a scan's as its file has it; some triangles may have none."""

    vertices: Floats  # (n, 3) in the file's unit, unmended
    faces: Ints  # (f, 3)
    paint: Paint
    findings: tuple[Finding, ...] = ()  # what its file has otherwise than most

    def at(self, faces: Ints, shares: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Return colours (k, 3), sRGB in [0, 1], and which places (k,) have one.

        The places are barycentric ``shares`` (k, 3) of triangles ``faces`` (k,). Images are
        bilinear, and repeat beyond their edges.
        """
        paint = self.paint
        colours = np.zeros((len(faces), 3))
        known = np.zeros(len(faces), bool)
        number = paint.images_of[faces]
        if paint.vertices is not None:
            own = np.flatnonzero(number == BARE)
            corners = self.faces[faces[own]]
            colours[own] = np.einsum("kc,kcd->kd", shares[own], paint.vertices[corners])
            known[own] = True
        for image in range(len(paint.images)):
            own = np.flatnonzero(number == image)
            places = np.einsum("kc,kcd->kd", shares[own], paint.coordinates[faces[own]])
            found = bilinear(paint.images[image], places)
            colours[own] = found[:, :3]
            known[own] = found[:, 3] > 0.5
        known &= np.isfinite(colours).all(axis=1)
        return np.where(known[:, None], colours, 0.0), known

    def beside(self, sides: Ints) -> tuple[Floats, NDArray[np.bool_]]:
        """Return colours (k, 3) in the middle of sides (k,) of triangles, and which have one.

        Sides are numbered as :func:`~solver.surface.directed_edges` has them.
        """
        side, face = np.divmod(sides, len(self.faces))
        return self.at(face, HALVES[side])

    def seams(self, faces: Ints) -> Ints:
        """Return pairs (k, 2) of sides that are one edge of ``faces``, and two of the images.

        The ``faces`` (f, 3) are the triangles by vertices of which no two are in one place.
        """
        ends = self.paint.coordinates[:, [[0, 1], [1, 2], [2, 0]]].swapaxes(0, 1).reshape(-1, 2, 2)
        sides = directed_edges(faces)
        turned = sides[:, 0] > sides[:, 1]
        ends[turned] = ends[turned][:, ::-1]
        images = np.tile(self.paint.images_of, 3)
        one, other = side_pairs(faces).T
        mapped = (images[one] != BARE) & (images[other] != BARE)
        apart = (ends[one] != ends[other]).any(axis=2).all(axis=1)
        cut = mapped & (apart | (images[one] != images[other]))
        return np.column_stack([one[cut], other[cut]])


HALVES = np.array([[0.5, 0.5, 0.0], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5]])  # shares: middles of sides


def bilinear(image: Texels, places: Floats) -> Floats:
    """Return the values (k, 4) in [0, 1] of an image, which repeats, at ``places`` (k, 2).

    A place is the part of the way from the left edge to the right and from the upper to the lower.
    """
    height, width = image.shape[:2]
    size = np.array([width, height])
    at = np.where(np.isfinite(places), places, 0.0) % 1.0 * size - 0.5
    low = np.floor(at).astype(np.int64)
    share = at - low
    found = np.zeros((len(places), 4))
    for right in (0, 1):
        for down in (0, 1):
            column, row = ((low + np.array([right, down])) % size).T
            weight = np.abs(1 - right - share[:, 0]) * np.abs(1 - down - share[:, 1])
            found += weight[:, None] * image[row, column]
    return found / 255.0


def read_colours(
    path: Path, scan: RawScan, of_vertices: Literal["srgb", "linear"] = "srgb"
) -> ScanColours | None:
    """Return the colours of a ``scan`` as it was read from ``path``, not mended; None: it has none.

    Images are those that its file names, in it (GLB) or beside it (PLY, and OBJ by its MTL). An OBJ
    or PLY has the colours ``of_vertices`` in sRGB or in linear light: no file says which. Raises
    :class:`InputError`: ``texture.path``, ``texture.missing`` or ``texture.unreadable``.
    """
    if not len(scan.faces):
        return None
    paint = None
    if scan.format == "obj":
        paint = paint_of_obj(path, read_content(path, MAX_BYTES, "a raw scan"))
    elif scan.format == "ply":
        paint = paint_of_ply(path, read_content(path, MAX_BYTES, "a raw scan"))
    elif scan.format == "glb":
        paint = paint_of_glb(path, read_content(path, MAX_BYTES, "a raw scan"))
    if paint is None and scan.colours is not None:
        srgb = scan.colours if of_vertices == "srgb" else to_srgb(scan.colours)
        paint = Paint.of_vertices(srgb, len(scan.faces))
    if paint is None:
        return None
    if len(paint.images_of) != len(scan.faces):
        reason = f"{path.name}: its faces and texture coordinates do not match"
        raise InputError("texture.unreadable", reason, file=path.name)
    findings = []
    if paint.missing:
        message = f"{path.name}: {', '.join(paint.missing)} does not lie beside it."
        advice = "Send it with the scan: what lies on it has no colours."
        findings.append(Finding("texture.missing", "warning", message, advice))
    colours = ScanColours(scan.vertices, scan.faces, paint)
    if is_flipped(colours):
        colours = replace(colours, paint=paint.flipped())
        message = f"{path.name}: its texture coordinates go down from the upper edge of the image."
        advice = "They were read so, as colours meet at the seams then, and do not otherwise."
        findings.append(Finding("texture.flipped", "info", message, advice))
    return replace(colours, findings=tuple(findings))


@dataclass(frozen=True)
class FlipOptions:
    """When images are taken for upside down: jumps of colour at seams, of 1 for black to white."""

    seams: int = 4000  # that are looked at, at most
    least_seams: int = 30  # with fewer the file is believed
    least_jump: float = 0.05  # as it is read: below, the colours meet
    clear: float = 0.5  # most of this that is left when turned over


FLIP = FlipOptions()


def is_flipped(colours: ScanColours, options: FlipOptions = FLIP) -> bool:
    """Return whether colours meet at a scan's seams only with its images turned upside down."""
    if not colours.paint.images:
        return False
    _, place = weld(colours.vertices)  # files have a vertex at a seam twice
    pairs = colours.seams(place[colours.faces])
    if len(pairs) < options.least_seams:
        return False
    pairs = pairs[:: -(-len(pairs) // options.seams)]
    as_read = _jump(colours, pairs)
    turned = _jump(replace(colours, paint=colours.paint.flipped()), pairs)
    return as_read > options.least_jump and turned < options.clear * as_read


def _jump(colours: ScanColours, pairs: Ints) -> float:
    """Return the mean difference of colour across seams, 1 where one side has none."""
    (one, known), (other, also) = (colours.beside(sides) for sides in pairs.T)
    return float(np.where(known & also, np.abs(one - other).mean(axis=1), 1.0).mean())
