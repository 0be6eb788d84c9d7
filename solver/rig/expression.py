"""A fitted expression, and the arrays that a rig's file has of several.

docs/reference/rig-format.md describes these.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, astuple, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from solver.errors import Finding, InputError, SolveError
from solver.fitting.face import PosedFace
from solver.fitting.known import KnownFit
from solver.fitting.objective import Target
from solver.kinds import FILES
from solver.model import SubjectModel
from solver.rig.round_trip import RoundTrip
from solver.storage import Arrays
from solver.surface import Floats, Ints

FILE = "rig.npz"
FORMAT = FILES[FILE].format  # also of activations.npz and muscle_weights.npz
ENTRIES = ("xx", "xy", "xz", "yy", "yz", "zz")  # of an activation, in the order of its columns
ROLES = {"train": "training", "test": "unseen"}  # of an expression's scan, in words


@dataclass(frozen=True)
class ExpressionFit:
    """One expression, fitted.

    ``error_mm`` is the distance between skin and target on the face's vertices, along the scan's
    normals if the fit was to planes; NaN elsewhere and where the scan has no confidence.
    ``status`` is how the solve ended: ``converged``, ``stopped`` (out of steps, or stuck),
    ``failed`` (the best of what there was), or ``unknown`` in rigs made before it was kept.
    """

    name: str  # of the capture
    role: str  # ``train`` (its scan shaped S) or ``test`` (activations only)
    activations: Floats  # (m, 6) symmetric contractions, see ENTRIES; (1, 0, 0, 1, 0, 1) at rest
    jaw: Floats  # (5,) b of solver.model.JawFrame, rad and mm
    skin: Floats  # (v, 3) mm, the whole scan topology as solved
    target: Floats  # (v, 3) mm, the same as scanned
    error_mm: Floats  # (v,)
    inverted: int  # number of tets with det F <= 0
    iterations: int
    seconds: float
    objective: float  # mean square of that distance over the face, mm^2
    x: Floats | None = None  # (p, 3) mm, tet vertices as solved; None in older rigs
    round_trip: RoundTrip | None = None  # None if not tried
    solver: str = "reduced"  # or ``ipopt``
    status: str = "converged"
    notices: tuple[Finding, ...] = ()  # what was odd about the scan or the solve
    confidence: Floats | None = None  # (v,) of the scan in [0, 1]; None in older rigs
    known: tuple[KnownFit, ...] = ()  # what a table knew of muscles, and what was fitted

    def seen(self, vertices: Ints) -> Floats:
        """Return the scan's confidence (k,) at ``vertices``; in older rigs 1 where it has any."""
        shown = np.isfinite(self.error_mm[vertices]).astype(np.float64)
        return shown if self.confidence is None else self.confidence[vertices] * shown

    def is_of(self, scan: Floats) -> bool:
        """Return whether the expression was fitted to this ``scan`` (v, 3), NaN in its holes."""
        return np.array_equal(self.target.astype(np.float32), scan.astype(np.float32), True)

    def measured_error(self, vertices: Ints) -> Floats:
        """Return the errors (k,) in mm of those ``vertices`` that the scan shows."""
        error = self.error_mm[vertices]
        return error[np.isfinite(error)]


def refuse_not_finite(name: str, state: PosedFace) -> None:
    """Raise ``solve.not_finite`` rather than let the fit of ``name`` be written as NaN."""
    if not (np.isfinite(state.x).all() and np.isfinite(state.pose.a).all()):
        raise SolveError("solve.not_finite", f"the fit of {name} is not finite")


def errors_on_skin(model: SubjectModel, target: Target, points: Floats) -> Floats:
    """Return how far the face's ``points`` lie off their target, (v,) mm; NaN beside the face."""
    error = np.full(len(model.skin.vertices), np.nan)
    error[model.face] = target.distances(points)
    return error


