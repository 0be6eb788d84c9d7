"""A rig: a fitted person, self-contained in one file ``rig.npz``."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import scipy.sparse as sp

from solver.errors import Finding, InputError
from solver.model import SubjectModel
from solver.rig.result import (
    ExpressionFit,
    activation_arrays,
    load_activations,
    load_weights,
    weight_arrays,
)
from solver.storage import Archive

FORMAT = 1  # of rig.npz
FILE = "rig.npz"


@dataclass(frozen=True)
class Rig:
    """Everything a fit hands over.

    ``weights`` (n, m + 1) is the final S, ``seconds`` the time of each phase of the job,
    ``notices`` what was odd about the model or the job as a whole, ``figures`` the rig's
    :func:`~solver.rig.report.report`; None before it is made.
    """

    model: SubjectModel
    weights: sp.csr_array
    expressions: tuple[ExpressionFit, ...]
    seconds: dict[str, float] = field(default_factory=dict)
    notices: tuple[Finding, ...] = ()
    figures: dict[str, Any] | None = None

    def save(self, path: Path) -> None:
        """Write ``rig.npz``: the model, S and the expressions, without pickles."""
        model = self.model.archive()
        header = {
            "format": FORMAT,
            "model": model.header,
            "seconds": self.seconds,
            "notices": [notice.as_dict() for notice in self.notices],
            "figures": self.figures,
        }
        parts = {
            "model": model.arrays,
            "weights": weight_arrays(self.weights, self.model),
            "activations": activation_arrays(self.expressions, self.model),
        }
        arrays = {
            f"{part}_{name}": array for part, held in parts.items() for name, array in held.items()
        }
        Archive(header, arrays).write(path)

    def known_figures(self) -> dict[str, Any]:
        """Return the figures; raises :class:`InputError` (``export.figures``) if there are none."""
        if self.figures is None:
            raise InputError(
                "export.figures", "the rig has no figures: its report.json is not beside it"
            )
        return self.figures

    @classmethod
    def load(cls, path: Path) -> Rig:
        """Read a rig: its ``rig.npz``, or a folder with it or with the four files of 0.1.

        These are ``model.npz``, ``muscle_weights.npz``, ``activations.npz`` and, if it is there,
        ``report.json``. Raises :class:`InputError` as their readers, ``rig.unreadable`` for what is
        no rig.
        """
        if path.is_dir() and not (path / FILE).exists():
            return cls._load_folder(path)
        file = path / FILE if path.is_dir() else path
        archive = Archive.read(file, "rig", "a rig", FORMAT)
        if "model" not in archive.header:
            raise _no_rig(file)
        model = SubjectModel.load(file)
        return cls(
            model,
            load_weights(file, model),
            load_activations(file, model),
            archive.header["seconds"],
            tuple(Finding.from_dict(each) for each in archive.header["notices"]),
            archive.header["figures"],
        )

    @classmethod
    def _load_folder(cls, folder: Path) -> Rig:
        for name in ("model.npz", "muscle_weights.npz", "activations.npz"):
            if not (folder / name).exists():
                raise _no_rig(folder)
        model = SubjectModel.load(folder / "model.npz")
        figures = folder / "report.json"
        return cls(
            model,
            load_weights(folder / "muscle_weights.npz", model),
            load_activations(folder / "activations.npz", model),
            figures=json.loads(figures.read_text(encoding="utf-8")) if figures.exists() else None,
        )


def _no_rig(path: Path) -> InputError:
    return InputError(
        "rig.unreadable",
        f"{path.name} is no rig: a rig is its {FILE}, or a folder with model.npz, "
        "muscle_weights.npz and activations.npz",
        file=path.name,
    )
