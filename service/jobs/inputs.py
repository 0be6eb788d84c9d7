"""The files a job reads, looked up and fixed when it is submitted.

An input is ``{"role", "name", "filename", "sha256", "of"}``: ``filename`` is the user's own name
for the file, so that an error in it can name it, ``of`` the id of what it belongs to. The scan that
a job is about has its ``capture_role`` too. Models and fits read the registered form of a raw
capture.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePath
from typing import Any

from sqlalchemy import ColumnElement, select, true
from sqlalchemy.orm import Session

from service.bounds import shorten
from service.captures import repository as captures
from service.captures.repository import RegisteredForm, neutral_of, registered_form
from service.errors import Problem, not_found
from service.jobs import repository
from service.jobs.handed_on import InputFile, artifact_file, handed_on, input_file, join, readable
from service.jobs.schemas import NewJob
from service.rigs import repository as rigs
from service.store.models import Capture, Job, Rig
from service.subjects import repository as subjects
from service.templates import repository as templates
from solver.kinds import FILES, KINDS, MOST_FILM_FRAMES, MOST_PHOTOS, ROLES, Kind

ESTIMATION = "neutral_from_photos"
ESTIMATED_MESH = "neutral.ply"


@dataclass(frozen=True)
class Inputs:
    """Files that a job reads, the capture it is about and the job that made its model, if any."""

    files: list[InputFile]
    capture_id: str | None = None
    model_job_id: str | None = None


def resolve(session: Session, kind: Kind, new: NewJob) -> Inputs:
    """Return what a job will read."""
    subjects.get(session, new.subject_id)
    _refuse_unread(kind, new)
    handed = handed_on(session, kind, new)
    tables, others = _known_activations(session, kind, new)
    found = _found(session, kind, others)
    files = join([*found.files, *tables], handed)
    if "assets" in kind.reads:
        _refuse_unnamed(new, files)
    return replace(found, files=files)


def _found(session: Session, kind: Kind, new: NewJob) -> Inputs:
    """Return what belongs to the subject, its rig and the captures that are named."""
    if "capture" in kind.reads:
        return _about_one_capture(session, kind, new)
    if "neutral" in kind.reads:
        return Inputs([_neutral(session, new.subject_id), *_template(session, kind, new)])
    if {"rig", "model"}.isdisjoint(kind.reads) and new.rig_id is None:
        read = _photos if "photos" in kind.reads else _markers
        return Inputs([*read(session, new), *_template(session, kind, new)])
    return _of_a_model(session, kind, new)


def _refuse_unread(kind: Kind, new: NewJob) -> None:
    for member, reads in (
        (
            "captures",
            {
                *("captures", "own_scans", "capture", "performance", "markers", "marker_set"),
                *("photos", "assets"),
            },
        ),
        ("rig_id", {"rig", "any_rig"}),
    ):
        if getattr(new, member) and reads.isdisjoint(kind.reads):
            raise Problem(422, "job.unexpected", f"{kind.name} takes no {member}", member=member)


def _about_one_capture(session: Session, kind: Kind, new: NewJob) -> Inputs:
    """Return the scan as it was uploaded with its landmarks, and what else ``kind`` reads."""
    capture = _the_capture(session, new)
    _refuse_no_scan(capture)
    if capture.registered and kind.leaves == "registration":
        raise Problem(
            409,
            "capture.is_registered",
            f"{capture.name} was uploaded as a registered scan: there is nothing to register",
            capture_id=capture.id,
        )
    scan = _capture_file("scan", capture)
    files = [{**scan, "capture_role": capture.role}, *_landmarks("landmarks", capture)]
    if "neutral" in kind.reads and capture.role != "neutral":
        neutral = _neutral(session, new.subject_id, of_an_expression=True)
        of_the_neutral = {"of_a_neutral": [Job.id == neutral["of"]]}
        files += [neutral, *_left_files(session, kind, new.subject_id, of_the_neutral)]
    return Inputs([*files, *_template(session, kind, new)], capture_id=capture.id)


def _landmarks(role: str, capture: Capture) -> list[InputFile]:
    """Return the file beside a capture, if there is one."""
    filename = capture.landmarks_filename
    sha256 = capture.landmarks_sha256
    if not (filename and sha256):
        return []
    return [input_file(role, capture.name, filename, sha256, of=capture.id)]


def _the_capture(session: Session, new: NewJob) -> Capture:
    if len(new.captures) != 1:
        raise Problem(
            422,
            "job.one_capture",
            f"{new.kind} takes one capture, not {len(new.captures)}",
            member="captures",
        )
    return captures.get(session, new.subject_id, new.captures[0])


def _refuse_no_scan(capture: Capture) -> None:
    role = ROLES[capture.role]
    if not role.is_scan:
        detail = f"{capture.name} is {role.noun}: {role.then}"
        raise Problem(422, f"capture.is_{capture.role}", detail, capture_id=capture.id)


def _neutral(session: Session, subject_id: str, *, of_an_expression: bool = False) -> InputFile:
    neutral = captures.neutral(session, subject_id)
    if neutral is None:
        # the newest that photographs were made into
        made = true(), [ESTIMATION], ESTIMATED_MESH, ()
        if estimate := rigs.left_by(session, subject_id, *made):
            return artifact_file("neutral", estimate)
        raise Problem(
            409, "subject.no_neutral", "the subject has no neutral capture", subject_id=subject_id
        )
    if (form := registered_form(session, neutral)) is not None:
        return _form_file("neutral", neutral, form)
    if of_an_expression:
        raise Problem(
            409,
            "subject.neutral_not_registered",
            f"an expression is registered from the neutral: register {neutral.name} first",
            subject_id=subject_id,
            capture_id=neutral.id,
        )
    raise _not_registered({neutral.id: _REGISTER_FIRST.format(name=neutral.name)})


def _template(session: Session, kind: Kind, new: NewJob) -> list[InputFile]:
    """Return the subject's template if ``kind`` reads it; none: the solver has one of its own."""
    template_id = subjects.get(session, new.subject_id).template_id
    if template_id is None or "template" not in kind.reads:
        return []
    template = templates.get(session, template_id)
    file = (template.name, template.filename, template.sha256)
    return [input_file("template", *file, of=template_id)]


