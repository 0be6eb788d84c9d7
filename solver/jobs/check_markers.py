"""The job that checks a take of markers, with the person's rig or without."""

from __future__ import annotations

import time
from pathlib import Path

from solver.anatomy.template import Template
from solver.errors import Finding, InputError, judge_findings
from solver.jobs import Task
from solver.kinds.check_markers import CheckMarkers
from solver.model import SubjectModel
from solver.progress import Step
from solver.registration.locate import face_surface
from solver.scans.markers.bind import frames_about, model_face
from solver.scans.markers.check import Reference, check_take
from solver.scans.markers.findings import ADVICE, MarkerCheck
from solver.scans.markers.marker_set import MarkerSet
from solver.scans.markers.picture import check_picture
from solver.scans.markers.take import read_take
from solver.storage import write_json
from solver.templates.builtin.build import builtin_template


def run(task: Task[CheckMarkers]) -> list[Path]:
    """Check a take: whether it can be used, and which label is wrong, when and how.

    A bad take, also one that cannot be read, is a verdict and no exception. With a rig it leaves
    ``markers.json`` as well, a marker set that is proposed for the session. Raises
    :class:`solver.errors.InputError` for a rig, marker set or template that cannot be used.
    """
    path, progress = task.inputs["markers"], task.progress
    progress(Step("read", 0.0, message=path.name))
    start = time.perf_counter()
    reference = _reference(task)
    labels: tuple[str, ...] = ()
    progress(Step("check", 0.2))
    try:
        take = read_take(path)
        labels = take.labels
        neutral = frames_about(take, task.options.neutral)
        found = check_take(take, reference, neutral, actor=task.options.actor)
    except InputError as error:
        advice = ADVICE.get(error.code, ADVICE["markers.unreadable"])
        found = MarkerCheck([Finding(error.code, "error", error.message, advice, error.context)])
    judged = judge_findings(found.findings)
    progress(Step("pictures", 0.8))
    files = [task.out / "check.json", task.out / "check.png"]
    check_picture(found, labels, reference.face, f"{path.name}: {judged}", files[1])
    report = {
        "file": path.name,
        "verdict": judged,
        "findings": [finding.to_dict() for finding in found.findings],
        "labels": found.labels,
        "figures": found.figures | {"seconds": round(time.perf_counter() - start, 2)},
    }
    write_json(files[0], report)
    if found.bound is not None:
        files.append(task.out / "markers.json")
        found.bound.save(files[2])
    progress(Step("done", 1.0, message=judged))
    return files


def _reference(task: Task[CheckMarkers]) -> Reference:
    """Return the rig's person with the session's marker set, or a face that is nobody's."""
    files = task.inputs
    if "rig" in files or "model" in files:
        model = SubjectModel.load(files.get("model", files.get("rig", Path())))
        markers = MarkerSet.load(files["marker_set"]) if "marker_set" in files else None
        return Reference(model_face(model), model.sha256, markers)
    given = files.get("template")
    return Reference(face_surface(builtin_template() if given is None else Template.load(given)))
