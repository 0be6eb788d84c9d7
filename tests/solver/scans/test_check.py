"""The ingest check: every fault by its name, and no alarm for scans without one."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.bad_scans import BAD_SCANS, Subject
from benchmarks.corruption import Corruption, corrupted
from benchmarks.ingest import BLINK, builtin_subject, dense, is_named
from solver.errors import judge_findings
from solver.meshio.obj import write_obj
from solver.registration.units import FRAME
from solver.scans.check import ScanCheck, check, check_picture
from solver.scans.findings import ADVICE
from solver.surface import Surface
from solver.templates.builtin.build import builtin_capture_set, builtin_expression
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
    findings = [finding.to_dict() for finding in found.findings]
    report = {"verdict": judge_findings(found.findings), "findings": findings}
    assert is_named(bad, report), alarms(found)
    assert all(finding.code in ADVICE for finding in found.findings)


@pytest.mark.parametrize("expression", ["neutral", "surprise", "kiss"])
def test_no_alarm_for_the_built_in_person(expression: str, tmp_path: Path) -> None:
    captures = builtin_capture_set()
    scan = {"neutral": captures.neutral, **captures.train, **captures.test}[expression]
    role = "neutral" if expression == "neutral" else "expression"
    assert alarms(checked(written(tmp_path, dense(scan, 2)), role)) == []


@pytest.mark.parametrize("expression", ["neutral", "smile", "ah"])
def test_no_alarm_for_real_heads(expression: str, tmp_path: Path) -> None:
    role = "neutral" if expression == "neutral" else "expression"
    assert alarms(checked(written(tmp_path, dense(ict_capture(expression), 1)), role)) == []


@pytest.mark.parametrize(
    ("scan", "true"),
    [
        ("menpo3d/james.obj", {"scan.coarse"}),
        ("meshmonk/DemoFace_10K.obj", {"scan.spikes", "scan.coarse", "scan.size"}),
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


def scanned(surface: Surface, cell_mm: float) -> Surface:
    """Return what a scanner with a vertex every 0.7 ``cell_mm`` or so makes of a face."""
    how = Corruption(noise_mm=0.1, hole_share=0.0, cell_mm=cell_mm)
    scan = corrupted(surface, 1, how)
    return Surface(scan.vertices, scan.faces)


@pytest.mark.parametrize("cell_mm", [1.4, 2.8])
def test_eyes_lips_and_teeth_are_judged_at_the_densities_of_scanners(
    cell_mm: float, tmp_path: Path
) -> None:
    looks = {
        "open": ({}, set()),
        "closed": (BLINK, {"scan.eyes_closed"}),
        "parted": ({"jawOpen": 0.08}, {"scan.mouth_open"}),
        "wide": ({"jawOpen": 0.3}, {"scan.mouth_open"}),
    }
    for look, (weights, expected) in looks.items():
        found = checked(written(tmp_path, scanned(builtin_expression(weights), cell_mm)), "neutral")
        codes = {finding.code for finding in found.findings}
        assert codes & {"scan.eyes_closed", "scan.mouth_open"} == expected, look
        judged = {each.about: each for each in found.parts}
        assert judged["eyes"].judged
        assert judged["lips"].judged
        assert judged["teeth"].judged == (look == "wide")


def test_what_is_too_coarse_to_judge_is_said_to_be(tmp_path: Path) -> None:
    found = checked(written(tmp_path, scanned(builtin_expression(BLINK), 5.5)), "neutral")
    assert "scan.coarse" in [finding.code for finding in found.findings]
    assert judge_findings(found.findings) == "usable"
    eyes = next(each for each in found.parts if each.about == "eyes")
    assert not eyes.judged
    assert "a vertex only every" in eyes.words
    check_picture(found, "coarse", tmp_path / "check.png")


def test_small_gaps_are_told_and_explained(tmp_path: Path) -> None:
    head = dense(ict_capture("neutral"), 1)
    middles = head.vertices[head.faces].mean(axis=1)
    off = np.linalg.norm((middles - np.array([42.0, -15.0, 85.0]))[:, :2], axis=1)
    found = checked(written(tmp_path, Surface(head.vertices, head.faces[off > 6.0])), "neutral")
    assert found.cover is not None
    assert not found.cover.covered.all()
    codes = {finding.code: finding.severity for finding in found.findings}
    assert codes["scan.gaps"] == "info"
    assert judge_findings(found.findings) == "good"


def test_noise_is_measured(tmp_path: Path) -> None:
    head = dense(ict_capture("neutral"), 1)
    noise = np.random.default_rng(3).normal(0, 0.8, head.vertices.shape)
    found = checked(written(tmp_path, head.with_vertices(head.vertices + noise)), "neutral")
    assert alarms(found)[0].startswith("The surface is noisy")
    assert found.figures["noise_mm"] == pytest.approx(0.8, abs=0.15)


def written(folder: Path, surface: Surface) -> Path:
    path = folder / "scan.obj"
    write_obj(path, surface)
    return path


def test_unit_and_axes_are_found_in_any_pose(tmp_path: Path) -> None:
    head = subject().head
    turn = Rotation.random(rng=np.random.default_rng(2)).as_matrix()
    path = written(tmp_path, head.with_vertices(head.vertices @ turn.T / 25.4 + 7.0))
    place = checked(path, "neutral").location
    assert place is not None
    assert place.size.unit.name == "inch"
    back = place.motion(place.mm_per_unit * (head.vertices @ turn.T / 25.4 + 7.0))
    assert np.linalg.norm(back - head.vertices, axis=1).max() < 1.5
