"""Commands that solve in this process, without a service."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from myoface.cli.app import (
    BAD_SCAN,
    Forward,
    LandmarksFile,
    NewFile,
    NewFolder,
    RawScan,
    Scan,
    Unit,
    Up,
    frame_options,
    read_scene,
)
from myoface.cli.console import JobView, out, show_registration, show_verdict

if TYPE_CHECKING:
    from solver.pipeline import PersonFiles

solve = typer.Typer(help="Solve here, without a service.", no_args_is_help=True)

Model = Annotated[Path, typer.Argument(exists=True, dir_okay=False, help="model.npz")]
Scans = Annotated[list[Path], typer.Argument(exists=True, dir_okay=False, help="expression scans")]
Rig = Annotated[Path, typer.Argument(exists=True, file_okay=False, help="a fitted rig's folder")]
Distance = Annotated[
    Literal["point", "plane"],
    typer.Option(help="to the scan's vertices, or along its normals: the skin may slide"),
]
FitSolver = Annotated[
    Literal["reduced", "ipopt"], typer.Option("--solver", help="ipopt: the slow reference")
]
LinearSolver = Annotated[
    str | None, typer.Option(help="rslab, rslab-single, cholmod, superlu; default: what is fast")
]
MaxIterations = Annotated[int, typer.Option(min=1, max=500, help="at most so many of Gauss-Newton")]
CaptureRole = Literal["unknown", "neutral", "expression"]
SceneFile = Annotated[
    Path, typer.Argument(exists=True, dir_okay=False, help="JSON, see docs/guide/simulation.md")
]
Assets = Annotated[
    list[str] | None,
    typer.Option("--asset", help="NAME=FILE, a file that the scene names; may be repeated"),
]
Video = Annotated[bool, typer.Option("--video", help="write a film, too")]
Resume = Annotated[bool, typer.Option("--resume", help="go on after the frames in the folder")]
TemplateFile = Annotated[
    Path | None, typer.Option("--template", exists=True, help="template NPZ; default: built-in")
]


# The solver is imported where it is used: compiled numerics take seconds to load.


@solve.command("check-scan")
def check_scan(
    scan: RawScan,
    output: NewFolder = Path("check"),
    role: Annotated[CaptureRole, typer.Option(help="what the scan is meant to be")] = "unknown",
    template: TemplateFile = None,
    landmarks: LandmarksFile = None,
    unit: Unit = "auto",
    up: Up = "auto",
    forward: Forward = "auto",
) -> None:
    """Tell whether a scan can be used, and what to do if not; ends with 3 if it is bad."""
    from solver.pipeline import check_scan as check

    options = {**frame_options(unit, up, forward), "role": role}
    with JobView("check-scan") as view, _made(output):
        check(scan, output, template=template, landmarks=landmarks, options=options, progress=view)
    found = json.loads((output / "check.json").read_text(encoding="utf-8"))
    show_verdict(scan.name, found)
    out.print(f"{output / 'check.png'}", markup=False)
    if found["verdict"] == "bad":
        raise typer.Exit(BAD_SCAN)


@solve.command("register-scan")
def register_scan(
    scan: RawScan,
    output: NewFolder = Path("registered"),
    neutral: Annotated[
        Path | None,
        typer.Option(exists=True, dir_okay=False, help="of an expression: registered neutral"),
    ] = None,
    template: TemplateFile = None,
    landmarks: LandmarksFile = None,
    unit: Unit = "auto",
    up: Up = "auto",
    forward: Forward = "auto",
) -> None:
    """Put the template's vertices on a raw scan."""
    from solver.pipeline import register_scan as register

    with JobView("register-scan") as view, _made(output):
        register(
            scan,
            output,
            template=template,
            neutral=neutral,
            landmarks=landmarks,
            options=frame_options(unit, up, forward),
            progress=view,
        )
    figures = json.loads((output / "registration.json").read_text(encoding="utf-8"))
    show_registration(scan.name, figures)
    out.print(f"{output / 'registered.ply'}", markup=False)


@solve.command("build-model")
def build_model(
    neutral: Scan,
    output: NewFolder = Path("model"),
    template: TemplateFile = None,
    edge_mm: Annotated[
        float | None, typer.Option(min=3, max=30, help="edge length of the tetrahedra")
    ] = None,
) -> None:
    """Build a person's model from the neutral scan."""
    from solver.pipeline import build_model as build

    options = {} if edge_mm is None else {"edge_mm": edge_mm}
    with JobView("build-model") as view, _made(output):
        build(neutral, output, template=template, options=options, progress=view)
    out.print(f"{output / 'model.npz'}", markup=False)


