"""The result of a fit: muscle activations per expression and the blending matrix S.

``activations.npz`` and ``muscle_weights.npz`` are documented in docs/reference/rig-format.md.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp

from solver.errors import Finding, InputError
from solver.model import SubjectModel
from solver.rig.round_trip import RoundTrip
from solver.storage import Arrays, read_arrays, with_prefix
from solver.surface import Floats, Ints

FORMAT = 1  # of activations.npz and muscle_weights.npz
ENTRIES = ("xx", "xy", "xz", "yy", "yz", "zz")  # of an activation, in the order of its columns
PARTS = {"activations": "activations.npz", "weights": "muscle_weights.npz"}  # a folder's files
ROLES = {"train": "training", "test": "unseen"}  # of an expression's scan, in words


@dataclass(frozen=True)
class ExpressionFit:
    """One expression, fitted.

    name, role
        What the capture was called; ``train`` (its scan shaped S) or ``test`` (activations only).
    activations
        (m, 6) symmetric contraction of every muscle in the order xx, xy, xz, yy, yz, zz; a relaxed
        muscle is (1, 0, 0, 1, 0, 1).
    jaw
        (5,) b of :class:`solver.model.JawFrame`, rad and mm.
    skin, target
        (v, 3) the whole scan topology in mm: as solved and as scanned.
    error_mm
        (v,) distance between them on the face's vertices, along the scan's normals if the fit was
        to planes; NaN elsewhere and where the scan has no confidence.
    inverted
        Number of tets with det F <= 0.
    iterations, seconds
        How the solve went.
    objective
        Mean square of that distance over the face, mm^2.
    x
        (p, 3) tet vertices as solved, mm; None in rigs made before they were kept.
    round_trip
        What came back when the activations were simulated and fitted again; None if not tried.
    solver, status
        ``reduced`` or ``ipopt``, and how it ended: ``converged``, ``stopped`` (out of steps, or
        stuck) or ``failed`` (the best of what there was); ``unknown`` in rigs made before it was
        kept.
    notices
        What was odd about the scan or the solve.
    """

    name: str
    role: str
    activations: Floats
    jaw: Floats
    skin: Floats
    target: Floats
    error_mm: Floats
    inverted: int
    iterations: int
    seconds: float
    objective: float
    x: Floats | None = None
    round_trip: RoundTrip | None = None
    solver: str = "reduced"
    status: str = "converged"
    notices: tuple[Finding, ...] = ()

    def measured_error(self, vertices: Ints) -> Floats:
        """Return the errors (k,) in mm of those ``vertices`` that the scan shows."""
        error = self.error_mm[vertices]
        return error[np.isfinite(error)]


def save_activations(
    path: Path, expressions: tuple[ExpressionFit, ...], model: SubjectModel
) -> None:
    """Write ``activations.npz``; lengths in mm, surfaces and errors in single precision."""
    with path.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **activation_arrays(expressions, model))


def activation_arrays(expressions: tuple[ExpressionFit, ...], model: SubjectModel) -> Arrays:
    """Return what :func:`load_activations` reads."""
    muscles, vertices = model.muscle_count, len(model.skin.vertices)

    def column(field: str, shape: tuple[int, ...], dtype: type = np.float64) -> np.ndarray:
        rows: np.ndarray = np.array([getattr(fit, field) for fit in expressions], dtype=dtype)
        return rows.reshape(len(expressions), *shape)

    x = np.full((len(expressions), *model.rest.shape), np.nan)
    trips = np.full((len(expressions), len(fields(RoundTrip))), np.nan)
    for k, fit in enumerate(expressions):
        if fit.x is not None:
            x[k] = fit.x
        if fit.round_trip is not None:
            trips[k] = astuple(fit.round_trip)

    return {
        "format": np.array(FORMAT),
        "muscles": np.array(model.muscle_names, dtype=np.str_),
        "names": np.array([fit.name for fit in expressions], dtype=np.str_),
        "roles": np.array([fit.role for fit in expressions], dtype=np.str_),
        "activations": column("activations", (muscles, 6)),
        "jaw": column("jaw", (5,)),
        "skin": column("skin", (vertices, 3), np.float32),
        "target": column("target", (vertices, 3), np.float32),
        "error_mm": column("error_mm", (vertices,), np.float32),
        "inverted": column("inverted", (), np.int64),
        "iterations": column("iterations", (), np.int64),
        "seconds": column("seconds", ()),
        "objective": column("objective", ()),
        "x": x,
        "round_trip": trips,
        "solver": np.array([fit.solver for fit in expressions], dtype=np.str_),
        "status": np.array([fit.status for fit in expressions], dtype=np.str_),
        "notices": np.array([_notices_text(fit.notices) for fit in expressions], dtype=np.str_),
    }


def load_activations(path: Path, model: SubjectModel) -> tuple[ExpressionFit, ...]:
    """Read ``activations.npz`` of a rig of ``model``, or those of a ``rig.npz``.

    Raises :class:`InputError`: ``rig.unreadable``, ``rig.format``, or ``rig.model`` if it belongs
    to a model with other muscles or another skin.
    """
    with _reading(path):
        data = _read_part(path, "activations")
        if (
            tuple(data["muscles"].tolist()) != model.muscle_names
            or data["skin"].shape[1:] != model.skin.vertices.shape
        ):
            raise _other_model(path)
        return tuple(
            ExpressionFit(
                name=str(data["names"][k]),
                role=str(data["roles"][k]),
                activations=data["activations"][k],
                jaw=data["jaw"][k],
                skin=data["skin"][k].astype(np.float64),
                target=data["target"][k].astype(np.float64),
                error_mm=data["error_mm"][k].astype(np.float64),
                inverted=int(data["inverted"][k]),
                iterations=int(data["iterations"][k]),
                seconds=float(data["seconds"][k]),
                objective=float(data["objective"][k]),
                x=_known(data, "x", k),
                round_trip=None
                if (trip := _known(data, "round_trip", k)) is None
                else RoundTrip(*map(float, trip)),
                **_solve(data, k),
            )
            for k in range(len(data["names"]))
        )


def save_weights(path: Path, weights: sp.csr_array, model: SubjectModel) -> None:
    """Write ``muscle_weights.npz``: S (n, m + 1) as CSR, explicit zeros kept."""
    with path.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **weight_arrays(weights, model))


def weight_arrays(weights: sp.csr_array, model: SubjectModel) -> Arrays:
    """Return what :func:`load_weights` reads."""
    return {
        "format": np.array(FORMAT),
        "muscles": np.array(model.muscle_names, dtype=np.str_),
        "model": np.array(model_hash(model)),
        "data": weights.data,
        "indices": weights.indices,
        "indptr": weights.indptr,
        "shape": np.array(weights.shape),
    }


def load_weights(path: Path, model: SubjectModel) -> sp.csr_array:
    """Read ``muscle_weights.npz`` (n, m + 1) for ``model``, or that of a ``rig.npz``.

    Raises :class:`InputError`: ``rig.unreadable``, ``rig.format``, or ``rig.model`` if S was fitted
    on another model.
    """
    with _reading(path):
        data = _read_part(path, "weights")
        if str(data["model"]) != model_hash(model):
            raise _other_model(path)
        parts = (data["data"], data["indices"], data["indptr"])
        return sp.csr_array(parts, shape=tuple(data["shape"].tolist()))


def model_hash(model: SubjectModel) -> str:
    """Return the sha256 of what S depends on: the tets at rest and the muscles' names."""
    digest = hashlib.sha256("\n".join(model.muscle_names).encode())
    digest.update(np.ascontiguousarray(model.rest, dtype="<f8").tobytes())
    digest.update(np.ascontiguousarray(model.tets, dtype="<i8").tobytes())
    return digest.hexdigest()


