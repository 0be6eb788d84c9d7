"""One fit of shapes: of persons or expressions to a surface, of all together to samples."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from solver.meshio.raw import RawScan
from solver.registration.locate import face_surface
from solver.registration.scan_surface import sample, scan_surface
from solver.registration.shape_fit import (
    LIKENESS,
    ShapeModel,
    expression_model,
    find_correspondences,
    fit_shapes,
    full_model,
    identity_model,
    match_samples,
)
from solver.registration.topology import topology
from solver.similarity import small_motion
from solver.surface import vertex_areas
from solver.templates.builtin.build import builtin_template

pytestmark = pytest.mark.long
MOVED = small_motion(np.array([0.02, -0.02, 0.01, 2.0, -1.0, 1.5]))


@pytest.mark.parametrize("kind", ["persons", "expressions", "anybody"])
def test_a_face_of_known_weights_is_found(kind: str) -> None:
    template = builtin_template()
    skin = template.skin
    basis = template.shapes
    known = topology(template)
    assert basis is not None
    face = face_surface(template)
    shapes: ShapeModel = {
        "persons": lambda: identity_model(known, basis),
        "expressions": lambda: expression_model(skin.vertices, known, basis),
        "anybody": lambda: full_model(skin.vertices, face, basis),
    }[kind]()
    rng = np.random.default_rng(3)
    weights = 0.5 * rng.standard_normal(len(shapes.prior)) * ~shapes.bounded
    weights[np.flatnonzero(shapes.bounded)[:1]] = 0.8
    truth = shapes.at(weights)
    there = MOVED.inverse()(truth)
    if kind == "anybody":
        area = vertex_areas(skin.vertices, face.faces)[shapes.used]
        match = match_samples(sample(there, face.faces, None, 60_000), area)
        fit = fit_shapes(match, small_motion(np.zeros(6)), shapes, options=LIKENESS, sizes=True)
    else:
        raw = RawScan("a.obj", there, skin.faces, None, None, None, "obj", "obj")
        match = partial(find_correspondences, scan_surface(raw, 1.0))
        fit = fit_shapes(match, small_motion(np.zeros(6)), shapes, sizes=False)
    away = np.linalg.norm(fit.vertices - truth, axis=1)[np.unique(face.faces)]
    assert away.mean() < 0.8
    assert fit.weights[shapes.bounded].min(initial=0.0) >= 0
    assert fit.weights[shapes.bounded].max(initial=0.0) <= 1.2
