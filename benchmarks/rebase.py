"""The built-in anatomy on two studios' heads: whether it is sound there, and fits and registers.

``myoface template rebase`` takes the built-in template onto MeshMonk's template (a face without
mouth, eyes and back of the head, in mm) and onto the neutral of ICT-FaceKit (a head with all its
parts, in cm), both in ``--data``. Of each: the tets and the findings of a template's check; the
demo person, carried there, fitted to the five training scans by S and to the unseen ones by
activations alone, distances over the face vertex by vertex; and two real raw scans registered to
the new topology. ``built-in`` as a head is the template itself. ``--pictures`` draws the templates.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

from benchmarks import report, subject_fits
from benchmarks.documents import Figures, Section, Table
from benchmarks.registration import raw_scans
from solver.anatomy.build import build_subject_model
from solver.anatomy.meshing import find_or_make_mesh
from solver.anatomy.template import Template
from solver.fitting.drives.admissible import Admissible
from solver.fitting.face import Face
from solver.fitting.geometry import usual_options
from solver.registration.topology import topology
from solver.rig.pictures import skin_picture, template_picture
from solver.storage import read_arrays
from solver.surface import Floats, Surface
from solver.templates.builtin.build import builtin_capture_set, builtin_template
from solver.templates.rebase import Rebased, rebase
from solver.templates.report import report_template
from solver.templates.tables import CaptureSet

QUICK_ROUNDS = 6
COLUMNS = {
    "vertices": "vertices",
    "seconds": "seconds",
    "distance_mm": "off the head, mm",
    "inverted": "inverted tets",
    "min_dihedral_deg": "smallest angle, deg",
    "errors": "errors",
    "train_mean_mm": "training, mm",
    "test_mean_mm": "unseen, mm",
    "fits_inverted": "inverted in fits",
    "raw_mean_mm": "raw scans, mm",
}


def main() -> None:
    """Run from the command line."""
    parser = report.parser(__doc__ or "")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--heads", default="meshmonk,ict", help="built-in, meshmonk, ict")
    parser.add_argument("--pictures", type=Path, help="folder for pictures of the templates")
    options = parser.parse_args()
    report.finish(run(options), options, section)


def run(options: argparse.Namespace) -> Figures:
    """Rebase, fit and register; return the figures."""
    template = find_or_make_mesh(builtin_template())
    heads = {}
    for name in options.heads.split(","):
        based = template
        captures = builtin_capture_set()
        figures: Figures = {"seconds": 0.0}
        if name != "built-in":
            start = time.perf_counter()
            made = _rebase(template, name, options.data)
            figures = {
                "seconds": time.perf_counter() - start,
                "distance_mm": made.registration["mean_mm"],
                "coverage": made.registration["coverage"],
                "findings": [finding["message"] for finding in made.registration["findings"]],
            }
            based = made.template
            captures = carried(made, template, captures)
        heads[name] = {**figures, **_figures(based, captures, options)}
        if options.pictures is not None:
            options.pictures.mkdir(parents=True, exist_ok=True)
            template_picture(based, options.pictures / f"rebase-{name}-anatomy.png")
            skin_picture(based, options.pictures / f"rebase-{name}-skin.png")
    return {"template": template.name, "heads": heads}


def section(figures: Figures) -> Section:
    """Return the document's section."""
    rows = [
        [name, *(head.get(key, "") for key in COLUMNS)] for name, head in figures["heads"].items()
    ]
    return Section(
        title="A studio's own head",
        compared=(
            "The built-in anatomy carried onto other heads (`myoface template rebase`): MeshMonk's "
            "template, a face without mouth, eyes and back of the head, and ICT-FaceKit's neutral. "
            "`off the head` is the template's distance to the head, `errors` are those of "
            "`template check`. The demo person, carried into the new topology, is fitted as in "
            "fit quality; two real raw scans are registered to it (the worse one's mean distance)."
        ),
        parts=[Table(["head", *COLUMNS.values()], rows)],
    )


def _rebase(template: Template, name: str, data: Path) -> Rebased:
    if name == "meshmonk":
        return rebase(template, data / "scans/meshmonk/Template.obj", name=name)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "ict.obj"
        write_ict_head(path, data)
        return rebase(template, path, name=name)


def write_ict_head(path: Path, data: Path) -> None:
    """Write ICT-FaceKit's neutral as a studio would: polygons, in cm."""
    kit = read_arrays(data / "ict_facekit/ict_facekit.npz")
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in kit["V"].tolist()]
    polygons = ([corner + 1 for corner in quad if corner >= 0] for quad in kit["quads"].tolist())
    lines += [f"f {' '.join(map(str, polygon))}" for polygon in polygons]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def carried(made: Rebased, template: Template, captures: CaptureSet) -> CaptureSet:
    """Return captures of the template's topology in that of a rebased one."""
    skin = made.template.skin

    def move(delta: Floats) -> Floats:
        return made.carry(made.turn.turn(delta))

    own = captures.neutral.vertices
    neutral = skin.with_vertices(skin.vertices + move(own - template.skin.vertices))

    def scans(given: dict[str, Surface]) -> dict[str, Surface]:
        return {
            name: neutral.with_vertices(neutral.vertices + move(scan.vertices - own))
            for name, scan in given.items()
        }

    return CaptureSet(neutral, scans(captures.train), scans(captures.test))


def _figures(based: Template, captures: CaptureSet, options: argparse.Namespace) -> Figures:
    checked = report_template(based)
    mesh = checked.figures["mesh"]
    # as jobs do: muscles divided, and within what they can do
    model = build_subject_model(based, captures.neutral.vertices, compartments=True)
    face = Face(model)
    schedule = usual_options(model, Admissible(), QUICK_ROUNDS if options.quick else None)
    train = subject_fits.by_geometry(face, captures.train, schedule)
    test = subject_fits.by_activations(train.face, captures.test)
    raw = raw_scans(topology(based), options.data / "scans")
    return {
        "vertices": len(based.skin.vertices),
        "face_vertices": len(based.face_vertices),
        "tets": mesh["tets"],
        "inverted": mesh["inverted"],
        "min_dihedral_deg": mesh["smallest_dihedral_deg"],
        "errors": sum(finding.severity == "error" for finding in checked.findings),
        "warnings": [f"{f.context['about']}: {f.message}" for f in checked.findings],
        "mesh_source": model.mesh_source,
        "train_mean_mm": train.mean_mm,
        "test_mean_mm": test.mean_mm,
        "fits_inverted": train.count_inverted() + test.count_inverted(),
        "expressions": {**train.figures("train"), **test.figures("test")},
        "failed": {**train.failed, **test.failed},
        "raw_mean_mm": raw["mean_surface_mm"],
        "raw_scans": raw["scans"],
        "fit_seconds": train.seconds + test.seconds,
    }


if __name__ == "__main__":
    main()
