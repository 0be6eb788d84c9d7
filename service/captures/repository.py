"""The table of captures, the jobs about one of them, and its registered form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy import select
from sqlalchemy.orm import Session, selectinload

from service import paging
from service.errors import not_found
from service.paging import Slice
from service.queue.states import State
from service.store.models import Artifact, Capture, Job

REGISTRATION = "register_scan"
REGISTERED_MESH = "registered.ply"


def get(session: Session, subject_id: str, capture_id: str) -> Capture:
    """Return a subject's capture."""
    capture = session.get(Capture, capture_id)
    if capture is None or capture.subject_id != subject_id:
        raise not_found("capture", capture_id)
    return capture


def of_subject(session: Session, subject_id: str) -> Sequence[Capture]:
    """Return all of a subject's captures."""
    return session.scalars(select(Capture).where(Capture.subject_id == subject_id)).all()


def newest(
    session: Session, subject_id: str, labels: Sequence[str] | None, limit: int, cursor: str | None
) -> Slice[Capture]:
    """Return a subject's captures, newest first, those with all of ``labels`` if there are any."""
    query = select(Capture).where(Capture.subject_id == subject_id)
    query = paging.filter_by_labels(query, Capture.labels, labels)
    return paging.newest(session, query, limit, cursor)


def neutral(session: Session, subject_id: str) -> Capture | None:
    """Return a subject's neutral capture."""
    return session.scalars(
        select(Capture).where(Capture.subject_id == subject_id, Capture.role == "neutral")
    ).one_or_none()


def succeeded_jobs(session: Session, kind: str, captures: Sequence[Capture]) -> Sequence[Job]:
    """Return the successful jobs of a kind about single captures, newest first.

    What was found of a scan in another role than it has now is not among them: a neutral is judged
    and registered in another way than an expression.
    """
    roles = {capture.id: capture.role for capture in captures}
    jobs = session.scalars(
        select(Job)
        .where(Job.capture_id.in_(list(roles)), Job.kind == kind, Job.state == State.SUCCEEDED)
        .options(selectinload(Job.artifacts))
        .order_by(Job.created_at.desc(), Job.id.desc())
    )
    return [job for job in jobs if _role_in(job) in (None, roles[str(job.capture_id)])]


def _role_in(job: Job) -> str | None:
    """Return the role in which a job read its scan; None: it does not say."""
    return next((item.get("capture_role") for item in job.inputs if item["role"] == "scan"), None)


@dataclass(frozen=True)
class RegisteredForm:
    """A mesh in the template's topology: a name that people recognise, and the file's sha256.

    ``of`` is the capture, or the job that registered it.
    """

    filename: str
    sha256: str
    of: str


def registered_form(
    session: Session, capture: Capture, neutral_sha256: str | None = None
) -> RegisteredForm | None:
    """Return a capture's own file, or what its newest fitting registration left; None: neither.

    Expressions are registered from a neutral and lie in its frame. ``neutral_sha256`` asks for the
    newest form that was made from this neutral, so that no fit mixes two.
    """
    if capture.registered:
        return RegisteredForm(capture.filename, capture.sha256, capture.id)
    for job in succeeded_jobs(session, REGISTRATION, [capture]):
        if neutral_sha256 in (None, neutral_of(job)):
            name = f"{capture.name}.{REGISTERED_MESH}"
            return RegisteredForm(name, registered_mesh(job).sha256, job.id)
    return None


def neutral_of(job: Job) -> str | None:
    """Return the sha256 of the registered neutral that a job read, if it read one."""
    return next((item["sha256"] for item in job.inputs if item["role"] == "neutral"), None)


def registered_mesh(job: Job) -> Artifact:
    """Return the registered mesh of a successful ``register_scan`` job."""
    return next(artifact for artifact in job.artifacts if artifact.name == REGISTERED_MESH)
