"""Reading ICT-FaceKit (USC Institute for Creative Technologies, MIT): a head that varies.

It comes as it is published, or as one file: ``ict_facekit.npz`` holds ``V`` (26719, 3) neutral in
cm, ``quads`` with -1 in the fourth column of a triangle, ``E`` and ``ex`` expression displacements
and their names, ``I`` and ``idn`` identities.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from solver.anatomy.public_ict_facekit import public_facekit
from solver.anatomy.shapes import ShapeBasis
from solver.errors import InputError
from solver.npz import read_arrays
from solver.surface import Floats, Ints, Surface

VERTEX_COUNT = 26719
MM_PER_UNIT = 10.0

# Ranges of vertex numbers, as published with the model.
NARROW_FACE = range(0, 6706)
HEAD = range(0, 11248)
FLESH = range(0, 14062)
GUMS_AND_TONGUE = range(14062, 17039)
UPPER_TEETH = range(17039, 19247)
LOWER_TEETH = range(19247, 21451)
EYEBALLS = range(21451, 24591)

TEETH_NAMES = tuple(
    f"{side} {{jaw}} {tooth} tooth"
    for side, order in (("left", 1), ("right", -1))
    for tooth in (
        "second secondary molar",
        "first secondary molar",
        "second secondary premolar",
        "first secondary premolar",
        "secondary canine",
        "lateral secondary incisor",
        "central secondary incisor",
    )[::order]
)


@dataclass(frozen=True)
class FaceKit:
    """The head: ``skin`` with all vertices and how it varies, in mm.

    ``deltas`` are the displacements (n, 3) of the expressions; ``identities`` (k, n, 3) those of
    one standard deviation of each identity component, whose coefficients are independent.
    """

    skin: Surface
    deltas: dict[str, Floats]
    identities: Floats


def read_facekit(folder: Path) -> FaceKit:
    """Return the neutral head, its expressions and its identities.

    ``folder`` holds ``ict_facekit.npz``, or else the model as USC ICT publishes it
    (:mod:`solver.anatomy.public_ict_facekit`).

    Raises
    ------
    InputError
        ``faces.unreadable`` if there is neither or ``ict_facekit.npz`` is not such a file,
        ``faces.topology`` if its vertices are not those of ICT-FaceKit, or as
        :func:`~solver.anatomy.public_ict_facekit.public_facekit`.
    """
    path = folder / "ict_facekit.npz"
    if not path.exists():
        return _face_kit(public_facekit(folder), folder)
    try:
        return _face_kit(read_arrays(path), path)
    except InputError:
        raise
    except (LookupError, TypeError, ValueError) as error:
        raise InputError(
            "faces.unreadable", f"{path} is not an ICT-FaceKit file: {error}", file=str(path)
        ) from error


def _face_kit(data: dict[str, np.ndarray], path: Path) -> FaceKit:
    vertices = data["V"].astype(float) * MM_PER_UNIT
    if len(vertices) != VERTEX_COUNT:
        raise InputError(
            "faces.topology",
            f"{path} has {len(vertices)} vertices, ICT-FaceKit has {VERTEX_COUNT}",
            file=str(path),
            expected=VERTEX_COUNT,
            found=len(vertices),
        )
    skin = Surface(vertices, triangulate(data["quads"].astype(np.int64)))
    names = [str(name) for name in data["ex"]]
    deltas = dict(zip(names, data["E"].astype(float) * MM_PER_UNIT, strict=True))
    return FaceKit(skin, deltas, data["I"].astype(float) * MM_PER_UNIT)


def triangulate(quads: Ints) -> Ints:
    """Return triangles (f, 3) of quads (k, 4) whose fourth vertex is -1 where it is a triangle."""
    whole = quads[:, 3] >= 0
    return np.vstack([quads[whole][:, :3], quads[whole][:, [0, 2, 3]], quads[~whole][:, :3]])


def faces_within(faces: Ints, vertices: range) -> Ints:
    """Return the numbers of the faces whose vertices all lie in a range."""
    return np.flatnonzero(np.all((faces >= vertices.start) & (faces < vertices.stop), axis=1))


def arkit_name(expression: str) -> str:
    """Return ARKit's name of an expression: ``browDown_L`` is ``browDownLeft`` there."""
    for ending, side in (("_L", "Left"), ("_R", "Right")):
        if expression.endswith(ending):
            return expression.removesuffix(ending) + side
    return expression


def shape_basis(kit: FaceKit) -> ShapeBasis:
    """Return how the head varies over persons and expressions."""
    return ShapeBasis(
        identity=kit.identities.astype(np.float32),
        expressions=np.stack(list(kit.deltas.values())).astype(np.float32),
        expression_names=tuple(arkit_name(name) for name in kit.deltas),
    )