def _known(data: dict[str, np.ndarray], array: str, k: int) -> Floats | None:
    """Return a row of an array that older rigs do not have; None too where all of it is NaN."""
    if array not in data or np.isnan(data[array][k]).all():
        return None
    return np.asarray(data[array][k], np.float64)


def _notices_text(notices: tuple[Finding, ...]) -> str:
    return json.dumps([notice.as_dict() for notice in notices], allow_nan=False)


def _solve(data: dict[str, np.ndarray], k: int) -> dict[str, Any]:
    """Return solver, status and notices of an expression; older rigs do not have them."""
    if "status" not in data:
        return {"status": "unknown"}
    notices = tuple(Finding.from_dict(each) for each in json.loads(str(data["notices"][k])))
    return {"solver": str(data["solver"][k]), "status": str(data["status"][k]), "notices": notices}


def _read_part(path: Path, name: str) -> Arrays:
    """Return the arrays of a file, or those under ``name`` of a ``rig.npz`` or a rig's folder."""
    if path.is_dir():
        whole = path / "rig.npz"
        path = whole if whole.exists() else path / PARTS[name]
    data = read_arrays(path)
    if "header" in data:
        data = with_prefix(data, f"{name}_")
    _check_format(path, data)
    return data


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    try:
        yield
    except InputError:
        raise
    except (LookupError, TypeError, ValueError) as error:
        raise InputError(
            "rig.unreadable", f"{path.name} is not part of a rig: {error}", file=path.name
        ) from error


def _check_format(path: Path, data: dict[str, np.ndarray]) -> None:
    if int(data["format"]) != FORMAT:
        raise InputError(
            "rig.format",
            f"{path.name} has rig format {int(data['format'])}, not {FORMAT}",
            file=path.name,
            expected=FORMAT,
            found=int(data["format"]),
        )


def _other_model(path: Path) -> InputError:
    return InputError(
        "rig.model", f"{path.name} belongs to a rig of another subject model", file=path.name
    )
