"""``preview.bin``: what a page evaluates when a slider moves (docs/preview.md)."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from solver.rig.preview.make import Preview
from solver.rig.view.format import write_container


def write_preview(path: Path, preview: Preview) -> None:
    """Write sliders, reduced skin and error; a mean that was not measured is null."""
    skin = preview.skin
    arrays = {"basis": skin.basis, "linear": skin.linear, "quadratic": skin.quadratic}
    write_container(path, _header(preview), arrays)


def _header(preview: Preview) -> dict[str, Any]:
    controls, unseen = preview.controls, preview.unseen
    figures = preview.figures()
    return {
        "controls": [asdict(control) for control in controls.each],
        "error_mm": {
            **figures["error_mm"],
            "by_sort": figures["error_by_sort_mm"],
            "per_control": [unseen.mean_about(control.name) for control in controls.each],
        },
        "presets": [
            {
                "name": name,
                "values": [round(float(value), 6) for value in values],
                "mean_mm": figures["presets_mm"][name],
            }
            for name, values in controls.presets.items()
        ],
    }
