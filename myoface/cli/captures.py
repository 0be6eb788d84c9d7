"""Commands about a subject's scans: add, check, register, list, delete."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, cast

from myoface.cli.app import (
    EyeDistance,
    Forward,
    Labels,
    LandmarksFile,
    SubjectId,
    Unit,
    Unlabel,
    Up,
    Url,
    WithLabels,
    read_label_changes,
    read_label_filter,
    read_labels,
    require_change,
    scan_frame,
)
from myoface.cli.commands import Argument, Group, Option, UsageError
from myoface.cli.console import (
    BAD,
    JobDisplay,
    complain,
    err,
    label_words,
    out,
    show_outcome,
    show_table,
    transfer_bar,
)
from myoface.cli.lookup import find_subject, matching
from myoface.client import DEFAULT_URL, Client
from myoface.errors import UNREACHABLE, ApiError
from myoface.names import NamedScan, as_name, name_scans, why_no_name
from myoface.resources import Capture, Job, Result
from myoface.roles import NO_SCANS, Role, ScanRole

captures = Group("A subject's scans: add, check, register, list, delete.")

Names = Annotated[
    list[str] | None, Argument(help="names or ids of captures; default: all that apply")
]
Files = Annotated[
    list[Path],
    Argument(
        exists=True,
        dir_okay=False,
        help="scans: OBJ, PLY, GLB, STL, raw also XYZ; photographs, takes of markers, assets ...",
    ),
]
Results = Annotated[
    Path | None, Option("--output", "-o", file_okay=False, help="folder for the jobs' files")
]


@captures.command()
def add(
    subject: SubjectId,
    files: Files,
    name: Annotated[
        str | None, Option(help="its name, made legal; default: of the file's name")
    ] = None,
    role: Annotated[
        Role | None, Option(help="what it is; default: what the file's name says")
    ] = None,
    neutral: Annotated[bool, Option("--neutral", help="short for --role neutral")] = False,
    performance: Annotated[
        bool, Option("--performance", help="short for --role performance: skin points, .npy")
    ] = False,
    markers: Annotated[
        bool, Option("--markers", help="short for --role markers: a take of them, or their set")
    ] = False,
    asset: Annotated[
        bool,
        Option(
            "--asset",
            help="short for --role asset: a file that scenes name, a mesh, CSV, NPY, NPZ, OSIM "
            "or a video (MP4, MOV, WebM, MKV, AVI)",
        ),
    ] = False,
    registered: Annotated[
        bool, Option("--registered", help="it has the template's vertices in their order")
    ] = False,
    raw: Annotated[
        bool, Option("--raw", help="it is as the scanner made it, which is the default")
    ] = False,
    replace: Annotated[
        bool, Option("--replace", help="put it in the place of an earlier scan of its name")
    ] = False,
    title: Annotated[
        str | None, Option(help="what people call it; default: as its file is called")
    ] = None,
    label: Labels = None,
    landmarks: LandmarksFile = None,
    mask: Annotated[
        Path | None,
        Option(exists=True, dir_okay=False, help="PNG, white where a photograph counts"),
    ] = None,
    check: Annotated[bool, Option("--check", help="and tell whether it can be used")] = False,
    unit: Unit = "auto",
    eye_distance: EyeDistance = None,
    up: Up = "auto",
    forward: Forward = "auto",
    url: Url = DEFAULT_URL,
) -> None:
    """Upload scans, each with the name and role that its file has, and print the capture ids.

    Names become legal ones before anything is sent; neutral, rest or relaxed as a word of a file's
    name is the neutral. A file that is there already is not sent again. With --check the command
    ends with 3 if a scan is bad.
    """
    role = _role(role, neutral=neutral, performance=performance, markers=markers, asset=asset)
    if len(files) > 1 and (name is not None or title or landmarks or mask or role == "neutral"):
        raise UsageError("--name, --title, --neutral, --landmarks and --mask take one file")
    if registered and raw:
        raise UsageError("--registered and --raw exclude one another")
    scans = name_scans(files, names=[name] * len(files), roles=[role] * len(files))
    if check and any(each.role in NO_SCANS for each in scans):
        raise UsageError("--check is for scans, not for what is none: performances, markers ...")
    options = scan_frame(unit, eye_distance, up, forward)
    if not check and options != scan_frame("auto", None, "auto", "auto"):
        raise UsageError(
            "--unit, --eye-distance, --up and --forward need --check: they are for a check, or for "
            "`myoface captures register`, and are not kept with the scan"
        )
    given = {
        "registered": registered,
        "landmarks": landmarks,
        "mask": mask,
        "replace": replace,
        "title": title,
        "labels": read_labels(label),
    }
    with Client(url) as client:
        whose = find_subject(client, subject)
        added = [_upload(client, whose, each, given) for each in scans]
        if check:
            _check(client, whose, added, options, None)


@captures.command("list")
def list_captures(subject: SubjectId, label: WithLabels = None, url: Url = DEFAULT_URL) -> None:
    """List a subject's scans with their newest verdicts and registrations."""
    labels = read_label_filter(label)
    with Client(url) as client:
        show_captures(client.captures(find_subject(client, subject), labels=labels))


