"""Pieces of a benchmark, joined, are one run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks import fit_quality, report
from benchmarks.documents import Figures
from benchmarks.pieces import PieceError, merged


def person(mean: float, contraction: float, *sets: str) -> Figures:
    """Return figures of one subject in some sets by admissible controls."""
    lifts = {"a": contraction, "b": 2.0 * contraction, "c": 0.1}
    fit = {"train_mean_mm": mean, "inverted": 1, "expressions": {"smile": {"contractions": lifts}}}
    return {"tets": 9, **{name: {"admissible": fit} for name in sets}}


def piece(folder: Path, name: str, subjects: Figures) -> Path:
    figures = fit_quality.summarised({"subjects": subjects})
    found = report.stamped(figures, ["/somewhere/fit_quality.py", "--subjects", name])
    path = folder / f"{name}.json"
    path.write_text(json.dumps(found))
    return path


def test_pieces_by_subject_and_by_set_are_one_run(tmp_path: Path) -> None:
    whole = {"A": person(0.3, 0.2, "standard", "strong"), "B": person(0.4, 0.3, "standard")}
    files = [
        piece(tmp_path, "A", {"A": person(0.3, 0.2, "standard")}),
        piece(tmp_path, "A-strong", {"A": person(0.3, 0.2, "strong")}),
        piece(tmp_path, "B", {"B": whole["B"]}),
    ]
    found = merged("fit_quality", files)
    one = fit_quality.summarised({"subjects": whole})
    assert {key: found[key] for key in one} == one
    assert found["standard"]["admissible"]["train_mean_mm"] == 0.4
    assert found["standard"]["admissible"]["inverted"] == 2
    assert found["standard"]["admissible"]["same_muscle_other_person"] > 0.9
    assert [each["commit"] for each in found["run"]["pieces"]] == [found["run"]["commit"]] * 3
    assert "--subjects A-strong" in found["run"]["command"]


def test_pieces_that_contradict_each_other_are_no_run(tmp_path: Path) -> None:
    files = [piece(tmp_path, str(mm), {"A": person(mm, 0.2, "strong")}) for mm in (0.3, 0.4)]
    with pytest.raises(
        PieceError, match=r"0\.4\.json: subjects\.A\.strong\.admissible\.train_mean"
    ):
        merged("fit_quality", files)
    with pytest.raises(PieceError, match="is of the benchmark fit_quality, not of markers"):
        merged("markers", files)
