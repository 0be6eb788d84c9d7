"""The job that makes the sliders of a rig's page."""

from __future__ import annotations

import time
from pathlib import Path

from solver.fitting.target_checks import check_held
from solver.jobs import Task
from solver.kinds.build_preview import BuildPreview
from solver.mechanics.linear import fastest
from solver.progress import Step
from solver.rig import Rig
from solver.rig.preview import make_preview, preview_picture, read_back, write_preview
from solver.storage import write_json

TOLERANCE = 1e-5  # residual of an equilibrium: within a thousandth of a mm, far below the error


def run(task: Task[BuildPreview]) -> list[Path]:
    """Make the sliders of a rig: muscles and jaw, and the skin's motion they stand for.

    Poses of the sliders are simulated; a reduced skin is fitted to some and measured on others.
    Raises as :func:`solver.rig.preview.make_preview`, and :class:`solver.errors.InputError` for
    files that do not belong together.
    """
    out = task.out
    progress = task.progress
    progress(Step("read", 0.0, message=task.inputs["rig"].name))
    begin = time.perf_counter()
    rig = Rig.load(task.inputs)
    fits = [fit for fit in rig.expressions if fit.status != "failed"]
    face = rig.face(fastest(), TOLERANCE).with_free_jaw()  # its sliders are those of five numbers
    check_held(face)
    preview = make_preview(
        face,
        fits,
        seed=task.options.seed,
        seconds=task.options.max_seconds,
        listen=lambda phase, done: progress(Step(phase, 0.02 + 0.93 * done)),
    )
    files = [out / "preview.bin", out / "preview.json", out / "preview.png"]
    write_preview(files[0], preview)
    skin = rig.model.skin.vertices
    shown = rig.model.face
    preview, measured = read_back(files[0], preview, skin, shown)
    progress(Step("pictures", 0.96))
    preview_picture(rig.model, preview, files[2])
    seconds = round(time.perf_counter() - begin, 1)
    told = {"seconds": seconds, "files": {files[0].name: measured}}
    write_json(files[1], {**preview.figures(), **told})
    progress(Step("done", 1.0))
    return files
