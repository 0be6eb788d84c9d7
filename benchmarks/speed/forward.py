"""The forward problem: activations and jaw in, equilibrium out; how time grows with the mesh."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from benchmarks.documents import Figures
from benchmarks.speed.clock import Stopwatch
from benchmarks.speed.solvers import CONVERGED, IPOPT_W_A, prepared
from solver.fitting import activation
from solver.fitting.activation import unseen_regulariser
from solver.fitting.face import Face, Pose, PosedFace
from solver.fitting.objective import SkinDistance, Target
from solver.mechanics.linear import Factor, LinearSolver, fastest
from solver.model import SubjectModel
from solver.surface import Floats
from solver.templates.tables import CaptureSet

NEIGHBOUR = 0.95
"""Part of the way from rest to an expression: where the warm start of that expression is."""

PART = 0.5
"""Part of the way from the neutral face to a scan that meshes are compared with."""


def forward(face: Face, poses: Mapping[str, Pose]) -> list[Figures]:
    """Simulate every pose cold, from the resting face, and warm, from 95 % of the pose."""
    rest = face.rest
    found = []
    for name, pose in poses.items():
        with Stopwatch() as cold:
            settled = face.continuation(rest, pose)
        near = face.continuation(rest, rest.pose.toward(pose, NEIGHBOUR))
        with Stopwatch() as warm:
            again = face.continuation(near, pose)
        found.append(
            {
                "name": name,
                "cold_seconds": cold.seconds,
                "warm_seconds": warm.seconds,
                "iterations": settled.equilibrium.iterations,
                "difference_mm": float(np.abs(settled.x - again.x).max()),
                "inverted": face.flesh.count_inverted(settled.x),
            }
        )
    return found


def scaling(
    models: Mapping[float, SubjectModel],
    captures: CaptureSet,
    names: Sequence[str],
    plausible: Mapping[str, Pose],
    common: float,
) -> list[Figures]:
    """Fit the expressions ``names`` on meshes of several sizes, by tets' edge, and simulate them.

    How cost grows with the mesh shows where every mesh solves the same problem. So what is fitted
    is :data:`PART` of the way to the scans, with the prior of the comparison with IPOPT: whole
    expressions with S made by geometry make flesh buckle, differently on every mesh, and with a
    lighter prior the steps tell how a fit is conditioned. What is simulated are ``plausible``
    poses, and beside them (``forward_fitted_seconds``) the poses
    that were fitted on the mesh of edge ``common``, which no muscle could take: they crush single
    tets of the others. All begin with the resting face, which is prepared once.

    Seconds are medians; ``activation_iteration_seconds`` are those of a fit's seconds by iteration.
    """
    poses: dict[str, Pose] = {}
    found = []
    for edge in sorted(models, key=lambda edge: edge != common):
        model = models[edge]
        face = Face(model, linear=fastest())
        regulariser = replace(unseen_regulariser(face), w_a=IPOPT_W_A)
        preparing = prepared(face)
        fits = []
        iterations = []
        for name in names:
            way = captures.test[name].vertices - captures.neutral.vertices
            target = Target.from_points((model.skin.vertices + PART * way)[model.face])
            data = SkinDistance(face, target)
            with Stopwatch() as watch:
                fitted = activation.fit(face, data, regulariser, options=CONVERGED)
            fits.append(watch.seconds)
            iterations.append(fitted.iterations)
            poses.setdefault(name, fitted.state.pose)
        moves, factors = _simulated(face, face.rest, {**plausible, **poses})
        found.append(
            {
                "edge_mm": edge,
                "vertices": len(model.rest),
                "free_vertices": len(face.flesh.free),
                "tets": len(model.tets),
                "prepared_seconds": preparing,
                "activation_seconds": float(np.median(fits)),
                "activation_iterations": iterations,
                "activation_iteration_seconds": float(np.median(np.divide(fits, iterations))),
                "forward_seconds": float(np.median([moves[name] for name in plausible])),
                "forward_fitted_seconds": float(np.median([moves[name] for name in names])),
                "forward_factors": factors,
            }
        )
    return sorted(found, key=lambda size: size["vertices"])


def _simulated(
    face: Face, rest: PosedFace, poses: Mapping[str, Pose]
) -> tuple[dict[str, float], dict[str, int]]:
    """Simulate every pose from rest: seconds and factorisations."""
    face.linear = linear = _Counting(face.linear)
    seconds = {}
    factors = {}
    for name, pose in poses.items():
        linear.count = 0
        with Stopwatch() as watch:
            face.continuation(rest, pose)
        seconds[name] = watch.seconds
        factors[name] = linear.count
    return seconds, factors


def mildest(captures: CaptureSet) -> list[str]:
    """Return the half of the unseen expressions that move the skin least, in mean."""
    neutral = captures.neutral.vertices
    motion = {
        name: float(np.linalg.norm(scan.vertices - neutral, axis=1).mean())
        for name, scan in captures.test.items()
    }
    return sorted(motion, key=motion.__getitem__)[: (len(motion) + 1) // 2]


class _Counting:
    """A linear solver that counts its factorisations."""

    def __init__(self, solver: LinearSolver) -> None:
        self._solver = solver
        self.count = 0

    def factor(self, data: Floats, *, indefinite: bool = False) -> Factor:
        self.count += 1
        return self._solver.factor(data, indefinite=indefinite)
