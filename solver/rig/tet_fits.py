"""Expressions fitted by activations of single tets: the system P of a rig beside its muscles.

:mod:`solver.fitting.per_tet` has the model, which muscle geometry is compared with.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from solver.errors import SolveError, make_warning
from solver.fitting import per_tet
from solver.fitting.contact import terms
from solver.fitting.face import Face, Pose, PosedFace
from solver.fitting.least_squares import Listener
from solver.fitting.objective import Target
from solver.fitting.per_tet import PER_TET, PerTetOptions, tissue
from solver.fitting.per_tet.tissue import Tissue
from solver.mechanics.flesh import COROTATED_DET, IDENTITY
from solver.meshio.registered import RegisteredScan
from solver.model import SubjectModel
from solver.rig.expression import errors_on_skin, refuse_not_finite
from solver.rig.round_trip import RoundTrip
from solver.rig.system import TetFit
from solver.surface import Floats, Ints


class TetFitter:
    """Fits activations of a model's tets and a jaw to ``targets``, the faces of scans by name."""

    def __init__(
        self,
        model: SubjectModel,
        targets: Mapping[str, Target],
        linear: str | None = None,
        options: PerTetOptions = PER_TET,
    ) -> None:
        self._face = Face(model, material=COROTATED_DET, linear=linear)
        self._tissue = tissue.of_face(self._face)
        self._targets = targets
        self._data = terms(self._face, targets)
        self.options = options

    @property
    def tets(self) -> Ints:
        """The numbers (k,) of the tets with muscle."""
        return self._tissue.active

    def fit(self, name: str, scan: RegisteredScan, listen: Listener | None = None) -> TetFit:
        """Fit a ``scan`` called ``name``, and go to its activations from rest once more.

        Where the flesh finds no way the face stays at rest, and the fit says so.
        """
        begun = time.perf_counter()
        try:
            found = per_tet.fit(self._face, self._data[name], options=self.options, listen=listen)
            refuse_not_finite(name, found.state)
        except (SolveError, np.linalg.LinAlgError) as error:
            notice = make_warning("solve.failed", f"no fit was found ({error})")
            at_rest = self._described(name, scan, self._tissue.face.rest)
            return replace(at_rest, status="failed", notices=(notice,))
        return replace(
            self._described(name, scan, found.state),
            iterations=found.iterations,
            seconds=time.perf_counter() - begun,
            status="converged" if found.status == per_tet.Status.CONVERGED else "stopped",
            round_trip=self._round_trip(found.state),
        )

    def _described(self, name: str, scan: RegisteredScan, state: PosedFace) -> TetFit:
        face = self._tissue.face
        target = self._targets[name]
        points = face.face_points(state.x)
        return TetFit(
            name=name,
            role="test",  # no scan shapes tets
            activations=muscle_means(self._tissue, state.pose.a),
            jaw=face.five_jaw_numbers(state.pose.b),
            skin=face.whole_skin(state.x, state.pose.b),
            target=scan.vertices,
            error_mm=errors_on_skin(face.model, target, points),
            inverted=self._face.flesh.count_inverted(state.x),
            iterations=0,
            seconds=0.0,
            objective=target.value(points),
            x=state.x,
            confidence=scan.confidence,
            tet_activations=state.pose.a,
        )

    def _round_trip(self, found: PosedFace) -> RoundTrip:
        """Return how far the skin is off the fitted one where its activations lead from rest."""
        face = self._tissue.face
        try:
            again = face.continuation(face.rest, Pose(found.pose.a, found.pose.b))
        except (SolveError, np.linalg.LinAlgError):
            return RoundTrip()
        return RoundTrip.between(face.face_points(again.x), face.face_points(found.x))


def muscle_means(tissue: Tissue, a: Floats) -> Floats:
    """Return the means (m, 6) of tets' activations ``a`` (k, 6) over the flesh of each muscle."""
    volumes = np.asarray(tissue.fractions.sum(axis=0))[:, None]
    changes = tissue.fractions.T @ (a - IDENTITY)
    # muscles without flesh stay at rest
    return np.asarray(IDENTITY + changes / np.where(volumes > 0.0, volumes, 1.0))
