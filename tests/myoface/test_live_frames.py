"""The client's own few lines of the layout of frames, and the solver's."""

from __future__ import annotations

import math
from array import array

import pytest

from myoface.client.live_frames import pack_frame, read_frame
from myoface.errors import ApiError
from solver.kinds.live_messages import GAP, HELD, RESUMED, FollowedFrame, GivenFrame

LAYOUT = [{"name": "head", "shape": [4, 4]}, {"name": "values", "shape": [2]}]
PLACES = {"rows": 3, "width": 3, "labels": ["a", "b", "c"]}


@pytest.mark.parametrize(
    ("numbers", "expects", "found"),
    [
        ([0.25, 1], {"rows": 2, "width": 1}, [0.25, 1]),
        (array("f", [0.25, 1]), {"width": 1}, [0.25, 1]),
        (array("f", [0.25, 1]).tobytes(), {}, [0.25, 1]),
        ([[1, 2, 3], None], {"width": 3}, [1, 2, 3, *[math.nan] * 3]),
        ({"c": [7, 8, 9], "a": (1, 2, 3)}, PLACES, [1, 2, 3, *[math.nan] * 3, 7, 8, 9]),
        ({"b": 0.5}, {"width": 1, "labels": ["a", "b"]}, [math.nan, 0.5]),
    ],
)
def test_the_solver_reads_what_the_client_packs(
    numbers: object, expects: dict[str, object], found: list[float]
) -> None:
    given = GivenFrame.unpack(pack_frame(2**32 + 7, 0.1, numbers, expects))  # type: ignore[arg-type]
    assert (given.number, given.seconds) == (7, 0.1)
    assert list(array("f", given.numbers)) == pytest.approx(found, nan_ok=True)


def test_the_client_reads_what_the_solver_packs() -> None:
    numbers = array("f", range(18))
    flags = HELD | RESUMED | GAP
    sent = FollowedFrame(7, 0.5, 2.5, math.nan, 0.5, 3, flags, numbers.tobytes())
    face = read_frame(sent.pack(), LAYOUT)
    assert (face.number, face.seconds, face.solve_ms, face.dropped) == (7, 0.5, 2.5, 3)
    assert math.isnan(face.error_p50_mm)
    assert (face.is_held, face.is_resumed, face.is_gap) == (True, True, True)
    assert (len(face.arrays["head"]), list(face.arrays["values"])) == (16, [16, 17])


@pytest.mark.parametrize("data", [b"", b"MYF<", b"MYF>" + bytes(60), b"MYF<\2" + bytes(60)])
def test_other_bytes_are_no_frame(data: bytes) -> None:
    with pytest.raises(ApiError) as refused:
        read_frame(data, LAYOUT)
    assert refused.value.code == "client.frame"
