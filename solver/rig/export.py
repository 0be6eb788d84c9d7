"""All files of a rig."""

from __future__ import annotations

from pathlib import Path

from solver.rig.gltf import write_glb
from solver.rig.pictures import fit_picture
from solver.rig.report import write_report
from solver.rig.result import Rig, save_activations, save_weights


def write_rig(rig: Rig, out: Path) -> list[Path]:
    """Write the rig into the folder ``out`` and return the paths of its files.

    These are ``rig.glb``, ``activations.npz``, ``muscle_weights.npz``, ``report.json`` and
    ``fit_<expression>.png``.
    """
    out.mkdir(parents=True, exist_ok=True)
    glb, activations = out / "rig.glb", out / "activations.npz"
    weights, report = out / "muscle_weights.npz", out / "report.json"
    write_glb(glb, rig)
    save_activations(activations, rig.expressions, rig.model)
    save_weights(weights, rig.weights, rig.model)
    write_report(report, rig)
    pictures = []
    for fit in rig.expressions:
        pictures.append(out / f"fit_{fit.name}.png")
        fit_picture(rig.model, fit, pictures[-1])
    return [glb, activations, weights, report, *pictures]
