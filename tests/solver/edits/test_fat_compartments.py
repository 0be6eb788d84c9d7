"""The fat compartments of the built-in person and of ICT-FaceKit's landmarks."""

import numpy as np
import pytest

from solver.anatomy.data import SIDES, read_table
from solver.edits.fat_compartments import fat_map, missing_landmarks, read_compartments, shares
from solver.scene.places import Places
from solver.surface import directed_edges
from tests.fixtures import small_model

GAINS = pytest.mark.parametrize("gain", [True, False])


@pytest.fixture(scope="module")
def places() -> Places:
    """The built-in person's landmarks."""
    return Places.of(small_model(), None, {})


def in_region(places: Places, painted: np.ndarray, name: str) -> float:
    model = places.model
    return float(painted[np.intersect1d(model.regions[name], model.face)].mean())


@GAINS
def test_fat_comes_and_goes_in_cheeks_and_jowls_not_on_nose_and_lips(
    places: Places, gain: bool
) -> None:
    painted = fat_map(places.model, places.landmarks, gain=gain)
    assert 0.0 <= painted.min() < painted.max() <= 1.0
    assert min(in_region(places, painted, name) for name in ("cheeks", "jaw")) > 0.4
    bare = ("nose", "upper_lip", "lower_lip", "left_upper_lid", "right_upper_lid")
    assert max(in_region(places, painted, name) for name in bare) < 0.05


@GAINS
def test_the_map_has_no_edges(places: Places, gain: bool) -> None:
    skin = places.model.skin
    painted = fat_map(places.model, places.landmarks, gain=gain)
    one, other = directed_edges(skin.faces).T
    far = np.linalg.norm(skin.vertices[one] - skin.vertices[other], axis=1)
    assert (np.abs(painted[one] - painted[other]) / far).max() < 0.1  # a mm


def test_both_sides_are_alike(places: Places) -> None:
    painted = fat_map(places.model, places.landmarks, gain=True)
    names = {name[:-2] for name in places.landmarks if name.endswith(SIDES[0])}
    left, right = (painted[[places.landmarks[n + side] for n in sorted(names)]] for side in SIDES)
    np.testing.assert_allclose(left, right, atol=0.1)  # the person is a little askew


def test_the_templates_have_the_landmarks_that_place_compartments(places: Places) -> None:
    assert missing_landmarks(places.landmarks) == []
    tables = ("bodyparts3d_landmarks", "ict_landmarks")
    names = [row["name"].replace(" ", "_") for table in tables for row in read_table(table)]
    assert missing_landmarks({name.removesuffix(SIDES[0]): 0 for name in names}) == []
    assert "menton" in missing_landmarks({"nose_tip": 0, "gonion_l": 1})


def test_shares_follow_the_depths_of_a_sex() -> None:
    assert max(shares(gain=True).values()) == 1.0
    # sunken cheeks rather than a full nasolabial fold: that is what slender faces have
    assert shares(gain=False)["nasolabial"] > 2 * shares(gain=True)["nasolabial"]
    assert shares(gain=True, sex="female") != shares(gain=True, sex="male")


def test_every_row_names_its_source() -> None:
    known = {row["key"] for row in read_table("sources")}
    for table in ("fat_compartments", "depths_by_weight"):
        assert {key for row in read_table(table) for key in row["source"].split()} <= known
    assert len({each.name for each in read_compartments()}) == len(read_compartments())
