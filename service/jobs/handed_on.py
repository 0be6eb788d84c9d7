"""Files that earlier jobs left, as inputs of a job: named by job and file, no upload in between."""

from __future__ import annotations

from pathlib import PurePath
from typing import Any

from sqlalchemy.orm import Session

from service.errors import Problem
from service.jobs import repository
from service.jobs.schemas import FromJob, NewJob
from service.queue.states import State
from service.rigs import repository as rigs
from service.store.models import Artifact, Job
from solver.kinds import FILES, KINDS, Kind

InputFile = dict[str, Any]  # a file of a job, as its request keeps it

# Roles of what was made of one rig and is of no other
OF_A_RIG = frozenset(file.role for file in FILES.values() if file.of_a_rig)

# Roles that are found where none is named
FOUND = OF_A_RIG | {
    file.role for file in FILES.values() if file.of_a_neutral or file.of_expressions
}

# Roles of which a job may have several files, by their names
NAMED = frozenset({"asset", "capture", "photo", "facts", "mask", "wrinkles"})


def input_file(role: str, name: str, filename: str, sha256: str, *, of: str) -> InputFile:
    """Return a file of a job; ``role`` is what it is to the solver, ``name`` what jobs call it.

    ``of`` is the id of the capture or template whose file it is, or of the job that left it.
    """
    return {"role": role, "name": name, "filename": filename, "sha256": sha256, "of": of}


def artifact_file(role: str, artifact: Artifact, name: str | None = None) -> InputFile:
    """Return a file that a job left; jobs call it by its own name unless another is given."""
    name = name or artifact.name
    return input_file(role, name, artifact.name, artifact.sha256, of=artifact.job_id)


def handed_on(session: Session, kind: Kind, new: NewJob) -> list[InputFile]:
    """Return the files of earlier jobs that a job is to read, each with its role.

    Raises :class:`Problem` for a job that is not the subject's, has not succeeded or is of another
    rig, and for a file that it did not leave, that is no input, or none of this kind.
    """
    return [
        _input_file(session, kind, new, each, f"from_jobs.{number}")
        for number, each in enumerate(new.from_jobs)
    ]


def _input_file(
    session: Session, kind: Kind, new: NewJob, given: FromJob, member: str
) -> InputFile:
    job = repository.get(session, given.job)
    _refuse_unready(job, new, member)
    role = _role(kind, job, given.artifact, member)
    if role in OF_A_RIG and job.request.get("rig_id") != new.rig_id:
        detail = f"{given.artifact} of job {job.id} is of another rig"
        raise Problem(409, "artifact.other_rig", detail, member=member, job_id=job.id)
    artifact = readable(session, job.id, given.artifact, member=member)
    return artifact_file(role, artifact, given.name or PurePath(artifact.name).stem)


def readable(session: Session, job_id: str, name: str, **more: Any) -> Artifact:
    """Return a file that a job left, for another job to read; ``more`` are members of a problem.

    Raises :class:`Problem` if there is none, or if it is of a format that this release does not
    read. The format is not known of what was left before formats were noted: the job finds out.
    """
    artifact = rigs.artifact_of_job(session, job_id, name)
    formats = FILES[name].formats if name in FILES else (artifact.format,)
    if artifact.format not in (None, *formats):
        numbers = " and ".join(map(str, formats))
        found = f"{name} of job {job_id} has format {artifact.format}"
        detail = f"{found}: this release reads {numbers}"
        about = {"job_id": job_id, "file": name, "found": artifact.format, "expected": [*formats]}
        raise Problem(409, "artifact.format", detail, **about, **more)
    return artifact


def _refuse_unready(job: Job, new: NewJob, member: str) -> None:
    """Refuse a job of another subject, and one that has left nothing, or not yet."""
    if job.subject_id != new.subject_id:
        detail = f"job {job.id} is another subject's"
        raise Problem(409, "artifact.other_subject", detail, member=member, job_id=job.id)
    if job.state is not State.SUCCEEDED:
        state = job.state.value
        detail = f"job {job.id} is {state}: only one that succeeded hands files on"
        raise Problem(409, "artifact.not_left", detail, member=member, job_id=job.id, state=state)


def _role(kind: Kind, job: Job, name: str, member: str) -> str:
    """Return what a job's file is to a job of a ``kind``."""
    left = KINDS[job.kind].hands_on if job.kind in KINDS else ()
    useful = [
        file for file in left if {FILES[file].input, FILES[file].role}.intersection(kind.reads)
    ]
    if name not in useful:
        what = f"takes of it {', '.join(useful)}" if useful else "takes no file of it"
        detail = f"{kind.name} does not read {name} of a {job.kind} job: it {what}"
        more = {"member": member, "job_id": job.id, "expected": useful}
        raise Problem(422, "artifact.not_an_input", detail, **more)
    return FILES[name].role


def join(files: list[InputFile], handed: list[InputFile]) -> list[InputFile]:
    """Return all files of a job: what is named stands instead of what was found.

    Raises :class:`Problem` if two are the same thing: marker sets, or assets of one name.
    """
    named = {each["role"] for each in handed}
    kept = [each for each in files if each["role"] not in named.intersection(FOUND)]
    known = {_place(each) for each in kept}
    for number, each in enumerate(handed):
        if _place(each) in known:
            what = each["role"].replace("_", " ")
            what = f"{what} called {each['name']}" if each["role"] in NAMED else what
            detail = f"the job has another {what}: leave one of them out"
            raise Problem(422, "job.twice", detail, member=f"from_jobs.{number}")
        known.add(_place(each))
    return [*kept, *handed]


def _place(file: InputFile) -> tuple[str, str]:
    """Return what of a job's inputs there can be one of."""
    return file["role"], file["name"] if file["role"] in NAMED else ""
