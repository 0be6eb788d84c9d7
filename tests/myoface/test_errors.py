"""Errors as one line."""

from __future__ import annotations

import pytest

from myoface.errors import describe


@pytest.mark.parametrize(
    ("problem", "line"),
    [
        (
            {"detail": "a.obj has 1,234 vertices, not 26719", "expected": 26719, "found": 1234},
            "a.obj has 1,234 vertices, not 26719 (x)",
        ),
        (
            {"message": "a.obj is 0.51 mm across, a head 120 to 500", "expected": [120.0, 500.0]},
            "a.obj is 0.51 mm across, a head 120 to 500 (x)",
        ),
        ({"message": "a.obj is 0.51 mm across", "found": 0.5123}, "a.obj is 0.51 mm across (x)"),
        ({"detail": "too large", "expected": 10, "line": 3}, "too large (line 3, expected 10, x)"),
        ({"detail": "13 vertices", "found": 3}, "13 vertices (found 3, x)"),
        (
            {"message": "no rest after 11 steps", "frame": 11, "time": 11 / 30},
            "no rest after 11 steps (frame 11, time 0.366667, x)",
        ),
        ({"detail": "take, frame 11: too large", "frame": 11}, "take, frame 11: too large (x)"),
    ],
)
def test_nothing_is_said_twice(problem: dict[str, object], line: str) -> None:
    assert describe({**problem, "code": "x"}) == line
