"""The job that fits a film: weights of shapes and a head, frame after frame of its pictures."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from typing_extensions import override

from solver.anatomy.skin_points import SkinPoints
from solver.anatomy.template import Template
from solver.errors import InputError, SolveError
from solver.fitting.contraction import Contraction
from solver.fitting.face import Face
from solver.jobs import Task
from solver.jobs.photos import as_box, find_landmarker
from solver.jobs.sequences import (
    DECIMALS,
    FrameFitter,
    distance_figures,
    fit_frames,
    frame_numbers,
    shape_controls,
    write_animated,
)
from solver.kinds.fit_photo import FitPhoto
from solver.live.landmarks import IMAGE_AXES
from solver.photo.archive import CAMERA
from solver.photo.camera import PinholeCamera
from solver.photo.detect import Box
from solver.photo.expression import marks_of, read_neutral
from solver.photo.film import FilmOptions, FilmTracker, find_focal
from solver.photo.film_marks import FilmMarks, find_marks
from solver.photo.footage import Footage, Pictures, open_film
from solver.photo.mesh_points import landmark_points
from solver.photo.oddities import find_closed_eyes
from solver.photo.photo import Photo
from solver.photo.report import SeenFace, photo_picture
from solver.progress import Step, part_of
from solver.registration.landmarks import landmark_vertices
from solver.rig.frames import Status, sequence_report, write_sequence
from solver.rig.frames.animation_gltf import AnimatedSkin
from solver.rig.frames.shape_frames import ShapeFrame, read_shape_frames
from solver.similarity import IDENTITY, small_motion
from solver.tracks.fit import ShapeFace, State
from solver.tracks.plain import PlainFace

MOST_SHOTS = 6  # frames in the picture
FOUND = 0.1  # part of a job after which landmarks are found


class FilmFitter(FrameFitter[ShapeFrame]):
    """Fits and draws the frames of a film.

    The world is that of the first frame that is fitted: the head is at its place there, y is up
    and z leads to the camera, which stands still.
    """

    def __init__(
        self, source: Footage, marks: FilmMarks, tracker: FilmTracker[Any], numbers: range
    ) -> None:
        self._source = source
        self._marks = marks
        self._tracker = tracker
        self._face: ShapeFace[Any] = tracker.face
        self.camera: PinholeCamera | None = None  # in the world
        self.faults: dict[int, str] = {}  # why frames could not be fitted
        self.skin = AnimatedSkin(self._face.face.model.skin)
        self._shown = {numbers[k] for k in np.linspace(0, len(numbers) - 1, MOST_SHOTS).astype(int)}
        self._seen: Photo | None = None  # that the face is fitted to as it is
        self.shots: list[SeenFace] = []

    @override
    def read(self, folder: Path) -> list[ShapeFrame]:
        def take(values: Mapping[str, Any], _frames: Sequence[ShapeFrame]) -> None:
            if stored := values["camera"]:
                parts = {name: np.array(stored[name], np.float64) for name in CAMERA}
                self.camera = PinholeCamera(**parts)

        sizes = len(self._face.tracks.names), self._face.face.model.muscle_count
        return read_shape_frames(folder, *sizes, take)

    @override
    def take_up(self, frame: ShapeFrame, position: int) -> None:
        self._seen = None
        if frame.status != "fitted" or self.camera is None:
            self._tracker.pause()
            return
        tracker = self._tracker
        head = small_motion(frame.head)
        is_shown = frame.frame in self._shown
        photo = self._photo(frame.frame) if is_shown or tracker.needs_look else None
        if tracker.needs_look and photo is not None:
            tracker.step(photo)  # light and albedo are those of the first frame
        with suppress(SolveError):  # out of reach: the next frame begins where this one did
            tracker.begin(frame.controls, self.camera.with_head(head))
            self._seen = photo if is_shown else None

    @override
    def fit(self, number: int) -> ShapeFrame:
        begun = time.perf_counter()
        photo = self._photo(number)
        self._seen = None
        steps = 0
        status: Status = "unseen"
        if photo is None:
            self._tracker.pause()
        else:
            try:
                steps = self._tracker.step(photo)
                status = "fitted"
                self._seen = photo
            except (InputError, SolveError, np.linalg.LinAlgError) as error:
                status = "kept"
                self.faults[number] = str(error)
        if self.camera is None and self._tracker.point is not None:
            self.camera = replace(self._tracker.point.cameras[0], rotation=IMAGE_AXES)
        return self._frame(number, status, steps, photo, time.perf_counter() - begun)

    def _photo(self, number: int) -> Photo | None:
        """Return a frame with its landmarks; None where no face is seen."""
        if number not in self._marks.landmarks:
            return None
        found = self._source.photo(number)
        return replace(found, landmarks=self._marks.landmarks[number])

    def _frame(
        self, number: int, status: Status, steps: int, photo: Photo | None, seconds: float
    ) -> ShapeFrame:
        """Return the record of a frame."""
        points = self._tracker.points
        point = self._tracker.point
        shown = 0.0
        off = np.zeros(0)
        head = IDENTITY
        if point is not None and self.camera is not None:
            head = self.camera.head_of(point.cameras[0])
        if photo is not None:
            known, given = marks_of(photo, points)
            shown = len(given) / len(points.names)
            if status == "fitted" and point is not None:
                camera = point.cameras[0]
                seen = camera.project(known.at(point.skin))
                apart = np.linalg.norm(seen[:, :2] - given, axis=1)
                off = apart * seen[:, 2] / camera.focal.mean()
        return ShapeFrame(
            frame=number,
            status=status,
            **shape_controls(self._tracker.state),
            head=head.twist.round(DECIMALS),
            **distance_figures(off),
            coverage=round(shown, 4),
            iterations=steps,
            seconds=round(seconds, 4),
        )

    @override
    def show(self, frame: ShapeFrame, position: int) -> None:
        tracker = self._tracker
        self.skin.add(frame, self._face.skin(tracker.state))
        if self._seen is not None and tracker.point is not None and frame.frame in self._shown:
            (camera,) = tracker.point.cameras
            look = tracker.look and tracker.look.turned(camera.rotation.T)
            self.shots.append(SeenFace(self._seen, camera, tracker.point.skin, look))

    @override
    def beside(self) -> dict[str, Any]:
        """Return the film's camera, once there is one."""
        return {"camera": None if self.camera is None else self.camera_values}

    @property
    def camera_values(self) -> dict[str, list[Any]]:
        """The film's camera as JSON values."""
        assert self.camera is not None, "a frame was fitted"
        return {name: getattr(self.camera, name).tolist() for name in CAMERA}


