"""All files of a rig."""

from __future__ import annotations

from pathlib import Path

from solver.rig.certificate import Certificate
from solver.rig.gltf import write_glb
from solver.rig.pictures import fit_picture
from solver.rig.report import report, write_report
from solver.rig.result import Rig, save_activations, save_weights
from solver.rig.web_page import write_page


def write_rig(rig: Rig, certificate: Certificate, out: Path) -> list[Path]:
    """Write the rig into the folder ``out`` and return the paths of its files.

    These are ``rig.glb``, ``activations.npz``, ``muscle_weights.npz``, ``report.json``,
    ``report.html`` and ``fit_<expression>.png``.
    """
    out.mkdir(parents=True, exist_ok=True)
    glb, activations = out / "rig.glb", out / "activations.npz"
    weights, figures_file = out / "muscle_weights.npz", out / "report.json"
    page = out / "report.html"
    write_glb(glb, rig)
    save_activations(activations, rig.expressions, rig.model)
    save_weights(weights, rig.weights, rig.model)
    figures = report(rig, certificate)
    write_report(figures_file, figures)
    pictures = []
    for fit in rig.expressions:
        pictures.append(out / f"fit_{fit.name}.png")
        fit_picture(rig.model, fit, pictures[-1])
    write_page(page, figures)
    return [glb, activations, weights, figures_file, page, *pictures]
