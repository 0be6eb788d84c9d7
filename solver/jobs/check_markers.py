"""The job that checks a take of markers, with the person's rig or without."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from solver.errors import Finding, InputError, judge_findings, quote, worst_first
from solver.fitting import prior
from solver.fitting.expression_basis import LINEAR, ExpressionBasis
from solver.fitting.face import Face
from solver.fitting.markers.reach import reach
from solver.fitting.prior import GaussianPrior
from solver.jobs import Task, read_template
from solver.kinds.check_markers import CheckMarkers
from solver.mechanics.linear import fastest
from solver.model import SubjectModel
from solver.progress import Step
from solver.registration.locate import face_surface
from solver.rig import Rig
from solver.scans.markers.check import check_picture, check_take
from solver.scans.markers.findings import ADVICE, MarkerCheck, add
from solver.scans.markers.places.bind import Reference, rest_places
from solver.scans.markers.places.face_take import frames_about
from solver.scans.markers.readers.take import read_take
from solver.storage import write_json


def run(task: Task[CheckMarkers]) -> list[Path]:
    """Check a take: whether it can be used, and which label is wrong, when and how.

    A bad take, also one that cannot be read, is a verdict and no exception. With a rig it leaves
    ``markers.json`` as well, a marker set that is proposed for the session. Raises
    :class:`solver.errors.InputError` for a rig, marker set or template that cannot be used.
    """
    path = task.inputs["markers"]
    progress = task.progress
    progress(Step("read", 0.0, message=path.name))
    start = time.perf_counter()
    reference = _reference(task)
    progress(Step("check", 0.2))
    try:
        take = read_take(path)
        neutral = frames_about(take, task.options.neutral)
        found = check_take(take, reference, neutral, actor=task.options.actor)
    except InputError as error:
        advice = ADVICE.get(error.code, ADVICE["markers.unreadable"])
        found = MarkerCheck([Finding(error.code, "error", error.message, advice, error.context)])
    judged = judge_findings(found.findings)
    # a take that cannot be used determines no muscles
    if "rig" in task.inputs and found.bound is not None and judged != "bad":
        progress(Step("muscles", 0.5))
        _report_reach(task, found)
    progress(Step("pictures", 0.8))
    files = [task.out / "check.json", task.out / "check.png"]
    check_picture(found, reference.face, f"{path.name}: {judged}", files[1])
    report = {
        "file": path.name,
        "verdict": judged,
        "findings": [finding.to_dict() for finding in worst_first(found.findings)],
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
        shown = task.options.expression
        expression = None if shown is None else Rig.load(files).expression(shown)
        return Reference.given(model, files, expression)
    return Reference(face_surface(read_template(task)))


def _report_reach(task: Task[CheckMarkers], check: MarkerCheck) -> None:
    """Add the rig's muscles that the markers determine, and where one more would help most."""
    assert check.bound is not None
    rig = Rig.load(task.inputs)
    face = rig.face(fastest())
    markers = check.bound.used
    found = reach(face, markers, _prior(task, rig, face))
    names = rig.model.muscle_names
    known = rest_places(replace(check.bound, markers=markers), rig.model.skin)
    check.figures |= {
        "muscles": len(names),
        "muscles_determined": found.known_muscles,
        "muscles_following": found.following_muscles,
    }
    words = f"{len(markers)} markers determine {found.known_muscles} of {len(names)} muscles"
    if found.following_muscles:
        words += f", and {found.following_muscles} more as they go along in known expressions"
    information = {
        name: round(float(each), 3) for name, each in zip(names, found.information, strict=True)
    }
    further = []
    for each in found.further:
        away = np.linalg.norm(known - each.place, axis=1)
        nearest = int(np.nanargmin(away))
        further.append(
            {
                "place_mm": each.place.round(1).tolist(),
                "gain": round(each.gain, 3),
                "beside": quote(markers[nearest].label),
                "beside_mm": round(float(away[nearest]), 1),
                "muscles": [names[muscle] for muscle in each.muscles],
            }
        )
    first = further[0]
    where = f"{first['beside_mm']:.0f} mm beside {first['beside']}"
    message = f"{words}; one more would help most {where}: {' and '.join(first['muscles'])}."
    add(check, "markers.reach", "info", message, information=information, further=further)


def _prior(task: Task[CheckMarkers], rig: Rig, face: Face) -> GaussianPrior:
    """Return the prior of the template's shapes, or of the rig's expressions."""
    shapes = read_template(task).shapes
    if shapes is not None and shapes.expressions.shape[1] == len(face.model.skin.vertices):
        return prior.from_basis(face, ExpressionBasis.solve(face, shapes.expressions, LINEAR))
    poses = [face.pose_of(each.activations, each.jaw).vector() for each in rig.expressions]
    return prior.from_changes(face.layout, [pose - face.layout.rest for pose in poses], prior.LOOSE)
