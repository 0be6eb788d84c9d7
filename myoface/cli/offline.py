"""Commands that solve in this process: one for each kind of job, made of its contract."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from inspect import Parameter, Signature
from pathlib import Path
from typing import Annotated, Any, Literal

from myoface.cli.app import NewFile, NewFolder, read_object, read_scene
from myoface.cli.commands import Argument, Group, Option, UsageError
from myoface.cli.console import JobDisplay, out, show_outcome
from myoface.names import name_scans
from solver.jobs import run_job
from solver.kinds import INPUTS, KINDS, SCANS, InputPart, Kind

solve = Group("Solve here, without a service.")

Model = Annotated[Path, Argument(exists=True, dir_okay=False, help="model.npz")]
SceneFile = Annotated[
    Path, Argument(exists=True, dir_okay=False, help="JSON, see docs/guide/simulation.md")
]
Resume = Annotated[bool, Option("--resume", help="go on after the frames in the folder")]

SCAN_ROLES = ("unknown", *SCANS)  # that a scan may be meant for


def _parts(kind: Kind) -> list[InputPart]:
    """Return what a kind's command asks for, other than its options."""
    found: list[InputPart] = []
    for each in (INPUTS[name] for name in (*kind.reads, *kind.asks)):
        if "capture" in kind.reads and each.of_an_expression:
            found += each.of_an_expression
        elif "any_rig" in kind.reads and each.beside_a_rig:
            found += each.beside_a_rig
        else:
            found += each.parts
    return found


def _type_and_default(part: InputPart) -> tuple[Any, Any]:
    """Return the type of a part on the command line, and its default."""
    rules: dict[str, Any] = {"help": part.words}
    if part.form in ("file", "file or folder", "files"):
        rules |= {"exists": True, "dir_okay": part.form == "file or folder"}
    said = Argument(**rules) if part.is_needed else Option(f"--{part.parameter}", **rules)
    if part.form == "role":
        return Annotated[Literal[SCAN_ROLES], said], SCAN_ROLES[0]
    type_: Any = {"files": list[Path], "named files": list[str]}.get(part.form, Path)
    if part.is_needed:
        return Annotated[type_, said], Parameter.empty
    return Annotated[type_ | None, said], None


def make_command(kind: Kind) -> Callable[..., None]:
    """Return the command of a kind of job, which a group takes."""
    parameters = _parameters(kind)

    def command(**given: Any) -> None:
        _run(kind, given)

    order = sorted(parameters, key=lambda each: each.default is not Parameter.empty)
    command.__signature__ = Signature(order)  # type: ignore[attr-defined]
    command.__annotations__ = {each.name: each.annotation for each in order}
    command.__doc__ = f"{kind.title}. {kind.description}"
    return command


def _name(kind: Kind) -> str:
    return kind.name.removeprefix("fit_").replace("_", "-")


def _parameters(kind: Kind) -> list[Parameter]:
    """Return the parameters of a kind's command: its inputs, the folder, its options."""
    found: dict[str, Parameter] = {}

    def add(name: str, annotation: Any, default: Any = Parameter.empty) -> None:
        assert name not in found, f"{kind.name} has an input and an option called {name}"
        found[name] = Parameter(
            name, Parameter.KEYWORD_ONLY, default=default, annotation=annotation
        )

    properties = kind.schema["properties"]
    parts = _parts(kind)
    for part in parts:
        if part.is_needed:
            add(part.parameter, *_type_and_default(part))
    for name, rules in properties.items():
        if _is_document(rules):
            add(name, SceneFile)
    add("output", NewFolder, Path(kind.folder))
    for part in parts:
        if not part.is_needed:
            add(part.parameter, *_type_and_default(part))
    for name, rules in properties.items():
        if not _is_document(rules):
            add(name, _option(name, rules), rules.get("default", Parameter.empty))
    if kind.frames:
        add("resume", Resume, False)
    return list(found.values())


def _is_document(rules: Mapping[str, Any]) -> bool:
    return "$ref" in rules