def _of_a_model(session: Session, kind: Kind, new: NewJob) -> Inputs:
    """Return a model, the rig if ``kind`` reads one, and what to fit or to play."""
    rig = _parent(session, new) if "rig" in kind.reads or new.rig_id is not None else None
    if rig is not None:
        model = repository.get(session, rig.model_job_id)
        files = _files_of_rig(session, rig)
    else:
        model = _newest_model(session, new)
        files = [_artifact(session, model.id, "model", "model.npz")]
    if "performance" in kind.reads:
        files.append(_performance(session, new))
    elif "markers" in kind.reads:
        files += _markers(session, new)
    elif "marker_set" in kind.reads:
        files += _marker_files(session, new, most_takes=0).values()
    elif "photos" in kind.reads:
        files += _photos(session, new)
    elif "captures" in kind.reads or ("own_scans" in kind.reads and new.captures):
        files += _expressions(session, new, model)
    elif "assets" in kind.reads:
        files += _assets(session, new)
    files += _template(session, kind, new)
    made_of = {
        # a scan that is registered again may have left colours then that it did not before
        "of_a_neutral": [rigs.made_into_model(model), rigs.registered_again(model)],
        "of_a_model": [rigs.made_of_model(model)],
        **({"of_a_rig": [rigs.made_of_rig(rig)]} if rig else {}),
    }
    files += _left_files(session, kind, new.subject_id, made_of)
    if rig is not None:
        files += _of_expressions(session, kind, rig, neutral_of(model))
    return Inputs(files, model_job_id=model.id)


def _left_files(
    session: Session,
    kind: Kind,
    subject_id: str,
    made_of: Mapping[str, Sequence[ColumnElement[bool]]],
) -> list[InputFile]:
    """Return the files that earlier jobs left for a kind, the newest of each.

    ``made_of`` has what holds of those jobs, by the member of :class:`LeftFile` that asks for it,
    and what holds of others, of which a file is taken where the first left none.
    """
    files = []
    for name, file in FILES.items():
        asked = next((holds for member, holds in made_of.items() if getattr(file, member)), ())
        if file.input not in kind.reads:
            continue
        leavers = [each.name for each in KINDS.values() if name in each.hands_on]
        for holds in asked:
            found = rigs.left_by(session, subject_id, holds, leavers, name, file.formats)
            if found:
                files.append(artifact_file(file.role, found))
                break
    return files


def _of_expressions(session: Session, kind: Kind, rig: Rig, neutral: str | None) -> list[InputFile]:
    """Return what the rig's expressions left for a kind, by their names, the newest of each.

    They were registered from the ``neutral`` with this sha256, which the rig's model was built of.
    """
    left = {name: file for name, file in FILES.items() if file.of_expressions}
    wanted = {name: file.role for name, file in left.items() if file.input in kind.reads}
    if not wanted or neutral is None:
        return []
    fitted = {
        capture.id: capture
        for capture in captures.of_subject(session, rig.subject_id)
        if capture.role == "expression" and capture.name in rig.expressions
    }
    found: dict[tuple[str, str], InputFile] = {}
    for job in captures.succeeded_jobs(session, captures.REGISTRATION, [*fitted.values()]):
        if neutral_of(job) != neutral:
            continue
        for artifact in job.artifacts:
            if (role := wanted.get(artifact.name)) is not None:
                name = fitted[str(job.capture_id)].name
                found.setdefault((role, name), artifact_file(role, artifact, name))
    return [*found.values()]


