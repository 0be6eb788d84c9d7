"""Commands about batches: all scans of a session in one call."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from myoface.cli.app import (
    EyeDistance,
    Forward,
    OfSubject,
    Unit,
    Up,
    Url,
    read_object,
    require_object,
    scan_frame,
)
from myoface.cli.commands import Argument, Group, Option, UsageError
from myoface.cli.console import as_typed, out, show_table, transfer_bar
from myoface.cli.lookup import find_batch, find_subject
from myoface.client import DEFAULT_URL, Client
from myoface.errors import ApiError
from myoface.names import NamedScan, name_session
from myoface.resources import Batch, Then

batches = Group("All scans of a session in one call.")

BatchId = Annotated[str, Argument(help="batch: its id, start of it, or name")]


@batches.command("add")
def add_batch(
    files: Annotated[list[Path], Argument(exists=True, dir_okay=False, help="the scans")],
    neutral: Annotated[
        Path | None,
        Option(exists=True, dir_okay=False, help="the neutral scan; default: the one called so"),
    ] = None,
    subject: OfSubject = None,
    person: Annotated[str | None, Option(help="name of a new subject")] = None,
    registered: Annotated[
        bool, Option("--registered", help="they have the template's vertices")
    ] = False,
    landmarks: Annotated[
        list[str] | None, Option(help="SCAN=FILE, landmarks on one of the scans; repeat")
    ] = None,
    unit: Unit = "auto",
    eye_distance: EyeDistance = None,
    up: Up = "auto",
    forward: Forward = "auto",
    options: Annotated[
        str,
        Option(
            metavar="JSON",
            help='of the jobs, by kind, JSON or @FILE: {"fit_geometry": {"rounds": 3}}',
        ),
    ] = "{}",
    then: Annotated[
        list[Then] | None, Option(help="what to make of them; repeat; default: all")
    ] = None,
    wait: Annotated[bool, Option(help="follow the batch until it ends")] = True,
    url: Url = DEFAULT_URL,
) -> None:
    """Upload scans with the names and roles that their files have; check, register, fit them."""
    if (subject is None) == (person is None):
        raise UsageError("give either --subject or --person")
    steps = then or ["register", "model", "geometry"]
    kinds = ["check_scan", *(["register_scan"] if "register" in steps else [])]
    frame = scan_frame(unit, eye_distance, up, forward)
    given = with_frame(read_object(options, "--options"), kinds, frame)
    marks = landmarks_of(landmarks or [], name_session(neutral, files))
    with Client(url) as client:
        whose = subject and find_subject(client, subject)
        with transfer_bar("scans") as progress:
            batch = client.create_batch(
                neutral,
                files,
                subject_id=whose,
                person=person,
                registered=registered,
                then=steps,
                options=given,
                landmarks=marks,
                progress=progress,
            )
        out.print(batch.id)
        if wait:
            try:
                _show(client.wait_for_batch(batch.id))
            except ApiError:
                _show(client.batch(batch.id))  # which says what is wrong with each scan
                raise


def with_frame(
    given: dict[str, Any], kinds: Iterable[str], frame: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the options of a batch, with how its scans lie in space in those of ``kinds``."""
    found = {kind: require_object(own, f"--options: {kind}") for kind, own in given.items()}
    return found | {kind: {**frame, **found.get(kind, {})} for kind in kinds}


def landmarks_of(given: list[str], scans: Sequence[NamedScan]) -> dict[Path, Path]:
    """Return the files ``SCAN=FILE`` by the scan's: its file or its name, or ``neutral``."""
    found = {}
    for each in given:
        scan, _, file = each.partition("=")
        of = [one for one in scans if scan in (str(one.path), one.path.name, one.path.stem)]
        of = of or [one for one in scans if scan == one.name]
        of = of or [one for one in scans if scan == one.role == "neutral"]
        if len(of) != 1:
            names = ", ".join(one.name for one in scans)
            raise UsageError(
                f"--landmarks {each}: SCAN=FILE is expected, of one of the scans, which are {names}"
            )
        if not Path(file).is_file():
            raise UsageError(f"--landmarks {each}: SCAN=FILE is expected, and {file!r} is no file")
        found[of[0].path.resolve()] = Path(file)
    return found


@batches.command("list")
def list_batches(subject: OfSubject = None, url: Url = DEFAULT_URL) -> None:
    """List batches."""
    with Client(url) as client:
        found = client.batches(subject_id=subject and find_subject(client, subject))
    rows = [(each.id, each.name, each.state, each.subject_id, len(each.scans)) for each in found]
    show_table(("batch", "name", "state", "subject", "scans"), rows)


@batches.command("show")
def show_batch(batch: BatchId, url: Url = DEFAULT_URL) -> None:
    """Show what became of each scan of a batch."""
    with Client(url) as client:
        _show(client.batch(find_batch(client, batch)))


@batches.command("cancel")
def cancel_batch(
    batch: BatchId,
    reason: Annotated[str, Option(help="why, for the record")] = "by the command line",
    url: Url = DEFAULT_URL,
) -> None:
    """Stop a batch and its jobs."""
    with Client(url) as client:
        out.print(client.cancel_batch(find_batch(client, batch), reason).state)


def _show(batch: Batch) -> None:
    rows = [
        (
            each.name,
            each.role,
            each.check and (each.check.verdict or each.check.state),
            each.registration and each.registration.state,
        )
        for each in batch.scans
    ]
    show_table(("scan", "role", "check", "registration"), rows)
    for each in batch.scans:
        if each.left_out:
            out.print(f"{each.name} is left out: {as_typed(each.left_out)}")
    out.print(f"{batch.state}, subject {batch.subject_id}")
    if batch.fit and batch.fit.rig_id:
        out.print(f"rig {batch.fit.rig_id}")
