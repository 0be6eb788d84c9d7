"""The landmarks of all frames of a film, found before any of them is fitted.

A face is looked for where it was in the frame before. Where it is not seen there, one elsewhere is
the same if it is near, or if it has been away for some frames: somebody else may be in the picture.
What is seen for a moment alone is no face: detectors take a lamp or a hand for one.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Self

import numpy as np

from solver.errors import Finding, InputError, count_words, make_warning, quote_names
from solver.photo.detect import Box, FaceLimits, PhotoFace, find_face
from solver.photo.footage import Footage
from solver.photo.oddities import find_oddities
from solver.photo.photo import Photo
from solver.registration.detector import FaceDetector
from solver.surface import Floats

# why a frame has no face that can be fitted: what is wrong with its picture is told
UNSEEN = (
    *("photo.no_face", "photo.faces", "photo.small", "photo.profile", "photo.cut_off"),
    "photo.mask_empty",
)
ODD = {
    "photo.blurred": "a blurred face",
    "photo.exposure": "a face in too much light or too little",
}
BRIEF = "photo.brief"  # of a frame whose face is seen for a moment alone


@dataclass(frozen=True)
class MarkOptions:
    """What counts as the face of a film."""

    # a face is known from frame to frame, so that a smaller one will do than in a photograph
    limits: FaceLimits = field(default_factory=lambda: FaceLimits(eyes_px=(60.0, 20.0)))
    least_run: int = 3  # frames after one another in which a face has to be seen
    near: float = 1.0  # from its place in the frame before, of its size: the same face ...
    away: int = 5  # ... and anywhere after so many frames in which it is not seen
    judged: int = 100  # frames at most, all over the film, whose light and sharpness are looked at


MARK_OPTIONS = MarkOptions()


@dataclass(frozen=True)
class FilmMarks:
    """Landmarks by the frames' numbers; ``missing`` says by a code why others have none."""

    landmarks: Mapping[int, Mapping[str, Floats]]
    missing: Mapping[int, str]
    size: tuple[int, int]  # of the pictures, px
    judged: int = 0  # frames that were looked at for oddities
    odd: Mapping[str, Sequence[int]] = field(default_factory=dict)  # code -> those that are

    def oddities(self, name: str) -> Iterator[Finding]:
        """Yield what is odd about frames of the film ``name``, each oddity once."""
        for code, numbers in self.odd.items():
            words = count_words(len(numbers), f"has {ODD[code]}", f"have {ODD[code]}")
            shown = ", ".join(quote_names(numbers))
            message = f"{name}: of {self.judged} frames that were looked at {words}: {shown}"
            yield make_warning(code, message, {"file": name, "frames": [*numbers]})


def find_marks(
    footage: Footage,
    numbers: Sequence[int],
    landmarker: Callable[[str], Path],
    box: Box | None = None,
    neutral: int | None = None,
    show: Callable[[float], None] = lambda _part: None,
    options: MarkOptions = MARK_OPTIONS,
) -> FilmMarks:
    """Return the landmarks of the frames ``numbers``: those beside them, else those found.

    ``landmarker`` gives the detector's file, and is asked only where a frame, whose name it gets,
    has no landmarks. ``box`` says which face is meant in the first frame that shows one: until it
    is seen there, nobody else is. ``neutral`` is one more frame, which is not of the film's run.
    ``show`` is told how far it is. Raises :class:`InputError`: ``film.sizes`` for pictures of
    different sizes, ``photo.faces`` where several are seen and no box says which,
    ``photo.no_face`` where no frame has one, and what is wrong with a picture.
    """
    found: dict[int, Mapping[str, Floats]] = {}
    missing: dict[int, str] = {}
    seen = set[int]()  # by the detector
    size: tuple[int, int] | None = None
    searched = sorted({*numbers} if neutral is None else {*numbers, neutral})
    odd: dict[str, list[int]] = {}
    places = np.linspace(0, len(numbers) - 1, min(options.judged, len(numbers))).round()
    judged = {numbers[int(place)] for place in places}
    with _Finder(landmarker, box, options) as finder:
        for done, number in enumerate(searched, 1):
            photo = footage.photo(number)
            size = size or photo.size
            if photo.size != size:
                message = (
                    f"{footage.name}: {photo.name} has {photo.size[0]} x {photo.size[1]} px, "
                    f"frames before it {size[0]} x {size[1]}: frames of a film are of one size"
                )
                raise InputError("film.sizes", message, photo=photo.name, found=list(photo.size))
            try:
                if photo.landmarks:
                    found[number] = photo.landmarks
                else:
                    found[number] = finder.find(photo)
                    seen.add(number)
            except InputError as error:
                if error.code not in UNSEEN or (error.code == "photo.faces" and not found):
                    raise
                missing[number] = error.code
            if number in judged and number in found:
                marked = replace(photo, landmarks=found[number])
                for code in dict.fromkeys(each.code for each in find_oddities(marked)):
                    odd.setdefault(code, []).append(number)
            show(done / len(searched))
    assert size is not None, "frames were chosen"
    for number in (each for each in _brief(numbers, found, options.least_run) if each in seen):
        del found[number]
        missing[number] = BRIEF
    if not found:
        message = f"{footage.name}: no face is seen in any of its {len(numbers)} frames"
        raise InputError("photo.no_face", message, file=footage.name)
    return FilmMarks(found, missing, size, len(judged & found.keys()), odd)


class _Finder:
    """Finds the face of one frame after the other; the detector is there once it is needed."""

    def __init__(
        self, landmarker: Callable[[str], Path], box: Box | None, options: MarkOptions
    ) -> None:
        self._landmarker = landmarker
        self._options = options
        self._box = box
        self._is_known = False  # whether the face has been seen
        self._away = 0  # frames since then
        self._detector = ExitStack()
        self._open: FaceDetector | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_about: object) -> None:
        self._detector.close()

    def find(self, photo: Photo) -> Mapping[str, Floats]:
        """Return a photograph's landmarks; raises as :func:`~solver.photo.detect.find_face`."""
        if self._open is None:
            self._open = self._detector.enter_context(FaceDetector(self._landmarker(photo.name)))
        self._away += 1
        face = self._look(photo, self._open)
        self._box = face.box
        self._is_known = True
        self._away = 0
        return face.landmarks

    def _look(self, photo: Photo, detector: FaceDetector) -> PhotoFace:
        options = self._options
        if self._box is None:
            return find_face(photo, detector, None, options.limits)
        try:
            return find_face(photo, detector, self._box, options.limits)
        except InputError as error:
            if error.code != "photo.no_face" or not self._is_known:
                raise
            face = find_face(photo, detector, None, options.limits)
            if self._away <= options.away and _apart(face.box, self._box) > options.near:
                raise
            return face


def _apart(box: Box, before: Box) -> float:
    """Return how far the middle of a box is from where it was before, by its size then."""
    corners, others = np.reshape(box, (2, 2)), np.reshape(before, (2, 2))
    moved = np.linalg.norm(corners.mean(axis=0) - others.mean(axis=0))
    return float(moved / np.ptp(others, axis=0).max())


def _brief(numbers: Sequence[int], found: Collection[int], least: int) -> list[int]:
    """Return the frames of runs that are shorter than ``least`` frames, and than all of them."""
    brief = list[int]()
    run = list[int]()
    for number in [*numbers, None]:
        if number is not None and number in found:
            run.append(number)
            continue
        brief += run if len(run) < min(least, len(numbers)) else []
        run = []
    return brief
