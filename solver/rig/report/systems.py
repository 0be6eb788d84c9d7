"""A rig's systems side by side: what each comes to in every expression."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from solver.anatomy.tetrahedra import volumes
from solver.contact.crossing import crossing
from solver.contact.mouth import Mouth
from solver.fitting.contraction import Contraction
from solver.fitting.stretches import matrices
from solver.model import SubjectModel
from solver.rig.expression import ExpressionFit
from solver.rig.report.measures import distances, rounded
from solver.rig.rig import Rig
from solver.rig.system import ShapeFit, TetFit
from solver.surface import Floats, Ints

SYSTEMS = {"S": "muscles", "P": "single tets", "T": "muscle tracks", "B": "plain shapes"}


@dataclass(frozen=True)
class SystemOptions:
    """Controls that count."""

    counts: float = 0.05  # from this part of its range on, that of a weight or of a contraction


@dataclass(frozen=True)
class LipFlesh:
    """The flesh of the lips, whose volume no expression changes in a living face."""

    tets: Ints  # (k, 4)
    rest_mm3: float

    @classmethod
    def of(cls, model: SubjectModel, within_mm: float = 5.0) -> LipFlesh | None:
        """Return the tets whose middles are near the lips' skin; None in a model without lips."""
        lips = np.concatenate([model.region("upper_lip"), model.region("lower_lip")])
        if not len(lips):
            return None
        away, _ = cKDTree(model.skin.vertices[lips]).query(model.tet_centres)
        tets = model.tets[away < within_mm]
        return cls(tets, float(volumes(model.rest, tets).sum())) if len(tets) else None

    def change(self, x: Floats) -> float:
        """Return the change of the volume at x (p, 3), a part of that at rest."""
        return float(volumes(x, self.tets).sum() / self.rest_mm3 - 1.0)


@dataclass(frozen=True)
class SystemMeasures:
    """Measures fits of one model, of muscles or of shapes."""

    model: SubjectModel
    lips: LipFlesh | None
    mouth: Mouth | None
    contraction: Contraction
    options: SystemOptions = SystemOptions()

    @classmethod
    def of(cls, rig: Rig) -> SystemMeasures:
        """Return what measures the systems of a rig."""
        model = rig.model
        sizes = volumes(model.rest, model.tets)
        contraction = Contraction.of(model, sizes, rig.weights)
        return cls(model, LipFlesh.of(model), Mouth.of(model), contraction)

    def figures(self, fit: ExpressionFit) -> dict[str, Any]:
        """Return the figures of one fit as JSON values; None is what is not known."""
        error = fit.measured_error(self.model.face)
        lips = None if self.lips is None or fit.x is None else 1e2 * self.lips.change(fit.x)
        controls = self._controls(fit)
        return {
            **distances(error),
            "lip_volume_percent": None if lips is None else rounded(lips),
            "crossing_mm": self.mouth and rounded(crossing(self.mouth, fit.skin).lips),
            "inverted": fit.inverted,
            "controls": len(controls),
            "controls_used": int((np.abs(controls) > self.options.counts).sum()),
            "iterations": fit.iterations,
            "seconds": round(fit.seconds, 3),
            "status": fit.status,
            "round_trip_mm": fit.round_trip and rounded(fit.round_trip.skin_mean_mm),
            "warnings": [notice.as_dict() for notice in fit.notices],
        }

    def _controls(self, fit: ExpressionFit) -> Floats:
        """Return weights (K,) of shapes, or contractions of muscles that have fibres.

        Of a tet it is what the direction gains or loses that its activation changes most.
        """
        if isinstance(fit, ShapeFit):
            return fit.weights
        if isinstance(fit, TetFit):
            stretches = np.linalg.eigvalsh(matrices(fit.tet_activations))
            return np.asarray(np.abs(stretches - 1.0).max(axis=1))
        found = self.contraction(fit.activations)
        return np.asarray(found[np.isfinite(found)])


def system_figures(rig: Rig) -> dict[str, dict[str, Any]]:
    """Return expression -> system -> figures; nothing where there are only muscles."""
    if not rig.systems:
        return {}
    measures = SystemMeasures.of(rig)
    found = dict[str, dict[str, Any]]()
    for system, fits in rig.fits_by_system.items():
        for fit in fits:
            found.setdefault(fit.name, {})[system] = measures.figures(fit)
    return found
