"""Fibre muscles: one activation each, from 0, relaxed, to 1, of fibres that also resist.

(Sifakis, Neverov, Fedkiw 2005; :mod:`solver.mechanics.fibre_muscle`.)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import scipy.sparse as sp
from typing_extensions import override

from solver.fitting.controls import Block, Spread
from solver.fitting.drives import ContractionMap, MuscleDrive
from solver.fitting.drives.six_numbers import ACTIVATION_REACH
from solver.fitting.tet_forces import MatrixRates, MuscleRates, TetForces
from solver.mechanics.fibre_muscle import CURVE, Curve, FibreMuscles, driven_by_muscles
from solver.mechanics.flesh import Flesh
from solver.model import SubjectModel
from solver.surface import Floats


@dataclass(frozen=True)
class FibreDrive(MuscleDrive, name="fibres"):
    """The activations (m,) of fibre ``muscles``."""

    muscles: FibreMuscles
    curve: Curve = CURVE

    @override
    def block(self, model: SubjectModel, flesh: Flesh, S: sp.csr_array) -> Block:
        return Block(
            "fibres",
            np.zeros(len(self.muscles.strengths)),
            reach=ACTIVATION_REACH,
            lower=0.0,
            upper=1.0,
            spread=Spread(template=0.1, scans=0.1, nothing=0.3),
            role="muscles",
        )

    @override
    def attach(self, flesh: Flesh) -> Flesh:
        return driven_by_muscles(flesh, self.muscles, self.curve)

    @override
    def controls(self, S: sp.csr_array, a: Floats) -> Floats:
        return a

    @override
    def rates(self, forces: TetForces) -> MuscleRates:
        return MatrixRates(forces.flesh.forces_by_control(forces.x, forces.controls))

    @override
    def contraction_map(
        self, model: SubjectModel, volumes: Floats, S: sp.csr_array
    ) -> ContractionMap:
        muscles = self.muscles
        count = len(self.muscles.strengths)
        flesh = np.bincount(muscles.muscles, muscles.fractions * volumes[muscles.tets], count)
        return ContractionMap(np.ones((count, 1)), np.asarray(flesh, np.float64))

    @override
    def settings(self) -> dict[str, Any]:
        muscles = self.muscles
        arrays = {each.name: getattr(muscles, each.name).tolist() for each in fields(muscles)}
        return {"muscles": arrays, "curve": self.curve._asdict()}

    @override
    @classmethod
    def restored(
        cls, settings: Mapping[str, Any], model: SubjectModel, S: sp.csr_array
    ) -> FibreDrive:
        arrays = {name: np.asarray(values) for name, values in settings["muscles"].items()}
        muscles = FibreMuscles(**arrays)
        entries = len(muscles.tets)
        numbers = (
            (muscles.tets, entries, len(model.tets)),
            (muscles.muscles, entries, len(muscles.strengths)),
            (muscles.sources, len(muscles.strengths), model.muscle_count),
        )
        for which, count, most in numbers:
            if which.shape != (count,) or not np.isin(which, np.arange(most)).all():
                raise ValueError("they are not of the model's tets and muscles")
        if muscles.fractions.shape != (entries,) or muscles.fibres.shape != (entries, 3):
            raise ValueError("its arrays do not fit each other")
        return cls(muscles, Curve(**settings["curve"]))
