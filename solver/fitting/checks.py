"""Checks of what a caller hands to a face: S, a pose, terms of the energy.

They are made where a face is made or asked, once; fits, which step within the bounds, pass by.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp

from solver.errors import InputError, SolveError
from solver.fitting.controls import ANGLE_UNIT, Layout
from solver.mechanics.boundary import JAW_FREEDOM
from solver.model import SubjectModel
from solver.surface import Floats

# by which a row's sum and an entry's sign may be off: differences step off the simplex
WEIGHTS_TOLERANCE = 1e-3


class PoseError(InputError, SolveError):
    """A pose has the wrong shape or is not finite: to a fit, a step that went too far."""


def check_weights(S: sp.csr_array, model: SubjectModel) -> None:
    """Raise :class:`InputError` (``face.weights``) unless S is a muscle geometry of ``model``.

    Its entries are among the model's, which tells rows in another order from those of the model.
    """
    own = model.weights
    if not (sp.issparse(S) and S.format == "csr"):
        raise _weights(f"S is {type(S).__name__}, not a sparse matrix (scipy.sparse.csr_array)")
    if S.shape != own.shape:
        muscles = f"passive flesh and {model.muscle_count} muscles"
        expected = f"{own.shape}: a row for each tet, columns for {muscles}"
        raise _weights(f"S has the shape {S.shape}, not {expected}")
    row = np.repeat(np.arange(S.shape[0]), np.diff(S.indptr))
    names = ("passive flesh", *model.muscle_names)
    for wrong, fault in ((~np.isfinite(S.data), "not finite"), (S.data < 0.0, "negative")):
        for k in np.flatnonzero(wrong & ~(np.abs(S.data) <= WEIGHTS_TOLERANCE))[:1]:
            place = f"row {row[k]}, column {S.indices[k]} ({names[S.indices[k]]})"
            message = f"S is {fault} in {place}: {S.data[k]}"
            raise _weights(message, row=int(row[k]), column=int(S.indices[k]))
    total = np.bincount(row, S.data, len(own.indptr) - 1)
    for k in np.flatnonzero(np.abs(total - 1.0) > WEIGHTS_TOLERANCE)[:1]:
        raise _weights(f"row {k} of S sums to {total[k]:.6g}, not to 1", row=int(k))
    same = np.array_equal(S.indptr, own.indptr) and np.array_equal(S.indices, own.indices)
    if not same:
        own_row = np.repeat(np.arange(own.shape[0]), np.diff(own.indptr))
        places = [each * own.shape[1] for each in (row, own_row)]
        known = np.isin(places[0] + S.indices, places[1] + own.indices) | (S.data == 0.0)
        for k in np.flatnonzero(~known)[:1]:
            message = (
                f"row {row[k]} of S has a share of {names[S.indices[k]]}, which has none there in "
                "the model: are the rows in another order, or S another model's?"
            )
            raise _weights(message, row=int(row[k]), column=int(S.indices[k]))


def _weights(message: str, **context: int) -> InputError:
    return InputError("face.weights", message, **context)


def check_pose(a: Floats, b: Floats, layout: Layout, names: Sequence[str]) -> None:
    """Raise :class:`PoseError` (``face.pose``) unless a and b are a ``layout``'s blocks, finite.

    ``names`` are those of the muscles, if it is they that a drives.
    """
    joints = " and ".join(block.name for block in layout.joints)
    muscles, units = layout.drive, layout.joint_units
    for name, value, shape in ((muscles.name, a, muscles.rest.shape), (joints, b, units.shape)):
        if np.shape(value) != shape:
            message = f"the shape of a pose's {name} is {np.shape(value)}, not {shape}"
            if value is b and np.shape(b) == (JAW_FREEDOM,):
                message += ": face.pose_of(a, jaw) takes a jaw's five numbers"
            raise PoseError("face.pose", message)
    for j in np.flatnonzero(~np.isfinite(a.reshape(len(a), -1)).all(axis=1))[:1]:
        name = names[j] if len(names) == len(a) else f"number {j}"
        raise PoseError("face.pose", f"the activation of {name} is not finite: {a[j]}")
    if not np.isfinite(b).all():
        raise PoseError("face.pose", f"the jaw is not finite: {b}")
    angles = b[units == ANGLE_UNIT]
    if np.abs(angles).max(initial=0.0) > np.pi / 2.0:
        turns = " and ".join(f"{angle:g}" for angle in angles)
        message = f"the jaw turns by {turns} rad: degrees? (np.radians makes radians)"
        raise PoseError("face.pose", message)
