"""Commands that talk to a service: subjects, templates, jobs."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

from myoface.cli.app import (
    Labels,
    NewFolder,
    OfSubject,
    Options,
    SubjectId,
    Unlabel,
    Url,
    WithLabels,
    read_label_changes,
    read_label_filter,
    read_labels,
    read_object,
    read_scene,
    require_change,
)
from myoface.cli.captures import choose, show_captures
from myoface.cli.commands import Argument, Group, Option, UsageError
from myoface.cli.console import (
    JobDisplay,
    complain,
    confirm,
    err,
    label_words,
    moment,
    out,
    printable,
    show_outcome,
    show_table,
    span,
    transfer_bar,
)
from myoface.cli.lookup import find_job, find_rig, find_subject, find_template
from myoface.cli.rigs import show_rigs
from myoface.client import DEFAULT_URL, Client
from myoface.errors import UNREACHABLE, ApiError, describe
from myoface.resources import FINAL_STATES, Artifact, FromJob, Job, JobItem, Result

subjects = Group("People.")
templates = Group("Template anatomies of a service.")
jobs = Group("Work: submit, follow, cancel.")

JobId = Annotated[str, Argument(help="job id, or the start of it")]

# JSON Schema's words for the limits of a number.
LIMITS = {"exclusiveMinimum": ">", "minimum": ">=", "maximum": "<="}


@subjects.command("list")
def list_subjects(label: WithLabels = None, url: Url = DEFAULT_URL) -> None:
    """List subjects."""
    with Client(url) as client:
        rows = [
            (
                each.id,
                each.name,
                each.template_id or "built-in",
                moment(each.created_at),
                label_words(each.labels),
            )
            for each in client.subjects(labels=read_label_filter(label))
        ]
    show_table(("id", "name", "template", "added", "labels"), rows)


@subjects.command("add")
def add_subject(
    name: str,
    template: Annotated[
        str | None, Option(help="template: id, start of it, or name; default: built-in")
    ] = None,
    label: Labels = None,
    url: Url = DEFAULT_URL,
) -> None:
    """Add a person and print the id."""
    labels = read_labels(label)
    with Client(url) as client:
        made_of = None if template is None else find_template(client, template)
        out.print(client.create_subject(name, template_id=made_of, labels=labels).id)


@subjects.command("edit")
def edit_subject(
    subject: SubjectId,
    name: Annotated[str | None, Option(help="the new name")] = None,
    label: Labels = None,
    unlabel: Unlabel = None,
    url: Url = DEFAULT_URL,
) -> None:
    """Give a person another name, or other labels."""
    changes = read_label_changes(label, unlabel)
    require_change(name=name, label=changes)
    with Client(url) as client:
        client.change_subject(find_subject(client, subject), name=name, labels=changes)


@subjects.command("show")
def show_subject(subject: SubjectId, url: Url = DEFAULT_URL) -> None:
    """Show a subject's scans, jobs and rigs."""
    with Client(url) as client:
        found = client.subject(find_subject(client, subject))
        out.print(f"{found.name} ({found.id})")
        show_captures(client.captures(found.id))
        _show_jobs(client.jobs(subject_id=found.id))
        show_rigs(client.rigs(subject_id=found.id))


@subjects.command("delete")
def delete_subject(
    subject: SubjectId,
    yes: Annotated[bool, Option("--yes", help="do not ask")] = False,
    cancel: Annotated[bool, Option("--cancel", help="stop its jobs first")] = False,
    url: Url = DEFAULT_URL,
) -> None:
    """Delete a subject with all its scans, jobs and rigs."""
    with Client(url) as client:
        found = client.subject(find_subject(client, subject))
        if not yes:
            confirm(f"Delete subject {found.name} ({found.id}) and everything of it?")
        client.delete_subject(found.id, cancel=cancel)


@templates.command("list")
def list_templates(url: Url = DEFAULT_URL) -> None:
    """List the service's template anatomies."""
    with Client(url) as client:
        show_table(
            ("id", "name", "sha256 of the file"),
            [(each.id, each.name, each.sha256) for each in client.templates()],
        )


