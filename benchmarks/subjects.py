"""The subjects benchmarks run on: the built-in person, or folders of real anatomy and faces."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from benchmarks.strong import HARD, strong_scans
from solver.anatomy.build import build_subject_model, jaw_tracks
from solver.anatomy.meshing import find_or_make_mesh
from solver.anatomy.template import ShapeBasis, Template
from solver.cache import cache_directory
from solver.fitting.drives.admissible import Admissible
from solver.fitting.face import Face
from solver.fitting.geometry import GeometryOptions, usual_options
from solver.fitting.training import train
from solver.mechanics.jaw_tracks import JawTracks
from solver.model import SubjectModel
from solver.surface import Surface
from solver.templates.builtin.build import builtin_capture_set, builtin_template
from solver.templates.ict_facekit import ict_capture_set, read_facekit, shape_basis
from solver.templates.ict_template import build_ict_template
from solver.templates.tables import CaptureSet

EDGE_MM = 9.0
COARSE_EDGE_MM = 18.0
"""Tets' edges of benchmarks: as in jobs, and small enough for IPOPT."""

QUICK_ROUNDS = 4  # of a fit of S in a quick run

SETS = ("standard", "strong")  # of a subject's training scans; the unseen ones are the same


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose one subject; without any it is the built-in person."""
    add_folders(parser)
    parser.add_argument("--subject", default="A", help="subject of the capture-sets file")


def add_folders(parser: argparse.ArgumentParser) -> None:
    """Add the options that say where subjects come from."""
    parser.add_argument("--anatomy", type=Path, help="folder of BodyParts3D meshes")
    parser.add_argument("--faces", type=Path, help="folder of ICT-FaceKit")
    parser.add_argument("--capture-sets", type=Path, help="capture-sets file (default: in --faces)")
    parser.add_argument("--whole", action="store_true", help="leave muscles whole, undivided")


def add_controls(parser: argparse.ArgumentParser) -> None:
    """Add the option that says what muscles and jaw may do in fits; by default as in jobs."""
    parser.add_argument("--controls", choices=("admissible", "free"), default="admissible")


def bounded(face: Face, options: argparse.Namespace) -> Face:
    """Return the face with the controls of :func:`add_controls`."""
    return face.driven_as(Admissible()) if options.controls == "admissible" else face


def schedule(options: argparse.Namespace, model: SubjectModel, *, quick: bool) -> GeometryOptions:
    """Return the schedule of fits of a model's S that end with these controls."""
    within = Admissible() if options.controls == "admissible" else None
    return usual_options(model, within, QUICK_ROUNDS if quick else None)


def default_to_data(parser: argparse.ArgumentParser) -> None:
    """Take folders, recording and takes from the data where they are not given, if it is there."""
    data = Path(os.environ.get("MYOFACE_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if data.is_dir():
        parser.set_defaults(
            anatomy=data / "bodyparts3d",
            faces=data / "ict_facekit",
            recording=data / "performance" / "alex_rom_3.csv",
            takes=data / "markers" / "animface",
        )


def builtin_options() -> argparse.Namespace:
    """Return what these options are where nothing is given: the built-in person, as in jobs."""
    parser = argparse.ArgumentParser()
    add_options(parser)
    return parser.parse_args([])


@dataclass(frozen=True)
class Subject:
    """A person to be fitted, with the sets of scans by their names (:data:`SETS`).

    ``hard`` are unseen scans of :data:`~benchmarks.strong.HARD` expressions.
    """

    name: str
    model: SubjectModel
    sets: dict[str, CaptureSet]
    hard: dict[str, Surface]
    tracks: JawTracks

    @property
    def captures(self) -> CaptureSet:
        """Return the standard set."""
        return self.sets["standard"]


def shapes(options: argparse.Namespace) -> ShapeBasis:
    """Return the shapes of the chosen template."""
    faces = options.faces
    found = builtin_template().shapes if faces is None else shape_basis(read_facekit(faces))
    assert found is not None, "templates of benchmarks have shapes"
    return found


def chosen_template(options: argparse.Namespace, edge_mm: float) -> Template:
    """Return the subjects' template with tets of ``edge_mm``."""
    if (options.faces is None) != (options.anatomy is None):
        raise SystemExit("--anatomy and --faces go together")
    if options.faces is None:
        return find_or_make_mesh(builtin_template(), edge_mm)
    return find_or_make_mesh(build_ict_template(options.anatomy, options.faces), edge_mm)


def trained(template: Template) -> Template:
    """Return a template with its S trained, which is kept in the cache: it takes ten minutes."""
    if template.mesh is not None and template.mesh.trained is not None:
        return template
    path = cache_directory() / f"benchmarks-trained-{template.sha256}.npz"
    if not path.exists():
        train(template).save(path)
    return Template.load(path)


def load(options: argparse.Namespace, edge_mm: float) -> tuple[SubjectModel, CaptureSet]:
    """Build the chosen subject's model with tets of ``edge_mm`` and return it with the scans."""
    subject = next(each(options, [options.subject], edge_mm))
    return subject.model, subject.captures


def each(options: argparse.Namespace, names: Sequence[str], edge_mm: float) -> Iterator[Subject]:
    """Yield several subjects of one template, whose scans are all read first.

    Without folders it is the built-in person alone, whatever the ``names``. The strong set has the
    unseen scans of the standard one.
    """
    template = trained(chosen_template(options, edge_mm))
    if options.faces is None:
        captures = {"built-in": builtin_capture_set()}
    else:
        captures = {n: ict_capture_set(options.faces, n, options.capture_sets) for n in names}
    for name, scans in captures.items():
        neutral = scans.neutral.vertices
        divided = not options.whole
        model = build_subject_model(template, neutral, edge_mm=edge_mm, compartments=divided)
        strong = replace(scans, train=strong_scans(template, scans.neutral))
        sets = dict(zip(SETS, (scans, strong), strict=True))
        hard = strong_scans(template, scans.neutral, HARD)
        yield Subject(name, model, sets, hard, jaw_tracks(template, model))