def fit_film(
    task: Task[FitPhoto],
    driven: ShapeFace[Any],
    face: Face,
    template: Template,
    options: FilmOptions,
) -> list[Path]:
    """Fit the frames of a film and write what sequences leave, and ``photo.png``.

    ``driven`` is the face that is fitted, ``face`` that of the rig's muscles.
    Frames that are ready are in ``out/frames``; with ``resume`` the fit goes on after those that
    are there. Raises :class:`~solver.errors.InputError`: ``film.*``, ``photo.*``,
    ``options.frames``, and ``sequence.nothing`` where no frame could be fitted.
    """
    with ExitStack() as opened:
        source = _open(task, [*landmark_vertices(template)], opened)
        return _fit(task, source, driven, face, landmark_points(template), options)


def _fit(
    task: Task[FitPhoto],
    source: Footage,
    driven: ShapeFace[Any],
    face: Face,
    points: SkinPoints,
    options: FilmOptions,
) -> list[Path]:
    """Fit the frames of a film in turn, by the landmarks' ``points`` on the skin."""
    given = task.options
    out = task.out
    progress = task.progress
    model = face.model
    numbers = frame_numbers(source.name, range(len(source)), given)
    neutral = _neutral(given, source)
    looking = part_of(progress, 0.0, FOUND)

    def show(part: float) -> None:
        looking(Step("landmarks", part))

    marks = find_marks(source, numbers, find_landmarker, _box(given, source), neutral, show)
    tracker = _tracker(driven, source, marks, points, options, neutral)
    fitter = FilmFitter(source, marks, tracker, numbers)
    done = fit_frames(task, numbers, fitter, source.name)
    progress(Step("export", 0.96))
    report = sequence_report(done, given.fps, source.name)
    at_rest = {} if neutral is None else marks.landmarks.get(neutral, {})
    closed = find_closed_eyes(given.neutral or source.name, at_rest)
    report |= {
        "system": "T" if given.model == "tracks" else "B",
        "film": {"size": list(marks.size), "camera": fitter.camera_values},
        "missing": {str(number): code for number, code in marks.missing.items()},
        "faults": {str(number): reason for number, reason in fitter.faults.items()},
        "notices": [each.as_dict() for each in (*marks.oddities(source.name), *closed)],
    }
    animated, report["files"] = write_animated(out, fitter.skin, model, given.fps)
    beside: dict[str, Any] = {"shapes": driven.tracks.names, "picture": marks.size}
    beside |= {f"camera_{name}": values for name, values in fitter.camera_values.items()}
    contraction = Contraction.of_face(face)
    files = write_sequence(out, done, model.muscle_names, given.fps, report, contraction, 0, beside)
    picture = out / "photo.png"
    photo_picture(model, fitter.shots, points, picture)
    progress(Step("done", 1.0))
    return [*files, *animated, picture]


