"""Whose landmarks a film's are, where others are in the picture or the face is not seen."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from solver.errors import InputError
from solver.photo.detect import Box
from solver.photo.film_marks import MARK_OPTIONS, FilmMarks, find_marks
from solver.photo.photo import Photo
from tests.solver.photo.test_detect import MarkedFaces, marked

ACTOR = (300, 400, 90.0, 0.0)
STRANGER = (900, 400, 90.0, 0.0)
ACTOR_S_BOX = (240.0, 340.0, 360.0, 460.0)


class Detector(MarkedFaces):
    """The stand-in for the detector, opened as that is."""

    def __init__(self, _file: Path) -> None:
        pass

    def __enter__(self) -> Detector:
        return self

    def __exit__(self, *_about: object) -> None:
        pass


class Frames:
    """Footage of frames that are given."""

    name = "film"

    def __init__(self, frames: Sequence[Photo]) -> None:
        self._frames = frames

    def __len__(self) -> int:
        return len(self._frames)

    def photo(self, number: int) -> Photo:
        return self._frames[number]

    def number(self, name: str) -> int | None:
        return int(name)


def find(
    monkeypatch: pytest.MonkeyPatch,
    faces: Sequence[Sequence[tuple[int, int, float, float]]],
    numbers: Sequence[int] | None = None,
    box: Box | None = None,
    neutral: int | None = None,
) -> FilmMarks:
    monkeypatch.setattr("solver.photo.film_marks.FaceDetector", Detector)
    footage = Frames([marked(*each) for each in faces])
    chosen = range(len(faces)) if numbers is None else numbers
    return find_marks(footage, chosen, lambda name: Path(name), box, neutral)


def columns(marks: FilmMarks) -> dict[int, int]:
    """Return about where the face is, by frame."""
    return {
        number: round(float(np.mean([places["0"][0], places["1"][0]])))
        for number, places in marks.landmarks.items()
    }


def test_somebody_else_is_not_the_face_that_is_missed_for_a_moment(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    both = [ACTOR, STRANGER]
    marks = find(monkeypatch, [[ACTOR], [ACTOR], both, [STRANGER], both, [ACTOR], [ACTOR]])
    assert columns(marks) == dict.fromkeys([0, 1, 2, 4, 5, 6], ACTOR[0])
    assert marks.missing == {3: "photo.no_face"}


def test_a_face_that_was_away_is_found_again_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    away = MARK_OPTIONS.away
    marks = find(monkeypatch, [[ACTOR]] * 4 + [[]] * away + [[STRANGER]] * 4)
    assert columns(marks)[4 + away] == STRANGER[0]
    assert [*marks.missing] == list(range(4, 4 + away))


def test_until_the_face_of_a_box_is_seen_nobody_else_is(monkeypatch: pytest.MonkeyPatch) -> None:
    both = [ACTOR, STRANGER]
    marks = find(monkeypatch, [[STRANGER], [STRANGER], *[both] * 4], box=ACTOR_S_BOX)
    assert columns(marks) == dict.fromkeys(range(2, 6), ACTOR[0])


def test_a_face_in_profile_is_missing_and_nobody_takes_its_place(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    profile = (*ACTOR[:3], 80.0)
    marks = find(monkeypatch, [[ACTOR]] * 3 + [[profile, STRANGER]] + [[ACTOR]] * 3)
    assert marks.missing == {3: "photo.profile"}


def test_a_neutral_frame_apart_is_no_brief_run(monkeypatch: pytest.MonkeyPatch) -> None:
    faces = [[ACTOR], [], *[[ACTOR]] * 4]
    marks = find(monkeypatch, faces, range(1, 6), neutral=0)
    assert sorted(marks.landmarks) == [0, 2, 3, 4, 5]
    assert find(monkeypatch, faces).missing[0] == "photo.brief"
    with pytest.raises(InputError, match="no face is seen"):
        find(monkeypatch, [[], []], neutral=0)


def test_oddities_of_frames_are_told_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The stand-in's faces are black but for a pixel."""
    marks = find(monkeypatch, [[ACTOR]] * 4)
    (told,) = marks.oddities("clip")
    assert (told.code, told.context["frames"]) == ("photo.exposure", [0, 1, 2, 3])
    assert told.message.startswith("clip: of 4 frames that were looked at 4 have a face")
