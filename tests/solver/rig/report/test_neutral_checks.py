"""A neutral that smiles, or has parted teeth, is told by what all expressions ask for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from solver.fitting.face import Face
from solver.model import SubjectModel
from solver.rig import ExpressionFit
from solver.rig.report.measures import check_neutral
from tests.solver.block import block_model
from tests.solver.rig.report.test_web_page import fit


def smiling_model() -> SubjectModel:
    names = ("zygomaticus_major_l", "zygomaticus_major_r")
    model = replace(block_model(), muscle_names=names)
    return replace(model, fibres=np.tile([1.0, 0.0, 0.0], (len(model.weights.data), 1)))


def fits(face: Face, stretches: list[float], jaw: float = 0.0) -> list[ExpressionFit]:
    """Return a fit for each stretch of the muscles' fibres, with an angle of the jaw."""
    found = []
    for number, stretch in enumerate(stretches):
        pose = np.tile([stretch, 0.0, 0.0, stretch**-0.5, 0.0, stretch**-0.5], (2, 1))
        one = fit(face, f"expression {number}", 0.2)
        found.append(replace(one, activations=pose, jaw=np.array([jaw, 0.0, 0.0, 0.0, 0.0])))
    return found


def test_muscles_that_smile_and_lengthen_in_most_expressions() -> None:
    face = Face(smiling_model())
    asked = [1.05, 1.05, 0.99, 1.04, 1.05]
    (finding,) = check_neutral(face, fits(face, asked))
    assert finding.code == "neutral.smiles"
    assert "AU 12 (lip corner puller)" in finding.message
    assert finding.context["expressions"] == [f"expression {k}" for k in (0, 1, 3, 4)]
    # a person who smiles more than at rest, lengthens them seldom, or shows too little
    for others in ([*asked[:4], 0.8], [1.05, 1.05, 1.0, 1.0, 1.0], asked[:4]):
        assert check_neutral(face, fits(face, others)) == []


def test_a_jaw_that_closes_beyond_rest_in_most_expressions() -> None:
    face = Face(smiling_model())
    closing = fits(face, [0.9] * 5, jaw=-0.3)
    still = fits(face, [0.9] * 5)
    (finding,) = check_neutral(face, closing)
    assert finding.code == "neutral.parted_teeth"
    assert finding.context["mm"] > 3.0
    assert check_neutral(face, [*closing[:2], *still[2:]]) == []


def test_rows_of_teeth_that_are_apart() -> None:
    model = smiling_model()
    for apart, codes in ((1.0, []), (4.0, ["neutral.parted_teeth"])):
        vertices = model.skin.vertices.copy()
        vertices[1] = vertices[0] + [0.0, -apart, 0.0]
        teeth = {"upper_teeth": np.array([0]), "lower_teeth": np.array([1])}
        regions = {**model.regions, **teeth}
        face = Face(replace(model, skin=model.skin.with_vertices(vertices), regions=regions))
        assert [finding.code for finding in check_neutral(face, [])] == codes