def _option(name: str, rules: Mapping[str, Any]) -> Any:
    """Return the type of an option on the command line, for the JSON Schema of its values."""
    flag = f"--{name.replace('_', '-')}"
    words = rules.get("description")
    types = [rules["type"]] if isinstance(rules.get("type"), str) else rules.get("type", [])
    forms = [*rules.get("anyOf", []), *rules.get("oneOf", [])]
    words_and_numbers = {"string" if "enum" in each else each.get("type") for each in forms}
    if {"string", "number"} <= words_and_numbers:
        read = Option(flag, help=words, parser=_read_word, metavar=name.upper())
        return Annotated[str | float | None, read]
    if "enum" in rules:
        choices = tuple(each for each in rules["enum"] if each is not None)
        kind: Any = Literal[choices]
        may_be_none = None in rules["enum"]
    else:
        known = {"boolean": bool, "integer": int, "number": float, "string": str, "object": dict}
        kind = next(known[each] for each in types if each in known)
        may_be_none = "null" in types
    bounds: dict[str, Any] = {"min": rules.get("minimum"), "max": rules.get("maximum")}
    if kind not in (int, float):
        bounds = {}
    if kind is dict:
        bounds = {"parser": lambda word: read_object(word, flag), "metavar": "JSON"}
    flags = dict.fromkeys((flag, flag.removesuffix("-mm")))
    made = Option(*flags, help=words, **bounds)
    return Annotated[kind | None if may_be_none else kind, made]


def _read_word(given: str) -> str | float:
    """Return a number, or the word that is none."""
    try:
        return float(given)
    except ValueError:
        return given


def _run(kind: Kind, given: dict[str, Any]) -> None:
    """Do a kind's job with what its command was given, and show what it left."""
    properties = kind.schema["properties"]
    folder = given["output"]
    options = {
        name: read_scene(given[name]) if _is_document(rules) else given[name]
        for name, rules in properties.items()
    }
    # by what the kind reads: an option may be called as the input of another kind
    files = {part.role: given[part.parameter] for part in _parts(kind) if part.role}
    if (rig := files.pop("rig", None)) is not None:
        from solver.rig import find_files

        files |= find_files(rig)
    with JobDisplay(_name(kind)) as view, _made(folder):
        left = run_job(
            kind.name,
            folder,
            options=options,
            captures=name_expressions(given.get("scans") or [])
            | _named_files("asset", given)
            | _named_files("photo", given)
            | _named_files("wrinkle", given),
            facts=_named_files("facts", given),
            masks=_named_files("mask", given),
            role=given.get("role", "unknown"),
            resume=given.get("resume", False),
            progress=view,
            **files,
        )
    kind = kind.given(options)
    report = json.loads((folder / kind.report).read_text(encoding="utf-8"))
    judged = files.get("scan") or files.get("markers")
    code = show_outcome(kind.name, report, judged and judged.name)
    if kind.leaves in SUMMARIES:
        SUMMARIES[kind.leaves](report, given)
    if live := report.get("live"):
        _show_live(live)
    out.print(f"{folder / kind.result}")
    written = {path.name for path in left or ()}
    for name in kind.hands_on:
        if name in written and name != kind.result:
            out.print(f"{folder / name}")
    if code:
        raise SystemExit(code)


def _show_sequence(report: Mapping[str, Any], _given: Mapping[str, Any]) -> None:
    out.print(
        f"{report['fitted']} of {report['frames']} frames fitted, {report['mean_mm']:.2f} mm off "
        f"on average, {report['frame_ms']:.0f} ms a frame"
    )
    if "all_markers" not in report:  # of scans
        return
    every = report["all_markers"]
    if every["mean_mm"] is not None:
        out.print(
            f"with the {every['rejected']:.1%} of points that were rejected {every['mean_mm']:.2f} "
            f"mm, at most {every['max_mm']:.1f} mm: {every['max_label']} in frame "
            f"{every['max_frame']}"
        )


