"""The job that checks markers: its files, with a rig and without, and broken takes as verdicts."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from myoface.cli.markers import markers as markers_group
from solver.errors import InputError
from solver.fitting.face import Face
from solver.jobs import run_job
from solver.rig import ExpressionFit, Rig
from solver.scans.markers.places.bind import Reference, rest_places
from solver.scans.markers.places.marker_set import Marker, MarkerSet
from solver.similarity import IDENTITY
from tests.fixtures import small_capture, small_model
from tests.solver.scans.markers.made_take import LABELS, made_positions, made_take, on_skin
from tests.take_files import c3d_bytes


@pytest.fixture
def take(tmp_path: Path) -> Path:
    file = tmp_path / "take.c3d"
    file.write_bytes(c3d_bytes(made_positions(300), list(LABELS), rate=60.0))
    return file


@pytest.mark.long
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


@pytest.mark.parametrize(
    ("change", "code", "words"),
    [
        ({"model_sha256": "0" * 64}, "markers.other_model", "bind it again"),
        ({"vertices": (0, 1, 5_000_000)}, "markers.set_schema", "no vertex of the skin"),
        ({"vertices": (7, 7, 7)}, "markers.set_schema", "no triangle"),
    ],
)
def test_a_set_that_is_not_of_the_person_is_refused(
    change: dict, code: str, words: str, tmp_path: Path, take: Path
) -> None:
    model = small_model()
    given = tmp_path / "markers.json"
    model.save(tmp_path / "model.npz")
    marker = Marker("Chin", change.get("vertices", (4, 8, 15)))
    MarkerSet((marker,), IDENTITY, change.get("model_sha256", model.sha256)).save(given)
    files = {"markers": take, "model": tmp_path / "model.npz", "marker_set": given}
    with pytest.raises(InputError, match=words) as caught:
        run_job("check_markers", tmp_path / "out", **files)
    assert caught.value.code == code
    with pytest.raises(InputError, match=words):  # and where a program of its own reads it
        Reference.of(model, MarkerSet.load(given))


@pytest.mark.long
def test_a_take_without_labels_is_checked_by_its_tracks(tmp_path: Path) -> None:
    take = tmp_path / "take.npz"
    model = tmp_path / "model.npz"
    points = made_positions(300)
    names = tuple(f"*{number}" for number in range(len(LABELS)))
    made_take(points[:, :0], (), unlabelled=points, unlabelled_names=names).save(take)
    small_model().save(model)
    report, *_ = run_job("check_markers", tmp_path / "out", markers=take, model=model)
    found = json.loads(report.read_text())
    assert found["verdict"] == "good"
    assert [each["label"] for each in found["labels"]] == list(names)


@pytest.mark.long
def test_a_take_without_rest_is_bound_in_an_expression(tmp_path: Path) -> None:
    model = small_model()
    face = small_capture("ah")
    at_rest = Face(model).rest_pose()
    none = np.zeros(len(face.vertices))
    skin = face.vertices, model.skin.vertices, none
    opened = ExpressionFit("ah", "train", at_rest.a, at_rest.b, *skin, 0, 1, 0.0, 0.0)
    rig = tmp_path / "rig.npz"
    take = tmp_path / "open.npz"
    Rig(model, model.weights, (opened,)).save(rig)
    noise = 0.1 * np.random.default_rng(0).normal(size=(200, len(LABELS), 3))
    made_take(on_skin("ah") + noise).save(take)
    files = {"markers": take, "rig": rig}
    report, *_ = run_job("check_markers", tmp_path / "rest", **files)
    assert json.loads(report.read_text())["findings"][0]["code"] == "markers.neutral"
    report, _, bound = run_job(
        "check_markers", tmp_path / "ah", options={"expression": "ah"}, **files
    )
    (reach,) = json.loads(report.read_text())["findings"]
    assert reach["code"] == "markers.reach"
    information = np.array([*reach["information"].values()])
    assert ((information >= 0.0) & (information <= 1.0)).all()
    assert reach["further"][0]["gain"] > 0.0
    markers = MarkerSet.load(bound)
    places = rest_places(markers, model.skin)
    assert np.median(np.linalg.norm(places - on_skin("neutral"), axis=1)) < 0.5
    output = tmp_path / "bound.json"
    words = [str(rig), str(take), "--expression", "ah", "--output", str(output)]
    markers_group.run(["bind", *words], "markers")
    assert MarkerSet.load(output).markers == markers.markers
    with pytest.raises(InputError, match="no expression kiss"):
        run_job("check_markers", tmp_path / "kiss", options={"expression": "kiss"}, **files)


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


@pytest.mark.long
def test_a_take_may_be_at_rest_before_frame_0(tmp_path: Path) -> None:
    take = tmp_path / "take.npz"
    made_take(made_positions(300), first=-200).save(take)
    report, _ = run_job("check_markers", tmp_path / "out", options={"neutral": -150}, markers=take)
    assert json.loads(report.read_text())["figures"]["neutral"] == [-165, -135]


def test_the_command_binds_a_take_to_a_person(
    tmp_path: Path, take: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = tmp_path / "model.npz"
    output = tmp_path / "markers.json"
    small_model().save(model)
    markers_group.run(["bind", str(model), str(take), "--output", str(output)], "markers")
    assert MarkerSet.load(output).labels == LABELS
    assert f"{len(LABELS)} face" in capsys.readouterr().out
