"""All files of a rig."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from solver.rig.certificate import Certificate
from solver.rig.exporters import write_all
from solver.rig.pictures import fit_picture
from solver.rig.report import report, write_report
from solver.rig.result import save_activations, save_weights
from solver.rig.rig import Rig
from solver.rig.web_page import write_page


def write_rig(rig: Rig, certificate: Certificate, out: Path) -> list[Path]:
    """Write the rig into the folder ``out`` and return the paths of its files.

    These are those of all exporters that belong to every rig (``rig.npz``, ``rig.glb`` ...), the
    parts ``activations.npz`` and ``muscle_weights.npz`` of ``rig.npz`` for programs that read them,
    ``report.json``, ``report.html`` and ``fit_<expression>.png``.
    """
    out.mkdir(parents=True, exist_ok=True)
    rig = replace(rig, figures=report(rig, certificate))
    assert rig.figures is not None
    activations, weights = out / "activations.npz", out / "muscle_weights.npz"
    save_activations(activations, rig.expressions, rig.model)
    save_weights(weights, rig.weights, rig.model)
    figures_file, page = out / "report.json", out / "report.html"
    write_report(figures_file, rig.figures)
    exported = write_all(rig, out)
    pictures = []
    for fit in rig.expressions:
        pictures.append(out / f"fit_{fit.name}.png")
        fit_picture(rig.model, fit, pictures[-1])
    write_page(page, rig.figures)
    return [*exported, activations, weights, figures_file, page, *pictures]