def _open(task: Task[FitPhoto], landmarks: Sequence[str], opened: ExitStack) -> Footage:
    """Return the job's pictures: a film's file, folder or ZIP, or photographs in their order."""
    if "film" in task.inputs:
        return opened.enter_context(open_film(task.inputs["film"], landmarks))
    if not task.captures:
        raise InputError("job.missing", "the job needs a film, or its pictures", expected="film")
    return Pictures("the film", task.captures, task.facts, task.masks, landmarks)


def _box(given: FitPhoto, source: Footage) -> Box | None:
    """Return the box of the face that is meant: of the first frame that shows it."""
    if len(given.boxes) > 1:
        message = f"options.boxes: {len(given.boxes)} are given, a film has one: of its first frame"
        raise InputError("photo.neutral", message, found=len(given.boxes), expected=1)
    for name, box in given.boxes.items():
        if source.number(name) is None:
            message = f"options.boxes: {source.name} has no frame {name!r}"
            raise InputError("photo.neutral", message, photo=name)
        return as_box(box)
    return None


def _neutral(given: FitPhoto, source: Footage) -> int | None:
    """Return the number of the frame with the neutral face, if one is named."""
    if given.neutral is None:
        return None
    number = source.number(given.neutral)
    if number is None:
        message = f"options.neutral: {source.name} has no frame {given.neutral!r}"
        raise InputError("photo.neutral", message, photo=given.neutral)
    return number


def _tracker(
    face: ShapeFace[State],
    source: Footage,
    marks: FilmMarks,
    points: SkinPoints,
    options: FilmOptions,
    neutral: int | None,
) -> FilmTracker[State]:
    """Return what fits the frames: its focal length is known by then, and its neutral."""
    seen = [*marks.landmarks]
    chosen = np.linspace(0, len(seen) - 1, min(options.focal_frames, len(seen))).astype(int)

    def photo(number: int) -> Photo:
        return replace(source.photo(number), landmarks=marks.landmarks[number])

    told = [photo(seen[place]) for place in chosen]
    known = next((each.camera for each in told if each.camera is not None), None)
    plain = PlainFace(face.face.model, face.tracks)
    focal = find_focal(plain, told, points, options) if known is None else known.focal
    tracker = FilmTracker(face, points, focal, options)
    if neutral is not None:
        if code := marks.missing.get(neutral):
            message = f"options.neutral: frame {neutral} shows no face that can be used ({code})"
            raise InputError("photo.neutral", message, photo=str(neutral), found=code)
        at_rest = tracker.known(photo(neutral))
        look = read_neutral(face, at_rest, points, options.expression)
        tracker.points = look.points
        if look.appearance is not None:
            tracker.look = look.appearance.turned(look.camera.rotation)
    return tracker
