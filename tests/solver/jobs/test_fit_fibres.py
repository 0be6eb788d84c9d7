"""The job that calibrates fibre muscles: what it leaves of a rig's scans, and what it refuses."""

import json

import numpy as np
import pytest

from solver.errors import InputError
from solver.fitting.calibration import FibreShape, load_muscles, with_fibres
from solver.fitting.face import Face, Pose
from solver.jobs import run_job
from solver.mechanics.flesh import IDENTITY, MOONEY_RIVLIN
from solver.rig import ExpressionFit, Rig
from tests.solver.simulation.test_fibres import fibred_block


def expression(face, name, role, a):
    pose = Pose(np.array(a), np.array([0.03, 0.0, 0.0, 0.0, 0.0]), face.layout)
    state = face.continuation(face.rest, pose)
    target = face.whole_skin(state.x, pose.b)
    model = face.model
    error = np.full(len(target), np.nan)
    error[model.face[1:]] = 0.5
    target[model.face[0]] = 1e4  # what has no error was not seen
    rest = np.tile(IDENTITY, (model.muscle_count, 1))
    return ExpressionFit(name, role, rest, np.zeros(5), target, target, error, 0, 1, 0.0, 0.0)


@pytest.fixture(scope="module")
def real():
    """A rig of scans whose muscles are weak and turned."""
    plain = Face(fibred_block(), material=MOONEY_RIVLIN)
    shape = FibreShape(plain)
    truth = shape.layout.rest.copy()
    shape.layout.part("strengths", truth)[:] = np.log([0.4, 0.25])
    shape.layout.part("directions", truth)[:] = [0.0, 0.0, 0.5]
    face = shape.face(truth)
    kinds = {"left": ("train", (0.7, 0.1)), "right": ("train", (0.1, 0.8))}
    kinds["both"] = ("test", (0.5, 0.5))
    fits = tuple(expression(face, name, *kind) for name, kind in kinds.items())
    return Rig(plain.model, plain.model.weights, fits)


@pytest.mark.long
def test_muscles_are_calibrated_and_unseen_expressions_gain(real, tmp_path):
    real.save(tmp_path / "rig.npz")
    steps = []
    files = run_job(
        "fit_fibres",
        tmp_path,
        options={"rounds": 8},
        rig=tmp_path / "rig.npz",
        progress=steps.append,
    )
    names = ["fibre_muscles.npz", "fibre_muscles.json", "report.json", "report.html"]
    assert [file.name for file in files] == names
    report = json.loads(files[1].read_text())
    means = report["means"]
    assert means["train_uncalibrated_mm"] > 0.05
    assert means["train_fibre_mm"] < 0.4 * means["train_uncalibrated_mm"]
    assert means["test_fibre_mm"] < 0.7 * means["test_uncalibrated_mm"]
    assert means["test_blended_mm"] == 0.5
    for fit in report["expressions"].values():
        assert fit["inverted"] == 0
        assert all(0.0 <= a <= 1.0 for a in fit["activations"].values())
        assert set(fit["activations"]) == set(report["strengths"])
    # the rig's certificate has them beside S
    certificate = json.loads(files[2].read_text())
    fibres = {key: report[key] for key in ("means", "expressions", "strengths")}
    assert certificate["fibres"] == fibres
    assert certificate["train_mean_mm"] == pytest.approx(0.5)
    assert "<summary>Fibre muscles, one activation each: training scans" in files[3].read_text()
    # the left muscle is broad
    assert set(report["strengths"]) == {"left.1", "left.2", "right"}
    fractions = [step.fraction for step in steps]
    assert fractions == sorted(fractions)
    plain = Face(real.model, material=MOONEY_RIVLIN)
    face = with_fibres(plain, load_muscles(files[0], plain))
    assert face.layout.upper[0] == 1.0


def test_a_rig_without_training_scans_is_refused(real, tmp_path):
    Rig(real.model, real.weights, real.expressions[2:]).save(tmp_path / "rig.npz")
    with pytest.raises(InputError) as caught:
        run_job("fit_fibres", tmp_path, rig=tmp_path / "rig.npz")
    assert caught.value.code == "fibres.no_scans"
    (tmp_path / "notes.npz").write_bytes(b"no archive")
    with pytest.raises(InputError) as caught:
        load_muscles(tmp_path / "notes.npz", Face(real.model))
    assert caught.value.code == "fibres.unreadable"
