"""Whether a template's arrays fit together: shapes, finite numbers, indices in range."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from solver.errors import InputError
from solver.surface import Surface

if TYPE_CHECKING:
    from solver.anatomy.template import Template


def check_arrays(template: Template, file: str) -> None:
    """Raise what is wrong with a template's arrays; ``file`` is named in the message.

    Raises
    ------
    InputError
        ``template.shape``, ``template.nan`` or ``template.range``, with the ``array``'s name.
    """
    check = _Check(file)
    check.surface("skin", template.skin)
    skin = len(template.skin.vertices)
    check.surface("cranium", template.cranium)
    check.surface("mandible", template.mandible)
    check.numbers("flesh_faces", template.flesh_faces, len(template.skin.faces))
    for name in ("face_vertices", "attached_cranium", "attached_mandible"):
        check.numbers(name, getattr(template, name), skin)
    for name in ("flesh_faces", "face_vertices"):
        if not len(getattr(template, name)):
            check.wrong("shape", name, "is empty")
    for name, ids in template.regions.items():
        check.numbers(f"region {name}", ids, skin)
    for name, vertex in template.landmarks.items():
        check.numbers(f"landmark {name}", np.array([vertex]), skin)
    check.points("parting", template.parting, (skin, 3))
    check.points("condyles", template.condyles, (2, 3))
    check.points("planes", np.array([template.back_z, template.bottom_y]), (2,))
    for muscle in template.muscles:
        check.surface(f"muscle {muscle.name}", muscle.surface)
        axis = np.stack([muscle.fibre, muscle.origin, muscle.insertion])
        check.points(f"axis of muscle {muscle.name}", axis, (3, 3))
    if template.shapes is not None:
        shapes = template.shapes
        check.points("identity shapes", shapes.identity, (None, skin, 3))
        check.points("expressions", shapes.expressions, (len(shapes.expression_names), skin, 3))
    if template.mesh is not None:
        mesh = template.mesh
        check.points("mesh vertices", mesh.vertices, (None, 3))
        count = len(mesh.vertices)
        check.numbers("mesh tets", mesh.tets, count, columns=4)
        for name in ("cranium", "mandible", "cut", "sliding"):
            check.numbers(f"mesh {name}", getattr(mesh, name), count)
        for name in ("embedded", "attached_mandible"):
            check.numbers(f"mesh {name}", getattr(mesh, name), skin)
        check.numbers("mesh embedded_in", mesh.embedded_in, len(mesh.tets))
        check.points("mesh shares", mesh.shares, (len(mesh.embedded_in), 4))
        weights = mesh.weights
        check.points("mesh weights", weights.data, (len(weights.indices),))
        check.numbers("mesh weights", weights.indices, weights.shape[1])
        for name, found, wanted in (
            ("weights", weights.shape[0], len(mesh.tets)),
            ("embedded_in", len(mesh.embedded_in), len(mesh.embedded)),
        ):
            if found != wanted:
                check.wrong("shape", f"mesh {name}", f"has {found} rows, not {wanted}")


class _Check:
    def __init__(self, file: str) -> None:
        self._file = file

    def wrong(self, code: str, array: str, what: str) -> None:
        raise InputError(
            f"template.{code}", f"{self._file}: {array} {what}", file=self._file, array=array
        )

    def points(self, name: str, array: np.ndarray, shape: tuple[int | None, ...]) -> None:
        fits = array.ndim == len(shape) and all(
            wanted in (None, found) for wanted, found in zip(shape, array.shape, strict=True)
        )
        if not fits or array.dtype.kind not in "fi":
            wanted = " x ".join("any" if n is None else str(n) for n in shape)
            self.wrong("shape", name, f"has shape {array.shape} of {array.dtype}, not {wanted}")
        if not np.isfinite(array).all():
            place = np.argwhere(~np.isfinite(array))[0]
            self.wrong("nan", name, f"has an entry that is not finite, at {place.tolist()}")

    def numbers(self, name: str, array: np.ndarray, count: int, columns: int = 0) -> None:
        fits = array.shape[1:] == ((columns,) if columns else ()) and array.ndim > 0
        if not fits or array.dtype.kind != "i":
            self.wrong("shape", name, f"has shape {array.shape} of {array.dtype}")
        outside = np.argwhere((array < 0) | (array >= count))
        if len(outside):
            place = tuple(outside[0])
            self.wrong("range", name, f"has {array[place]} at {list(map(int, place))}, of {count}")

    def surface(self, name: str, surface: Surface) -> None:
        self.points(f"{name} vertices", surface.vertices, (None, 3))
        self.numbers(f"{name} faces", surface.faces, len(surface.vertices), columns=3)
