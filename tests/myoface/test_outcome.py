"""What a demonstration comes to."""

from __future__ import annotations

from myoface.demo.outcome import Bars, DemoOutcome, Validation

REPORT = {
    "train_mean_mm": 0.5,
    "test_mean_mm": None,
    "inverted": 0,
    "tets": 10,
    "vertices": 8,
    "muscles": 2,
    "expressions": {},
}


def test_a_session_without_unseen_expressions_is_judged_by_the_others() -> None:
    outcome = DemoOutcome(REPORT, {}, [], Validation(0, 0, ""), Bars(train_mm=0.4, test_mm=0.4))
    assert outcome.failures() == ["training mean 0.500 mm is over the bar of 0.4 mm"]