@templates.command("add")
def add_template(
    file: Annotated[Path, Argument(exists=True, dir_okay=False, help="NPZ template")],
    name: Annotated[str | None, Option(help="default: the file's name")] = None,
    url: Url = DEFAULT_URL,
) -> None:
    """Upload a template anatomy and print the id."""
    with Client(url) as client, transfer_bar(file.name) as progress:
        out.print(client.create_template(name or file.stem, file, progress=progress).id)


@jobs.command("list")
def list_jobs(
    subject: OfSubject = None,
    state: Annotated[str | None, Option(help="queued, running, succeeded ...")] = None,
    kind: Annotated[str | None, Option(help="build_model, fit_geometry ...")] = None,
    url: Url = DEFAULT_URL,
) -> None:
    """List jobs."""
    with Client(url) as client:
        whose = subject and find_subject(client, subject)
        _show_jobs(client.jobs(subject_id=whose, state=state, kind=kind))


@jobs.command("kinds")
def show_kinds(
    kind: Annotated[str | None, Argument(help="show the options of this one")] = None,
    url: Url = DEFAULT_URL,
) -> None:
    """List the kinds of job, or the options of one."""
    with Client(url) as client:
        found = {each.kind: each for each in client.kinds()}
    if kind is None:
        show_table(("kind", "what it does"), [(each.kind, each.title) for each in found.values()])
    elif kind in found:
        options = found[kind].options["properties"].items()
        rows = [
            (name, json.dumps(schema.get("default")), _limits(schema), schema["description"])
            for name, schema in options
        ]
        show_table(("option", "default", "allowed", "what"), rows)
    else:
        known = ", ".join(found)
        raise UsageError(f"there is no kind {kind!r}; there are {printable(known)}")


def _limits(schema: dict[str, Any]) -> str:
    """Return the values that an option's JSON Schema allows."""
    if "enum" in schema:
        return ", ".join(map(json.dumps, schema["enum"]))
    limits = [f"{sign} {schema[key]}" for key, sign in LIMITS.items() if key in schema]
    return ", ".join(limits) or str(schema.get("type", "see GET /v1/kinds"))


@jobs.command("submit")
def submit_job(
    kind: Annotated[str, Argument(help="see `myoface jobs kinds`")],
    subject: SubjectId,
    capture: Annotated[list[str] | None, Option(help="name or id of a capture; repeat")] = None,
    artifact: Annotated[
        list[str] | None,
        Option(
            metavar="JOB/FILE",
            help="file that an earlier job left, JOB/FILE=NAME for a scene; repeat",
        ),
    ] = None,
    rig: Annotated[
        str | None, Option(help="rig id, for fit_activations and all that plays a rig")
    ] = None,
    options: Options = "{}",
    scene: Annotated[
        Path | None,
        Option(exists=True, dir_okay=False, help="JSON, for simulate, animate and edit"),
    ] = None,
    wait: Annotated[bool, Option(help="follow the job until it ends")] = True,
    url: Url = DEFAULT_URL,
) -> None:
    """Submit a job; without --capture of a scan a fit takes all the subject's expressions."""
    with Client(url) as client:
        whose = find_subject(client, subject)
        chosen = choose(client.captures(whose), capture) if capture else []
        is_unnamed = all(each.role == "activations" for each in chosen)
        if is_unnamed and any(
            each.kind == kind and "captures" in each.reads for each in client.kinds()
        ):
            listed = reversed(client.captures(whose))  # a rig has them in their scans' order
            chosen += [each for each in listed if each.role == "expression"]
        given = {} if scene is None else {"scene": read_scene(scene)}
        left = [_read_artifact(client, each) for each in artifact or []]
        job = client.submit(
            kind,
            whose,
            captures=[*(each.id for each in chosen), *left],
            rig_id=rig and find_rig(client, rig),
            options=read_object(options, "--options") | given,
        )
        out.print(job.id)
        if wait:
            _follow(client, job)


def _read_artifact(client: Client, given: str) -> FromJob:
    """Return the file that ``JOB/FILE`` or ``JOB/FILE=NAME`` says."""
    job, slash, rest = given.partition("/")
    file, is_named, name = rest.partition("=")
    if not (job and slash and file) or (is_named and not name):
        raise UsageError(f"--artifact {given}: JOB/FILE or JOB/FILE=NAME is expected")
    return FromJob(job=find_job(client, job), artifact=file, name=name or None)


