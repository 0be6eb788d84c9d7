"""Refusal of jobs that have to find faces where no living worker can.

A video is found out about at submission, not when the job has waited its turn. Workers say what
they lack (:class:`~service.store.models.Worker`); those of a release that did not say are taken for
able, and where none lives the job waits, as any other does.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from datetime import timedelta
from pathlib import PurePath
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.errors import Problem
from service.jobs.handed_on import InputFile
from service.jobs.schemas import NewJob
from service.store.database import clock
from service.store.models import Worker
from solver.kinds import Kind
from solver.kinds.inputs import FILMS

# What reading each needs, with the code of the job's error without it, the first to come first
VIDEO = {"av": "video.extra", "mediapipe": "video.extra", "landmarker": "video.model"}
PHOTO = {"mediapipe": "landmarks.extra", "landmarker": "landmarks.model"}
FILM = {"av": "film.extra", **PHOTO}

# In which a worker was seen that counts: a little longer than others count it, so that one which
# could do the job is not overlooked
ALIVE = timedelta(minutes=1)
ADVICE = {
    "extra": "install myoface[video,mediapipe] where workers run",
    "model": "run myoface assets fetch landmarker where workers run",
}


def refuse_unseen(session: Session, kind: Kind, new: NewJob, files: Iterable[InputFile]) -> None:
    """Raise :class:`Problem` for a job that every living worker of its queue would fail."""
    needs, name = _needs(new, list(files))
    if not needs:
        return
    alive = clock(session) - ALIVE
    queue = kind.given(new.options).queue
    living = session.scalars(select(Worker).where(Worker.queue == queue, Worker.seen_at > alive))
    lacks = [set(each.lacks or ()) & needs.keys() for each in living if kind.name in each.kinds]
    if not lacks or not all(lacks):
        return
    least = min(lacks, key=len)
    code = next(code for part, code in needs.items() if part in least)
    advice = ADVICE[code.partition(".")[2]]
    raise Problem(409, code, f"{name}: no worker can find faces in it: {advice}", found=name)


def _needs(new: NewJob, files: list[InputFile]) -> tuple[Mapping[str, str], str]:
    """Return what finding faces in a job's files needs, and the name of the first of them."""
    recording = _recording(new.options)
    told = {each["name"] for each in files if each["role"] == "facts"}
    if told and new.options.get("sequence") is True:
        return {}, ""  # a film whose other pictures may be passed over
    for file in files:
        is_film = PurePath(file["filename"]).suffix.lower() in FILMS
        name = file["name"]
        if file["role"] == "asset" and is_film and name == recording:
            return VIDEO, name
        if file["role"] == "film":
            return FILM if is_film else PHOTO, name
        if file["role"] == "photo" and name not in told:
            return PHOTO, name
    return {}, ""


def _recording(options: Mapping[str, Any]) -> str | None:
    """Return the asset that a scene plays as a recording."""
    scene = options.get("scene")
    recording = scene.get("recording") if isinstance(scene, Mapping) else None
    return recording.get("asset") if isinstance(recording, Mapping) else None
