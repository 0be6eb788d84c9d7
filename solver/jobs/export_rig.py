"""The job that writes a rig in the format of another program."""

from __future__ import annotations

from pathlib import Path

from solver.errors import InputError
from solver.jobs import Task
from solver.kinds.export_rig import ExportRig
from solver.progress import Step
from solver.rig import Rig
from solver.rig.exporters import export_measured, exporter
from solver.storage import write_json

REPORT = "export.json"


def run(task: Task[ExportRig]) -> list[Path]:
    """Write the rig by the exporter ``format``, and ``export.json`` with the name of its file.

    Raises :class:`solver.errors.InputError` (``export.*``) as
    :func:`solver.rig.exporters.export`, and as the exporter.
    """
    given = task.options
    progress = task.progress
    file = given.file or exporter(given.format).FILE
    if file == REPORT:
        message = f"options.file: {file} tells of the export: give its file another name"
        raise InputError("export.options", message, found=file)
    progress(Step("read", 0.0, message=task.inputs["rig"].name))
    rig = Rig.load(task.inputs)
    progress(Step("export", 0.3, message=given.format))
    made = task.out / file
    report = task.out / REPORT
    figures = export_measured(rig, given.format, made, given.settings).figures
    told = {"format": given.format, "file": file, "bytes": made.stat().st_size}
    write_json(report, {**told, "files": {file: figures}})
    progress(Step("done", 1.0))
    return [made, report]
