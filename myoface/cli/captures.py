"""Commands about a subject's scans: add, check, register, list, delete."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer

from myoface.cli.app import (
    BAD_SCAN,
    Forward,
    LandmarksFile,
    SubjectId,
    Unit,
    Up,
    Url,
    frame_options,
)
from myoface.cli.console import (
    JobView,
    complain,
    err,
    out,
    show_registration,
    show_table,
    show_verdict,
    transfer_bar,
)
from myoface.client import DEFAULT_URL, Client
from myoface.errors import UNREACHABLE, ApiError
from myoface.resources import Capture, Job, Result, Role

captures = typer.Typer(
    help="A subject's scans: add, check, register, list, delete.", no_args_is_help=True
)

NO_SCANS = ("performance", "asset")
FRAMES = ".npy"  # the ending of a performance's files

Names = Annotated[
    list[str] | None, typer.Argument(help="names or ids of captures; default: all that apply")
]
Files = Annotated[
    list[Path],
    typer.Argument(exists=True, dir_okay=False, help="OBJ, PLY, GLB or STL; raw also XYZ"),
]
Results = Annotated[
    Path | None, typer.Option("--output", "-o", file_okay=False, help="folder for the jobs' files")
]


@captures.command()
def add(
    subject: SubjectId,
    files: Files,
    neutral: Annotated[bool, typer.Option("--neutral", help="this is the neutral scan")] = False,
    performance: Annotated[
        bool, typer.Option("--performance", help="frames of skin points, .npy")
    ] = False,
    asset: Annotated[
        bool, typer.Option("--asset", help="a file that scenes name: CSV, NPY, OBJ, PLY, STL, GLB")
    ] = False,
    raw: Annotated[bool, typer.Option("--raw", help="as the scanner made it")] = False,
    landmarks: LandmarksFile = None,
    check: Annotated[bool, typer.Option("--check", help="and tell whether it can be used")] = False,
    unit: Unit = "auto",
    up: Up = "auto",
    forward: Forward = "auto",
    url: Url = DEFAULT_URL,
) -> None:
    """Upload scans, each named like its file, and print the capture ids.

    With --check the command ends with 3 if a scan is bad.
    """
    if len(files) > 1 and (neutral or landmarks):
        raise typer.BadParameter("--neutral and --landmarks take one file")
    if performance and (neutral or raw or check):
        raise typer.BadParameter("--performance takes neither --neutral, --raw nor --check")
    if asset and (performance or neutral or raw or check):
        raise typer.BadParameter("--asset takes no --performance, --neutral, --raw or --check")
    for file in files:
        if not (performance or asset) and file.suffix.lower() == FRAMES:
            raise typer.BadParameter(f"{file.name}: frames are added with --performance")
    role: Role = "expression"
    if neutral or performance or asset:
        role = "neutral" if neutral else "performance" if performance else "asset"
    with Client(url) as client:
        added = [
            _upload(client, subject, file, role, registered=not raw, marks=landmarks)
            for file in files
        ]
        if check:
            _check(client, subject, added, frame_options(unit, up, forward), None)


@captures.command("list")
def list_captures(subject: SubjectId, url: Url = DEFAULT_URL) -> None:
    """List a subject's scans with their newest verdicts and registrations."""
    with Client(url) as client:
        show_captures(client.captures(subject))


@captures.command()
def check(
    subject: SubjectId,
    names: Names = None,
    output: Results = None,
    unit: Unit = "auto",
    up: Up = "auto",
    forward: Forward = "auto",
    url: Url = DEFAULT_URL,
) -> None:
    """Tell whether scans can be used, and what to do if not; ends with 3 if one is bad."""
    with Client(url) as client:
        scans = (each for each in client.captures(subject) if each.role not in NO_SCANS)
        _check(client, subject, choose(scans, names), frame_options(unit, up, forward), output)


