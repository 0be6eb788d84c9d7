"""The second that is taken for rest: the face comes back to it, and what is unclear is told."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from myoface.cli.markers import markers as markers_group
from solver.errors import Finding, judge_findings
from solver.registration.locate import face_surface
from solver.scans.markers.check import check_take
from solver.scans.markers.findings import MarkerCheck
from solver.scans.markers.places.bind import Reference, model_face
from solver.scans.markers.readers.take import Take, read_take
from solver.templates.builtin.build import builtin_template
from tests.fixtures import data_folder, small_model
from tests.solver.scans.markers.made_take import RATE, made_take, on_skin


@cache
def nobody() -> Reference:
    return Reference(face_surface(builtin_template()))


def real_take(name: str, frames: slice = slice(None)) -> Take:
    take = read_take(data_folder("markers", "animface", f"{name}.c3d"))
    first = take.first + (frames.start or 0)
    residual = None if take.residual is None else take.residual[frames]
    parts = {"positions": take.positions[frames], "unlabelled": take.unlabelled[frames]}
    return replace(take, **parts, residual=residual, first=first)


def told(check: MarkerCheck) -> list[Finding]:
    return [each for each in check.findings if each.severity != "info"]


def test_rest_is_where_a_face_comes_back_to_and_another_long_pose_is_told() -> None:
    check = check_take(real_take("jaw"), nobody())
    first, last = check.figures["neutral"]
    assert first < 100  # not the stillest second, 1315 to 1374
    (found,) = told(check)
    assert found.code == "markers.unclear_rest"
    assert found.context["frames"] == [[first, last], [1315, 1374]]
    assert found.context["label"] == "Chin"
    assert 7.0 < found.context["found"] < 10.0
    assert judge_findings(check.findings) == "usable"


def test_held_expressions_are_no_rest() -> None:
    check = check_take(real_take("nose"), nobody())
    assert check.figures["neutral"][1] < 110  # later the nose is wrinkled, for the stillest second
    assert told(check) == []


def held(*poses: str) -> Take:
    """Return a take that holds each pose for a second and a half, the first ones less still."""
    rng = np.random.default_rng(3)
    noise = np.linspace(0.3, 0.05, len(poses))
    faces = [on_skin(pose) for pose in poses]
    time = np.linspace(0.0, 1.0, int(0.5 * RATE))[1:, None, None]
    parts = []
    for number, (face, size) in enumerate(zip(faces, noise, strict=True)):
        if number:
            parts.append(faces[number - 1] + time * (face - faces[number - 1]))
        still = np.repeat(face[None], int(1.5 * RATE), axis=0)
        parts.append(still + rng.normal(0.0, size, still.shape))
    return made_take(np.concatenate(parts))


@pytest.mark.long
@pytest.mark.parametrize("poses", [("neutral", "ah"), ("ah", "neutral")])
def test_of_two_poses_that_are_held_alike_the_closed_mouth_is_rest(poses: tuple[str, str]) -> None:
    take = held(*poses)
    check = check_take(take, nobody())
    row = poses.index("neutral") * 2.0 * RATE
    assert row - 1 <= check.figures["neutral"][0] <= row + RATE
    assert "markers.unclear_rest" in {each.code for each in told(check)}
    person = Reference(model_face(small_model()), small_model().sha256)
    check = check_take(take, person)  # whose face tells
    assert row - 1 <= check.figures["neutral"][0] <= row + RATE
    assert "markers.unclear_rest" not in {each.code for each in told(check)}


@pytest.mark.parametrize("frames", [slice(130, 220), slice(370, 450)], ids=["ajar", "wide"])
def test_a_mouth_that_is_open_in_every_frame_is_told_without_a_rig(frames: slice) -> None:
    (found,) = told(check_take(real_take("jaw", frames), nobody()))
    assert found.code == "markers.neutral"
    assert "the mouth is open" in found.message


def open_take() -> Take:
    return made_take(on_skin("ah") + 0.1 * np.random.default_rng(0).normal(size=(99, 41, 3)))


@pytest.mark.parametrize("actor", [False, True])
def test_a_mouth_that_is_open_in_every_frame_is_told_with_a_rig(actor: bool) -> None:
    person = Reference(model_face(small_model()), small_model().sha256)
    found = told(check_take(open_take(), person, actor=actor))
    assert "markers.neutral" in [each.code for each in found]


def test_binding_an_open_mouth_as_rest_is_told_and_ends_with_3(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, take, output = (tmp_path / name for name in ("model.npz", "take.npz", "markers.json"))
    small_model().save(model)
    real_take("jaw", slice(370, 450)).save(take)
    with pytest.raises(SystemExit) as caught:
        markers_group.run(["bind", str(model), str(take), "--output", str(output)], "markers")
    assert caught.value.code == 3
    assert output.exists()
    shown = capsys.readouterr().out
    assert "the mouth is open" in shown
    assert "too far off the skin" in shown
