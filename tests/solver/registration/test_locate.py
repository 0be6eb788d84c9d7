"""The face is found in any pose, unit and crop, with one verdict for check and registration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from solver.anatomy.template import Template
from solver.errors import InputError, judge_findings
from solver.meshio.obj import write_obj
from solver.meshio.raw import RawScan, mend, read_raw
from solver.registration.landmarks import landmark_vertices
from solver.registration.locate import Location, face_surface, locate_face, location_findings
from solver.registration.register import find_start
from solver.registration.scan_surface import sample
from solver.registration.search import RefinementOptions, face_points, refine_pose
from solver.registration.units import FRAME
from solver.scans.check import check
from solver.similarity import Similarity, fit_similarity
from solver.surface import Floats, Surface
from solver.templates.builtin.build import builtin_template

pytestmark = pytest.mark.long

MM_PER_UNIT = (1.0, 10.0, 1000.0, 25.4, 3.7, 0.02, 140.0)  # three of them are no unit's
CROPS = ("whole", "front", "holes", "shoulders", "cloud")
FAST = (0, 2, 4, 8, 16)


@cache
def template() -> Template:
    return builtin_template()


def person(rng: np.random.Generator, *, neutral: bool) -> Surface:
    """Return a head that the template does not have, in an expression of random muscles."""
    shapes = template().shapes
    skin = template().skin
    assert shapes is not None
    who = 0.6 * rng.standard_normal(len(shapes.identity))
    weights = rng.random(len(shapes.expressions)) * (rng.random(len(shapes.expressions)) < 0.12)
    vertices = skin.vertices + np.tensordot(who, shapes.identity, 1)
    return skin.with_vertices(
        vertices + (not neutral) * np.tensordot(weights, shapes.expressions, 1)
    )


def raw_scan(vertices: Floats, faces: np.ndarray) -> RawScan:
    return RawScan("scan.obj", vertices, faces.astype(np.int64), None, None, None, "obj", "obj")


def crop(head: Surface, kind: str, rng: np.random.Generator) -> Surface:
    """Return what a scan shows of a head, in the head's own place."""
    vertices = head.vertices
    faces = head.faces
    kept = np.ones(len(vertices), bool)
    if kind in ("front", "holes"):
        kept = vertices[:, 2] > vertices[:, 2].max() - rng.uniform(90, 130)
    if kind == "holes":
        for centre in vertices[rng.choice(np.flatnonzero(kept), 14)]:
            kept &= np.linalg.norm(vertices - centre, axis=1) > rng.uniform(5, 18)
    faces = faces[kept[faces].all(axis=1)]
    if kind == "shoulders":
        bust = trimesh.creation.icosphere(subdivisions=4)
        place = [0.0, vertices[:, 1].min() - 60, vertices[:, 2].mean() - 40]
        faces = np.vstack([faces, np.asarray(bust.faces) + len(vertices)])
        vertices = np.vstack([vertices, np.asarray(bust.vertices) * [220, 90, 110] + place])
    if kind == "cloud":
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        points, _ = trimesh.sample.sample_surface(mesh, 40_000, seed=1)
        return Surface(np.asarray(points), np.zeros((0, 3), np.int64))
    return Surface(vertices + rng.normal(0.0, 0.2, vertices.shape), faces)


def locate(scan: RawScan, frame: Mapping[str, Any] = FRAME) -> Location:
    mended, _ = mend(scan)
    return locate_face(
        mended, sample(mended.vertices, mended.faces, mended.normals), template(), frame
    )


@pytest.mark.parametrize(
    "number", [pytest.param(k, marks=() if k in FAST else pytest.mark.slow) for k in range(42)]
)
def test_the_face_is_found_in_any_pose_unit_and_crop(number: int) -> None:
    rng = np.random.default_rng(1000 + number)
    unit = MM_PER_UNIT[number % len(MM_PER_UNIT)]
    kind = CROPS[number % len(CROPS)]
    head = person(rng, neutral=number % 3 == 0)
    turn = Rotation.random(rng=rng).as_matrix()
    shift = rng.uniform(-300, 300, 3)
    place = Similarity(1 / unit, turn, shift / unit)
    seen = crop(head, kind, rng)
    found = locate(raw_scan(place(seen.vertices), seen.faces))
    assert found.is_face
    assert found.mm_per_unit == pytest.approx(unit, rel=0.12)
    assert found.size.is_known == (unit in MM_PER_UNIT[:4])
    face = template().face_vertices
    rest = template().skin.vertices
    there = place(head.vertices[face])
    known = fit_similarity(there, rest[face])
    assert np.linalg.norm(found.pose.motion(there) - known(there), axis=1).mean() < 12.0
    assert found.motion.then(known_turn(known)).degrees < 12.0


def known_turn(known: Similarity) -> Similarity:
    return Similarity(1.0, known.rotation.T, np.zeros(3))


