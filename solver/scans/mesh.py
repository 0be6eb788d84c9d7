"""What a reader of raw scans returns: the mesh or point cloud as it is stored, unmended."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from solver.surface import Floats, Ints

NO_FACES: Ints = np.zeros((0, 3), np.int64)


@dataclass(frozen=True)
class Mesh:
    """A mesh as a file holds it.

    ``vertices`` (n, 3), in the file's unit, may hold NaN; ``faces`` (f, 3) are triangles, none for
    a point cloud; ``normals`` (n, 3), as stored; ``colours`` (n, 3) in [0, 1]. ``empty_groups``
    are the names of parts that hold no face.
    """

    vertices: Floats
    faces: Ints
    normals: Floats | None = None
    colours: Floats | None = None
    empty_groups: tuple[str, ...] = ()


def unit_colours(colours: Floats) -> Floats:
    """Return colours (n, 3) in [0, 1], given so or as bytes."""
    return np.clip(colours / (255.0 if np.nanmax(colours, initial=0.0) > 1.0 else 1.0), 0.0, 1.0)


def joined(parts: list[Mesh]) -> Mesh:
    """Return several meshes as one; normals and colours stay only if every part has them."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])

    def all_of(values: list[Floats | None]) -> Floats | None:
        known = [value for value in values if value is not None]
        return np.concatenate(known) if known and len(known) == len(parts) else None

    return Mesh(
        vertices=np.concatenate([part.vertices for part in parts]),
        faces=np.concatenate(
            [part.faces + start for part, start in zip(parts, starts[:-1], strict=True)]
        ),
        normals=all_of([part.normals for part in parts]),
        colours=all_of([part.colours for part in parts]),
        empty_groups=tuple(name for part in parts for name in part.empty_groups),
    )
