"""The job that brings a raw scan into a template's topology."""

from __future__ import annotations

from pathlib import Path

from solver.jobs import Task, read_template
from solver.kinds.kind import FrameOptions
from solver.meshio.raw import mend, read_raw
from solver.meshio.registered import read_registered, write_registered
from solver.progress import Step
from solver.registration.detector import landmarker_file
from solver.registration.landmarks import match, read_landmarks
from solver.registration.register import register
from solver.registration.report import distance_picture, report
from solver.registration.topology import topology
from solver.storage import write_json


def run(task: Task[FrameOptions]) -> list[Path]:
    """Register a raw scan: a neutral, or an expression if the person's ``neutral`` is given.

    ``landmarks`` are in the scan's own unit and axes. ``registered.ply`` has the template's
    vertices in mm with the property ``confidence``. Raises :class:`solver.errors.InputError` for
    files that cannot be used and for a scan without a face (``scan.not_a_face``).
    """
    scan = task.inputs["scan"]
    progress = task.progress
    neutral = task.inputs.get("neutral")
    landmarks = task.inputs.get("landmarks")
    progress(Step("read", 0.0, message=scan.name))
    anatomy = read_template(task)
    skin = anatomy.skin
    rest = None
    if neutral is not None:
        rest = read_registered(neutral, skin.faces, len(skin.vertices))
    marks = None
    if landmarks is not None:
        marks = match(landmarks.name, read_landmarks(landmarks), anatomy)
    raw, _ = mend(read_raw(scan))
    known = topology(anatomy)
    registered = register(
        raw,
        known,
        None if rest is None else rest.vertices,
        frame=task.options.model_dump(),
        landmarks=marks,
        landmarker=landmarker_file(),
        progress=progress,
    )
    progress(Step("pictures", 0.85))
    files = [task.out / name for name in ("registered.ply", "registration.json", "distance.png")]
    size_from = registered.start.size.taken_from if rest is None else rest.size_from
    write_registered(files[0], registered.skin, registered.trust.confidence, size_from)
    write_json(files[1], report(registered, known, size_from))
    distance_picture(registered, known, files[2])
    progress(Step("done", 1.0))
    return files
