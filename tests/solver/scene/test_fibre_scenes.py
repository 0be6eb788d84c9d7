"""Fibre muscles in scenes: performances of theirs, curves, keys, edits, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from solver.errors import InputError
from solver.fitting.calibration import fibre_muscles, save_muscles, with_fibres
from solver.fitting.face import Face, Pose
from solver.jobs import run_job
from solver.mechanics.flesh import MOONEY_RIVLIN
from solver.rig import Rig
from solver.rig.frames import SequenceFrame, write_sequence
from tests.solver.simulation.test_fibres import fibred_block

MODEL = fibred_block()
COUNT = 5
FPS = 10.0
LAST = np.array([0.6, 0.3])


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return a rig with fibre muscles, and a take of theirs."""
    folder = tmp_path_factory.mktemp("fibres")
    plain = Face(MODEL, material=MOONEY_RIVLIN)
    save_muscles(folder / "fibre_muscles.npz", plain, fibre_muscles(plain, 8.0))
    Rig(MODEL, MODEL.weights, ()).save(folder / "rig.npz")
    frames = [
        SequenceFrame(
            *(number, LAST * number / (COUNT - 1), np.zeros(5), np.zeros(6), 0, 3, 0.1),
            *("fitted", 0.3, 0.5, 1.0, 1.0),
        )
        for number in range(COUNT)
    ]
    take, table, _ = write_sequence(folder, frames, MODEL.muscle_names, FPS, {})
    assert table.read_text().startswith("frame,time,status,mean_mm,left,right,jaw.1,")
    names = {"rig": "rig.npz", "fibre_muscles": "fibre_muscles.npz"}
    return {**{name: folder / file for name, file in names.items()}, "take": take}


def simulate(files: dict[str, Path], out: Path, scene: dict[str, Any], **less: None) -> Any:
    """Play a scene and return the arrays of its animation."""
    inputs = {"rig": files["rig"], "fibre_muscles": files["fibre_muscles"], **less}
    options = {"scene": {"fps": FPS, "contact": {"lips": False, "eyes": False}, **scene}}
    run_job("simulate", out, options=options, captures={"take": files["take"]}, **inputs)
    with np.load(out / "animation.npz") as data:
        return dict(data)


def motion(arrays: Any, frame: int = -1) -> float:
    return float(np.linalg.norm(arrays["skin"][frame] - arrays["skin"][0], axis=1).mean())


TAKE = {"asset": "take"}


@pytest.mark.long
def test_a_take_of_fibre_muscles_is_the_flesh_that_it_was_fitted_with(
    files: dict[str, Path], tmp_path: Path
) -> None:
    played = simulate(files, tmp_path, {"performance": TAKE})
    assert played["muscles"].tolist() == list(MODEL.muscle_names)
    np.testing.assert_allclose(played["activations"][-1], LAST, atol=1e-12)
    plain = Face(MODEL, material=MOONEY_RIVLIN)
    face = with_fibres(plain, fibre_muscles(plain, 8.0))
    own = face.continuation(face.rest, Pose(LAST, np.zeros(5), face.layout))
    skin = face.whole_skin(own.x, np.zeros(5))[played["vertices"]]
    np.testing.assert_allclose(played["skin"][-1], skin, atol=0.02)
    report = json.loads((tmp_path / "animation.json").read_text())
    assert report["inverted"] == 0


@pytest.mark.long
def test_gains_end_at_one_and_curves_go_on(files: dict[str, Path], tmp_path: Path) -> None:
    once = simulate(files, tmp_path / "once", {"performance": TAKE})
    twice = simulate(files, tmp_path / "twice", {"performance": {**TAKE, "gain": 2}})
    np.testing.assert_allclose(twice["activations"][-1], [1.0, 0.6], atol=1e-12)
    curve = {**TAKE, "gain": 2, "curve": {"left": 2.0}}
    more = simulate(files, tmp_path / "more", {"performance": curve})
    np.testing.assert_allclose(more["activations"], twice["activations"], atol=1e-12)
    assert motion(once) < motion(twice) < motion(more)


@pytest.mark.long
def test_keys_direct_fibre_muscles(files: dict[str, Path], tmp_path: Path) -> None:
    keys = [{"time": 0}, {"time": 0.3, "fibres": {"left": 0.5}, "jaw": {"open_deg": 2}}]
    alone = simulate(files, tmp_path / "alone", {"keys": keys})
    np.testing.assert_allclose(alone["activations"][-1], [0.5, 0.0], atol=1e-12)
    assert alone["jaw"][-1, 0] == pytest.approx(np.radians(2))
    entry = {**TAKE, "keys": [{"time": 0.4, "fibres": {"right": -1, "left": 1}}]}
    layered = simulate(files, tmp_path / "layered", {"performance": entry})
    np.testing.assert_allclose(layered["activations"][-1], [1.0, 0.0], atol=1e-12)


@pytest.mark.long
def test_a_palsy_weakens_fibre_muscles(files: dict[str, Path], tmp_path: Path) -> None:
    whole = simulate(files, tmp_path / "whole", {"performance": TAKE})
    edits = [{"kind": "paralysis", "muscles": ["left", "right"]}]
    still = simulate(files, tmp_path / "still", {"performance": TAKE, "edits": edits})
    assert motion(still) < 1e-3 < 0.1 * motion(whole)


@pytest.mark.parametrize(
    ("scene", "less", "code", "words"),
    [
        ({"performance": TAKE}, {"fibre_muscles": None}, "scene.fibres", "run fit_fibres"),
        (
            {"keys": [{"time": 0, "fibres": {"left": 1}}]},
            {"fibre_muscles": None},
            "scene.fibres",
            "run fit_fibres",
        ),
        (
            {"performance": TAKE, "keys": [{"time": 0, "muscles": {"left": 0.7}}]},
            {},
            "scene.fibres",
            "keys[0]",
        ),
        (
            {"performance": {**TAKE, "curve": {"nose": 2}}},
            {},
            "scene.muscle",
            "curve of the performance",
        ),
        (
            {"performance": TAKE, "keys": [{"time": 0, "fibres": {"nose": 1}}]},
            {},
            "scene.muscle",
            "keys[0]",
        ),
    ],
)
def test_what_fibre_scenes_cannot_be(
    files: dict[str, Path],
    tmp_path: Path,
    scene: dict[str, Any],
    less: dict[str, None],
    code: str,
    words: str,
) -> None:
    with pytest.raises(InputError) as caught:
        simulate(files, tmp_path, scene, **less)
    assert caught.value.code == code
    assert words in caught.value.message
