"""The photographs of a job: read with what lies beside each, faults of all told at once."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import Any

from solver.errors import InputError
from solver.jobs import Task
from solver.kinds import MOST_PHOTOS
from solver.photo.photo import Photo
from solver.photo.read import read_photo


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
