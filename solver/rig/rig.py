"""A rig: a fitted person with its expressions, self-contained in one file ``rig.npz``.

docs/reference/rig-format.md has its arrays, and the files of 0.1 that are read for one release.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, astuple, dataclass, field, fields, replace
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp

from solver.anatomy.tetrahedra import volumes
from solver.errors import Finding, InputError, make_warning, quote
from solver.fitting.drives import MuscleDrive
from solver.fitting.drives.admissible import Admissible
from solver.fitting.drives.six_numbers import SixNumbers
from solver.fitting.drives.stored import restore, store
from solver.fitting.face import Face
from solver.fitting.interior_point import FeasibleSet
from solver.fitting.known import KnownFit
from solver.kinds import FILES
from solver.mechanics.boundary import JAW_FREEDOM
from solver.mechanics.newton import NewtonOptions
from solver.model import SIZE_WORDS, SubjectModel
from solver.rig.round_trip import RoundTrip
from solver.storage import Archive, Arrays, read_arrays, with_prefix
from solver.surface import Floats, Ints

FILE = "rig.npz"
FORMAT = FILES[FILE].format  # also of activations.npz and muscle_weights.npz
FREE_DRIVE = SixNumbers()
ENTRIES = ("xx", "xy", "xz", "yy", "yz", "zz")  # of an activation, in the order of its columns
ROLES = {"train": "training", "test": "unseen"}  # of an expression's scan, in words
# files of a rig of 0.1, by the roles that they have in a job; the report may be missing
FILES_OF_0_1 = {
    "model": "model.npz",
    "weights": "muscle_weights.npz",
    "rig": "activations.npz",
    "report": "report.json",
}


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


@dataclass(frozen=True, kw_only=True)
class SystemFit(ExpressionFit):
    """One expression, fitted by weights of K shapes and a jaw instead of muscles.

    Its ``activations`` are what the shapes ask of the muscles, its ``jaw`` is that of the shapes
    with what is on top of it.
    """

    weights: Floats  # (K,)
    jaw_on_top: Floats  # (5,) of the shapes', rad and mm
    lengths: Floats  # (m,) mm of the muscles' centre lines, zero where there is none


@dataclass(frozen=True)
class System:
    """A rig's expressions fitted without its muscles: by muscle tracks (T) or plain shapes (B).

    In a rig's ``systems`` they are ``T``, muscle tracks, and ``B``, plain blendshapes; ``S``, its
    muscles, are its own expressions. Scans of one name are the same in all of them.
    """

    shapes: tuple[str, ...]  # names of the K shapes
    expressions: tuple[SystemFit, ...]

    def without(self, scans: Mapping[str, Floats]) -> System:
        """Return the system without the expressions that have other ``scans`` (v, 3) now."""
        kept = [
            fit for fit in self.expressions if fit.name not in scans or fit.is_of(scans[fit.name])
        ]
        return replace(self, expressions=tuple(kept))

    def replaced(self, other: System) -> System:
        """Return ``other`` with those expressions of this one that it does not have.

        Weights of other shapes say nothing beside it, and are dropped.
        """
        if self.shapes != other.shapes:
            return other
        names = {fit.name for fit in other.expressions}
        kept = [fit for fit in self.expressions if fit.name not in names]
        return replace(other, expressions=(*kept, *other.expressions))


@dataclass(frozen=True)
class Rig:
    """Everything a fit hands over."""

    model: SubjectModel
    weights: sp.csr_array  # (n, m + 1), the final S
    expressions: tuple[ExpressionFit, ...]
    seconds: dict[str, float] = field(default_factory=dict)  # of each phase of the job
    notices: tuple[Finding, ...] = ()  # what was odd about the model or the job as a whole
    figures: dict[str, Any] | None = None  # of solver.rig.report; None before they are made
    drive: MuscleDrive = FREE_DRIVE  # that S was fitted with
    # what else drives the face, by its letter
    systems: Mapping[str, System] = field(default_factory=dict)

    def face(self, linear: str | None = None, tolerance: float = NewtonOptions.tolerance) -> Face:
        """Return the person as fitted: with S and drive, a driven jaw on the model's tracks.

        ``linear`` and ``tolerance`` are those of :class:`~solver.fitting.face.Face`.
        """
        face = Face(self.model, self.weights, linear=linear, tolerance=tolerance)
        return face.driven_as(self.drive)

    @cached_property
    def limits(self) -> FeasibleSet | None:
        """The values that the muscles can take, as the rig was fitted; None if all of them."""
        size = volumes(self.model.rest, self.model.tets)
        return self.drive.feasible(self.model, size, self.weights)

    @property
    def warnings(self) -> tuple[Finding, ...]:
        """Return what is odd about the rig as a whole: its origin, and what was noticed."""
        if self.model.size_from == "scan":
            return self.notices
        origin = self.model.size_from
        code = "model.estimated" if origin == "photographs" else "model.size"
        return (make_warning(code, SIZE_WORDS[origin]), *self.notices)

    def skins(self) -> dict[str, Floats]:
        """Return the skin at rest, ``neutral``, and in every expression, (v, 3), mm."""
        return {
            "neutral": self.model.skin.vertices,
            **{fit.name: fit.skin for fit in self.expressions},
        }

    def known_figures(self) -> dict[str, Any]:
        """Return the figures; raises :class:`InputError` (``export.figures``) if there are none."""
        if self.figures is None:
            message = "the rig has no figures: its report.json is not beside it"
            raise InputError("export.figures", message)
        return self.figures

    def expression(self, name: str) -> ExpressionFit:
        """Return the expression of a name; raises :class:`InputError` (``rig.expression``)."""
        known = {fit.name: fit for fit in self.expressions}
        if name not in known:
            message = f"the rig has no expression {quote(name)}"
            raise InputError("rig.expression", message, expected=sorted(known), found=quote(name))
        return known[name]

    def save(self, path: Path | str) -> None:
        """Write ``rig.npz``: lengths in mm, surfaces and errors in single precision."""
        model = self.model.archive()
        header = {
            "format": FORMAT,
            "model": model.header,
            "seconds": self.seconds,
            "notices": [notice.as_dict() for notice in self.notices],
            "figures": self.figures,
            "drive": store(self.drive),
            "systems": {name: {"shapes": each.shapes} for name, each in self.systems.items()},
        }
        parts = {
            "model": model.arrays,
            "weights": _weight_arrays(self.weights, self.model),
            "activations": _expression_arrays(self.expressions, self.model),
            **{
                f"system_{name}": _system_arrays(each, self.model)
                for name, each in self.systems.items()
            },
        }
        arrays = {
            f"{part}_{name}": array for part, held in parts.items() for name, array in held.items()
        }
        Archive(header, arrays).write(path)

    def show(self, height: int = 640) -> Any:
        """Return the rig for a notebook to show, ``height`` pixels high."""
        # exporters are imported when they are asked for: they read rigs
        return import_module("solver.rig.exporters.view").notebook(self, height)

    def save_as_0_1(self, folder: Path) -> list[Path]:
        """Write ``muscle_weights.npz`` and ``activations.npz``, for programs that read those."""
        parts = {
            folder / FILES_OF_0_1["weights"]: _weight_arrays(self.weights, self.model),
            folder / FILES_OF_0_1["rig"]: _expression_arrays(self.expressions, self.model),
        }
        for path, arrays in parts.items():
            np.savez_compressed(path, allow_pickle=False, **arrays)
        return list(parts)

    @classmethod
    def load(cls, files: Path | str | Mapping[str, Path]) -> Rig:
        """Read a rig: its ``rig.npz``, folder or downloaded ZIP, or a job's files by their roles.

        Raises :class:`InputError`: ``rig.unreadable`` for what is no rig, ``rig.format``,
        ``rig.model`` for files of 0.1 that are not of one model, and as :meth:`SubjectModel.load`.
        """
        given = find_files(Path(files)) if isinstance(files, Path | str) else files
        if "weights" in given:
            return cls._load_0_1(given)
        path = given["rig"]
        archive = Archive.read(path, "rig", "a rig", FORMAT, inside=FILE)
        if "model" not in archive.header:
            raise _no_rig(path)
        with _reading(path):
            model = SubjectModel.from_archive(archive.part("model"))
            header = archive.header
            rig = cls(
                model,
                _weights_from(with_prefix(archive.arrays, "weights_"), model, path),
                _expressions_from(with_prefix(archive.arrays, "activations_"), model, path),
                header["seconds"],
                tuple(Finding.from_dict(each) for each in header["notices"]),
                header["figures"],
                systems={
                    name: _system_from(
                        about, with_prefix(archive.arrays, f"system_{name}_"), model, path
                    )
                    for name, about in dict(header.get("systems", {})).items()
                },
            )
            drive = restore(header["drive"]) if "drive" in header else rig._find_drive()
            return replace(rig, drive=drive)

    @classmethod
    def _load_0_1(cls, files: Mapping[str, Path]) -> Rig:
        """Read the files of 0.1; a sequence was fitted without the expressions."""
        weights = files["weights"]
        subject = SubjectModel.load(files["model"])
        expressions: tuple[ExpressionFit, ...] = ()
        with _reading(weights):
            S = _weights_from(read_arrays(weights), subject, weights)
        if (path := files.get("rig")) is not None:
            with _reading(path):
                expressions = _expressions_from(read_arrays(path), subject, path)
        figures = None
        if (report := files.get("report")) is not None:
            with _reading(report):
                figures = json.loads(report.read_text(encoding="utf-8"))
        rig = cls(subject, S, expressions, figures=figures)
        return replace(rig, drive=rig._find_drive())

    def _find_drive(self) -> MuscleDrive:
        """Return the drive of a rig made before it was kept, by its training expressions."""
        trained = [fit for fit in self.expressions if fit.role == "train"]
        if not trained:
            return SixNumbers()
        drive = Admissible()
        size = volumes(self.model.rest, self.model.tets)
        admissible = drive.feasible(self.model, size, self.weights)
        inside = all(admissible.contains(fit.activations) for fit in trained)
        return drive if inside else SixNumbers()


def find_files(rig: Path) -> dict[str, Path]:
    """Return the files of a rig by their roles in a job: its ``rig.npz``, else those of 0.1.

    ``rig`` is the file, a ZIP with it or a folder. Raises :class:`InputError` (``rig.unreadable``).
    """
    if not rig.is_dir():
        return {"rig": rig}
    if (rig / FILE).exists():
        return {"rig": rig / FILE}
    found = {role: rig / name for role, name in FILES_OF_0_1.items() if (rig / name).exists()}
    if not found.keys() >= FILES_OF_0_1.keys() - {"report"}:
        raise _no_rig(rig)
    return found


# The arrays of S and of the expressions: those of the files of 0.1, and prefixed in rig.npz.


def _weight_arrays(weights: sp.csr_array, model: SubjectModel) -> Arrays:
    """Return S as CSR, explicit zeros kept."""
    return {
        "format": np.array(FORMAT),
        "muscles": np.array(model.muscle_names, dtype=np.str_),
        "model": np.array(_model_hash(model)),
        "data": weights.data,
        "indices": weights.indices,
        "indptr": weights.indptr,
        "shape": np.array(weights.shape),
    }


def _weights_from(data: Arrays, model: SubjectModel, path: Path) -> sp.csr_array:
    _check_format(path, data)
    if str(data["model"]) != _model_hash(model):
        raise _other_model(path)
    parts = (data["data"], data["indices"], data["indptr"])
    return sp.csr_array(parts, shape=tuple(data["shape"].tolist()))


def _model_hash(model: SubjectModel) -> str:
    """Return the sha256 of what S depends on: the tets at rest and the muscles' names."""
    digest = hashlib.sha256("\n".join(model.muscle_names).encode())
    digest.update(np.ascontiguousarray(model.rest, dtype="<f8").tobytes())
    digest.update(np.ascontiguousarray(model.tets, dtype="<i8").tobytes())
    return digest.hexdigest()


