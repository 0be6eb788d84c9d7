"""The files a job reads, looked up and fixed when it is submitted.

An input is ``{"role", "name", "filename", "sha256"}``: ``filename`` is the user's own name for the
file, so that an error in it can name it.
"""

from __future__ import annotations

from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.captures import repository as captures
from service.errors import Problem, unknown
from service.jobs import repository
from service.jobs.schemas import NewJob
from service.kinds import Kind
from service.rigs import repository as rigs
from service.store.models import Capture, Rig
from service.subjects import repository as subjects
from service.templates import repository as templates

Input = dict[str, Any]


def resolve(session: Session, kind: Kind, new: NewJob) -> tuple[list[Input], str | None]:
    """Return what a job will read, and the id of the job that made its model, if it uses one."""
    subjects.get(session, new.subject_id)
    for member, read in (("captures", "captures"), ("rig_id", "rig")):
        if getattr(new, member) and read not in kind.reads:
            raise Problem(422, "job.unexpected", f"{kind.kind} takes no {member}", member=member)
    inputs: list[Input] = []
    model_job_id = None
    if "neutral" in kind.reads:
        inputs += _neutral(session, new)
    if "model" in kind.reads:
        model_job_id = _newest_model(session, new)
    if "rig" in kind.reads:
        rig = _parent(session, new)
        model_job_id = rig.model_job_id
        inputs += [
            _artifact(session, rig.job_id, "weights", "muscle_weights.npz"),
            _artifact(session, rig.job_id, "rig", "activations.npz"),
        ]
    if model_job_id:
        inputs.append(_artifact(session, model_job_id, "model", "model.npz"))
    if "captures" in kind.reads:
        inputs += _captures(session, new)
    return inputs, model_job_id


def _neutral(session: Session, new: NewJob) -> list[Input]:
    neutral = captures.neutral(session, new.subject_id)
    if neutral is None:
        raise Problem(
            409,
            "subject.no_neutral",
            "the subject has no neutral capture",
            subject_id=new.subject_id,
        )
    found = [_capture("neutral", neutral)]
    template_id = subjects.get(session, new.subject_id).template_id
    if template_id:
        template = templates.get(session, template_id)
        found.append(_input("template", template.name, template.filename, template.sha256))
    return found


def _newest_model(session: Session, new: NewJob) -> str:
    job = repository.newest_model(session, new.subject_id)
    if job is None:
        raise Problem(
            409,
            "subject.no_model",
            "the subject has no model; run build_model first",
            subject_id=new.subject_id,
        )
    return job.id


def _parent(session: Session, new: NewJob) -> Rig:
    if new.rig_id is None:
        raise Problem(422, "job.missing", f"{new.kind} needs rig_id", member="rig_id")
    rig = rigs.get(session, new.rig_id)
    if rig.subject_id != new.subject_id:
        raise Problem(409, "rig.other_subject", "the rig is another subject's", rig_id=rig.id)
    return rig


def _captures(session: Session, new: NewJob) -> list[Input]:
    if not new.captures:
        raise Problem(422, "job.missing", f"{new.kind} needs captures", member="captures")
    rows = session.scalars(
        select(Capture).where(
            Capture.subject_id == new.subject_id, Capture.id.in_(set(new.captures))
        )
    )
    found = {capture.id: capture for capture in rows}
    for capture_id in new.captures:
        if capture_id not in found:
            raise unknown("capture", capture_id)
        if found[capture_id].role == "neutral":
            raise Problem(
                422,
                "capture.not_an_expression",
                f"{found[capture_id].name} is the neutral capture",
                capture_id=capture_id,
            )
    return [_capture("capture", found[capture_id]) for capture_id in dict.fromkeys(new.captures)]


def _artifact(session: Session, job_id: str, role: str, name: str) -> Input:
    artifact = rigs.artifact_of_job(session, job_id, name)
    return _input(role, name, name, artifact.sha256)


def _capture(role: str, capture: Capture) -> Input:
    return _input(role, capture.name, capture.filename, capture.sha256)


def _input(role: str, name: str, filename: str, sha256: str) -> Input:
    return {"role": role, "name": name, "filename": filename, "sha256": sha256}
