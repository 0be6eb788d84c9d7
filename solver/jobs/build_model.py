"""The job that builds a subject's model."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from solver.anatomy.build import build_subject_model, model_summary
from solver.anatomy.meshing import find_or_make_mesh
from solver.jobs import Task, read_template
from solver.kinds.build_model import BuildModel
from solver.meshio.registered import read_registered
from solver.progress import Step, part_of
from solver.rig.pictures import anatomy_picture, fibres_picture, tets_picture
from solver.storage import write_json


def run(task: Task[BuildModel]) -> list[Path]:
    """Build a subject's model from a registered neutral scan.

    A template without tets of the wanted edge length gets them first, in minutes, and they are kept
    in the cache folder for everybody. Raises :class:`solver.errors.InputError` for a scan or
    template that cannot be used, :class:`solver.errors.SolveError` if no mesh can be made.
    """
    neutral = task.inputs["neutral"]
    edge_mm = task.options.edge_mm
    progress = task.progress
    progress(Step("read", 0.0, message=neutral.name))
    anatomy = read_template(task)
    scan = read_registered(neutral, anatomy.skin.faces, len(anatomy.skin.vertices))
    anatomy = find_or_make_mesh(anatomy, edge_mm, part_of(progress, 0.02, 0.7))
    model = build_subject_model(
        anatomy,
        scan.vertices,
        edge_mm=edge_mm,
        compartments=task.options.muscles == "compartments",
        progress=part_of(progress, 0.7, 0.93),
    )
    model = replace(model, size_from=scan.size_from)
    names = ("model.npz", "model.json", "anatomy.png", "tets.png", "fibres.png")
    files = [task.out / name for name in names]
    model.save(files[0])
    write_json(files[1], model_summary(model))
    progress(Step("pictures", 0.94))
    anatomy_picture(model, files[2])
    tets_picture(model, files[3])
    fibres_picture(model, files[4])
    progress(Step("done", 1.0))
    return files
