"""The registered form of a capture: its own file, or what the newest fitting registration left."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy.orm import Session

from service.captures import repository
from service.store.models import Artifact, Capture, Job

KIND = "register_scan"
MESH = "registered.ply"


@dataclass(frozen=True)
class RegisteredForm:
    """A mesh in the template's topology: a name that people recognise, and the file's sha256."""

    filename: str
    sha256: str


def registered_form(
    session: Session, capture: Capture, neutral_sha256: str | None = None
) -> RegisteredForm | None:
    """Return a capture's registered form; None: it is raw and not registered.

    Expressions are registered from a neutral and lie in its frame. ``neutral_sha256`` asks for the
    newest form that was made from this neutral, so that no fit mixes two.
    """
    if capture.registered:
        return RegisteredForm(capture.filename, capture.sha256)
    for job in repository.succeeded_jobs(session, KIND, [capture.id]):
        if neutral_sha256 in (None, neutral_of(job)):
            return RegisteredForm(f"{capture.name}.{MESH}", mesh(job).sha256)
    return None


def neutral_of(job: Job) -> str | None:
    """Return the sha256 of the registered neutral that a job read, if it read one."""
    return next((item["sha256"] for item in job.inputs if item["role"] == "neutral"), None)


def mesh(job: Job) -> Artifact:
    """Return the registered mesh of a successful ``register_scan`` job."""
    return next(artifact for artifact in job.artifacts if artifact.name == MESH)
