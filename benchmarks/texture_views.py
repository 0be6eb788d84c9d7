"""How close the textured skin of a registered scan is to the scan."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from shutil import copyfile

from benchmarks.documents import Figures
from solver.jobs import run_job


def measure_texture(scan: Path, template: Path | None, picture: Path | None) -> Figures:
    """Register a ``scan`` to a template, and return what the registration says of its colours.

    ``picture`` is where scan and skin are drawn side by side.
    """
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        run_job("register_scan", out, scan=scan, template=template)
        told = json.loads((out / "registration.json").read_text())
        if "texture" not in told:
            return {"note": "the scan has no colours", "findings": told["findings"]}
        if picture is not None:
            copyfile(out / "texture_views.png", picture)
    return dict(told["texture"])
