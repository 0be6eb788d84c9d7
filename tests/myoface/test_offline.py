"""The commands that solve in this process."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from myoface.cli.offline import name_expressions
from myoface.errors import ApiError
from solver.animation.blendshapes import Blendshapes, Solved
from solver.fitting.face import Pose
from solver.mechanics.flesh import IDENTITY
from solver.meshio.registered import write_registered
from solver.rig import Rig
from solver.scans.live_link import FaceTake, write_signals
from tests.command_line import Told, invoke
from tests.solver.block import head_block


@pytest.mark.parametrize("existed", [False, True])
def test_a_refused_scan_leaves_no_empty_folder(existed: bool, tmp_path: Path) -> None:
    scan = tmp_path / "neutral.obj"
    folder = tmp_path / "model"
    scan.write_text("v 0 0 nan\n")
    if existed:
        folder.mkdir()
    done = invoke(["solve", "build-model", str(scan), "-o", str(folder)])
    assert done.exit_code == 1
    assert done.stderr.startswith("error: ")
    assert folder.exists() == existed


def test_a_refusal_names_the_option_that_is_typed(tmp_path: Path) -> None:
    scan = tmp_path / "neutral.obj"
    scan.write_text("v 0 0 0\n")
    sizes = ["--unit", "cm", "--eye-distance", "60"]
    told = invoke(["solve", "check-scan", str(scan), *sizes, "-o", str(tmp_path / "check")])
    assert told.stderr.startswith("error: --eye-distance: 60")


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a rig without expressions."""
    folder = tmp_path_factory.mktemp("rig")
    model = head_block((7, 5, 1))
    Rig(model, model.weights, ()).save(folder / "rig.npz")
    np.save(folder / "map.npy", np.ones(len(model.skin.vertices)))
    return folder


def test_expressions_are_called_as_the_service_calls_them(tmp_path: Path) -> None:
    scans = [tmp_path / name for name in ("ein Lächeln.obj", "James Kiss 02.obj")]
    assert list(name_expressions(scans)) == ["ein_Lacheln", "James_Kiss_02"]
    for files, words in (
        (["smile.obj", "Smile.ply"], "'smile.obj' and 'Smile.ply' would both be called Smile"),
        (["nul.obj"], "a device's name"),
        (["ß!.obj", "___.obj"], "no name can be made of '___.obj'"),
    ):
        with pytest.raises(ApiError, match=words) as caught:
            name_expressions([tmp_path / file for file in files])
        assert "--name" not in str(caught.value)


@pytest.mark.long
def test_a_fit_ends_with_its_verdict_and_certificate(rig: Path, tmp_path: Path) -> None:
    skin = head_block((7, 5, 1)).skin
    moved = skin.vertices + 0.02 * (skin.vertices - skin.vertices.mean(axis=0))
    write_registered(tmp_path / "smile.ply", skin.with_vertices(moved), np.ones(len(moved)))
    out = tmp_path / "fitted"
    told = invoke(["solve", "activations", str(rig), str(tmp_path / "smile.ply"), "-o", str(out)])
    assert told.exit_code == 0, told.output
    report = json.loads((out / "report.json").read_text())
    words = " ".join(told.output.split())
    assert f"{report['verdict']}: {report['use']}" in words
    assert "report.html" in words


def played(command: str, rig: Path, scene: str, out: Path, *more: str) -> Told:
    (rig / "scene.json").write_text(scene)
    files = [str(rig), str(rig / "scene.json")]
    return invoke(["solve", command, *files, "-o", str(out), *more])


@pytest.mark.long
def test_scenes_are_played_with_their_assets(rig: Path, tmp_path: Path) -> None:
    soft = {"kind": "stiffness", "factor": 0.5, "map": {"asset": "soft"}}
    scene = json.dumps({"edits": [soft]})
    asset = ["--asset", f"soft={rig / 'map.npy'}"]
    done = played("simulate", rig, scene, tmp_path / "played", *asset)
    assert done.exit_code == 0, done.output
    assert "1 frames" in done.output
    assert (tmp_path / "played" / "animation.glb").exists()
    assert played("simulate", rig, scene, tmp_path / "played", *asset, "--resume").exit_code == 0
    done = played("edit", rig, scene, tmp_path / "edited", *asset)
    assert done.exit_code == 0, done.output
    assert "+0.0 ml" in done.output


@pytest.mark.parametrize(
    ("scene", "assets", "words"),
    [
        ("{", [], "scene.json is not JSON"),
        ("[" * 100_000, [], "scene.json is not JSON"),
        ("{}", ["map.npy"], "NAME=FILE is expected"),
        ("{}", ["=map.npy"], "NAME=FILE is expected"),
        ("{}", ["soft=gone.npy"], "there is no file gone.npy"),
        ("{}", ["soft=map.npy", "soft=map.npy"], "another file is called soft"),
    ],
)
def test_scenes_and_assets_that_are_none(
    rig: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    scene: str,
    assets: list[Any],
    words: str,
) -> None:
    monkeypatch.chdir(rig)
    given = [part for asset in assets for part in ("--asset", asset)]
    done = played("simulate", rig, scene, tmp_path / "played", *given)
    assert done.exit_code == 2
    assert words in " ".join(done.output.replace("│", "").split())
    assert not (tmp_path / "played").exists()


@pytest.mark.long
def test_signals_are_played_again_without_their_video(rig: Path, tmp_path: Path) -> None:
    model = head_block((7, 5, 1))
    resting = Pose(np.array([IDENTITY] * model.muscle_count), np.zeros(5))
    solved = Blendshapes(model.muscle_names, {"jawOpen": Solved(resting, 0.1)})
    solved.save(tmp_path / "shapes.npz", model, model.weights)
    times = np.arange(3) / 25.0
    still = np.zeros((3, 3))
    seen = np.ones(3, bool)
    take = FaceTake(times, np.zeros((3, 52)), still, np.zeros((3, 2, 3)), seen, "video")
    out = tmp_path / "played"
    out.mkdir()
    signals = out / "signals.csv"  # in the folder that is filled: it stays
    write_signals(signals, take)
    shapes = ["--blendshapes", str(tmp_path / "shapes.npz")]
    told = invoke(["transfer", str(signals), "--rig", str(rig), "-o", str(out), *shapes])
    assert told.exit_code == 0, told.output
    assert "3 frames played; in the whole recording 3 with a face" in " ".join(told.output.split())
    assert "expressions are blended; --learn learns controls" in told.output
    assert signals.is_file()
    assert not (out / "transfer.png").exists()