@solve.command("geometry")
def fit_geometry(
    model: Model,
    scans: Scans,
    output: NewFolder = Path("rig"),
    start: Annotated[
        tuple[Path, Path] | None,
        typer.Option(help="muscle_weights.npz and model.npz to start from, also of another person"),
    ] = None,
    rounds: Annotated[int, typer.Option(min=1, max=50, help="rounds of Gauss-Newton at most")] = 12,
    symmetry: Annotated[
        float, typer.Option(min=0.0, help="how much alike left and right become; 1e-3 is much")
    ] = 0.0,
    distance: Distance = "point",
    solver: FitSolver = "reduced",
    linear_solver: LinearSolver = None,
) -> None:
    """Fit muscle geometry, activations and jaw to several expressions at once."""
    from solver.pipeline import fit_geometry as fit

    options = {
        "rounds": rounds,
        "symmetry": symmetry,
        "distance": distance,
        "solver": solver,
        "linear_solver": linear_solver,
    }
    with JobView("geometry") as view, _made(output):
        fit(model, _named(scans), output, start=start, options=options, progress=view)
    out.print(f"{output / 'rig.glb'}", markup=False)


@solve.command("activations")
def fit_activations(
    model: Model,
    rig: Rig,
    scans: Scans,
    output: NewFolder = Path("rig-new"),
    max_iterations: MaxIterations = 25,
    distance: Distance = "point",
    solver: FitSolver = "reduced",
    linear_solver: LinearSolver = None,
) -> None:
    """Fit activations and jaw of further expressions with a rig's muscle geometry."""
    from solver.pipeline import fit_activations as fit

    options = {
        "max_iterations": max_iterations,
        "distance": distance,
        "solver": solver,
        "linear_solver": linear_solver,
    }
    weights = rig / "muscle_weights.npz"
    with JobView("activations") as view, _made(output):
        fit(model, weights, _named(scans), output, rig=rig, options=options, progress=view)
    out.print(f"{output / 'rig.glb'}", markup=False)


@solve.command("sequence")
def fit_sequence(
    model: Model,
    rig: Rig,
    performance: Annotated[
        Path, typer.Argument(exists=True, help="frames (.npy), or a folder of registered scans")
    ],
    output: NewFolder = Path("sequence"),
    fps: Annotated[float, typer.Option(min=0.001, help="frames per second")] = 30.0,
    start: Annotated[int, typer.Option(min=0, help="first frame to fit")] = 0,
    end: Annotated[int | None, typer.Option(min=1, help="the frame after the last")] = None,
    step: Annotated[int, typer.Option(min=1, help="fit every frame, every second ...")] = 1,
    temporal: Annotated[
        float, typer.Option(min=0, help="weight of the change from frame to frame")
    ] = 0.0,
    distance: Distance = "point",
    head_motion: Annotated[
        bool, typer.Option("--head-motion", help="solve the head's rigid motion")
    ] = False,
    max_iterations: MaxIterations = 12,
    linear_solver: LinearSolver = None,
    resume: Resume = False,
) -> None:
    """Fit activations and jaw to every frame of a performance."""
    from solver.pipeline import fit_sequence as fit

    options = {
        "fps": fps,
        "start": start,
        "end": end,
        "step": step,
        "temporal": temporal,
        "distance": distance,
        "head_motion": head_motion,
        "max_iterations": max_iterations,
        "linear_solver": linear_solver,
    }
    weights = rig / "muscle_weights.npz"
    with JobView("sequence") as view, _made(output):
        fit(model, weights, performance, output, resume=resume, options=options, progress=view)
    found = json.loads((output / "sequence.json").read_text(encoding="utf-8"))
    out.print(
        f"{found['fitted']} of {found['frames']} frames fitted, {found['mean_mm']:.2f} mm off on "
        f"average, {found['frame_ms']:.0f} ms a frame"
    )
    out.print(f"{output / 'sequence.npz'}", markup=False)


@solve.command("build-preview")
def build_preview(
    model: Model,
    rig: Rig,
    output: NewFolder = Path("preview"),
    seed: Annotated[int, typer.Option(min=0, help="of the poses that are simulated")] = 0,
    max_seconds: Annotated[
        float, typer.Option(min=10, help="then it is made of the poses that are ready")
    ] = 600.0,
) -> None:
    """Make the sliders of a rig: the skin that muscles and jaw move, and its error."""
    from solver.pipeline import build_preview as build

    options = {"seed": seed, "max_seconds": max_seconds}
    weights, activations = rig / "muscle_weights.npz", rig / "activations.npz"
    with JobView("build-preview") as view, _made(output):
        build(model, weights, activations, output, options=options, progress=view)
    out.print(f"{output / 'preview.bin'}", markup=False)