@jobs.command("retry")
def retry_job(
    job: JobId,
    options: Annotated[str, Option(metavar="JSON", help="those that differ, JSON or @FILE")] = "{}",
    wait: Annotated[bool, Option(help="follow the job until it ends")] = True,
    url: Url = DEFAULT_URL,
) -> None:
    """Make a job again that is over, with other options if they are given."""
    with Client(url) as client:
        again = client.retry(find_job(client, job), options=read_object(options, "--options"))
        out.print(again.id)
        if wait:
            _follow(client, again)


@jobs.command("wait")
def wait_for_job(job: JobId, url: Url = DEFAULT_URL) -> None:
    """Follow a job until it ends."""
    with Client(url) as client:
        _follow(client, client.job(find_job(client, job)))


def _follow(client: Client, job: Job) -> None:
    try:
        with JobDisplay(job.kind) as view:
            ended = client.wait(job.id, view.watch)
    except (ApiError, KeyboardInterrupt) as error:
        if isinstance(error, KeyboardInterrupt) or error.code == UNREACHABLE:
            err.print(f"the job goes on; follow it: myoface jobs wait {job.id}")
        raise
    attempts = "" if ended.attempt == 1 else f" at attempt {ended.attempt}"
    out.print(f"{ended.kind} succeeded{attempts}")
    result = ended.result or Result()
    if result.rig_id:
        out.print(f"rig {result.rig_id}")
    if result.summary and (code := show_outcome(ended.kind, result.summary)):
        raise SystemExit(code)


@jobs.command("log")
def show_log(job: JobId, url: Url = DEFAULT_URL) -> None:
    """Print what the solver printed."""
    with Client(url) as client:
        for line in client.log(find_job(client, job)):
            out.print(line.text)


@jobs.command("frames")
def show_frames(
    job: JobId,
    start: Annotated[int, Option(min=0, help="begin with this one, 0 is the first")] = 0,
    follow: Annotated[bool, Option("--follow", help="wait for more until it ends")] = False,
    url: Url = DEFAULT_URL,
) -> None:
    """Print the frames of a sequence that are ready, a line of JSON each."""
    with Client(url) as client:
        for frame in client.frames(find_job(client, job), start=start, follow=follow):
            out.print(json.dumps(frame.as_dict()))


@jobs.command("cancel")
def cancel_job(
    job: JobId,
    reason: Annotated[str, Option(help="why, for the record")] = "by the command line",
    url: Url = DEFAULT_URL,
) -> None:
    """Stop a job."""
    with Client(url) as client:
        out.print(client.cancel(find_job(client, job), reason).state)


@jobs.command("download")
def download_job(job: JobId, output: NewFolder = Path("job"), url: Url = DEFAULT_URL) -> None:
    """Download the files that a job left, such as a model's pictures."""
    with Client(url) as client:
        found = client.job(find_job(client, job))
        if found.result is None:
            ended = "failed" if found.state == "failed" else f"is {found.state}"
            why = f": {describe(found.error)}" if found.error else ""
            complain(f"the {found.kind} job {ended} and has left no files{why}")
            raise SystemExit(1)
        _download(client, found.result.artifacts, output)


def _download(client: Client, artifacts: Iterable[Artifact], folder: Path) -> None:
    for artifact in artifacts:
        with transfer_bar(artifact.name) as progress:
            client.download(artifact, folder / artifact.name, progress=progress)
        out.print(f"{folder / artifact.name}")


def _show_jobs(found: list[JobItem]) -> None:
    rows = [
        (
            each.id,
            each.subject_name,
            each.kind,
            each.state,
            each.result and each.result.verdict,
            moment(each.created_at),
            span(each.seconds),
            _stand(each),
        )
        for each in found
    ]
    show_table(("job", "person", "kind", "state", "verdict", "date", "took", "stand"), rows)


def _stand(job: JobItem) -> str:
    """Return how far a job is, or why it failed, and its attempt if that is not the first."""
    words = [f"attempt {job.attempt}"] if job.attempt > 1 else []
    if job.error:
        words.append(describe(job.error))
    elif job.progress and job.state not in FINAL_STATES:
        words.append(f"{job.progress.phase} {job.progress.fraction:.0%}")
    return ", ".join(words)
