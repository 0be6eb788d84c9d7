"""Commands that make, check and show template anatomies."""

from __future__ import annotations

import json
import textwrap
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from myoface.cli.app import (
    EyeDistance,
    Forward,
    LandmarksFile,
    NewFile,
    NewFolder,
    Unit,
    Up,
    scan_frame,
)
from myoface.cli.commands import Argument, Group, Option, UsageError
from myoface.cli.console import JobDisplay, Painted, out, show_registration, show_table
from solver.landmarker import HELP, landmarker_file
from solver.landmarker import VARIABLE as LANDMARKER

if TYPE_CHECKING:
    from solver.anatomy.template import Template
    from solver.templates.report import TemplateReport

template = Group("Make and check template anatomies.")

Given = Annotated[
    Path | None,
    Argument(exists=True, help="NPZ, or a template folder or its ZIP; default: built-in"),
]
NAMES_WIDTH = 96
MARKS = {"error": Painted("error", "red"), "warning": Painted("look at", "yellow")}


# The solver is imported where it is used: compiled numerics take seconds to load.


@template.command()
def build(
    anatomy: Annotated[
        Path | None, Option(exists=True, file_okay=False, help="BodyParts3D")
    ] = None,
    faces: Annotated[Path | None, Option(exists=True, file_okay=False, help="ICT-FaceKit")] = None,
    folder: Annotated[
        Path | None, Option(exists=True, help="a template folder of your own, or its ZIP")
    ] = None,
    builtin: Annotated[bool, Option("--builtin", help="the built-in face")] = False,
    output: NewFile = Path("template.npz"),
    edge_mm: Annotated[float, Option(min=3, max=30, help="edge length of the tetrahedra")] = 9.0,
    mesh: Annotated[bool, Option(help="make the tetrahedra that every subject will share")] = True,
    train: Annotated[
        bool, Option(help="fit its muscle geometry to its own expressions, as template train does")
    ] = False,
    landmarker: Annotated[
        Path | None,
        Option(
            exists=True, dir_okay=False, help="find its points with it, as template points does"
        ),
    ] = None,
) -> None:
    """Build a template from --anatomy and --faces, from --folder, or the --builtin one."""
    from solver.anatomy.meshing import find_or_make_mesh

    sources = [anatomy is not None and faces is not None, folder is not None, builtin]
    if sum(sources) != 1 or (anatomy is None) != (faces is None):
        raise UsageError("give --anatomy and --faces, or --folder, or --builtin")
    made = _build(anatomy, faces, folder)
    if mesh:
        with JobDisplay("template") as view:
            made = find_or_make_mesh(made, edge_mm, view)
    if train:
        made = _train(made)
    _save(made if landmarker is None else _find_points(made, landmarker), output)


@template.command()
def train(given: Given = None, output: NewFile = Path("trained.npz")) -> None:
    """Fit a template's muscle geometry to its own expressions, once for all subjects (10 minutes).

    Each expression of one unit of FACS shows a skin, and anatomy names the muscles that make it.
    Fits of subjects then begin there: in a third of the rounds, with more of the right muscles.
    """
    _save(_train(_load(given)), output)


def _train(made: Template) -> Template:
    from solver.fitting.training import train as fit

    with JobDisplay("template") as view:
        return fit(made, progress=view)


@template.command()
def points(
    given: Given = None,
    landmarker: Annotated[
        Path | None,
        Option(
            exists=True,
            dir_okay=False,
            envvar=LANDMARKER,
            help="MediaPipe's face_landmarker*.task; default: the fetched one",
        ),
    ] = None,
    output: NewFile = Path("with-points.npz"),
) -> None:
    """Find which points of a template's skin MediaPipe marks in pictures (3 minutes).

    Fits to photographs need them. The built-in face has its own; they serve every subject.
    """
    landmarker = landmarker or landmarker_file()
    if landmarker is None:
        raise UsageError(f"give --landmarker, or {HELP}")
    _save(_find_points(_load(given), landmarker), output)


