"""Places of markers by their labels."""

from __future__ import annotations

import pytest

from solver.scans.markers.readers.names import read_name, read_names


@pytest.mark.parametrize(
    ("label", "region", "side"),
    [
        ("LBRO1", "brow", 1),
        ("RBRO3", "brow", -1),
        ("Leyebrow_Inside", "brow", 1),
        ("LeftInnerBrow", "brow", 1),
        ("Eyebrow_Center", "glabella", 0),
        ("Mouth_UpL1", "upper_lip", 1),
        ("Mouth_Rend", "mouth", -1),
        ("Mouth_Down", "lower_lip", 0),
        ("LLIP", "lower_lip", 0),
        ("right_cheek_low", "cheek", -1),
        ("NoseHead_L", "nose", 1),
        ("LNSTRL", "nostril", 1),
        ("Chin_R2", "chin", -1),
        ("ForeHead_M", "forehead", 0),
        ("LFHD", "head", 1),
        ("LBHD", "back_of_head", 1),
        ("infraorbital_l", "orbit", 1),
        ("R_Orb_Up", "orbit", -1),
    ],
)
def test_a_label_has_a_region_and_a_side(label: str, region: str, side: int) -> None:
    named = read_name(label)
    assert named is not None
    assert (named.region, named.side) == (region, side)
    assert named.place[0] * side >= 0


def test_names_of_the_orbit_are_off_the_lids() -> None:
    by_label = {
        label: read_name(label)
        for label in ("LLid_Up", "LLid_Low", "Supraorbital_L", "Infraorbital_L", "LOrbit")
    }
    up, low, above, below, rim = (each.place[1] for each in by_label.values() if each)
    assert above > up + 5.0
    assert below < low - 5.0
    assert rim == below


@pytest.mark.parametrize(
    ("label", "part"),
    [
        ("headband_2", "head"),
        ("lower_teeth_1", "lower_teeth"),
        ("C7", "ignore"),
        ("LSHO", "ignore"),
    ],
)
def test_a_label_names_what_its_marker_rides_on(label: str, part: str) -> None:
    named = read_name(label)
    assert named is not None
    assert named.part == part


@pytest.mark.parametrize("label", ["M001", "*12", "foo", "Lens", ""])
def test_other_labels_name_no_place(label: str) -> None:
    assert read_name(label) is None


@pytest.mark.parametrize("start", [0, 1])
def test_plain_numbers_are_the_68_points(start: int) -> None:
    named = read_names([f"{number + start}" for number in range(68)])
    assert all(named)
    tip = named[30]
    right = named[36]
    left = named[45]
    assert tip is not None
    assert tip.place == (0, 0, 0)
    assert right is not None
    assert left is not None
    assert right.place[0] == -left.place[0] < 0