@captures.command()
def edit(
    subject: SubjectId,
    capture: Annotated[str, Argument(help="name or id of the capture")],
    name: Annotated[str | None, Option(help="the new name, made legal")] = None,
    title: Annotated[str | None, Option(help="what people call it")] = None,
    role: Annotated[ScanRole | None, Option(help="what it is; check it again then")] = None,
    label: Labels = None,
    unlabel: Unlabel = None,
    url: Url = DEFAULT_URL,
) -> None:
    """Give a scan another name, title or role, or other labels; its file stays as it is.

    Name and role stay while the subject has jobs that are not over.
    """
    changes = read_label_changes(label, unlabel)
    require_change(name=name, title=title, role=role, label=changes)
    legal = None if name is None else as_name(name)
    if legal == "":
        raise UsageError(f"--name {why_no_name(str(name))}")
    with Client(url) as client:
        whose = find_subject(client, subject)
        (found,) = choose(client.captures(whose), [capture])
        changed = client.change_capture(
            whose, found.id, name=legal, title=title, role=role, labels=changes
        )
        out.print(f"{changed.id}  {changed.name}  {changed.role}")


@captures.command()
def check(
    subject: SubjectId,
    names: Names = None,
    output: Results = None,
    unit: Unit = "auto",
    eye_distance: EyeDistance = None,
    up: Up = "auto",
    forward: Forward = "auto",
    url: Url = DEFAULT_URL,
) -> None:
    """Tell whether scans can be used, and what to do if not; ends with 3 if one is bad."""
    options = scan_frame(unit, eye_distance, up, forward)
    with Client(url) as client:
        whose = find_subject(client, subject)
        scans = (each for each in client.captures(whose) if each.role not in NO_SCANS)
        _check(client, whose, choose(scans, names), options, output)


@captures.command()
def register(
    subject: SubjectId,
    names: Names = None,
    output: Results = None,
    unit: Unit = "auto",
    eye_distance: EyeDistance = None,
    up: Up = "auto",
    forward: Forward = "auto",
    url: Url = DEFAULT_URL,
) -> None:
    """Register raw scans, the neutral first; by default those that wait for it.

    These are the scans that are not registered yet, or from an earlier neutral. An expression that
    fails does not keep the others back; the command then ends with 1.
    """
    options = scan_frame(unit, eye_distance, up, forward)
    failed = False
    with Client(url) as client:
        whose = find_subject(client, subject)
        known = client.captures(whose)
        chosen = choose(known, names) if names else waiting(known)
        if not chosen:
            out.print("no raw scan waits to be registered")
        for capture in sorted(chosen, key=lambda each: each.role != "neutral"):
            try:
                job = _solve(client, "register_scan", whose, capture, options, output)
            except ApiError as error:
                if capture.role == "neutral" or error.code == UNREACHABLE:
                    raise
                complain(f"{capture.name}: {error}")
                failed = True
            else:
                show_outcome(job.kind, _result(job).summary or {}, capture.name)
    if failed:
        raise SystemExit(1)


@captures.command()
def landmarks(
    subject: SubjectId,
    name: Annotated[str, Argument(help="name or id of the capture")],
    file: Annotated[Path, Argument(exists=True, dir_okay=False, help="JSON, LJSON or CSV")],
    url: Url = DEFAULT_URL,
) -> None:
    """Give a scan landmarks, or a photograph what is known of it, instead of those it had."""
    with Client(url) as client:
        whose = find_subject(client, subject)
        (capture,) = choose(client.captures(whose), [name])
        client.set_landmarks(whose, capture.id, file)