def write(folder: Path, factor: float) -> Path:
    head = person(np.random.default_rng(4), neutral=True)
    bust = crop(head, "shoulders", np.random.default_rng(4))
    path = folder / "scan.obj"
    write_obj(path, bust.with_vertices(factor * bust.vertices))
    return path


@pytest.mark.parametrize("unit", ["auto", "cm"])
def test_a_size_of_no_unit_is_the_same_warning_to_check_and_registration(
    unit: str, tmp_path: Path
) -> None:
    path = write(tmp_path, 1 / 3.7)
    frame = {**FRAME, "unit": unit}
    found = check(path, template(), frame, "unknown", None)
    severities = {finding.code: finding.severity for finding in found.findings}
    assert severities["scan.unit_unknown"] == "warning"
    assert judge_findings(found.findings) == "usable"
    _, start, _ = find_start(mend(read_raw(path))[0], template(), frame, None)
    assert not start.size.is_known
    assert start.mm_per_unit == found.figures["mm_per_unit"] == pytest.approx(3.7, rel=0.12)


def test_a_given_unit_that_cannot_be_is_refused_by_both(tmp_path: Path) -> None:
    path = write(tmp_path, 1.0)
    frame = {**FRAME, "unit": "cm"}
    found = check(path, template(), frame, "unknown", None)
    (refused,) = [finding for finding in found.findings if finding.severity == "error"]
    with pytest.raises(InputError) as caught:
        find_start(mend(read_raw(path))[0], template(), frame, None)
    assert (caught.value.code, caught.value.message) == (refused.code, refused.message)
    assert refused.code == "scan.scale"


def test_a_verdict_is_by_the_limits_that_are_given() -> None:
    face = face_points(face_surface(template()))
    samples = sample(template().skin.vertices, template().skin.faces)
    here = Similarity(1.0, np.eye(3), np.zeros(3))

    def judge(options: RefinementOptions) -> tuple[bool, bool]:
        pose = refine_pose(face, samples, here, 1.0, options)
        return pose.is_face, pose.is_good

    assert judge(RefinementOptions()) == (True, True)
    assert judge(RefinementOptions(good_cost=0.0)) == (True, False)
    assert judge(RefinementOptions(face_cost=0.0)) == (False, True)
    assert judge(RefinementOptions(face_share=1.0)) == (False, True)


def test_landmarks_replace_the_search(tmp_path: Path) -> None:
    head = person(np.random.default_rng(5), neutral=True)
    turn = Rotation.from_rotvec([0.4, 2.0, -0.3]).as_matrix()
    vertices = np.array(list(landmark_vertices(template()).values()))
    scan, _ = mend(raw_scan(head.vertices @ turn.T / 10, head.faces))
    points = head.vertices[vertices] @ turn.T / 10
    marks = points, template().skin.vertices[vertices]
    found = locate_face(
        scan, sample(scan.vertices, scan.faces, scan.normals), template(), FRAME, marks
    )
    assert found.is_face
    assert found.size.unit.name == "cm"
    assert found.motion.then(Similarity(1.0, turn, np.zeros(3))).degrees < 6.0


@pytest.mark.parametrize("number", [6, 26])
def test_an_open_mouth_between_holes_is_a_face(number: int) -> None:
    """Its rigid fit is no better than that of the back of a head, its likeness is."""
    rng = np.random.default_rng(number)
    shapes = template().shapes
    assert shapes is not None
    who = 0.8 * rng.standard_normal(len(shapes.identity))
    vertices = template().skin.vertices + np.tensordot(who, shapes.identity, 1)
    vertices += shapes.expressions[shapes.expression_names.index("jawOpen")]
    seen = crop(template().skin.with_vertices(vertices), "holes", rng)
    found = locate(raw_scan(seen.vertices, seen.faces))
    assert found.is_face
    assert not found.pose.is_face
    assert found.motion.degrees < 12.0


def test_the_back_of_a_head_is_no_face() -> None:
    skin = template().skin
    depth = skin.vertices[:, 2]
    behind = (depth < np.quantile(depth, 0.45))[skin.faces].all(axis=1)
    assert not locate(raw_scan(skin.vertices, skin.faces[behind])).is_face


def test_without_a_face_the_finding_says_so() -> None:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=95.0)
    lumps = 1 + 0.06 * np.sin(ball.vertices[:, [1, 2, 0]] / 23.0).sum(axis=1, keepdims=True)
    scan = replace(raw_scan(ball.vertices * lumps, np.asarray(ball.faces)), mm_per_unit=1.0)
    frame = {**FRAME, "unit": "mm", "up": "y", "forward": "z"}
    (finding,) = location_findings(scan, locate(scan, frame), frame)
    assert (finding.code, finding.severity) == ("scan.not_a_face", "error")