def _find_points(made: Template, landmarker: Path) -> Template:
    from solver.photo.mesh_points import find_points

    with JobDisplay("template") as view:
        found = find_points(made, landmarker, progress=view)
    spread_mm = sorted(found.points.spread_mm.tolist())
    middle = spread_mm[len(spread_mm) // 2] if spread_mm else 0.0
    out.print(
        f"a face in {found.with_face} of {found.pictures} pictures: {len(spread_mm)} points, "
        f"median spread {middle:.1f} mm; {len(found.left_out)} without agreement"
    )
    return replace(made, points=found.points)


@template.command()
def rebase(
    skin: Annotated[
        Path,
        Option(exists=True, dir_okay=False, help="the head, OBJ, PLY or GLB; eyes and teeth too"),
    ],
    given: Given = None,
    name: Annotated[str, Option(help="of the new template; default: of both")] = "",
    landmarks: LandmarksFile = None,
    unit: Unit = "auto",
    eye_distance: EyeDistance = None,
    up: Up = "auto",
    forward: Forward = "auto",
    output: NewFile = Path("rebased.npz"),
) -> None:
    """Carry a template onto a head of your own, whose vertices then are the topology of scans.

    Bones, muscles, regions, landmarks and shapes come along. The head keeps its vertices and their
    order, and its axes and origin if it is upright; its unit becomes mm. What is wrong with it
    is told, and with an error nothing is written.
    """
    from solver.registration.units import FRAME
    from solver.templates.rebase import rebase as carry
    from solver.templates.report import report_template

    frame = FRAME | scan_frame(unit, eye_distance, up, forward)
    with JobDisplay("template") as view:
        made = carry(_load(given), skin, name=name, frame=frame, landmarks=landmarks, progress=view)
    show_registration(skin.name, made.registration)
    _tell(report_template(made.template))
    _save(made.template, output)


@template.command()
def check(
    given: Given = None,
    json_file: Annotated[Path | None, Option("--json", help="report; - prints it")] = None,
) -> None:
    """Say what is wrong with a template; exit code 1 if it cannot be used."""
    from solver.templates.report import report_template

    report = report_template(_load(given))
    text = json.dumps(report.as_dict(), indent=2)
    if str(json_file) == "-":
        out.print(text)
    else:
        if json_file is not None:
            json_file.write_text(text + "\n", encoding="utf-8")
        _tell(report)
    if not report.good:
        raise SystemExit(1)


def _tell(report: TemplateReport) -> None:
    """Print a report's findings and verdict; end with 1 if the template is of no use."""
    for finding in report.findings:
        line = f"{finding.context['about']}: {finding.message}"
        out.print(MARKS[finding.severity], f" {line}")
    worth = "can be used" if report.good else "cannot be used"
    name = f"{report.figures['name']} {report.figures['version']}"
    out.print(f"{name}: {worth}, {len(report.findings)} findings")
    if not report.good:
        raise SystemExit(1)


def _save(made: Template, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    digest = made.save(path)
    out.print(
        f"{path}: {made.name} {made.version}, {len(made.muscles)} muscles, content sha256 {digest}"
    )


@template.command()
def show(
    given: Given = None,
    output: Annotated[
        Path | None, Option("--output", "-o", file_okay=False, help="folder for pictures")
    ] = None,
) -> None:
    """Show what a template holds, landmarks by name; with --output also draw it, and its skin."""
    from solver.templates.report import template_figures

    loaded = _load(given)
    show_table(("what", "how much"), list(_rows(template_figures(loaded))))
    if loaded.landmarks:
        out.print(Painted("names of landmarks", "bold"))
        names = ", ".join(loaded.landmarks)
        out.print(textwrap.indent(textwrap.fill(names, NAMES_WIDTH), "  "))
    if output is not None:
        from solver.rig.pictures import skin_picture, template_picture

        output.mkdir(parents=True, exist_ok=True)
        for name, draw in (("anatomy.png", template_picture), ("skin.png", skin_picture)):
            draw(loaded, output / name)
            out.print(f"{output / name}")


@template.command()
def export(given: Given = None, output: NewFolder = Path("template")) -> None:
    """Write a template as a folder of meshes and tables, to change it or as an example."""
    from solver.templates.tables import write_template

    write_template(_load(given), output)
    out.print(f"{output}")


def _build(anatomy: Path | None, faces: Path | None, folder: Path | None) -> Template:
    if anatomy is not None and faces is not None:
        from solver.templates.ict_template import build_ict_template

        out.print("fitting skull and muscles into the head (about a minute)")
        return build_ict_template(anatomy, faces)
    return _load(folder)


def _load(given: Path | None) -> Template:
    from solver.anatomy.template import Template
    from solver.templates.builtin.build import builtin_template
    from solver.templates.folder import read_template

    if given is None:
        return builtin_template()
    return Template.load(given) if given.suffix == ".npz" else read_template(given)


def _rows(figures: dict[str, Any]) -> list[tuple[str, object]]:
    """Return figures as rows; those of a group follow its name, indented."""
    rows: list[tuple[str, object]] = []
    for name, value in figures.items():
        words = name.replace("_", " ")
        if isinstance(value, dict):
            rows.append((words, None))
            rows += [(f"  {each}", figure) for each, figure in value.items()]
        else:
            rows.append((words, value))
    return rows