def _show_live(live: Mapping[str, Any]) -> None:
    """Say how far the session of a take was off, beside what it told then."""
    told = live["told"]
    if not live["frames"]:
        out.print("live sent nothing of these frames")
        return
    found = f"live was off {live['p50_mm']:.2f} mm, 95 % within {live['p95_mm']:.2f}"
    most = f"at most {live['max_mm']:.2f} in frame {live['max_frame']}"
    said = "had told nothing"
    if told["p50_mm"] is not None:
        said = f"had told {told['p50_mm']:.2f} mm, 95 % within {told['p95_mm']:.2f}"
    out.print(f"{found}, {most}, in {live['frames']} frames; it {said}")


def _show_animation(report: Mapping[str, Any], _given: Mapping[str, Any]) -> None:
    out.print(
        f"{report['frames']} frames, {report['frame_ms']:.0f} ms a frame, skin at most "
        f"{report['penetration_max_mm']:.2f} mm in what it meets, {report['inverted']} inverted "
        "tets"
    )


def _show_edit(report: Mapping[str, Any], _given: Mapping[str, Any]) -> None:
    volume = report["volume"]
    neutral = report["neutral"]
    out.print(
        f"{volume['change_ml']:+.1f} ml, the face at rest moved {neutral['moved_mm']:.2f} mm on "
        "average"
    )


def _show_rig(report: Mapping[str, Any], given: Mapping[str, Any]) -> None:
    out.print(f"{report['verdict']}: {report['use']}")
    out.print(f"{given['output'] / 'report.html'}")


def _show_export(report: Mapping[str, Any], given: Mapping[str, Any]) -> None:
    out.print(f"{given['output'] / report['file']}, {report['bytes']} bytes")


# What is said of a job, by what it leaves.
SUMMARIES: Mapping[str, Callable[[Mapping[str, Any], Mapping[str, Any]], None]] = {
    "sequence": _show_sequence,
    "animation": _show_animation,
    "edit": _show_edit,
    "export": _show_export,
    "rig": _show_rig,
}


def _named_files(parameter: str, given: Mapping[str, Any]) -> dict[str, Path]:
    """Return the files ``NAME=FILE`` that were given by an option, by their names."""
    found: dict[str, Path] = {}
    for each in given.get(parameter) or ():
        name, _, path = each.partition("=")
        if not (name and path):
            raise UsageError(
                f"--{parameter} {each}: NAME=FILE is expected, such as take={each or 'FILE'}"
            )
        if not Path(path).is_file():
            raise UsageError(f"--{parameter} {each}: there is no file {path}")
        if name in found:
            raise UsageError(f"--{parameter} {each}: another file is called {name}, too")
        found[name] = Path(path)
    return found


def name_expressions(scans: list[Path]) -> dict[str, Path]:
    """Return scans by the names that the service would give them, all as expressions."""
    named = name_scans(scans, roles=["expression"] * len(scans), option=None)
    return {each.name: each.path for each in named}


@contextmanager
def _made(folder: Path) -> Iterator[None]:
    """Make a folder for the block's results; one that stays empty goes again."""
    is_new = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    try:
        yield
    finally:
        if is_new and not any(folder.iterdir()):
            folder.rmdir()


@solve.command("live-link")
def live_link(
    recording: Annotated[Path, Argument(exists=True, dir_okay=False, help="Live Link Face's CSV")],
    model: Model,
    faces: Annotated[Path, Option(exists=True, file_okay=False, help="folder of ICT-FaceKit")],
    output: NewFile = Path("performance.npy"),
) -> None:
    """Make a performance of a Live Link Face recording, for a model of an ICT-FaceKit head."""
    from solver.model import SubjectModel
    from solver.scans.performance import write_performance
    from solver.templates.ict_facekit import model_performance

    subject = SubjectModel.load(model)
    frames = model_performance(faces, recording, subject)
    write_performance(output, frames, len(frames), len(subject.face))
    out.print(f"{len(frames)} frames, {frames.fps:g} a second")
    out.print(f"{output}")


for _kind in KINDS.values():
    solve.command(_name(_kind))(make_command(_kind))
