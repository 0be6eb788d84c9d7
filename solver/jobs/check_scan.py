"""The job that checks a raw scan while the person is still in the chair."""

from __future__ import annotations

import time
from pathlib import Path

from solver.errors import InputError, judge_findings, worst_first
from solver.jobs import Task, read_template
from solver.kinds import SCANS
from solver.kinds.kind import FrameOptions
from solver.progress import Step
from solver.scans.check import check, check_picture
from solver.storage import write_json

ROLES = ("unknown", *SCANS)


def run(task: Task[FrameOptions]) -> list[Path]:
    """Check a raw scan: whether it can be used, and what to do about it now.

    A bad scan, also one that cannot be read, is a verdict and no exception. In a scan of the role
    ``neutral`` an open mouth and closed eyes are errors, in an ``expression`` they are none;
    ``unknown`` only mentions them. Raises :class:`solver.errors.InputError` for options and
    templates that cannot be used.
    """
    if task.role not in ROLES:
        message = f"role is {task.role!r}, not one of {', '.join(ROLES)}"
        raise InputError("options.role", message, expected=list(ROLES))
    scan = task.inputs["scan"]
    progress = task.progress
    progress(Step("read", 0.0, message=scan.name))
    start = time.perf_counter()
    anatomy = read_template(task)
    progress(Step("check", 0.1))
    frame = task.options.model_dump()
    found = check(scan, anatomy, frame, task.role, task.inputs.get("landmarks"))
    verdict = judge_findings(found.findings)
    progress(Step("pictures", 0.8))
    files = [task.out / "check.json", task.out / "check.png"]
    check_picture(found, f"{scan.name}: {verdict}", files[1])
    report = {
        "file": scan.name,
        "verdict": verdict,
        "findings": [finding.to_dict() for finding in worst_first(found.findings)],
        "judged": [each.to_dict() for each in found.parts],
        "figures": found.figures | {"seconds": round(time.perf_counter() - start, 2)},
    }
    write_json(files[0], report)
    progress(Step("done", 1.0, message=verdict))
    return files
