"""The tables of rigs and artifacts."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from sqlalchemy import ColumnElement, or_, select
from sqlalchemy.orm import Session, aliased, load_only

from service import paging
from service.errors import Problem, not_found
from service.paging import Slice
from service.queue.states import State
from service.store.models import PREVIEW_FILE, Artifact, Job, Rig, is_preview_of
from service.subjects import repository as subjects

RIG_FILE = "rig.npz"  # the whole rig: the model, S and the expressions


def get(session: Session, rig_id: str) -> Rig:
    """Return a rig."""
    rig = session.get(Rig, rig_id)
    if rig is None:
        raise not_found("rig", rig_id)
    return rig


@dataclass(frozen=True)
class RigRow:
    """A rig, whose it is, and how many seconds the job took that made it."""

    rig: Rig
    subject_name: str
    seconds: float | None


def newest(
    session: Session,
    subject_id: str | None,
    labels: Sequence[str] | None,
    limit: int,
    cursor: str | None,
) -> Slice[Rig]:
    """Return rigs, newest first, of a subject and with all of ``labels`` if they are given."""
    query = paging.filter_by_labels(select(Rig), Rig.labels, labels)
    if subject_id is not None:
        query = query.where(Rig.subject_id == subject_id)
    return paging.newest(session, query, limit, cursor)


def lock(session: Session, rig_id: str) -> Rig:
    """Return a rig that nobody else can change until the commit."""
    rig = session.get(Rig, rig_id, with_for_update=True)
    if rig is None:
        raise not_found("rig", rig_id)
    return rig


def rows(session: Session, rigs: Sequence[Rig]) -> list[RigRow]:
    """Return rigs with what other tables say of them, by two queries for all."""
    names = subjects.names(session, [rig.subject_id for rig in rigs])
    jobs = select(Job).where(Job.id.in_([rig.job_id for rig in rigs]))
    times = load_only(Job.started_at, Job.finished_at)
    took = {job.id: job.seconds for job in session.scalars(jobs.options(times))}
    return [RigRow(rig, names.get(rig.subject_id, ""), took.get(rig.job_id)) for rig in rigs]


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


def made_of_rig(rig: Rig) -> ColumnElement[bool]:
    """Return what holds of jobs that read a rig."""
    same: ColumnElement[bool] = Job.request["rig_id"].as_string() == rig.id
    return same


def made_of_model(model: Job) -> ColumnElement[bool]:
    """Return what holds of jobs that read the model which a job made."""
    return Job.model_job_id == model.id


def made_into_model(model: Job) -> ColumnElement[bool]:
    """Return what holds of the job that left the neutral which a model was built from."""
    return Job.id.in_(_neutral_of(model))


def registered_again(model: Job) -> ColumnElement[bool]:
    """Return what holds of jobs about the scan whose registration a model was built from.

    What these leave on the template's texture coordinates lies on the model's skin, too.
    """
    first = aliased(Job)
    return Job.capture_id.in_(select(first.capture_id).where(first.id.in_(_neutral_of(model))))


def _neutral_of(model: Job) -> list[str | None]:
    return [item.get("of") for item in model.inputs if item["role"] == "neutral"]


def left_by(
    session: Session,
    subject_id: str,
    made_of: ColumnElement[bool],
    kinds: Iterable[str],
    name: str,
    formats: Iterable[int],
) -> Artifact | None:
    """Return the newest artifact ``name`` that a subject's jobs of some ``kinds`` left.

    They are those that ``made_of`` holds of; it is of one of ``formats``, or of one not noted.
    """
    return session.scalars(
        select(Artifact)
        .join(Job, Job.id == Artifact.job_id)
        .where(
            Job.subject_id == subject_id,
            Job.state == State.SUCCEEDED,
            Job.kind.in_(kinds),
            made_of,
            Artifact.name == name,
            or_(Artifact.format.is_(None), Artifact.format.in_(formats)),
        )
        .order_by(Job.created_at.desc(), Job.id.desc())
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
