"""The tables of rigs and artifacts."""

from __future__ import annotations

from sqlalchemy import select
from sqlalchemy.orm import Session, selectinload

from service import paging
from service.errors import Problem, not_found
from service.paging import Slice
from service.queue.states import State
from service.store.models import PREVIEW_FILE, Artifact, Job, Rig, is_preview_of

RIG_FILE = "rig.npz"  # the whole rig: the model, S and the expressions


def get(session: Session, rig_id: str) -> Rig:
    """Return a rig."""
    rig = session.get(Rig, rig_id)
    if rig is None:
        raise not_found("rig", rig_id)
    return rig


def newest(session: Session, subject_id: str | None, limit: int, cursor: str | None) -> Slice[Rig]:
    """Return rigs, newest first."""
    query = select(Rig).options(selectinload(Rig.artifacts))
    if subject_id is not None:
        query = query.where(Rig.subject_id == subject_id)
    return paging.newest(session, query, limit, cursor)


def preview(session: Session, rig: Rig) -> Artifact | None:
    """Return the preview of a rig by the newest job that made one."""
    return session.scalars(
        select(Artifact)
        .join(Job, Job.id == Artifact.job_id)
        .where(
            Job.subject_id == rig.subject_id,
            Job.state == State.SUCCEEDED,
            is_preview_of(rig.id),
            Artifact.name == PREVIEW_FILE,
        )
        .order_by(Job.created_at.desc())
        .limit(1)
    ).one_or_none()


def blendshapes(session: Session, rig: Rig) -> Artifact | None:
    """Return the blendshapes of a rig that its newest animation solved."""
    return session.scalars(
        select(Artifact)
        .join(Job, Job.id == Artifact.job_id)
        .where(
            Job.subject_id == rig.subject_id,
            Job.state == State.SUCCEEDED,
            Job.kind == "animate",
            Job.request["rig_id"].as_string() == rig.id,
            Artifact.name == "blendshapes.npz",
        )
        .order_by(Job.created_at.desc())
        .limit(1)
    ).one_or_none()


def artifact_of_rig(session: Session, rig: Rig, name: str) -> Artifact:
    """Return a rig's artifact by its name."""
    if name == PREVIEW_FILE and (found := preview(session, rig)):
        return found
    return artifact_of_job(session, rig.job_id, name)


def artifact(session: Session, artifact_id: str) -> Artifact:
    """Return an artifact."""
    found = session.get(Artifact, artifact_id)
    if found is None:
        raise not_found("artifact", artifact_id)
    return found


def artifact_of_job(session: Session, job_id: str, name: str) -> Artifact:
    """Return a job's artifact by its name."""
    found = session.scalars(
        select(Artifact).where(Artifact.job_id == job_id, Artifact.name == name)
    ).one_or_none()
    if found is None:
        raise Problem(404, "artifact.unknown", f"there is no artifact {name}", job_id=job_id)
    return found
