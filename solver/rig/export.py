"""All files of a rig."""

from __future__ import annotations

from pathlib import Path

from solver.rig.certificate import Certificate
from solver.rig.gltf import write_glb
from solver.rig.pictures import fit_picture
from solver.rig.report import report, write_activations_csv, write_report
from solver.rig.result import Rig, save_activations, save_weights
from solver.rig.view.write import write_inside, write_view
from solver.rig.web_page import write_page


def write_rig(rig: Rig, certificate: Certificate, out: Path) -> list[Path]:
    """Write the rig into the folder ``out`` and return the paths of its files.

    These are ``rig.glb``, ``activations.npz``, ``activations.csv``, ``muscle_weights.npz``,
    ``view.bin``, ``inside.bin``, ``report.json``, ``report.html`` and ``fit_<expression>.png``.
    """
    out.mkdir(parents=True, exist_ok=True)
    glb, activations, table = out / "rig.glb", out / "activations.npz", out / "activations.csv"
    weights, view, inside = out / "muscle_weights.npz", out / "view.bin", out / "inside.bin"
    figures_file, page = out / "report.json", out / "report.html"
    write_glb(glb, rig)
    save_activations(activations, rig.expressions, rig.model)
    save_weights(weights, rig.weights, rig.model)
    figures = report(rig, certificate)
    write_report(figures_file, figures)
    write_activations_csv(table, rig, figures)
    write_view(view, rig, figures)
    write_inside(inside, rig)
    pictures = []
    for fit in rig.expressions:
        pictures.append(out / f"fit_{fit.name}.png")
        fit_picture(rig.model, fit, pictures[-1])
    write_page(page, figures)
    return [glb, activations, table, weights, view, inside, figures_file, page, *pictures]