def expression_arrays(expressions: Sequence[ExpressionFit], model: SubjectModel) -> Arrays:
    """Return the arrays of a file; surfaces and errors are in single precision."""
    vertices = len(model.skin.vertices)

    def column(field: str, shape: tuple[int, ...], dtype: type = np.float64) -> np.ndarray:
        rows: np.ndarray = np.array([getattr(fit, field) for fit in expressions], dtype=dtype)
        return rows.reshape(len(expressions), *shape)

    def texts(values: Iterable[str]) -> np.ndarray:
        return np.array(list(values), dtype=np.str_)

    unknown = np.full(model.rest.shape, np.nan)
    x = [unknown if fit.x is None else fit.x for fit in expressions]
    unsure = np.full(vertices, np.nan)
    confidence = [unsure if fit.confidence is None else fit.confidence for fit in expressions]
    # as the rig's drive has them
    of_muscles = expressions[0].activations.shape if expressions else (model.muscle_count, 6)
    trips = [astuple(fit.round_trip or RoundTrip()) for fit in expressions]
    return {
        "format": np.array(FORMAT),
        "muscles": texts(model.muscle_names),
        "names": texts(fit.name for fit in expressions),
        "roles": texts(fit.role for fit in expressions),
        "activations": column("activations", of_muscles),
        "jaw": column("jaw", (5,)),
        "skin": column("skin", (vertices, 3), np.float32),
        "target": column("target", (vertices, 3), np.float32),
        "error_mm": column("error_mm", (vertices,), np.float32),
        "inverted": column("inverted", (), np.int64),
        "iterations": column("iterations", (), np.int64),
        "seconds": column("seconds", ()),
        "objective": column("objective", ()),
        "x": np.reshape(x, (len(x), *unknown.shape)),
        "confidence": np.reshape(confidence, (len(x), vertices)).astype(np.float32),
        "round_trip": np.reshape(trips, (len(trips), len(fields(RoundTrip)))),
        "solver": texts(fit.solver for fit in expressions),
        "status": texts(fit.status for fit in expressions),
        "notices": texts(
            json.dumps([each.as_dict() for each in fit.notices], allow_nan=False)
            for fit in expressions
        ),
        "known": texts(json.dumps([asdict(each) for each in fit.known]) for fit in expressions),
    }


def expressions_from(data: Arrays, model: SubjectModel, path: Path) -> tuple[ExpressionFit, ...]:
    """Return the expressions of a file's arrays.

    Raises :class:`InputError`: ``rig.format``, and ``rig.model`` for those of another model.
    """
    check_format(path, data)
    is_same = data["skin"].shape[1:] == model.skin.vertices.shape
    if not is_same or tuple(data["muscles"].tolist()) != model.muscle_names:
        raise other_model(path)
    return tuple(_expression_from(data, k) for k in range(len(data["names"])))


def _expression_from(data: Arrays, k: int) -> ExpressionFit:
    """Return an expression; older rigs do not have all arrays, and what is all NaN is not known."""

    def known(name: str) -> Floats | None:
        row = data[name][k] if name in data else np.array(np.nan)
        return None if np.isnan(row).all() else row.astype(np.float64)

    trip = known("round_trip")
    of_skin = ("activations", "jaw", "skin", "target", "error_mm")
    of_solve = ("inverted", "iterations", "seconds", "objective")
    values: dict[str, Any] = {
        **{name: data[name][k].astype(np.float64) for name in of_skin},
        **{name: data[name][k].item() for name in of_solve},
        "x": known("x"),
        "confidence": known("confidence"),
        "round_trip": None if trip is None else RoundTrip(*trip.tolist()),
        "status": "unknown",
    }
    if "status" in data:
        notices = json.loads(str(data["notices"][k]))
        values |= {name: str(data[name][k]) for name in ("solver", "status")}
        values["notices"] = tuple(Finding.from_dict(each) for each in notices)
    if "known" in data:
        values["known"] = tuple(KnownFit(**each) for each in json.loads(str(data["known"][k])))
    return ExpressionFit(str(data["names"][k]), str(data["roles"][k]), **values)


def check_format(path: Path, data: dict[str, np.ndarray]) -> None:
    """Raise :class:`InputError` (``rig.format``) for arrays of another format."""
    if (found := int(data["format"])) != FORMAT:
        message = f"{path.name} has rig format {found}, not {FORMAT}"
        raise InputError("rig.format", message, file=path.name, expected=FORMAT, found=found)


def other_model(path: Path) -> InputError:
    """Return the error of a file that is not of the model at hand."""
    message = f"{path.name} belongs to a rig of another subject model"
    return InputError("rig.model", message, file=path.name)
