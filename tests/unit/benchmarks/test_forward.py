"""The scaling: what every mesh is given, and what is counted."""

from __future__ import annotations

from dataclasses import replace

from benchmarks.speed import forward
from solver.anatomy.capture_set import CaptureSet
from solver.fitting.face import Face
from tests.unit.solver.block import block_model, poses


def test_one_mesh_twice_costs_the_same_steps() -> None:
    model = block_model()
    face = Face(model)
    scans = {}
    for number, pose in enumerate(poses(2)):
        state = face.move(model.weights, face.rest_state(model.weights), pose)
        vertices = face.whole_skin(state.x, pose.b)
        scans[f"expression {number}"] = replace(model.skin, vertices=vertices)
    captures = CaptureSet(model.skin, {}, scans)
    sizes = forward.scaling({2.0: model, 1.0: block_model()}, captures, list(scans), common=1.0)
    assert {size["edge_mm"] for size in sizes} == {1.0, 2.0}
    for count in ("vertices", "activation_iterations", "forward_factors"):
        assert sizes[0][count] == sizes[1][count]
    for size in sizes:
        assert min(size["activation_iterations"]) > 1
        # the resting face's own at least, and where that does not serve all the way another
        assert min(size["forward_factors"]) >= 1
        assert max(size["forward_factors"]) > 1
        assert size["free_vertices"] < size["vertices"]
        assert size["activation_iteration_seconds"] < size["activation_seconds"]
