"""The benchmark of edits, on a block of flesh."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from benchmarks.physics import effects
from benchmarks.physics.section import section
from solver.fitting.face import Face, Pose
from solver.rig import ExpressionFit
from solver.scene.places import Places
from tests.solver.block import head_block


@pytest.fixture(scope="module")
def subject():
    """A block with fibres along x, and an expression that contracts both of its muscles."""
    block = head_block((7, 5, 1))
    fibres = np.tile([1.0, 0.0, 0.0], (block.weights.nnz, 1))
    fibres[block.weights.indices == 0] = 0.0
    model = replace(block, fibres=fibres)
    face = Face(model)
    a = np.array([[0.8, 0.0, 0.0, 1.1, 0.0, 1.1]] * 2)
    b = np.array([0.04, 0.0, 0.0, 0.0, 0.0])
    state = face.continuation(face.rest, Pose(a, b))
    skin = face.whole_skin(state.x, b)
    fit = ExpressionFit("wide", "train", a, b, skin, skin, np.zeros(len(skin)), 0, 1, 0.0, 0.0)
    return effects.Subject(model, model.weights, [fit], Places(model, {}))


def test_edits_are_made_measured_and_drawn(subject, tmp_path):
    people = effects.run(subject, ("fat", "palsy"))
    found = effects.figures(people)
    assert found["fat"]["change_ml"] > 1.0
    assert found["palsy"]["change_ml"] == pytest.approx(0.0, abs=1e-6)
    assert found["palsy"]["drift_mm"]["wide"] > found["fat"]["drift_mm"]["wide"] > 0.0
    told = section({"effects": {"edits": found, "fibres": effects.fibres(subject)}})
    edits, muscles = told.parts
    assert [row[0] for row in edits.rows] == ["fat", "palsy"]
    assert [row[0] for row in muscles.rows] == ["wide"]
    assert all(len(row) == len(table.header) for table in told.parts for row in table.rows)
    effects.sheet(people, tmp_path / "sheet.png")
    assert Image.open(tmp_path / "sheet.png").width == 3 * effects.CELL[0]


def test_fat_of_the_cheeks_shows_there_and_not_on_the_nose(subject):
    x = subject.model.skin.vertices[:, 0]
    parts = {"cheeks": x < 50, "jaw": x < 50, "chin": x < 50, "nose": x > 100}
    regions = {name: np.flatnonzero(part) for name, part in parts.items()}
    model = replace(subject.model, regions=regions)
    person = replace(subject, model=model, fits=[], places=Places(model, {}))
    found = effects.figures(effects.run(person, ("full_cheeks", "palsy")))
    assert found["full_cheeks"]["cheeks_over_nose"] > 2.0
    assert found["palsy"]["cheeks_over_nose"] is None


def test_fibres_are_compared(subject):
    wide = effects.fibres(subject)["wide"]
    assert wide["blended_mm"] < 0.01 * wide["motion_mm"]
    # muscles along x whose cross section is almost the fibre model's: a good fit, if not as good
    assert wide["blended_mm"] < wide["fibre_mm"] < 0.2 * wide["motion_mm"]
    assert wide["fibre_mm"] <= wide["projected_mm"] + 1e-6


def test_every_effect_has_its_scene():
    assert all((effects.SCENES / f"{name}.json").exists() for name in effects.EFFECTS)
