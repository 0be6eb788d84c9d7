"""Swaps that last: found from the frame in which labels cross to the one in which they return."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from solver.scans.markers.readers.take import Take, read_take
from solver.scans.markers.signal.faults import Faults, find_faults
from tests.fixtures import data_folder
from tests.solver.scans.markers.made_take import LABELS, RATE, made_positions, made_take

FRAMES = 100
PAIRS = (
    ("Mouth_Lend", "Lcheek_Down"),
    ("Mouth_Lend", "Mouth_UpL1"),
    ("Mouth_Down", "Mouth_DownL"),
    ("Mouth_Rend", "Rcheek_Down"),
)


def swapped(take: Take, pair: tuple[str, str], rows: slice) -> Take:
    columns = [take.labels.index(label) for label in pair]
    positions = take.positions.copy()
    positions[rows, columns] = positions[rows, columns[::-1]]
    return replace(take, positions=positions)


def swaps(faults: Faults, labels: tuple[str, ...]) -> set[tuple[str, int, int]]:
    return {(labels[each.marker], each.first, each.last) for each in faults.of("swapped")}


@pytest.mark.parametrize("pair", PAIRS, ids="-".join)
@pytest.mark.parametrize("name", ["jaw", "nose"])
def test_a_long_swap_in_a_recorded_take_is_found_whole_and_put_right(
    name: str, pair: tuple[str, str]
) -> None:
    take = read_take(data_folder("markers", "animface", f"{name}.c3d"))
    for first in (330, 500, 700):  # the mouth opens, the nose is wrinkled, lips are pulled down
        last = first + FRAMES - 1
        spoilt = swapped(take, pair, slice(first, last + 1))
        faults = find_faults(spoilt.positions, take.rate)
        assert swaps(faults, take.labels) == {(label, first, last) for label in pair}
        assert not faults.of("outlier", "ghost", "relabelled", "moved")
        right, exchanged = faults.put_right(spoilt.positions)
        measured = np.isfinite(right)
        assert measured.mean() > 0.99 * np.isfinite(take.positions).mean()
        np.testing.assert_array_equal(right[measured], take.positions[measured])
        assert exchanged.sum() == 2 * FRAMES


def test_swaps_go_on_to_the_end_and_come_back_after_gaps() -> None:
    take = made_take(made_positions(600))
    end = 600
    one = ("LCheek", "LCheek_Up")
    other = ("LowerLip", "LowerLip_L")
    spoilt = swapped(swapped(take, one, slice(400, end)), other, slice(300, 420))
    columns = [LABELS.index(label) for label in other]
    spoilt.positions[296:300, columns] = np.nan
    faults = find_faults(spoilt.positions, RATE)
    expected = {(label, 400, end - 1) for label in one} | {(label, 300, 419) for label in other}
    assert swaps(faults, LABELS) == expected


def test_markers_that_leap_without_an_exchange_are_not_swapped() -> None:
    positions = made_positions(600)
    one = LABELS.index("LCheek")
    other = LABELS.index("LCheek_Up")
    positions[300:310, [one, other]] += [0.0, 25.0, 0.0]
    assert not find_faults(positions, RATE).of("swapped")
