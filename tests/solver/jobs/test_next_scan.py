"""The job that says what to scan next: the side that no scan has moved, in words."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from solver.anatomy.template import ShapeBasis
from solver.errors import InputError
from solver.fitting import activation
from solver.fitting.drives.admissible import Admissible
from solver.fitting.drives.six_numbers import SixNumbers
from solver.fitting.expression_basis import ExpressionBasis
from solver.fitting.face import Face, Pose, PosedFace
from solver.fitting.geometry_information import Linearisation, Misfit
from solver.jobs import next_scan, run_job
from solver.mechanics.flesh import IDENTITY
from solver.progress import Step
from solver.rig import ExpressionFit, Rig
from solver.rig.next_scan import library_targets
from tests.solver.block import head_block, thinner

MODEL = head_block((7, 5, 1))
PULL = np.array([0.75, 0.02, 0.0, 1.15, 0.0, 1.15])


@pytest.fixture(scope="module")
def fits() -> dict[str, ExpressionFit]:
    """One muscle at a time, and an open jaw, of somebody whose right muscle fills less flesh."""
    face = Face(MODEL).with_weights(thinner(MODEL.weights, 2))
    found = {}
    for name, muscles, hinge in (("Left", (0,), 0.0), ("Right", (1,), 0.0), ("jaw", (), 0.1)):
        a = np.tile(IDENTITY, (2, 1))
        a[list(muscles)] = PULL
        b = np.array([hinge, 0.0, 0.0, 0.0, 0.0])
        x = face.continuation(face.rest, Pose(a, b)).x
        skin = face.whole_skin(x, b)
        error = np.zeros(len(skin))
        found[name] = ExpressionFit(name, "train", a, b, skin, skin, error, 0, 1, 0.0, 0.0, x)
    return found


def basis(fits: dict[str, ExpressionFit], names: dict[str, str]) -> ShapeBasis:
    shapes = np.array([fits[name].skin - MODEL.skin.vertices for name in names.values()])
    none = np.zeros((0, *shapes.shape[1:]), np.float32)
    return ShapeBasis(none, shapes.astype(np.float32), tuple(names))


def test_the_muscle_whose_s_is_wrong_is_proposed(
    tmp_path: Path, fits: dict[str, ExpressionFit], monkeypatch: pytest.MonkeyPatch
) -> None:
    names = {"mouthSmileLeft": "Left", "mouthSmileRight": "Right", "jawOpen": "jaw"}
    shapes = basis(fits, names)
    shapes.expressions[0] *= 0.3  # a smile of the right side above all
    template = SimpleNamespace(shapes=shapes)
    monkeypatch.setattr(next_scan, "read_template", lambda _: template)
    Rig(MODEL, MODEL.weights, (fits["Left"],)).save(tmp_path / "rig.npz")
    steps: list[Step] = []
    options = {"count": 2}
    [file] = run_job(
        "next_scan", tmp_path, options=options, rig=tmp_path / "rig.npz", progress=steps.append
    )
    found = json.loads(file.read_text())
    assert found["words"] == "Shoot next: lip corner pull on the right, then jaw dropped"
    smile, jaw = found["next"]
    assert (smile["shape"], smile["side"], smile["facs"]) == ("mouthSmile", "right", "AU 12")
    assert smile["gain_mm"] > 3 * jaw["gain_mm"]
    assert found["expected_mm"] == pytest.approx(smile["expected_mm"] + smile["gain_mm"], abs=1e-3)
    assert list(found["library"]) == ["mouthSmile", "jawOpen"]
    muscles = found["information"]["muscles"]
    assert muscles["left"] > 0.3
    assert muscles["right"] == pytest.approx(0.0, abs=1e-3)
    fractions = [step.fraction for step in steps]
    assert fractions == sorted(fractions)


def test_a_basis_that_a_job_left_leads_to_the_same_words(
    tmp_path: Path, fits: dict[str, ExpressionFit], monkeypatch: pytest.MonkeyPatch
) -> None:
    names = {"mouthSmileLeft": "Left", "mouthSmileRight": "Right", "jawOpen": "jaw"}
    shapes = basis(fits, names)
    monkeypatch.setattr(next_scan, "read_template", lambda _: SimpleNamespace(shapes=shapes))
    face = Face(MODEL)
    rig = tmp_path / "rig.npz"
    kept = tmp_path / "expression_basis.npz"
    Rig(MODEL, MODEL.weights, (fits["Left"],)).save(rig)
    ExpressionBasis.solve(face, shapes.expressions).save(kept, face)
    descend = activation.descend
    begun = []

    def look(*given: Any, **how: Any) -> activation.ActivationFit:
        begun.append(given[3].pose.vector())
        return descend(*given, **how)

    monkeypatch.setattr(activation, "descend", look)
    [file] = run_job("next_scan", tmp_path / "rest", rig=rig)
    rest = len(begun)
    assert np.all(begun == face.layout.rest)
    [near] = run_job("next_scan", tmp_path / "near", rig=rig, expression_basis=kept)
    assert all(np.abs(q - face.layout.rest).max() > 1e-3 for q in begun[rest:])
    one, other = (json.loads(each.read_text()) for each in (file, near))
    assert one["words"] == other["words"]
    assert list(one["library"]) == list(other["library"])


def test_the_library_of_a_rig_within_limits_is_within_them(
    tmp_path: Path, fits: dict[str, ExpressionFit], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A smile that lengthens the muscle to 1.15, as it does across its fibres alone."""
    along = np.zeros((MODEL.weights.nnz, 3), np.float32)
    along[MODEL.weights.indices > 0] = [0.0, 1.0, 0.0]
    model = replace(MODEL, fibres=along)
    drive = Admissible()
    template = SimpleNamespace(shapes=basis(fits, {"mouthSmileLeft": "Left"}))
    monkeypatch.setattr(next_scan, "read_template", lambda _: template)
    limits = Face(model).driven_as(drive).layout.bounds.feasible
    assert limits is not None
    seen: list[np.ndarray] = []
    misfit = Linearisation.misfit

    def look(
        self: Linearisation, state: PosedFace, points: np.ndarray, seen_of: Any = None
    ) -> Misfit:
        if seen_of is None:  # no scan of the rig's
            seen.append(state.pose.a)
        return misfit(self, state, points, seen_of)

    monkeypatch.setattr(Linearisation, "misfit", look)
    for how in (SixNumbers(), drive):
        Rig(model, model.weights, (fits["Left"],), drive=how).save(tmp_path / "rig.npz")
        run_job("next_scan", tmp_path / how.__class__.__name__, rig=tmp_path / "rig.npz")
    free, *_, within = seen
    assert not limits.contains(free)
    assert limits.contains(within)


def test_a_template_of_other_names_is_refused(fits: dict[str, ExpressionFit]) -> None:
    with pytest.raises(InputError) as error:
        library_targets(MODEL, basis(fits, {"eyeLookUpLeft": "Left"}))
    assert error.value.code == "next_scan.no_shapes"


def test_both_sides_are_the_sum_of_their_motions(fits: dict[str, ExpressionFit]) -> None:
    names = {"browDownLeft": "Left", "browDownRight": "Right", "mouthLeft": "jaw"}
    found = library_targets(MODEL, basis(fits, names))
    assert set(found) == {"browDown", "mouthLeft"}
    neutral = MODEL.skin.vertices[MODEL.face]
    sides = [fits[name].skin[MODEL.face] - neutral for name in ("Left", "Right")]
    assert np.allclose(found["browDown"]["both"], neutral + sum(sides), atol=1e-4)
