"""The face in a video as a recording: shapes' weights, head and eyes of every frame, by MediaPipe.

Frames are looked at one by one, each by itself, and none is kept. Faces are then followed from
frame to frame by where they are: one is taken, the largest at the middle, and what is seen
elsewhere for a moment once it is gone is nobody.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from solver.errors import Finding, InputError, count_words, make_warning
from solver.landmarker import HELP, landmarker_file
from solver.registration.detector import DetectedFace, DetectorOptions, FaceDetector
from solver.scans.film import FILM_LIMITS, FilmLimits, decode_film
from solver.scans.live_link import ARKIT_NAMES, FaceTake
from solver.scans.signals import eyes_of
from solver.surface import Floats


@dataclass(frozen=True)
class VideoOptions:
    """How faces are found and followed."""

    most_faces: int = 4  # that are looked for in a frame
    limits: FilmLimits = FILM_LIMITS
    running: int = 5  # frames in which a face has to be seen, where none was before
    near: float = 0.5  # of a face's size: so far it goes from one frame to the next that has it
    alike: float = 1.6  # ratio of its sizes in both, at most
    bystander: float = 0.4  # of the largest face's size: smaller ones are not told


VIDEO = VideoOptions()


def weights_of(face: DetectedFace) -> Floats:
    """Return what is measured of a face: weights (52,) of ARKit's shapes, 0 of those not told."""
    return np.array([face.weights.get(name, 0.0) for name in ARKIT_NAMES])


@dataclass(frozen=True, eq=False)
class _Seen:
    """A face that was found in a frame."""

    middle: Floats  # (2,) px
    height: float  # px, from brow to chin
    eyes_px: float
    turn: Floats  # (3,) the head's rotation vector
    weights: Floats  # (52,)

    @classmethod
    def of(cls, face: DetectedFace) -> _Seen:
        left, top, right, bottom = face.box
        middle = np.array([left + right, top + bottom]) / 2
        turn = Rotation.from_matrix(face.rotation).as_rotvec()
        return cls(middle, bottom - top, face.eyes_px, turn, weights_of(face))


@dataclass(eq=False)
class _Track:
    """One face in the frames that have it."""

    frames: list[int] = field(default_factory=list)
    faces: list[_Seen] = field(default_factory=list)
    prominence: float = 0.0  # px, the sum of its sizes, less the farther from the middle it is

    def add(self, frame: int, face: _Seen, size: tuple[int, ...]) -> None:
        """Take a face of a frame of (width, height)."""
        self.frames.append(frame)
        self.faces.append(face)
        away = float(np.linalg.norm(face.middle / np.array(size) - 0.5))
        self.prominence += face.eyes_px * (1.0 - min(away, 1.0))

    @property
    def eyes_px(self) -> float:
        return float(np.median([face.eyes_px for face in self.faces]))


def read_video(
    path: Path,
    face: int | None = None,
    options: VideoOptions = VIDEO,
    progress: Callable[[int], None] = lambda _: None,
) -> FaceTake:
    """Return what is measured of a face in a video, nothing taken off.

    ``face`` is its number, 0 the largest at the middle; ``progress`` gets the number of frames that
    are done. Raises :class:`InputError`: as :func:`~solver.scans.film.decode_film` with
    ``video.extra``, ``video.unreadable``, ``video.size`` and ``video.long``; ``video.model``,
    ``video.no_face`` and ``video.faces`` where there is no face of this number.
    """
    times: list[float] = []
    tracks: list[_Track] = []
    with _detector(options) as detector:
        for picture in decode_film(path, "video", options.limits):
            pixels = picture.pixels()
            faces = [_Seen.of(each) for each in detector.faces_in(pixels)]
            _follow(tracks, len(times), faces, pixels.shape[1::-1], options)
            times.append(picture.time)
            progress(len(times))
    people = _people(tracks, min(options.running, len(times)), options)
    if not people:
        message = f"{path.name}: no face is seen in any of its {len(times)} frames"
        raise InputError("video.no_face", message, file=path.name)
    if face is not None and face >= len(people):
        known = count_words(len(people), "face is", "faces are")
        message = f"{path.name}: {known} seen, counted from 0, and none is number {face}"
        raise InputError("video.faces", message, file=path.name, expected=len(people), found=face)
    seen_by = people[face or 0]
    notices = [] if len(people) == 1 or face is not None else [_several(path.name, len(people))]
    return _take(np.array(times), seen_by, tuple(notices))


