"""The scaling: what every mesh is given, and what is counted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.speed import forward
from solver.fitting.face import Face, Pose
from solver.templates.tables import CaptureSet
from tests.solver.block import block_model, poses


def test_one_mesh_twice_costs_the_same_steps() -> None:
    model = block_model()
    face = Face(model)
    scans = {}
    for number, pose in enumerate(poses(2)):
        state = face.continuation(face.rest, pose)
        vertices = face.whole_skin(state.x, pose.b)
        scans[f"expression {number}"] = replace(model.skin, vertices=vertices)
    captures = CaptureSet(model.skin, {}, scans)
    models = {2.0: model, 1.0: block_model()}
    plausible = {"one": Pose(0.5 * (poses(1)[0].a + face.rest_pose().a), np.zeros(5))}
    sizes = forward.scaling(models, captures, list(scans), plausible, common=1.0)
    assert {size["edge_mm"] for size in sizes} == {1.0, 2.0}
    for count in ("vertices", "activation_iterations", "forward_factors"):
        assert sizes[0][count] == sizes[1][count]
    for size in sizes:
        assert min(size["activation_iterations"]) > 1
        assert set(size["forward_factors"]) == {"one", *scans}
        assert min(size["forward_seconds"], size["forward_fitted_seconds"]) > 0.0
        assert size["free_vertices"] < size["vertices"]
        assert size["activation_iteration_seconds"] < size["activation_seconds"]
