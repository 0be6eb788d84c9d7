"""The job that checks markers: its files, with a rig and without, and broken takes as verdicts."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from PIL import Image

from myoface.cli.markers import markers
from solver.jobs import run_job
from solver.scans.markers.marker_set import MarkerSet
from tests.fixtures import small_model
from tests.solver.scans.markers.made_take import LABELS, made_positions
from tests.take_files import c3d_bytes


@pytest.fixture
def take(tmp_path: Path) -> Path:
    file = tmp_path / "take.c3d"
    file.write_bytes(c3d_bytes(made_positions(300), LABELS, rate=60.0))
    return file


def test_a_take_is_checked_against_a_person_and_against_nobody(tmp_path: Path, take: Path) -> None:
    model = tmp_path / "model.npz"
    small_model().save(model)
    report, picture = run_job("check_markers", tmp_path / "alone", markers=take)
    alone = json.loads(report.read_text())
    assert alone["verdict"] == "good"
    assert Image.open(picture).width > 1000
    report, _, bound = run_job("check_markers", tmp_path / "whose", markers=take, model=model)
    found = json.loads(report.read_text())
    assert (found["verdict"], found["findings"]) == ("good", [])
    assert [each["label"] for each in found["labels"]] == list(LABELS)
    assert found["figures"]["off_skin_mm"] < 0.5 < alone["figures"]["off_skin_mm"]
    files = {"markers": take, "model": model, "marker_set": bound}
    report, *_ = run_job("check_markers", tmp_path / "set", options={"neutral": 40}, **files)
    assert json.loads(report.read_text())["verdict"] == "good"


@pytest.mark.parametrize("content", [b"", b"PathFileType\t4", b"\x02P" + bytes(600)])
def test_a_take_that_cannot_be_read_is_a_verdict(content: bytes, tmp_path: Path) -> None:
    file = tmp_path / "take.c3d"
    file.write_bytes(content)
    report, picture = run_job("check_markers", tmp_path / "out", markers=file)
    found = json.loads(report.read_text())
    assert found["verdict"] == "bad"
    (finding,) = found["findings"]
    assert finding["code"].startswith("markers.")
    assert finding["advice"]
    assert picture.exists()


def test_a_frame_that_the_take_does_not_have_is_told(tmp_path: Path, take: Path) -> None:
    report, _ = run_job("check_markers", tmp_path / "out", options={"neutral": 9999}, markers=take)
    assert "frames 1 to 300, not 9999" in json.loads(report.read_text())["findings"][0]["message"]


def test_the_command_binds_a_take_to_a_person(
    tmp_path: Path, take: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, output = tmp_path / "model.npz", tmp_path / "markers.json"
    small_model().save(model)
    markers.run(["bind", str(model), str(take), "--output", str(output)], "markers")
    assert MarkerSet.load(output).labels == LABELS
    assert f"{len(LABELS)} face" in capsys.readouterr().out