def _files_of_rig(session: Session, rig: Rig) -> list[InputFile]:
    """Return a rig's one file, or those of a rig of 0.1."""
    left = {artifact.name for artifact in repository.get(session, rig.job_id).artifacts}
    if rigs.RIG_FILE in left:
        return [_artifact(session, rig.job_id, "rig", rigs.RIG_FILE)]
    parts = {"weights": "muscle_weights.npz", "rig": "activations.npz"}
    if "report.json" in left:
        parts["report"] = "report.json"
    return [
        *(_artifact(session, rig.job_id, role, name) for role, name in parts.items()),
        _artifact(session, rig.model_job_id, "model", "model.npz"),
    ]


def _performance(session: Session, new: NewJob) -> InputFile:
    capture = _the_capture(session, new)
    if capture.role != "performance":
        raise Problem(
            422,
            "capture.not_a_performance",
            f"{capture.name} is a scan, not a performance",
            capture_id=capture.id,
        )
    return _capture_file("performance", capture)


def _markers(session: Session, new: NewJob) -> list[InputFile]:
    """Return one take of markers, and the session's marker set where that is named, too."""
    found = _marker_files(session, new, most_takes=1)
    if "markers" not in found:
        raise Problem(422, "job.missing", f"{new.kind} needs a take of markers", member="captures")
    return [*found.values()]


def _marker_files(session: Session, new: NewJob, most_takes: int) -> dict[str, InputFile]:
    """Return the take of markers and the marker set that are named, by their roles."""
    found: dict[str, InputFile] = {}
    for capture_id in dict.fromkeys(new.captures):
        capture = captures.get(session, new.subject_id, capture_id)
        if capture.role != "markers":
            raise Problem(
                422,
                "capture.not_markers",
                f"{capture.name} is no take of markers and no marker set",
                capture_id=capture.id,
            )
        is_set = PurePath(capture.filename).suffix.lower() in ROLES["markers"].sets
        role = "marker_set" if is_set else "markers"
        if role in found or not (is_set or most_takes):
            takes = "one take, and one marker set beside it" if most_takes else "one marker set"
            raise Problem(422, "job.one_take", f"{new.kind} reads {takes}", member="captures")
        found[role] = _capture_file(role, capture)
    return found


def _known_activations(session: Session, kind: Kind, new: NewJob) -> tuple[list[InputFile], NewJob]:
    """Return the table of known activations, if one is named, and the job without it."""
    if "activations" not in kind.reads or not new.captures:
        return [], new
    tables = session.scalars(
        select(Capture).where(
            Capture.subject_id == new.subject_id,
            Capture.id.in_(set(new.captures)),
            Capture.role == "activations",
        )
    ).all()
    if len(tables) > 1:
        detail = f"{new.kind} reads one table of known activations, not {len(tables)}"
        raise Problem(422, "job.one_table", detail, member="captures")
    ids = {each.id for each in tables}
    others = [each for each in new.captures if each not in ids]
    files = [_capture_file("activations", each) for each in tables]
    return files, new.model_copy(update={"captures": others})


def _photos(session: Session, new: NewJob) -> list[InputFile]:
    """Return photographs, each with what is known of it and with its mask; or a film's file."""
    is_film = new.options.get("sequence") is True
    if is_film and len(new.captures) == 1:
        capture = _the_capture(session, new)
        if capture.role == "film":
            return [_capture_file("film", capture)]
    found = _of_role(session, new, "photo", "capture.not_a_photo", "photograph")
    most = MOST_FILM_FRAMES if is_film else MOST_PHOTOS
    if not 1 <= len(found) <= most:
        detail = f"{new.kind} reads 1 to {most} photographs, not {len(found)}"
        raise Problem(422, "job.photos", detail, member="captures", expected=most)
    files: list[InputFile] = []
    for each in found:
        files += [_capture_file("photo", each), *_landmarks("facts", each)]
        if each.mask_filename and each.mask_sha256:
            what = each.name, each.mask_filename, each.mask_sha256
            files.append(input_file("mask", *what, of=each.id))
    return files


def _assets(session: Session, new: NewJob) -> list[InputFile]:
    """Return the files that a scene may name, by their captures' names."""
    what = "asset, which is a file that scenes name"
    found = _of_role(session, new, "asset", "capture.not_an_asset", what)
    return [_capture_file("asset", each) for each in found]


