"""The landmarks of all frames of a film, found before any of them is fitted.

A face is looked for where it was in the frame before, and in all of the picture where it is not
seen there. What is seen for a moment alone is no face: detectors take a lamp or a hand for one.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

from solver.errors import InputError
from solver.photo.detect import Box, FaceLimits, PhotoFace, find_face
from solver.photo.footage import Footage
from solver.photo.photo import Photo
from solver.registration.detector import FaceDetector
from solver.surface import Floats

# why a frame has no face that can be fitted: what is wrong with its picture is told
UNSEEN = (
    *("photo.no_face", "photo.faces", "photo.small", "photo.profile", "photo.cut_off"),
    "photo.mask_empty",
)
BRIEF = "photo.brief"  # of a frame whose face is seen for a moment alone


@dataclass(frozen=True)
class MarkOptions:
    """What counts as the face of a film."""

    # a face is known from frame to frame, so that a smaller one will do than in a photograph
    limits: FaceLimits = field(default_factory=lambda: FaceLimits(eyes_px=(60.0, 20.0)))
    least_run: int = 3  # frames after one another in which a face has to be seen


MARK_OPTIONS = MarkOptions()


@dataclass(frozen=True)
class FilmMarks:
    """Landmarks by the frames' numbers; ``missing`` says by a code why others have none."""

    landmarks: Mapping[int, Mapping[str, Floats]]
    missing: Mapping[int, str]
    size: tuple[int, int]  # of the pictures, px


def find_marks(
    footage: Footage,
    numbers: Sequence[int],
    landmarker: Callable[[str], Path],
    box: Box | None = None,
    show: Callable[[int], None] = lambda _number: None,
    options: MarkOptions = MARK_OPTIONS,
) -> FilmMarks:
    """Return the landmarks of the frames ``numbers``: those beside them, else those found.

    ``landmarker`` gives the detector's file, and is asked only where a frame, whose name it gets,
    has no landmarks. ``box`` says which face is meant in the first frame that shows one; ``show``
    is told of each frame. Raises :class:`InputError`: ``film.sizes`` for pictures of different
    sizes, ``photo.faces`` where several are seen and no box says which, ``photo.no_face`` where no
    frame has one, and what is wrong with a picture.
    """
    found: dict[int, Mapping[str, Floats]] = {}
    missing: dict[int, str] = {}
    seen = set[int]()  # by the detector
    size: tuple[int, int] | None = None
    with _Finder(landmarker, box, options) as finder:
        for number in numbers:
            photo = footage.photo(number)
            size = size or photo.size
            if photo.size != size:
                message = (
                    f"{footage.name}: {photo.name} has {photo.size[0]} x {photo.size[1]} px, "
                    f"frames before it {size[0]} x {size[1]}: frames of a film are of one size"
                )
                raise InputError("film.sizes", message, photo=photo.name, found=list(photo.size))
            try:
                found[number] = photo.landmarks or finder.find(photo)
                seen |= set() if photo.landmarks else {number}
            except InputError as error:
                if error.code not in UNSEEN or (error.code == "photo.faces" and not found):
                    raise
                missing[number] = error.code
            show(number)
    assert size is not None, "frames were chosen"
    for number in (each for each in _brief(numbers, found, options.least_run) if each in seen):
        del found[number]
        missing[number] = BRIEF
    if not found:
        message = f"{footage.name}: no face is seen in any of its {len(numbers)} frames"
        raise InputError("photo.no_face", message, file=footage.name)
    return FilmMarks(found, missing, size)


class _Finder:
    """Finds the face of one frame after the other; the detector is there once it is needed.

    Where it is not seen in a box, all of the picture is searched.
    """

    def __init__(
        self, landmarker: Callable[[str], Path], box: Box | None, options: MarkOptions
    ) -> None:
        self._landmarker = landmarker
        self._options = options
        self._box = box
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
        limits = self._options.limits
        if self._box is not None:
            with suppress(InputError):
                return self._keep(find_face(photo, self._open, self._box, limits))
        return self._keep(find_face(photo, self._open, None, limits))

    def _keep(self, face: PhotoFace) -> Mapping[str, Floats]:
        self._box = face.box
        return face.landmarks


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