@captures.command()
def register(
    subject: SubjectId,
    names: Names = None,
    output: Results = None,
    unit: Unit = "auto",
    up: Up = "auto",
    forward: Forward = "auto",
    url: Url = DEFAULT_URL,
) -> None:
    """Register raw scans, the neutral first; by default those that wait for it.

    These are the scans that are not registered yet, or from an earlier neutral. An expression that
    fails does not keep the others back; the command then ends with 1.
    """
    options = frame_options(unit, up, forward)
    failed = False
    with Client(url) as client:
        known = client.captures(subject)
        chosen = choose(known, names) if names else waiting(known)
        if not chosen:
            out.print("no raw scan waits to be registered")
        for capture in sorted(chosen, key=lambda each: each.role != "neutral"):
            try:
                job = _solve(client, "register_scan", subject, capture, options, output)
            except ApiError as error:
                if capture.role == "neutral" or error.code == UNREACHABLE:
                    raise
                complain(str(error))
                failed = True
            else:
                show_registration(capture.name, _result(job).summary or {})
    if failed:
        raise typer.Exit(1)


@captures.command()
def landmarks(
    subject: SubjectId,
    name: Annotated[str, typer.Argument(help="name or id of the capture")],
    file: Annotated[Path, typer.Argument(exists=True, dir_okay=False, help="JSON, LJSON or CSV")],
    url: Url = DEFAULT_URL,
) -> None:
    """Give a scan landmarks, instead of those it had, for its next check or registration."""
    with Client(url) as client:
        (capture,) = choose(client.captures(subject), [name])
        client.set_landmarks(subject, capture.id, file)


@captures.command()
def delete(
    subject: SubjectId,
    names: Annotated[list[str], typer.Argument(help="names or ids of captures")],
    url: Url = DEFAULT_URL,
) -> None:
    """Delete scans with their checks and registrations; models and rigs made of them stay."""
    with Client(url) as client:
        for capture in choose(client.captures(subject), names):
            client.delete_capture(subject, capture.id)


def choose(captures: Iterable[Capture], names: list[str] | None) -> list[Capture]:
    """Return the captures with these names or ids, all if there are none."""
    known = list(captures)
    if not names:
        return known
    found = {key: each for each in known for key in (each.name, each.id)}
    for name in names:
        if name not in found:
            has = ", ".join(sorted(each.name for each in known)) or "none"
            raise typer.BadParameter(f"{name}: the subject's captures to choose from are {has}")
    return list({found[name].id: found[name] for name in names}.values())


def show_captures(captures: Iterable[Capture]) -> None:
    """Show a table of captures."""
    known = list(captures)
    rows = [
        (each.id, each.name, each.role, _form(each, known), each.check and each.check.verdict)
        for each in known
    ]
    show_table(("capture", "name", "role", "form", "check"), rows)


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


def _upload(
    client: Client, subject: str, file: Path, role: Role, *, registered: bool, marks: Path | None
) -> Capture:
    try:
        with transfer_bar(file.name) as progress:
            capture = client.add_capture(
                subject, file, role=role, registered=registered, landmarks=marks, progress=progress
            )
    except (ApiError, KeyboardInterrupt) as error:
        if getattr(error, "code", UNREACHABLE) == UNREACHABLE:
            err.print(f"{file.name}: the same command goes on where it stopped", markup=False)
        raise
    out.print(f"{capture.id}  {capture.name}", markup=False)
    return capture


def _check(
    client: Client,
    subject: str,
    captures: Iterable[Capture],
    options: dict[str, Any],
    output: Path | None,
) -> None:
    verdicts = set()
    for capture in captures:
        job = _solve(client, "check_scan", subject, capture, options, output)
        summary = _result(job).summary or {}
        show_verdict(capture.name, summary)
        verdicts.add(summary["verdict"])
    if "bad" in verdicts:
        raise typer.Exit(BAD_SCAN)


def _solve(
    client: Client,
    kind: str,
    subject: str,
    capture: Capture,
    options: dict[str, Any],
    output: Path | None,
) -> Job:
    """Run a job about one capture; its files go to ``output/<capture>``."""
    with JobView(f"{kind} {capture.name}") as view:
        done = client.run(kind, subject, captures=[capture.id], options=options, watch=view.watch)
    if output is not None:
        for artifact in _result(done).artifacts:
            client.download(artifact, output / capture.name / artifact.name)
    return done


def _result(job: Job) -> Result:
    assert job.result is not None, "a job that succeeded has a result"
    return job.result