@captures.command()
def delete(
    subject: SubjectId,
    names: Annotated[list[str], Argument(help="names or ids of captures")],
    url: Url = DEFAULT_URL,
) -> None:
    """Delete scans with their checks and registrations; models and rigs made of them stay."""
    with Client(url) as client:
        whose = find_subject(client, subject)
        for capture in choose(client.captures(whose), names):
            receipt = client.deletion(client.delete_capture(whose, capture.id))
            if receipt.read_by:
                jobs = ", ".join(receipt.read_by)
                out.print(f"{capture.name} is deleted; jobs that had read it stay: {jobs}")


def choose(captures: Iterable[Capture], names: list[str] | None) -> list[Capture]:
    """Return the captures with these names or ids, all if there are none."""
    known = list(captures)
    if not names:
        return known
    chosen = []
    for name in names:
        found = matching(name, known, lambda each: each.name)
        if len(found) != 1:
            has = ", ".join(sorted(each.name for each in known)) or "none"
            are = "more than one" if found else "none"
            raise UsageError(f"{name}: {are} of the subject's captures, which are {has}")
        chosen += found
    return list({each.id: each for each in chosen}.values())


def show_captures(captures: Iterable[Capture]) -> None:
    """Show a table of captures."""
    known = list(captures)
    rows = [
        (
            each.id,
            each.name,
            each.role,
            _form(each, known),
            each.check and each.check.verdict,
            each.title,
            label_words(each.labels),
        )
        for each in known
    ]
    show_table(("capture", "name", "role", "form", "check", "title", "labels"), rows)


def waiting(captures: Iterable[Capture]) -> list[Capture]:
    """Return the raw captures that are not registered, or not from the neutral as it is now."""
    known = list(captures)
    neutral = next((each.registered_sha256 for each in known if each.role == "neutral"), None)
    return [
        each
        for each in known
        if not each.registered
        and (
            each.registration is None
            or (each.role == "expression" and each.registration.neutral_sha256 != neutral)
        )
    ]


def _form(capture: Capture, captures: list[Capture]) -> str:
    if capture.role in NO_SCANS:
        return "frames" if capture.role == "performance" else "file"
    if capture.registered:
        return "registered"
    if capture.registration is None:
        return "raw"
    is_behind = capture in waiting(captures)
    return "raw, registered from an earlier neutral" if is_behind else "raw, registered"


def _role(role: Role | None, **flags: bool) -> Role | None:
    """Return the role of ``--role`` or of one of its short forms."""
    asked = {role, *(name for name, is_given in flags.items() if is_given)} - {None}
    if len(asked) > 1:
        raise UsageError(f"a scan is one of {', '.join(map(str, sorted(asked, key=str)))}")
    return cast("Role | None", asked.pop() if asked else None)


def _upload(client: Client, subject: str, scan: NamedScan, given: dict[str, Any]) -> Capture:
    """Send a scan, or find it there; ``given`` is what else :meth:`Client.ensure_capture` takes."""
    try:
        with transfer_bar(scan.path.name) as progress:
            capture = client.ensure_capture(
                subject, scan.path, name=scan.name, role=scan.role, progress=progress, **given
            )
    except (ApiError, KeyboardInterrupt) as error:
        if getattr(error, "code", UNREACHABLE) == UNREACHABLE:
            err.print(f"{scan.path.name}: the same command goes on where it stopped")
        raise
    out.print(f"{capture.id}  {capture.name}  {capture.role}")
    return capture


def _check(
    client: Client,
    subject: str,
    captures: Iterable[Capture],
    options: dict[str, Any],
    output: Path | None,
) -> None:
    """Check scans one after the other; a check that fails keeps no other back."""
    codes: set[int] = set()
    for capture in captures:
        try:
            job = _solve(client, "check_scan", subject, capture, options, output)
        except ApiError as error:
            if error.code == UNREACHABLE:
                raise
            complain(f"{capture.name}: {error}")
            codes.add(1)
        else:
            codes.add(show_outcome(job.kind, _result(job).summary or {}, capture.name))
    if ending := next((code for code in (BAD, 1) if code in codes), 0):
        raise SystemExit(ending)


def _solve(
    client: Client,
    kind: str,
    subject: str,
    capture: Capture,
    options: dict[str, Any],
    output: Path | None,
) -> Job:
    """Run a job about one capture; its files go to ``output/<capture>``."""
    with JobDisplay(f"{kind} {capture.name}") as view:
        done = client.run(kind, subject, captures=[capture.id], options=options, watch=view.watch)
    if output is not None:
        for artifact in _result(done).artifacts:
            client.download(artifact, output / capture.name / artifact.name)
    return done


def _result(job: Job) -> Result:
    assert job.result is not None, "a job that succeeded has a result"
    return job.result