@solve.command()
def simulate(
    model: Model,
    rig: Rig,
    scene: SceneFile,
    output: NewFolder = Path("simulation"),
    asset: Assets = None,
    template: TemplateFile = None,
    video: Video = False,
    linear_solver: LinearSolver = None,
    resume: Resume = False,
) -> None:
    """Play keys of expressions, muscles and jaw by a fitted face's flesh."""
    from solver.pipeline import simulate as play

    options = {"scene": read_scene(scene), "video": video, "linear_solver": linear_solver}
    person = _person(model, rig, asset, template)
    with JobView("simulate") as view, _made(output):
        play(person, output, resume=resume, options=options, progress=view)
    _show_animation(output)


@solve.command()
def animate(
    model: Model,
    rig: Rig,
    scene: SceneFile,
    output: NewFolder = Path("animation"),
    asset: Assets = None,
    template: TemplateFile = None,
    blendshapes: Annotated[
        Path | None,
        typer.Option(exists=True, dir_okay=False, help="blendshapes.npz of an earlier animation"),
    ] = None,
    video: Video = False,
    linear_solver: LinearSolver = None,
    resume: Resume = False,
) -> None:
    """Play a recording of Live Link Face by a fitted face's flesh."""
    from solver.pipeline import animate as play

    options = {"scene": read_scene(scene), "video": video, "linear_solver": linear_solver}
    person = _person(model, rig, asset, template)
    with JobView("animate") as view, _made(output):
        play(
            person,
            output,
            blendshapes=blendshapes,
            resume=resume,
            options=options,
            progress=view,
        )
    _show_animation(output)


@solve.command()
def edit(
    model: Model,
    rig: Rig,
    scene: SceneFile,
    output: NewFolder = Path("edited"),
    asset: Assets = None,
    template: TemplateFile = None,
) -> None:
    """Fatten, slim, fill, operate on or paralyse a person, and replay the rig's expressions."""
    from solver.pipeline import edit as change

    options = {"scene": read_scene(scene)}
    person = _person(model, rig, asset, template)
    with JobView("edit") as view, _made(output):
        change(person, output, options=options, progress=view)
    found = json.loads((output / "edit.json").read_text(encoding="utf-8"))
    volume, neutral = found["volume"], found["neutral"]
    out.print(
        f"{volume['change_ml']:+.1f} ml, the face at rest moved {neutral['moved_mm']:.2f} mm on "
        "average"
    )
    out.print(f"{output / 'edit.glb'}", markup=False)


@solve.command("live-link")
def live_link(
    recording: Annotated[
        Path, typer.Argument(exists=True, dir_okay=False, help="Live Link Face's CSV")
    ],
    model: Model,
    faces: Annotated[
        Path, typer.Option(exists=True, file_okay=False, help="folder of ICT-FaceKit")
    ],
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
    out.print(f"{output}", markup=False)


def _person(model: Path, rig: Path, assets: list[str] | None, template: Path | None) -> PersonFiles:
    """Return the person that a scene is about; ``assets`` are ``NAME=FILE``."""
    from solver.pipeline import PersonFiles

    found: dict[str, Path] = {}
    for each in assets or ():
        name, _, path = each.partition("=")
        if not (name and Path(path).is_file()):
            raise typer.BadParameter(
                f"--asset {each}: NAME=FILE is expected, of a file that exists"
            )
        if name in found:
            raise typer.BadParameter(f"--asset {each}: another file is called {name}, too")
        found[name] = Path(path)
    return PersonFiles(model, rig / "muscle_weights.npz", rig, found, template)


def _show_animation(output: Path) -> None:
    found = json.loads((output / "animation.json").read_text(encoding="utf-8"))
    out.print(
        f"{found['frames']} frames, {found['frame_ms']:.0f} ms a frame, skin at most "
        f"{found['penetration_max_mm']:.2f} mm in what it meets, {found['inverted']} inverted tets"
    )
    out.print(f"{output / 'animation.glb'}", markup=False)


def _named(scans: list[Path]) -> dict[str, Path]:
    named = {path.stem: path for path in scans}
    if len(named) < len(scans):
        raise typer.BadParameter("two scans have the same name: an expression is named by its file")
    return named


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
