"""The photographs of a job: read with what lies beside each, and the face of each found."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from solver.anatomy.template import Template
from solver.errors import Finding, InputError, quote_names
from solver.jobs import Task
from solver.kinds import MOST_PHOTOS
from solver.landmarker import HELP, landmarker_file
from solver.photo.detect import Box, find_face, judge_size, judge_turn
from solver.photo.expression import begin_camera
from solver.photo.mesh_points import landmark_points
from solver.photo.oddities import find_left_out, find_oddities
from solver.photo.photo import Photo
from solver.photo.read import read_photo
from solver.registration.detector import FaceDetector
from solver.registration.landmarks import landmark_vertices


def read_photos(task: Task[Any], names: Collection[str] = ()) -> list[Photo]:
    """Return the photographs of a job, each called as its capture is.

    ``names`` are landmarks of the job's template. Raises :class:`InputError`: ``job.missing``
    without any, ``photo.too_many``, ``photo.alone`` for what lies beside a photograph that is not
    given, one photograph's own error, or ``photo.several`` with the ``faults`` of several.
    """
    if not task.captures:
        raise InputError("job.missing", "the job needs a photograph", expected="photo")
    if len(task.captures) > MOST_PHOTOS:
        message = f"{len(task.captures)} photographs are given: a job reads {MOST_PHOTOS} at most"
        raise InputError("photo.too_many", message, expected=MOST_PHOTOS)
    for name in (*task.facts, *task.masks):
        if name not in task.captures:
            given = ", ".join(task.captures)
            message = f"there is no photograph {name}, beside which a file is given: {given} are"
            raise InputError("photo.alone", message, found=name, expected=[*task.captures])
    photos: list[Photo] = []
    faults: list[InputError] = []
    for name, path in task.captures.items():
        try:
            photo = read_photo(path, task.facts.get(name), task.masks.get(name), names)
        except InputError as fault:
            fault.context.setdefault("photo", name)
            faults.append(fault)
        else:
            photos.append(replace(photo, name=name))
    if len(faults) == 1:
        raise faults[0]
    if faults:
        message = f"{len(faults)} photographs cannot be used: " + "; ".join(
            fault.message for fault in faults
        )
        raise InputError("photo.several", message, faults=[each.as_dict() for each in faults])
    return photos


def read_faces(
    task: Task[Any], template: Template, boxes: Mapping[str, Sequence[float]]
) -> tuple[dict[str, Photo], dict[str, list[Finding]]]:
    """Return the photographs by their names, and what is odd about each.

    ``boxes`` say which face is meant. Raises :class:`InputError` as :func:`read_photos`,
    ``landmarks.*`` and ``photo.*`` where landmarks have to be found, ``photo.small``, and
    ``photo.neutral`` for a box of no photograph.
    """
    photos = {photo.name: photo for photo in read_photos(task, landmark_vertices(template).keys())}
    for name in boxes:
        if name not in photos:
            known = quote_names(sorted(photos))
            message = f"options.boxes: there is no photograph {name!r}: {known} are"
            raise InputError("photo.neutral", message, photo=name)
    findings: dict[str, list[Finding]] = {name: [] for name in photos}
    unmarked = [name for name, photo in photos.items() if not photo.landmarks]
    points = landmark_points(template)
    for name, photo in photos.items():
        findings[name] += find_left_out(photo, points)
        if not photo.landmarks:
            continue
        camera, _ = begin_camera(photo, points, template.skin.vertices)
        findings[name] += judge_turn(name, camera.yaw)
        if photo.eyes_px is not None:
            findings[name] += judge_size(name, photo.eyes_px, camera.yaw)
    if unmarked:
        with FaceDetector(find_landmarker(unmarked[0])) as detector:
            for name in unmarked:
                face = find_face(photos[name], detector, as_box(boxes.get(name)))
                photos[name] = replace(photos[name], landmarks=face.landmarks)
                findings[name] += face.findings
    for name, photo in photos.items():
        findings[name] += find_oddities(photo)
    return photos, findings


def as_box(given: Sequence[float] | None) -> Box | None:
    """Return the box that an option gives; None without one."""
    if given is None:
        return None
    left, top, right, bottom = given
    return left, top, right, bottom


def find_landmarker(photo: str) -> Path:
    """Return the detector's file; ``photo`` is one that has no landmarks."""
    file = landmarker_file()
    if file is None:
        message = (
            f"{photo} has no landmarks, and nothing here finds them: give them as JSON beside it "
            f"(landmarks), or {HELP}"
        )
        raise InputError("landmarks.model", message, file=photo)
    return file
