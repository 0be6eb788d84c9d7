"""Where flesh glides on the cranium of the built-in head, and what the table may name."""

from dataclasses import replace

import numpy as np
import pytest

from solver.anatomy.bones import facial_spaces, gliding
from solver.anatomy.data import missing_landmarks, read_table
from solver.anatomy.template import TemplateMesh
from solver.model import name_words
from solver.templates.builtin.build import builtin_template
from solver.templates.ict_template import LANDMARKS

MIRROR = np.array([-1.0, 1.0, 1.0])


@pytest.fixture(scope="module")
def head():
    return builtin_template()


@pytest.fixture(scope="module")
def on_cranium(head):
    """Points (k, 3) of the mesh on the cranium, and whether flesh glides at each."""
    points = head.mesh.vertices[head.mesh.cranium]
    return points, gliding(head, points)


def under(head, points, landmark, radius=12.0):
    """Whether each of the points lies near a landmark of the skin."""
    place = head.skin.vertices[head.landmarks[landmark]]
    return np.linalg.norm(points - place, axis=1) < radius


def test_flesh_glides_on_forehead_and_cheek_bones_and_nowhere_else(head, on_cranium):
    points, glides = on_cranium
    for landmark in ("metopion", "malar_l", "malar_r"):
        assert glides[under(head, points, landmark, 16.0)].any(), landmark
    for landmark in ("nasion", "rhinion", "subnasale", "endocanthion_l", "tragus_l", "temple_l"):
        assert not glides[under(head, points, landmark)].any(), landmark
    assert points[glides, 2].min() > head.skin.vertices[head.landmarks["tragus_l"], 2] + 30.0


def test_both_sides_glide_alike(head, on_cranium):
    points = on_cranium[0]
    sides = gliding(head, points), gliding(head, points * MIRROR)
    assert (sides[0] != sides[1]).mean() < 0.02  # the muscles' surfaces are a little askew


def test_ligaments_and_origins_hold(head, on_cranium):
    points, glides = on_cranium
    height = head.skin.vertices[head.landmarks["mid_infraorbital_l"], 1]
    rim = under(head, points, "mid_infraorbital_l") & (points[:, 1] > height - 1.0)
    assert rim.any()
    assert not glides[rim].any()
    for muscle in ("zygomaticus_major_l", "zygomaticus_minor_l"):
        origin = next(each.origin for each in head.muscles if each.name == muscle)
        nearest = np.linalg.norm(points - origin, axis=1).argmin()
        assert not glides[nearest], muscle


def test_a_head_without_landmarks_glides_under_the_frontalis_alone(head, on_cranium):
    points, glides = on_cranium
    bare = gliding(replace(head, landmarks={}), points)
    assert bare.any()
    assert not (bare & ~glides).any()
    brow = head.skin.vertices[head.landmarks["brow_middle_l"], 1]
    assert points[bare, 1].min() > brow - 10.0


def test_meshes_of_before_keep_their_cranium(head):
    arrays = head.mesh.arrays()
    slid = head.mesh.cranium[::7]
    arrays |= {"cranium": np.setdiff1d(head.mesh.cranium, slid), "sliding": slid}
    again = TemplateMesh.from_arrays(arrays, len(head.muscles))
    np.testing.assert_array_equal(again.cranium, np.sort(head.mesh.cranium))


def test_the_table_names_what_both_templates_have():
    paths = [space.path for space in facial_spaces()]
    tables = ("landmarks", "bodyparts3d_landmarks")
    both = [{row["name"].replace(" ", "_") for row in read_table(table)} for table in tables]
    both[1] |= {name.removesuffix("_l") for name in LANDMARKS}
    for names in both:
        assert missing_landmarks(paths, dict.fromkeys(names, 0)) == []
    muscles = [
        [" ".join(name_words(row[column])) for row in read_table(table)]
        for table, column in (("muscles", "name"), ("bodyparts3d_muscles", "muscle"))
    ]
    for space in facial_spaces():
        for name in (*space.under, *space.origins):
            assert all(any(name in each for each in names) for names in muscles), name


def test_every_row_names_its_source():
    known = {row["key"] for row in read_table("sources")}
    rows = read_table("facial_spaces")
    assert {key for row in rows for key in row["source"].split()} <= known
    assert all(row["source"] and row["kind"] in ("space", "ligament") for row in rows)
