"""Actions of muscles: places are on the left, and the ways are those of a real smile."""

from __future__ import annotations

import numpy as np

from benchmarks.muscle_actions import (
    PLACES,
    find_place,
    goes_as_said,
    lid_gap,
    muscle_actions,
    named_muscles,
)
from tests.fixtures import small_capture, small_model

BY_MUSCLE = {action.muscle: action for action in muscle_actions()}
SMILE = BY_MUSCLE["zygomaticus major"]
FROWN = BY_MUSCLE["depressor anguli oris"]
BROW = BY_MUSCLE["frontalis medial part"]


def test_a_smile_is_that_of_zygomaticus_major() -> None:
    model = small_model()
    corner = find_place(model, SMILE.place)
    motion = (small_capture("smile").vertices - model.skin.vertices)[corner]
    assert goes_as_said(SMILE, motion)["as_texts"]
    assert not goes_as_said(FROWN, motion)["as_texts"]
    # on the other side lateral is the other way
    assert not goes_as_said(SMILE, motion * [-1.0, 0.2, 1.0])["as_texts"]
    assert not goes_as_said(SMILE, 0.001 * motion)["as_texts"]
    brow = find_place(model, BROW.place)
    surprise = (small_capture("surprise").vertices - model.skin.vertices)[brow]
    assert goes_as_said(BROW, surprise)["as_texts"]


def test_places_and_muscles_are_of_the_left() -> None:
    model = small_model()
    for action in BY_MUSCLE.values():
        assert action.place in PLACES
        place = model.skin.vertices[find_place(model, action.place)]
        in_the_middle = action.place in ("glabella", "tip of the nose")
        assert len(place) > 3
        assert np.ptp(place, axis=0).max() < 50.0
        assert (abs(place[:, 0].mean()) < 3.0) if in_the_middle else (place[:, 0].min() > 0.0)
    parts = [model.muscle_names[number] for number in named_muscles(model, "zygomaticus major")]
    assert parts == ["zygomaticus_major_l"]
    ring = named_muscles(model, "orbicularis oris", both=True)
    assert {model.muscle_names[number][-2:] for number in ring} == {"_l", "_r"}


def test_lids_that_meet_leave_no_gap() -> None:
    model = small_model()
    skin = model.skin.vertices.copy()
    open_mm = lid_gap(model, skin)
    assert 5.0 < open_mm < 14.0
    upper = model.region("left_upper_lid")
    skin[upper, 1] -= open_mm - 3.0
    assert np.isclose(lid_gap(model, skin), 3.0)
    skin[upper, 1] -= 5.0
    assert lid_gap(model, skin) == 0.0
