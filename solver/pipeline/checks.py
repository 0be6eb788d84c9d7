"""The job that checks a raw scan while the person is still in the chair."""

from __future__ import annotations

import json
import time
from pathlib import Path

from solver.anatomy.template import Template
from solver.errors import InputError
from solver.pipeline.common import Options, take
from solver.progress import Progress, Step, silent
from solver.registration.pose import FRAME
from solver.scans.check import check
from solver.scans.check_picture import check_picture
from solver.scans.findings import verdict
from solver.templates.builtin.build import builtin_template

ROLES = ("unknown", "neutral", "expression")


def check_scan(
    scan: Path,
    out: Path,
    *,
    template: Path | None = None,
    landmarks: Path | None = None,
    options: Options = None,
    progress: Progress = silent,
) -> list[Path]:
    """Check a raw scan: whether it can be used, and what to do about it now.

    Writes ``check.json`` (``verdict`` good, usable or bad; ``findings``, each with ``code``,
    ``severity``, ``message`` and ``advice``; ``figures``) and ``check.png``. A bad scan, also one
    that can not be read, is a verdict and no exception. ``landmarks`` is a file of
    :func:`solver.registration.landmarks.read_landmarks`. Options: ``unit``, ``up`` and ``forward``
    of the file, and ``role``: in a ``neutral`` an open mouth and closed eyes are errors, in an
    ``expression`` they are none; ``unknown`` only mentions them. Raises
    :class:`solver.errors.InputError` for options and templates that can not be used.
    """
    given = take(options, {**FRAME, "role": "unknown"})
    role = given.pop("role")
    if role not in ROLES:
        raise InputError(
            "options.role", f"role is {role!r}, not one of {', '.join(ROLES)}", expected=list(ROLES)
        )
    out.mkdir(parents=True, exist_ok=True)
    progress(Step("read", 0.0, message=scan.name))
    start = time.perf_counter()
    anatomy = builtin_template() if template is None else Template.load(template)
    progress(Step("check", 0.1))
    found = check(scan, anatomy, given, role, landmarks)
    judged = verdict(found.findings)
    progress(Step("pictures", 0.8))
    files = [out / "check.json", out / "check.png"]
    check_picture(found, f"{scan.name}: {judged}", files[1])
    report = {
        "file": scan.name,
        "verdict": judged,
        "findings": [finding.as_dict() for finding in found.findings],
        "figures": found.figures | {"seconds": round(time.perf_counter() - start, 2)},
    }
    files[0].write_text(json.dumps(report, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    progress(Step("done", 1.0, message=judged))
    return files
