"""The forward problem: activations and jaw in, equilibrium out; and how both grow with the mesh."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import scipy.sparse as sp

from benchmarks.documents import Figures
from benchmarks.speed.clock import Stopwatch
from benchmarks.speed.solvers import COARSE_W_A, CONVERGED
from solver.fitting import activation, standard
from solver.fitting.face import Face, Pose
from solver.fitting.objective import Target
from solver.fitting.terms import SkinDistance
from solver.model import SubjectModel

NEIGHBOUR = 0.95
"""Part of the way from rest to an expression: where the warm start of that expression is."""


def forward(face: Face, S: sp.csr_array, poses: Mapping[str, Pose]) -> list[Figures]:
    """Simulate every pose cold, from the resting face, and warm, from 95 % of the pose."""
    rest = face.rest_state(S)
    found = []
    for name, pose in poses.items():
        with Stopwatch() as cold:
            settled = face.move(S, rest, pose)
        near = face.move(S, rest, rest.pose.toward(pose, NEIGHBOUR))
        with Stopwatch() as warm:
            again = face.move(S, near, pose)
        found.append(
            {
                "name": name,
                "cold_seconds": cold.seconds,
                "warm_seconds": warm.seconds,
                "iterations": settled.equilibrium.iterations,
                "difference_mm": float(np.abs(settled.x - again.x).max()),
                "inverted": face.flesh.inverted(settled.x),
            }
        )
    return found


def scaling(models: Mapping[float, SubjectModel], skin: Any, repeats: int) -> list[Figures]:
    """Fit one expression, ``skin`` (V, 3), on meshes of several sizes and simulate what was found.

    S is every model's geometric one and the prior that of the comparison with IPOPT, so that all
    solve the same problem as nearly as meshes can: with a lighter prior the steps that a fit takes
    tell how it is conditioned, not how large it is. Times are the medians of ``repeats``.
    """
    found = []
    for edge, model in models.items():
        face, S = Face(model), model.weights
        regulariser = replace(standard.unseen_regulariser(face), w_a=COARSE_W_A)
        rest = face.rest_state(S)
        data = SkinDistance(face, Target.from_points(skin[model.face]))
        fits, moves = [], []
        for _ in range(repeats):
            with Stopwatch() as watch:
                fitted = activation.fit(face, S, data, regulariser, rest, CONVERGED)
            fits.append(watch.seconds)
        for _ in range(repeats):
            with Stopwatch() as watch:
                face.move(S, rest, fitted.state.pose)
            moves.append(watch.seconds)
        found.append(
            {
                "edge_mm": edge,
                "vertices": len(model.rest),
                "tets": len(model.tets),
                "activation_seconds": float(np.median(fits)),
                "activation_iterations": fitted.iterations,
                "forward_seconds": float(np.median(moves)),
            }
        )
    return found
