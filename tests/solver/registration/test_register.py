"""Scans that are spoilt on purpose come back to the vertices they were made of."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from benchmarks.corruption import Corruption, corrupted
from solver.errors import InputError
from solver.meshio.raw import mend
from solver.registration.register import near_head, register
from solver.registration.report import report
from solver.registration.shape_fit import lid_shapes
from solver.registration.topology import topology
from solver.registration.units import FRAME
from solver.templates.builtin.build import builtin_template

pytestmark = pytest.mark.long

SMILE = {"mouthSmileLeft": 0.9, "mouthSmileRight": 0.9, "jawOpen": 0.4, "browInnerUp": 0.6}


@pytest.fixture(scope="module")
def known():
    return topology(builtin_template())


@pytest.fixture(scope="module")
def person(known):
    """A person the template does not have, and their smile, as surfaces with known vertices."""
    template = known.template
    shapes = template.shapes
    who = 0.5 * np.random.default_rng(7).standard_normal(len(shapes.identity))
    neutral = template.skin.vertices + np.tensordot(who, shapes.identity, 1)
    weights = [SMILE.get(name, 0.0) for name in shapes.expression_names]
    smile = neutral + np.tensordot(weights, shapes.expressions, 1)
    return template.skin.with_vertices(neutral), template.skin.with_vertices(smile)


@pytest.fixture(scope="module")
def neutral(known, person):
    raw = corrupted(person[0], 3, Corruption(unit_mm=10.0))
    return register(mend(raw)[0], known)


def errors(found, truth, known):
    return np.linalg.norm(found - truth, axis=1)[known.template.face_vertices]


def test_neutral_in_any_pose_and_unit_finds_its_vertices(known, person, neutral):
    assert neutral.start.size.unit.name == "cm"
    assert errors(neutral.skin.vertices, person[0].vertices, known).mean() < 0.8
    assert len(neutral.folded) == 0


@pytest.mark.slow
def test_a_decimal_slip_of_the_unit_keeps_the_persons_size(known, person):
    raw = corrupted(person[0], 3, Corruption(unit_mm=0.001))
    found = register(mend(raw)[0], known)
    assert found.start.mm_per_unit == pytest.approx(0.001)
    assert errors(found.skin.vertices, person[0].vertices, known).mean() < 0.8
    codes = [finding["code"] for finding in report(found, known, "scan")["findings"]]
    assert "scan.unit_unknown" not in codes


def test_holes_have_no_confidence_and_the_rest_lies_on_the_scan(known, neutral):
    trust = neutral.trust
    hidden = np.setdiff1d(np.arange(len(trust.confidence)), known.outer)
    assert not trust.confidence[hidden].any()
    assert not trust.confidence[~trust.covered].any()
    covered = trust.covered[known.face].mean()
    assert 0.6 < covered < 0.95  # a fifth was cut out
    figures = report(neutral, known, "scan")
    assert figures["mean_mm"] < 0.3
    assert figures["coverage"] == pytest.approx(covered, abs=1e-3)
    assert "registration.holes" in [finding["code"] for finding in figures["findings"]]


def test_what_is_far_off_makes_the_face_no_coarser(known, person, neutral):
    head = mend(corrupted(person[0], 3, Corruption(unit_mm=10.0)))[0]
    body = trimesh.creation.icosphere(subdivisions=3, radius=900.0)
    far = neutral.start.motion.inverse()(np.asarray(body.vertices) - [0.0, 1500.0, 0.0])
    count = len(head.vertices)
    raw = replace(
        head,
        vertices=np.vstack([head.vertices, far / neutral.start.mm_per_unit]),
        faces=np.vstack([head.faces, np.asarray(body.faces) + count]),
        normals=None,
        colours=None,
    )
    near = near_head(raw, neutral.start, known.template.skin.vertices, most=count)
    assert 0.5 * count < len(near.vertices) <= count
    assert near.faces.max() == len(near.vertices) - 1
    assert np.isin(near.vertices, head.vertices).all()
    cloud = replace(raw, faces=np.zeros((0, 3), np.int64))
    assert len(near_head(cloud, neutral.start, known.template.skin.vertices, count).faces) == 0


def test_expression_keeps_the_head_where_the_neutral_has_it(known, person, neutral):
    raw = corrupted(person[1], 5, Corruption(unit_mm=1000.0))
    found = register(mend(raw)[0], known, neutral.skin.vertices)
    assert report(found, known, "guess")["size_from"] == "guess"
    moved = found.skin.vertices - neutral.skin.vertices
    assert errors(moved, person[1].vertices - person[0].vertices, known).mean() < 0.6
    assert found.start.size.unit.name == "m"


def test_without_shapes_the_surface_is_still_met(known, person):
    plain = topology(replace(known.template, shapes=None))
    raw = corrupted(person[0], 4, Corruption(hole_share=0.0))
    found = register(mend(raw)[0], plain)
    seen = plain.face[found.trust.covered[plain.face]]
    assert found.trust.distance_mm[seen].mean() < 0.4
    assert len(found.folded) == 0


def test_what_is_no_face_is_refused(known, person):
    raw = corrupted(person[0], 6, Corruption(hole_share=0.0))
    ball = raw.vertices - raw.vertices.mean(axis=0)
    ball *= 90.0 / np.linalg.norm(ball, axis=1, keepdims=True)
    with pytest.raises(InputError) as caught:
        register(mend(replace(raw, vertices=ball))[0], known, frame={**FRAME, "unit": "mm"})
    assert caught.value.code == "scan.not_a_face"


@pytest.mark.parametrize("sides", [("left", "right"), ("left",)])
def test_a_neutral_with_shut_eyes_is_opened(known, person, sides):
    """By the template's shape; lids that nobody has seen open have no confidence."""
    lids = lid_shapes(known.template.shapes)
    true = person[0].vertices
    shut = person[0].with_vertices(true + sum(lids[side] for side in sides))
    found = register(mend(corrupted(shut, 3, Corruption()))[0], known)
    assert found.opened.keys() == set(sides)
    assert errors(found.skin.vertices, true, known).mean() < 0.9
    assert errors(found.scanned.vertices, shut.vertices, known).mean() < 0.9
    moved = np.linalg.norm(sum(lids[side] for side in sides), axis=1)
    assert (found.trust.confidence[moved > 1.0] == 0.0).all()
    upper = known.template.regions[f"{sides[0]}_upper_lid"]
    off = np.linalg.norm(found.skin.vertices - true, axis=1)[upper].mean()
    assert off < 0.3 * moved[upper].mean()
    codes = {each["code"] for each in report(found, known, None)["findings"]}
    assert "registration.eyes_opened" in codes


def test_narrow_eyes_stay_as_they_are(known, person):
    lids = lid_shapes(known.template.shapes)
    narrow = person[0].with_vertices(person[0].vertices + 0.4 * sum(lids.values()))
    found = register(mend(corrupted(narrow, 3, Corruption()))[0], known)
    assert not found.opened
    assert errors(found.skin.vertices, narrow.vertices, known).mean() < 0.8
