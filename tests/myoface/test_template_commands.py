"""The commands that build, check, show and export a template."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from solver.anatomy.template import Template
from solver.templates.folder import read_template
from tests.ball_head import ball_head
from tests.command_line import invoke


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
    new, old = Template.load(tmp_path / "new.npz"), Template.load(saved)
    assert np.array_equal(new.skin.vertices, old.skin.vertices)
    assert [muscle.name for muscle in new.muscles] == [muscle.name for muscle in old.muscles]
    assert new.sha256 == read_template(tmp_path / "folder").sha256


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
    cloud, new = tmp_path / "cloud.xyz", tmp_path / "new.npz"
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