@contextmanager
def _detector(options: VideoOptions) -> Iterator[FaceDetector]:
    model = landmarker_file()
    if model is None:
        message = f"faces in videos are found with MediaPipe's face landmarker: {HELP}"
        raise InputError("video.model", message)
    try:
        detector = FaceDetector(model, DetectorOptions(options.most_faces, weights=True))
    except InputError as error:
        code = error.code.replace("landmarks.", "video.")
        raise InputError(code, error.message, **error.context) from error
    with detector:
        yield detector


def _follow(
    tracks: list[_Track],
    frame: int,
    faces: list[_Seen],
    size: tuple[int, ...],
    options: VideoOptions,
) -> None:
    """Give the faces of a frame to the tracks that end where they are; others begin new ones."""
    free = [track for track in tracks if track.frames[-1] < frame]
    middles = np.array([track.faces[-1].middle for track in free]).reshape(-1, 2)
    heights = np.array([track.faces[-1].height for track in free])
    for face in sorted(faces, key=lambda each: -each.eyes_px):
        away = np.linalg.norm(middles - face.middle, axis=1)
        low = np.minimum(heights, face.height)
        high = np.maximum(heights, face.height)
        away[(high > options.alike * low) | (away > options.near * high)] = np.inf
        if away.min(initial=np.inf) < np.inf:
            nearest = int(away.argmin())
            track = free[nearest]
            middles[nearest] = np.inf  # it is taken
        else:
            track = _Track()
            tracks.append(track)
        track.add(frame, face, size)


def _people(tracks: list[_Track], running: int, options: VideoOptions) -> list[dict[int, _Seen]]:
    """Return the faces by their frames, of one person after another, the most prominent first.

    One who is gone goes on as who comes elsewhere later, if nobody is there at both times.
    """
    lasting = [track for track in tracks if _longest_run(track.frames) >= running]
    lasting.sort(key=lambda track: -track.prominence)
    people: list[list[_Track]] = []
    for track in lasting:
        frames = set(track.frames)
        if people and not any(frames.intersection(each.frames) for each in people[0]):
            people[0].append(track)
        elif not people or track.eyes_px >= options.bystander * people[0][0].eyes_px:
            people.append([track])
    return [
        {frame: face for each in whole for frame, face in zip(each.frames, each.faces, strict=True)}
        for whole in people
    ]


def _longest_run(frames: list[int]) -> int:
    """Return how many frames follow one another at the most."""
    breaks = np.flatnonzero(np.diff(frames) > 1) + 1
    return max(len(run) for run in np.split(np.array(frames), breaks))


def _several(file: str, count: int) -> Finding:
    words = f"{count_words(count, 'face is', 'faces are')} seen, the largest at the middle is taken"
    message = f'{file}: {words}: choose another with "face"'
    return make_warning("video.faces", message, {"file": file, "count": count})


def _take(times: Floats, faces: dict[int, _Seen], notices: tuple[Finding, ...]) -> FaceTake:
    """Return the signals of a face in its frames; those of others are 0."""
    seen = np.isin(np.arange(len(times)), list(faces))
    weights = np.zeros((len(times), len(ARKIT_NAMES)))
    head = np.zeros((len(times), 3))
    for frame, face in faces.items():
        weights[frame] = face.weights
        head[frame] = face.turn
    since = times - times[0]
    return FaceTake(since, weights, head, eyes_of(weights), seen, "video", notices=notices)
