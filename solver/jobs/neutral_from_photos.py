"""The job that estimates a person's face at rest from photographs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from solver.anatomy.skin_points import SkinPoints
from solver.errors import Finding, InputError, make_warning
from solver.jobs import Task, read_template
from solver.jobs.photos import read_faces
from solver.kinds.neutral_from_photos import NeutralFromPhotos
from solver.meshio.registered import write_registered
from solver.model import SIZE_WORDS
from solver.photo.identity import IdentityFit, IdentityOptions, fit_identity
from solver.photo.mesh_points import landmark_points
from solver.photo.other_person import JudgedPhotos, find_other_person, not_as_the_rest
from solver.photo.photo import Photo
from solver.photo.report import camera_figures, identity_picture
from solver.progress import Step
from solver.storage import write_json

MOST_PHOTOS = 8  # that a neutral is made of
TOLD_WEIGHT = 0.05  # smaller weights of expressions are left out of the report


def run(task: Task[NeutralFromPhotos]) -> list[Path]:
    """Estimate a neutral; write ``neutral.ply``, ``neutral.json`` and ``neutral.png``.

    Raises :class:`~solver.errors.InputError`: ``photo.*``, ``landmarks.*`` where they have to be
    found.
    """
    given = task.options
    progress = task.progress
    progress(Step("read", 0.0, message=f"{len(task.captures)} photographs"))
    if len(task.captures) > MOST_PHOTOS:
        message = f"{len(task.captures)} photographs are given: a neutral is made of {MOST_PHOTOS}"
        raise InputError("photo.too_many", message, expected=MOST_PHOTOS)
    template = read_template(task)
    named, findings = read_faces(task, template, given.boxes)
    photos = [*named.values()]
    points = landmark_points(template)
    others = not_as_the_rest(template, named, points)
    for name, nats in others.nats.items():
        findings[name] += find_other_person(name, nats, "who is in the rest of the photographs")
    progress(Step("fit", 0.2))
    found = fit_identity(template, photos, points, _options(given))
    progress(Step("pictures", 0.9))
    files = [task.out / name for name in ("neutral.ply", "neutral.json", "neutral.png")]
    skin = template.skin.with_vertices(found.neutral)
    write_registered(files[0], skin, np.ones(len(found.neutral)), "photographs")
    write_json(files[1], _report(photos, found, points, findings, others))
    identity_picture(template, photos, found, points, files[2])
    progress(Step("done", 1.0))
    return files


def _options(given: NeutralFromPhotos) -> IdentityOptions:
    options = IdentityOptions()
    fit = options.views.fit
    fit = replace(
        fit,
        w_l=given.w_l,
        controls=replace(fit.controls, w_w=given.w_w),
        stop=replace(fit.stop, iterations=given.max_iterations),
    )
    return replace(options, views=replace(options.views, fit=fit))


def _report(
    photos: list[Photo],
    found: IdentityFit,
    points: SkinPoints,
    findings: dict[str, list[Finding]],
    others: JudgedPhotos,
) -> dict[str, Any]:
    """Return what is told of an estimate as JSON values."""
    odd = [each for name in findings for each in findings[name]]
    notices = [make_warning("model.estimated", SIZE_WORDS["photographs"]), *odd]
    told = {}
    for row, photo in enumerate(photos):
        weights = {
            name: round(weight, 3)
            for name, weight in found.weights[row].items()
            if weight >= TOLD_WEIGHT
        }
        told[photo.name] = {
            **camera_figures(photo, found.cameras[row], found.skins[row], points),
            "weights": weights,
            **others.figures(photo.name),
        }
    return {
        "notices": [each.as_dict() for each in notices],
        "size_from": "photographs",
        "photos": told,
        "coefficients": found.coefficients.round(4).tolist(),
        "iterations": found.steps,
        "objective": round(found.objective, 3),
    }
