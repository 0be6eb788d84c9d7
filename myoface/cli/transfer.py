"""The command that plays a video or its signals by rigs, and draws what was filmed beside."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from myoface.cli.app import NewFolder
from myoface.cli.commands import Argument, Option, UsageError
from myoface.cli.console import JobDisplay, out, show_table, span
from solver.kinds import INPUTS, KINDS

if TYPE_CHECKING:
    from solver.animation.controls import Controls
    from solver.rig import Rig

PICTURE = "transfer.png"
RIG = INPUTS["rig"].parts[0].words
LEARNING_S = KINDS["learn_controls"].schema["properties"]["max_seconds"]
_FILE: dict[str, Any] = {"exists": True, "dir_okay": False}


def transfer(
    video: Annotated[
        Path,
        Argument(**_FILE, help="of a face: MP4, MOV, WebM, Matroska or AVI; or its signals.csv"),
    ],
    rig: Annotated[list[Path], Option(exists=True, help=f"{RIG}; repeat for more people")],
    output: NewFolder = Path("transfer"),
    controls: Annotated[
        list[Path] | None,
        Option(**_FILE, help="controls.npz of learn-controls; repeat for more rigs, in any order"),
    ] = None,
    learn: Annotated[
        bool, Option("--learn", help="learn the controls of rigs that have none")
    ] = False,
    max_seconds: Annotated[
        float,
        Option(
            min=LEARNING_S["minimum"],
            max=LEARNING_S["maximum"],
            help="of each rig: so long mixtures are fitted to learn from",
        ),
    ] = LEARNING_S["default"],
    template: Annotated[
        Path | None, Option(**_FILE, help="template NPZ; default: built-in")
    ] = None,
    blendshapes: Annotated[
        Path | None, Option(**_FILE, help="blendshapes.npz of an earlier animation of the one rig")
    ] = None,
    basis: Annotated[
        Path | None, Option(**_FILE, help="expression_basis.npz of an earlier job of the one rig")
    ] = None,
    start: Annotated[int, Option(min=0, help="first frame")] = 0,
    end: Annotated[int | None, Option(min=1, help="the frame after the last")] = None,
    face: Annotated[
        int | None, Option(min=0, help="whose face, 0 being the largest at the middle")
    ] = None,
    neutral: Annotated[
        int | None, Option(min=0, help="frame in which the face is at rest; default: estimated")
    ] = None,
    gain: Annotated[float, Option(min=0, max=10, help="factor of all weights")] = 1.0,
    smooth_hz: Annotated[
        float | None, Option(min=0, max=100, help="faster motion is taken out; default: 6")
    ] = None,
    film: Annotated[bool, Option("--film", help="make animation.mp4, too")] = False,
    resume: Annotated[
        bool, Option("--resume", help="go on after the frames in the folder")
    ] = False,
) -> None:
    """Play a video of a face by rigs, and draw frames of it and of them side by side.

    Leaves `signals.csv`, which is a recording itself, `transfer.png`, and what `myoface solve
    animate` does: of several rigs in a folder for each, called as the rig. Needs the extras `video`
    and `mediapipe`, and MediaPipe's model: `myoface assets fetch landmarker`. Signals are played
    without looking again, and without a picture; so is any other recording.
    """
    from solver.anatomy.template import Template
    from solver.kinds.scene_recording import Recording
    from solver.rig.transfer_sheet import PlayedRig, draw_transfer
    from solver.scans.film import is_film
    from solver.scans.recordings import SIGNALS_FILE, read_recording, tell_detection
    from solver.templates.builtin.build import builtin_template

    of_one = {"blendshapes": blendshapes, "expression_basis": basis}
    files: dict[str, Any] = {name: file for name, file in of_one.items() if file is not None}
    if files and len(rig) > 1:
        raise UsageError("--blendshapes and --basis are of one rig: leave them out, or give one")
    if template is not None:
        files["template"] = template
    people = _load_people(rig, output, controls or [])
    recording: dict[str, Any] = {"asset": "video", "start": start, "end": end, "face": face}
    recording |= {"gain": gain, "smooth_hz": smooth_hz}
    if neutral is not None:
        recording["neutral"] = neutral
    output.mkdir(parents=True, exist_ok=True)
    played = video
    is_filmed = is_film(video)
    if is_filmed:
        played = output / SIGNALS_FILE
        with JobDisplay("transfer") as view:
            take = read_recording(video, Recording(**recording), played, tell_detection(view, 0.0))
        for notice in take.notices:
            if notice.code == "video.faces":  # others are of signals, and told when they are played
                out.print(f"warning: {notice.message}")
        del recording["face"]  # signals are one face's
    scene = {"recording": recording}
    reports = []
    for person in people:
        if person.controls is None and learn:
            person.controls = _learn(person, files, max_seconds)
        elif person.controls is None:
            least = f"at most {span(max_seconds)} of solving and a minute of learning"
            out.print(f"{person.name}: expressions are blended; --learn learns controls, {least}")
        reports.append(_animate(person, played, scene, files, film=film, resume=resume))
    told = reports[0]["transfer"]
    source = "video" if is_filmed else "recording"
    out.print(
        f"{reports[0]['frames']} frames played; in the whole {source} {told['seen']} with a face, "
        f"gaps: {told['gaps']}, the longest of {told['longest_gap_s']:.2f} s"
    )
    _show_reports(people, reports)
    if is_filmed:
        points = (Template.load(template) if template else builtin_template()).points
        drawn = [PlayedRig(each.name, each.folder, each.rig.model) for each in people]
        draw_transfer(output / PICTURE, video, played, drawn, points, start)
        out.print(f"{output / PICTURE}")


@dataclass
class _Person:
    """A rig, and the folder of what it plays."""

    name: str
    rig: Rig
    files: dict[str, Any]  # the rig's, by their roles in a job
    folder: Path
    controls: Path | None = None


def _load_people(paths: Sequence[Path], output: Path, controls: Sequence[Path]) -> list[_Person]:
    """Return the rigs, each with its own of all ``controls`` or with those in its folder."""
    from solver.animation.controls import FILE
    from solver.errors import InputError
    from solver.fitting.drives.stored import are_same
    from solver.rig import Rig, find_files

    people: list[_Person] = []
    for path, name in zip(paths, _names(paths), strict=True):
        files = find_files(path)
        folder = output / name if len(paths) > 1 else output
        person = _Person(name, Rig.load(files), files, folder)
        person.controls = next((each for each in controls if _read(each, person.rig)), None)
        left = folder / FILE
        if person.controls is None and left.is_file():
            with suppress(InputError):  # of another release: there are none then
                kept = _read(left, person.rig)
                if kept and are_same(kept.drive, person.rig.drive):
                    person.controls = left
        people.append(person)
    used = {person.controls for person in people}
    if others := [each.name for each in controls if each not in used]:
        raise InputError("controls.model", f"{others[0]} belongs to another rig", file=others[0])
    return people


def _read(controls: Path, rig: Rig) -> Controls | None:
    """Return controls if they are the rig's."""
    from solver.animation.controls import Controls
    from solver.errors import InputError

    try:
        return Controls.load(controls, rig.model, rig.weights)
    except InputError as error:
        if error.code != "controls.model":
            raise
        return None


