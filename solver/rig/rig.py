"""A rig: a fitted person with its expressions, self-contained in one file ``rig.npz``.

docs/reference/rig-format.md has its arrays, and the files of 0.1 that are read for one release.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
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
from solver.mechanics.newton import NewtonOptions
from solver.model import SIZE_WORDS, SubjectModel
from solver.rig.expression import (
    FILE,
    FORMAT,
    ExpressionFit,
    check_format,
    expression_arrays,
    expressions_from,
    other_model,
)
from solver.rig.system import System, read_system
from solver.storage import Archive, Arrays, read_arrays, with_prefix
from solver.surface import Floats

FREE_DRIVE = SixNumbers()
MUSCLES = "S"  # the letter of a rig's own expressions among its systems
# systems by the order in which files show a rig: the first that has expressions
SHOWN_FIRST = (MUSCLES, "T", "B", "P")
# files of a rig of 0.1, by the roles that they have in a job; the report may be missing
FILES_OF_0_1 = {
    "model": "model.npz",
    "weights": "muscle_weights.npz",
    "rig": "activations.npz",
    "report": "report.json",
}


@dataclass(frozen=True)
class FitRound:
    """What a round of the fit of S came to."""

    number: int  # from 1
    # part of the way from the muscles' limits to none, 0 within them; None before they are kept to
    loosened: float | None
    objective: float  # of all training scans, mm^2
    mean_mm: float  # distance over the face and the expressions
    seconds: float


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
    rounds: tuple[FitRound, ...] = ()  # of the fit of S; of older rigs they are not known

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

    @property
    def fits_by_system(self) -> dict[str, tuple[ExpressionFit, ...]]:
        """Return the expressions of every system, by its letter."""
        others = {letter: system.expressions for letter, system in self.systems.items()}
        return {MUSCLES: self.expressions, **others}

    @property
    def default_system(self) -> str:
        """Return the letter of the system that files and pictures show: S if it can be shown."""
        fits = self.fits_by_system
        return next((letter for letter in SHOWN_FIRST if fits.get(letter)), MUSCLES)

    @property
    def shown(self) -> tuple[ExpressionFit, ...]:
        """Return the expressions of the default system."""
        return self.fits_by_system[self.default_system]

    def skins(self) -> dict[str, Floats]:
        """Return the skin at rest, ``neutral``, and as shown in every expression, (v, 3), mm."""
        return {"neutral": self.model.skin.vertices, **{fit.name: fit.skin for fit in self.shown}}

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
            "rounds": [asdict(each) for each in self.rounds],
            "notices": [notice.as_dict() for notice in self.notices],
            "figures": self.figures,
            "drive": store(self.drive),
            "systems": {name: each.header() for name, each in self.systems.items()},
        }
        parts = {
            "model": model.arrays,
            "weights": _weight_arrays(self.weights, self.model),
            "activations": expression_arrays(self.expressions, self.model),
            **{f"system_{name}": each.arrays(self.model) for name, each in self.systems.items()},
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
            folder / FILES_OF_0_1["rig"]: expression_arrays(self.expressions, self.model),
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
                expressions_from(with_prefix(archive.arrays, "activations_"), model, path),
                header["seconds"],
                tuple(Finding.from_dict(each) for each in header["notices"]),
                header["figures"],
                systems={
                    name: read_system(
                        about, with_prefix(archive.arrays, f"system_{name}_"), model, path
                    )
                    for name, about in dict(header.get("systems", {})).items()
                },
                rounds=tuple(FitRound(**each) for each in header.get("rounds", ())),
            )
            if "drive" not in header:
                return replace(rig, drive=rig._find_drive())
            return replace(rig, drive=restore(header["drive"], model, rig.weights))

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
                expressions = expressions_from(read_arrays(path), subject, path)
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
    check_format(path, data)
    if str(data["model"]) != _model_hash(model):
        raise other_model(path)
    parts = (data["data"], data["indices"], data["indptr"])
    S = sp.csr_array(parts, shape=tuple(data["shape"].tolist()))
    S.check_format(full_check=True)
    if S.shape != (wanted := (len(model.tets), model.muscle_count + 1)):
        raise ValueError(f"S has the shape {S.shape}, not {wanted}")
    return S


def _model_hash(model: SubjectModel) -> str:
    """Return the sha256 of what S depends on: the tets at rest and the muscles' names."""
    digest = hashlib.sha256("\n".join(model.muscle_names).encode())
    digest.update(np.ascontiguousarray(model.rest, dtype="<f8").tobytes())
    digest.update(np.ascontiguousarray(model.tets, dtype="<i8").tobytes())
    return digest.hexdigest()


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    try:
        yield
    except InputError:
        raise
    except (LookupError, TypeError, ValueError) as error:
        message = f"{path.name} is not part of a rig: {error}"
        raise InputError("rig.unreadable", message, file=path.name) from error


def _no_rig(path: Path) -> InputError:
    message = (
        f"{path.name} is no rig: a rig is its {FILE}, a ZIP or folder with it, or a folder with "
        "model.npz, muscle_weights.npz and activations.npz"
    )
    return InputError("rig.unreadable", message, file=path.name)
