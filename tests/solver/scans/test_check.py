"""The ingest check: every fault by its name, and no alarm for scans without one."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.bad_scans import BAD_SCANS, Subject
from benchmarks.ingest import builtin_subject
from solver.errors import judge_findings
from solver.meshio.obj import write_obj
from solver.registration.locate import FRAME
from solver.scans.check import ScanCheck, check
from solver.scans.findings import ADVICE
from solver.surface import Surface
from solver.templates.builtin.build import builtin_capture_set
from tests.fixtures import data_folder, ict_capture

pytestmark = pytest.mark.long

SLOW = (
    "not a face",
    "half a face",
    "skull",
    "a million vertices",
    "scale wrong by 10, large",
    "scale wrong by 1000, large",
)


@cache
def subject() -> Subject:
    return builtin_subject()


def checked(path: Path, role: str, landmarks: Path | None = None) -> ScanCheck:
    return check(path, subject().template, FRAME, role, landmarks)


def alarms(found: ScanCheck) -> list[str]:
    return [finding.message for finding in found.findings if finding.severity != "info"]


@pytest.mark.parametrize(
    "fault", [pytest.param(f, marks=pytest.mark.slow if f in SLOW else ()) for f in BAD_SCANS]
)
def test_every_fault_is_named(fault: str, tmp_path: Path) -> None:
    bad = BAD_SCANS[fault](subject(), tmp_path)
    found = checked(bad.path, "neutral", bad.landmarks)
    named = {finding.code: finding for finding in found.findings}
    assert bad.code in named, alarms(found)
    assert judge_findings(found.findings) == bad.verdict, alarms(found)
    assert all(code in ADVICE for code in named)


@pytest.mark.parametrize("expression", ["neutral", "surprise", "kiss"])
def test_no_alarm_for_the_built_in_person(expression: str, tmp_path: Path) -> None:
    captures = builtin_capture_set()
    scan = {"neutral": captures.neutral, **captures.train, **captures.test}[expression]
    role = "neutral" if expression == "neutral" else "expression"
    assert alarms(checked(written(tmp_path, scan), role)) == []


@pytest.mark.parametrize("expression", ["neutral", "smile", "ah"])
def test_no_alarm_for_real_heads(expression: str, tmp_path: Path) -> None:
    role = "neutral" if expression == "neutral" else "expression"
    assert alarms(checked(written(tmp_path, ict_capture(expression)), role)) == []


@pytest.mark.parametrize(
    ("scan", "true"),
    [
        ("menpo3d/james.obj", set()),
        ("meshmonk/DemoFace_10K.obj", {"scan.spikes"}),
        ("meshmonk/Template.obj", {"scan.cut_off"}),  # a face cut off at the temples
    ],
)
def test_raw_scans_have_true_findings_only(scan: str, true: set[str]) -> None:
    found = checked(data_folder("scans", *scan.split("/")), "unknown")
    assert {f.code for f in found.findings if f.severity != "info"} == true


def test_a_given_unit_that_can_not_be_is_an_error(tmp_path: Path) -> None:
    path = written(tmp_path, subject().head)
    found = check(path, subject().template, {**FRAME, "unit": "cm"}, "unknown", None)
    assert "scan.scale" in [finding.code for finding in found.findings]
    assert judge_findings(found.findings) == "bad"


def test_a_hole_is_found_where_it_is(tmp_path: Path) -> None:
    head = ict_capture("neutral")
    cheek = np.array([42.0, -15.0, 85.0])
    middles = head.vertices[head.faces].mean(axis=1)
    whole = np.linalg.norm((middles - cheek)[:, :2], axis=1) > 9.0
    found = checked(written(tmp_path, Surface(head.vertices, head.faces[whole])), "neutral")
    holes = next(finding for finding in found.findings if finding.code == "scan.holes")
    assert holes.severity == "warning"
    (hole,) = holes.context["holes"]
    assert hole["region"].startswith("left ")
    assert 150 < hole["area_mm2"] < 350


def test_noise_is_measured(tmp_path: Path) -> None:
    head = ict_capture("neutral")
    noise = np.random.default_rng(3).normal(0, 0.8, head.vertices.shape)
    found = checked(written(tmp_path, head.moved(head.vertices + noise)), "neutral")
    assert alarms(found)[0].startswith("The surface is noisy")
    assert found.figures["noise_mm"] == pytest.approx(0.8, abs=0.15)


def written(folder: Path, surface: Surface) -> Path:
    path = folder / "scan.obj"
    write_obj(path, surface)
    return path


def test_unit_and_axes_are_found_in_any_pose(tmp_path: Path) -> None:
    head = subject().head
    turn = Rotation.random(rng=np.random.default_rng(2)).as_matrix()
    path = written(tmp_path, head.moved(head.vertices @ turn.T / 25.4 + 7.0))
    place = checked(path, "neutral").location
    assert place is not None
    assert place.unit == "inch"
    back = place.motion(place.mm_per_unit * (head.vertices @ turn.T / 25.4 + 7.0))
    assert np.linalg.norm(back - head.vertices, axis=1).max() < 1.5
