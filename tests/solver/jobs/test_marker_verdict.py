"""The verdict of a fitted take: what was rejected is counted, and told with label and frames."""

from __future__ import annotations

import numpy as np

from solver.errors import make_warning
from solver.jobs.marker_verdict import judge_fit

LABELS = tuple(f"M{number}" for number in range(20))
NUMBERS = range(101, 181)


def frames() -> tuple[np.ndarray, np.ndarray]:
    shape = len(NUMBERS), len(LABELS)
    return np.full(shape, "seen", "<U10"), np.full(shape, 0.5)


def test_a_fit_that_keeps_all_markers_is_good_unless_something_was_noticed() -> None:
    found = judge_fit(LABELS, NUMBERS, *frames())
    assert (found["verdict"], found["findings"]) == ("good", [])
    assert found["all_markers"] == {
        **{"mean_mm": 0.5, "p95_mm": 0.5, "max_mm": 0.5, "max_label": "M0", "max_frame": 101},
        "rejected": 0.0,
    }
    odd = [make_warning("markers.other_person", "it is another's")]
    assert judge_fit(LABELS, NUMBERS, *frames(), odd)["verdict"] == "usable"


def test_rejected_markers_count_and_are_told_with_label_and_frames() -> None:
    states, off = frames()
    states[18:80, 3] = "outlier"
    off[18:80, 3] = 13.4
    states[40:43, 4:8] = "outlier"
    off[40:43, 4:8] = 6.0
    off[0, 9] = np.nan
    found = judge_fit(LABELS, NUMBERS, states, off)
    assert found["verdict"] == "usable"
    assert found["all_markers"]["max_mm"] == 13.4
    assert found["all_markers"]["max_label"] == "M3"
    assert found["all_markers"]["max_frame"] == 119
    assert found["all_markers"]["mean_mm"] > 1.0
    assert found["all_markers"]["rejected"] == round(74 / (80 * 20 - 1), 4)
    label, at_once = found["findings"]
    assert (label["code"], label["label"], label["frames"]) == (
        "markers.rejected",
        "M3",
        [[119, 180]],
    )
    assert label["share"] == 0.775
    assert (at_once["code"], at_once["frames"]) == ("markers.rejected_frames", [[141, 143]])
    assert at_once["labels"] == ["M3", "M4", "M5", "M6", "M7"]


def test_a_fit_that_rejects_a_third_or_is_far_off_everywhere_is_bad() -> None:
    states, off = frames()
    states[:, :7] = "outlier"
    found = judge_fit(LABELS, NUMBERS, states, off)
    assert (found["verdict"], found["findings"][0]["code"]) == ("bad", "markers.rejected_most")
    states, off = frames()
    found = judge_fit(LABELS, NUMBERS, states, off + 4.0)
    assert (found["verdict"], found["findings"][0]["code"]) == ("bad", "markers.far_off")


def test_labels_that_were_kept_though_far_off_are_told_worst_first() -> None:
    states, off = frames()
    off[:, 2] = 2.5
    off[:, 11] = 4.0
    found = judge_fit(LABELS, NUMBERS, states, off)
    (finding,) = found["findings"]
    assert (finding["code"], finding["labels"]) == ("markers.label_off", ["M11", "M2"])
    assert "M11 4.0, M2 2.5" in finding["message"]


def test_a_region_that_the_face_does_not_follow_is_told() -> None:
    states, off = frames()
    labels = [*LABELS[:16], "Chin", "Chin_L2", "Chin_R2", "Mouth_Down"]
    off[:, 16:] = 1.9  # of a face that is as good elsewhere
    assert judge_fit(labels, NUMBERS, states, off)["verdict"] == "good"
    off[:, 16:] = 4.0
    found = judge_fit(labels, NUMBERS, states, off)
    region, label = found["findings"]
    assert (region["code"], region["region"]) == ("markers.region_off", "jaw")
    assert (region["found"], region["expected"]) == (4.0, 0.5)
    assert label["code"] == "markers.label_off"