def _expression_arrays(expressions: Sequence[ExpressionFit], model: SubjectModel) -> Arrays:
    muscles = model.muscle_count
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
    trips = [astuple(fit.round_trip or RoundTrip()) for fit in expressions]
    return {
        "format": np.array(FORMAT),
        "muscles": texts(model.muscle_names),
        "names": texts(fit.name for fit in expressions),
        "roles": texts(fit.role for fit in expressions),
        "activations": column("activations", (muscles, 6)),
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


def _expressions_from(data: Arrays, model: SubjectModel, path: Path) -> tuple[ExpressionFit, ...]:
    _check_format(path, data)
    is_same = data["skin"].shape[1:] == model.skin.vertices.shape
    if not is_same or tuple(data["muscles"].tolist()) != model.muscle_names:
        raise _other_model(path)
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


# The arrays of another system: those of expressions, and its own controls.


def _system_arrays(system: System, model: SubjectModel) -> Arrays:
    controls = {
        name: np.reshape([getattr(fit, name) for fit in system.expressions], (-1, size))
        for name, size in _controls(system.shapes, model).items()
    }
    return {**_expression_arrays(system.expressions, model), **controls}


def _system_from(about: Mapping[str, Any], data: Arrays, model: SubjectModel, path: Path) -> System:
    shapes = tuple(about["shapes"])
    controls = _controls(shapes, model)
    for name, size in controls.items():
        if data[name].shape != (len(data["names"]), size):
            raise ValueError(f"{name} are {data[name].shape}")
    fits = [
        SystemFit(**vars(fit), **{name: data[name][k] for name in controls})
        for k, fit in enumerate(_expressions_from(data, model, path))
    ]
    return System(shapes, tuple(fits))


def _controls(shapes: tuple[str, ...], model: SubjectModel) -> dict[str, int]:
    """Return how many numbers each control of an expression has, in the order of its arrays."""
    return {"weights": len(shapes), "jaw_on_top": JAW_FREEDOM, "lengths": model.muscle_count}


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    try:
        yield
    except InputError:
        raise
    except (LookupError, TypeError, ValueError) as error:
        message = f"{path.name} is not part of a rig: {error}"
        raise InputError("rig.unreadable", message, file=path.name) from error


def _check_format(path: Path, data: dict[str, np.ndarray]) -> None:
    if (found := int(data["format"])) != FORMAT:
        message = f"{path.name} has rig format {found}, not {FORMAT}"
        raise InputError("rig.format", message, file=path.name, expected=FORMAT, found=found)


def _other_model(path: Path) -> InputError:
    message = f"{path.name} belongs to a rig of another subject model"
    return InputError("rig.model", message, file=path.name)


def _no_rig(path: Path) -> InputError:
    message = (
        f"{path.name} is no rig: a rig is its {FILE}, a ZIP or folder with it, or a folder with "
        "model.npz, muscle_weights.npz and activations.npz"
    )
    return InputError("rig.unreadable", message, file=path.name)
