"""The commands that build, check, show and export a template."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from solver.anatomy.skin_points import SkinPoints
from solver.anatomy.template import Template
from solver.errors import InputError
from solver.photo.mesh_points import FoundPoints
from solver.templates.folder import read_template
from tests.ball_head import ball_head
from tests.command_line import invoke

TWO_POINTS = SkinPoints(
    np.array([[0, 1, 2], [3, 4, 5]]),
    np.array([[0.1, 0.2, 0.7], [1 / 3, 1 / 3, 1 / 3]]),
    ("4", "33"),
    np.array([0.7, 1.5]),
)


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    ball_head().save(tmp_path / "ball.npz")
    return tmp_path / "ball.npz"


def run(*words: str | Path, code: int = 0) -> str:
    result = invoke(["template", *map(str, words)])
    assert result.exit_code == code, result.output
    return result.output


def test_from_file_to_folder_and_back(saved: Path, tmp_path: Path) -> None:
    run("export", saved, "-o", tmp_path / "folder")
    run("build", "--folder", tmp_path / "folder", "--no-mesh", "-o", tmp_path / "new.npz")
    new = Template.load(tmp_path / "new.npz")
    old = Template.load(saved)
    assert np.array_equal(new.skin.vertices, old.skin.vertices)
    assert [muscle.name for muscle in new.muscles] == [muscle.name for muscle in old.muscles]
    assert new.sha256 == read_template(tmp_path / "folder").sha256


def test_points_of_a_detector_go_along(tmp_path: Path) -> None:
    replace(ball_head(), mesh=None, points=TWO_POINTS).save(tmp_path / "ball.npz")
    assert re.search(r"detector points\s+2", run("show", tmp_path / "ball.npz"))
    folder = tmp_path / "folder"
    run("export", tmp_path / "ball.npz", "-o", folder)
    read = read_template(folder).points
    assert read is not None
    assert read.names == TWO_POINTS.names
    for name in ("corners", "weights", "spread_mm"):
        np.testing.assert_array_equal(getattr(read, name), getattr(TWO_POINTS, name))
    table = folder / "points.csv"
    text = table.read_text().replace("4,0,1,2,", "4,0,1,9999,")
    table.write_text(text)
    with pytest.raises(InputError, match=r"points\.csv, 4: vertex 9999") as caught:
        read_template(folder)
    assert caught.value.code == "template.vertex"


def test_points_are_found_with_a_landmarker(
    saved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("MYOFACE_FACE_LANDMARKER", raising=False)
    monkeypatch.setenv("MYOFACE_CACHE", str(tmp_path / "cache"))
    assert "MYOFACE_FACE_LANDMARKER" in run("points", saved, code=2)
    found = FoundPoints(TWO_POINTS, pictures=360, with_face=359, left_out={"58": np.inf})
    monkeypatch.setattr("solver.photo.mesh_points.find_points", lambda *_, **__: found)
    model = tmp_path / "face_landmarker.task"
    new = tmp_path / "new.npz"
    model.touch()
    told = run("points", saved, "--landmarker", model, "-o", new)
    assert "a face in 359 of 360 pictures: 2 points, median spread 1.5 mm; 1 without" in told
    loaded = Template.load(new)
    assert loaded.points is not None
    assert loaded.points.names == ("4", "33")
    assert loaded.mesh is not None


def test_check_tells_what_is_wrong(saved: Path, tmp_path: Path) -> None:
    assert "can be used, 0 findings" in run("check", saved)
    head = ball_head()
    replace(head, condyles=head.condyles[::-1].copy()).save(tmp_path / "bad.npz")
    told = run("check", tmp_path / "bad.npz", code=1)
    assert "error left condyle: it is on the other side" in told
    report = json.loads(run("check", tmp_path / "bad.npz", "--json", "-", code=1))
    assert not report["good"]
    assert {finding["code"] for finding in report["findings"]} == {"condyle.side"}


@pytest.mark.long
def test_show_prints_the_hash_and_draws(saved: Path, tmp_path: Path) -> None:
    told = run("show", saved, "-o", tmp_path / "pictures")
    assert Template.load(saved).sha256 in told
    assert "puller_l" in told
    assert set(Template.load(saved).landmarks) <= set(re.split(r"[,\s]+", told))
    for name in ("anatomy.png", "skin.png"):
        assert (tmp_path / "pictures" / name).stat().st_size > 10_000


def test_rebase_leaves_nothing_of_what_is_no_head(saved: Path, tmp_path: Path) -> None:
    cloud = tmp_path / "cloud.xyz"
    new = tmp_path / "new.npz"
    np.savetxt(cloud, ball_head().skin.vertices)
    told = run("rebase", saved, "--skin", cloud, "-o", new, code=1)
    assert "cloud.xyz is a cloud of points" in told
    assert "required: --skin" in run("rebase", saved, code=2)
    assert not new.exists()


@pytest.mark.parametrize(
    "words",
    [[], ["--anatomy", "."], ["--builtin", "--folder", "."], ["--folder", ".", "--faces", "."]],
)
def test_one_source_is_asked_for(words: list[str]) -> None:
    assert "give --anatomy and --faces" in run("build", *words, code=2)
