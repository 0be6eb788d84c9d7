"""Show 4: how long frames take with contact of lips, teeth and eyes, warm, contact found anew.

``quasi_static`` and ``dynamic`` play a recording on a fitted person: ``median_s``, ``p95_s`` and
``max_s`` of a frame, ``iterations`` on average. ``sizes`` play its first frames on meshes of other
sizes, by the same activations of the muscles and every mesh's own initial S; ``exponent`` is that
of the quasi-static median by vertices.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import scipy.sparse as sp

from benchmarks import plots
from benchmarks.documents import Figures
from benchmarks.physics.fitted import Fitted
from solver.animation import Drives
from solver.contact import contact_potentials
from solver.edits import DENSITY
from solver.fitting.face import Face
from solver.kinds.scene import STIFFNESS_PA
from solver.mechanics.flesh import COROTATED_TRACE
from solver.mechanics.linear import fastest
from solver.model import SubjectModel
from solver.simulation import Simulator, Stepped
from solver.simulation.forces import Drive
from solver.surface import Floats

WARM = 2
"""Frames in the beginning that are not counted: kernels are compiled and patterns analysed."""

SCALING_FRAMES = 40


def run(person: Fitted, drives: Drives, models: Mapping[float, SubjectModel]) -> Figures:
    """Play ``drives`` on the person, and their beginning on ``models`` by their edges in mm."""
    found = {
        name: timed(play(person.model, person.S, drives, drives.times, dynamic=dynamic))
        for name, dynamic in (("quasi_static", False), ("dynamic", True))
    }
    sizes = [sized(edge, model, drives) for edge, model in models.items()]
    vertices = [each["vertices"] for each in sizes]
    medians = [each["quasi_static"]["median_s"] for each in sizes]
    return {
        "vertices": len(person.model.rest),
        "tets": len(person.model.tets),
        "frames": len(drives.times),
        **found,
        "sizes": sizes,
        "exponent": plots.power_law(vertices, medians)[0] if len(sizes) > 1 else None,
    }


def sized(edge: float, model: SubjectModel, drives: Drives) -> Figures:
    """Return what the first frames take on a mesh of another size."""
    times = drives.times[:SCALING_FRAMES]
    return {
        "edge_mm": edge,
        "vertices": len(model.rest),
        "tets": len(model.tets),
        "quasi_static": timed(play(model, model.weights, drives, times, dynamic=False)),
        "dynamic": timed(play(model, model.weights, drives, times, dynamic=True)),
    }


def play(
    model: SubjectModel, S: sp.csr_array, drives: Drives, times: Floats, *, dynamic: bool
) -> list[Stepped]:
    """Return every step but the first of the ``times``, which the face begins at rest in."""
    material = COROTATED_TRACE.in_pascal(STIFFNESS_PA)
    face = Face(model, S, material=material, linear=fastest())
    simulator = Simulator(
        face,
        contact_potentials(model, STIFFNESS_PA, lips=True, teeth=True, eyes=True),
        [],
        dynamic=dynamic,
        density=np.full(len(model.tets), DENSITY),
    )

    def asked(time: float) -> Drive:
        frame = drives(time)
        return Drive(time, face.flesh_controls(frame.a), frame.jaw, frame.head)

    before = asked(times[0])
    motion = simulator.rest(before)
    steps = []
    for time in times[1:]:
        goal = asked(time)
        steps.append(simulator.step(motion, before, goal))
        motion = steps[-1].motion
        before = goal
    return steps


def timed(steps: Sequence[Stepped]) -> Figures:
    """Return the figures of a simulation's warm steps."""
    warm = steps[WARM:]
    seconds = [step.seconds for step in warm]
    return {
        "median_s": float(np.median(seconds)),
        "p95_s": float(np.percentile(seconds, 95)),
        "max_s": max(seconds),
        "iterations": float(np.mean([step.iterations for step in warm])),
        "halvings": sum(step.halvings for step in steps),
        "inverted": sum(step.inverted for step in steps),
        "frame_s": [round(each, 4) for each in seconds],
    }


def plot(path: Path, figures: Figures) -> None:
    """Plot a frame's median time by the mesh's vertices."""
    sizes = figures["sizes"]
    plots.scaling(
        path,
        "A frame with contact",
        [each["vertices"] for each in sizes],
        {
            name.replace("_", "-"): [each[name]["median_s"] for each in sizes]
            for name in ("quasi_static", "dynamic")
        },
    )