def _of_role(session: Session, new: NewJob, role: str, code: str, noun: str) -> list[Capture]:
    """Return the captures that a job names, each once; refuse those of another role by a code."""
    found = [captures.get(session, new.subject_id, each) for each in dict.fromkeys(new.captures)]
    for capture in found:
        if capture.role != role:
            raise Problem(422, code, f"{capture.name} is no {noun}", capture_id=capture.id)
    return found


def _refuse_unnamed(new: NewJob, files: list[InputFile]) -> None:
    """Refuse a scene that names an asset which the job is not given."""
    known = sorted({each["name"] for each in files if each["role"] == "asset"})
    for place, name in named_assets(new.options.get("scene"), "options.scene"):
        if name not in known:
            given = ", ".join(known) or "none"
            detail = f"the job is given no asset {shorten(name)!r}; it is given {given}"
            more = {"member": place, "found": shorten(name), "expected": known}
            raise Problem(422, "job.asset", detail, **more)


def named_assets(document: Any, place: str) -> Iterator[tuple[str, str]]:
    """Yield the place and name of every asset that a scene's ``document`` names."""
    left = [(place, document)]
    while left:
        place, value = left.pop()
        if isinstance(value, list):
            left += [(f"{place}[{number}]", each) for number, each in enumerate(value)]
        elif isinstance(value, dict):
            if isinstance(name := value.get("asset"), str):
                yield f"{place}.asset", name
            left += [(f"{place}.{key}", each) for key, each in value.items() if key != "asset"]


def _newest_model(session: Session, new: NewJob) -> Job:
    job = repository.newest_model(session, new.subject_id)
    if job is None:
        raise Problem(
            409,
            "subject.no_model",
            "the subject has no model; run build_model first",
            subject_id=new.subject_id,
        )
    return job


def _parent(session: Session, new: NewJob) -> Rig:
    if new.rig_id is None:
        raise Problem(422, "job.missing", f"{new.kind} needs rig_id", member="rig_id")
    rig = rigs.get(session, new.rig_id)
    if rig.subject_id != new.subject_id:
        raise Problem(409, "rig.other_subject", "the rig is another subject's", rig_id=rig.id)
    return rig


def _expressions(session: Session, new: NewJob, model: Job) -> list[InputFile]:
    """Return the registered forms of the chosen expressions, in the frame of the model's neutral.

    All that cannot be read are named at once.
    """
    inputs = []
    faults = {}
    for capture in _chosen(session, new):
        form = registered_form(session, capture, neutral_of(model))
        if form is None:
            faults[capture.id] = _what_to_do(session, capture)
        else:
            inputs.append(_form_file("capture", capture, form))
    if faults:
        raise _not_registered(faults)
    return inputs


def _chosen(session: Session, new: NewJob) -> list[Capture]:
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
            raise not_found("capture", capture_id)
        _refuse_no_scan(found[capture_id])
        if found[capture_id].role == "neutral":
            raise Problem(
                422,
                "capture.not_an_expression",
                f"{found[capture_id].name} is the neutral capture",
                capture_id=capture_id,
            )
    return [found[capture_id] for capture_id in dict.fromkeys(new.captures)]


_REGISTER_FIRST = "{name} is a raw scan: register it first"
_REGISTER_AGAIN = "{name} was registered from an earlier neutral: register it again"
_BUILD_AGAIN = "{name} belongs to a newer neutral than the model's: build the model again"


def _what_to_do(session: Session, capture: Capture) -> str:
    """Say why a raw expression cannot be fitted to a model of another neutral than its own.

    Either the expression or the model is behind the subject's neutral as it is now.
    """
    if registered_form(session, capture) is None:
        return _REGISTER_FIRST.format(name=capture.name)
    neutral = captures.neutral(session, capture.subject_id)
    now = neutral and registered_form(session, neutral)
    is_current = now is not None and registered_form(session, capture, now.sha256) is not None
    return (_BUILD_AGAIN if is_current else _REGISTER_AGAIN).format(name=capture.name)


def _not_registered(faults: dict[str, str]) -> Problem:
    detail = "; ".join(faults.values())
    capture_ids = list(faults)
    return Problem(409, "capture.not_registered", detail, capture_ids=capture_ids)


def _artifact(session: Session, job_id: str, role: str, name: str) -> InputFile:
    return artifact_file(role, readable(session, job_id, name))


def _capture_file(role: str, capture: Capture) -> InputFile:
    return input_file(role, capture.name, capture.filename, capture.sha256, of=capture.id)


def _form_file(role: str, capture: Capture, form: RegisteredForm) -> InputFile:
    return input_file(role, capture.name, form.filename, form.sha256, of=form.of)