def _names(paths: Sequence[Path]) -> list[str]:
    """Return what rigs are called: as their folder or file, no two alike."""
    names: list[str] = []
    for path in map(Path.resolve, paths):
        name = path.parent.name if path.name == "rig.npz" else path.name
        name = name.removesuffix(".npz").removesuffix(".zip") or "rig"
        others = (f"{name}-{number}" for number in count(2))
        names.append(next(each for each in chain([name], others) if each not in names))
    return names


def _learn(person: _Person, files: Mapping[str, Any], max_seconds: float) -> Path:
    """Learn a rig's controls in its folder, and return their file."""
    from solver.animation.controls import FILE
    from solver.jobs import run_job

    shared = {name: file for name, file in files.items() if name == "template"}
    with JobDisplay(f"learn {person.name}") as view:
        options = {"max_seconds": max_seconds}
        # pairs that an attempt before left in the folder count
        run_job(
            "learn_controls",
            person.folder,
            options=options,
            resume=True,
            progress=view,
            **shared,
            **person.files,
        )
    return person.folder / FILE


def _animate(
    person: _Person,
    recording: Path,
    scene: Mapping[str, Any],
    files: Mapping[str, Any],
    *,
    film: bool,
    resume: bool,
) -> dict[str, Any]:
    """Play a recording by a rig; return the report."""
    from solver.jobs import run_job

    own = {**files, **person.files}
    if person.controls is not None:
        own["controls"] = person.controls
    with JobDisplay(person.name) as view:
        run_job(
            "animate",
            person.folder,
            options={"scene": scene, "video": film},
            captures={"video": recording},
            resume=resume,
            progress=view,
            **own,
        )
    report: dict[str, Any] = json.loads((person.folder / "animation.json").read_text("utf-8"))
    return report


def _show_reports(people: Sequence[_Person], reports: Sequence[Mapping[str, Any]]) -> None:
    """Show how each rig played the recording, a line for each."""
    rows = []
    for person, report in zip(people, reports, strict=True):
        told = report["transfer"]
        fitted = [told.get(name) for name in ("flagged", "exact")]
        unseen = len(told["unseen_shapes"])
        rows.append([person.name, report["frames"], told["controls"], *fitted, unseen])
    show_table(["rig", "frames", "controls", "flagged", "exact", "unseen shapes"], rows)
