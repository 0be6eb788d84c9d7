"""Show 1: flesh against what is known without any mesh.

``stretch_error``: a bar pulled at both ends against the closed form of its material, relative to
the bar's length, the worst of all materials. ``pressure_error``: the volume that a round body loses
under pressure against the linear bulk modulus. ``refinement_order``: the exponent by which the
error falls with the tets' size where a body force upholds a given smooth deformation.
``momentum_drift`` and ``energy_growth``: of the face's flesh, held by nothing, stretched, spun and
let go, over free steps and relative to what it began with.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import igl
import matplotlib
import numpy as np
from matplotlib.figure import Figure
from scipy.optimize import brentq

from benchmarks.documents import Figures
from benchmarks.physics.box import box
from benchmarks.plots import COLOURS, HEIGHT_IN, STYLE, WIDTH_IN, power_law, save
from solver.edits import DENSITY
from solver.fitting.face import Face
from solver.kinds.scene import STIFFNESS_PA
from solver.mechanics import equilibrium, linear
from solver.mechanics.flesh import (
    COROTATED_DET,
    COROTATED_TRACE,
    MOONEY_RIVLIN,
    NEO_HOOKEAN,
    Flesh,
    Material,
)
from solver.model import SubjectModel
from solver.similarity import IDENTITY
from solver.simulation import Simulator
from solver.simulation.forces import Drive, FleshMotion, Inertia, lumped_masses
from solver.surface import Floats, Ints, area_normals

MATERIALS = {
    "corotated, trace": COROTATED_TRACE,
    "corotated, det": COROTATED_DET,
    "Neo-Hookean": NEO_HOOKEAN,
    "Mooney-Rivlin": MOONEY_RIVLIN,
}

STRETCH = 1.3
SQUEEZE = 1e-4
"""Pressure over the bulk modulus: so small that the answer is linear."""

CELLS = (4, 6, 8, 12)
EXACT = 1e-13
EXACT_STEP = 1e-10
LEASH = 1e-9
"""Springs over the flesh's stiffness that keep free flesh from drifting; the loads cancel."""

STEPS = 50
STEP_SECONDS = 1.0 / 60.0


def run(model: SubjectModel) -> Figures:
    """Run all checks; ``model``'s flesh is what flies."""
    stretch = {name: stretched(material) for name, material in MATERIALS.items()}
    pressure = {name: squeezed(material) for name, material in MATERIALS.items()}
    refined = [refinement(cells) for cells in CELLS]
    sizes = [1.0 / cells for cells in CELLS]
    return {
        "stretch_error": max(stretch.values()),
        "stretch_errors": stretch,
        "pressure_error": max(pressure.values()),
        "pressure_errors": pressure,
        "refinement_order": power_law(sizes, refined)[0],
        "refinement": [
            {"cells": cells, "error_mm": error} for cells, error in zip(CELLS, refined, strict=True)
        ],
        **flying(model),
    }


def principal_energy(material: Material, stretches: Floats) -> float:
    """Return psi of three principal stretches, of passive flesh without barrier."""
    J = float(stretches.prod())
    mu = material.mu
    lam = material.lam
    volume = material.kappa * (J - 1.0) ** 2
    if material.law == "corotated":
        strain = stretches - 1.0
        return float(mu * strain @ strain + 0.5 * lam * strain.sum() ** 2) + volume
    squares = float(stretches @ stretches)
    if material.law == "mooney_rivlin":
        inverse = J**2 * float((1.0 / stretches**2).sum())
        parts = np.cbrt(J) ** -2 * squares + np.cbrt(J) ** -4 * inverse - 6.0
        return float(0.25 * mu * parts + (0.5 * lam + mu / 3.0) * (J - 1.0) ** 2) + volume
    mu, lam = 4.0 / 3.0 * mu, lam + 5.0 / 6.0 * mu
    alpha = 1.0 + 0.75 * mu / lam
    sheared = 0.5 * mu * (squares - 3.0 - np.log((squares + 1.0) / 4.0))
    return float(sheared + 0.5 * lam * ((J - alpha) ** 2 - (1.0 - alpha) ** 2)) + volume


def pulled(material: Material) -> tuple[float, float]:
    """Return the width and the nominal stress of a bar at :data:`STRETCH` with free sides."""

    def slope(at: Floats, direction: Floats) -> float:
        step = 1e-6 * direction
        ends = [principal_energy(material, at + sign * step) for sign in (1.0, -1.0)]
        return (ends[0] - ends[1]) / 2e-6

    def sideways(width: float) -> float:
        return slope(np.array([STRETCH, width, width]), np.array([0.0, 1.0, 1.0]))

    width = float(brentq(sideways, 0.5, 1.2, xtol=1e-14))
    return width, slope(np.array([STRETCH, width, width]), np.array([1.0, 0.0, 0.0]))


def stretched(material: Material) -> float:
    """Return the relative error of a bar that is pulled at both ends."""
    rest, tets = box((8, 2, 2), (40.0, 10.0, 10.0))
    width, stress = pulled(material)
    inside = tractions(rest, tets, lambda normals: normals * [stress, 0.0, 0.0])
    x = unheld(rest, tets, material, inside)
    goal = (rest - rest.mean(axis=0)) * [STRETCH, width, width]
    return float(np.abs(x - x.mean(axis=0) - goal).max()) / np.ptp(rest[:, 0])


def squeezed(material: Material) -> float:
    """Return the relative error of the volume that a round body loses under pressure."""
    rest, tets = box((8, 8, 8), (40.0, 40.0, 40.0))
    rest -= 20.0
    # towards a ball, as far as no tet at the box's edges gets flat
    length = np.maximum(np.linalg.norm(rest, axis=1), 1e-9)
    rest *= (0.4 + 0.6 * np.abs(rest).max(axis=1) / length)[:, None]
    bulk = material.lam + 2.0 * material.kappa + 2.0 / 3.0 * material.mu
    load = tractions(rest, tets, lambda normals: -SQUEEZE * bulk * normals)
    x = unheld(rest, tets, material, load)
    flesh = Flesh(rest, tets, np.zeros(0, int), material)
    lost = 1.0 - float(flesh.volumes @ flesh.jacobians(x)) / float(flesh.volumes.sum())
    return abs(lost / SQUEEZE - 1.0)


def tractions(rest: Floats, tets: Ints, per_area: Callable[[Floats], Floats]) -> Floats:
    """Return the load (p, 3) of forces on the surface, ``per_area`` by the unit normals."""
    faces = igl.boundary_facets(tets)[0]
    doubled = area_normals(rest, faces)
    area = 0.5 * np.linalg.norm(doubled, axis=1, keepdims=True)
    load = np.zeros_like(rest)
    np.add.at(load, faces, (area * per_area(0.5 * doubled / area) / 3.0)[:, None, :])
    return load


def unheld(rest: Floats, tets: Ints, material: Material, load: Floats) -> Floats:
    """Return the equilibrium x (p, 3) of flesh that nothing holds, under loads in balance."""
    flesh = Flesh(rest, tets, np.zeros(0, int), material)
    pulled = Inertia(flesh)
    pulled.stiffness = np.full(len(rest), LEASH * flesh.force_scale)
    pulled.load = load
    return settled(flesh.plus(pulled), rest)


def settled(flesh: Flesh, x: Floats) -> Floats:
    """Return the equilibrium of passive flesh from x (p, 3)."""
    a = flesh.passive()
    solver = linear.analyse(flesh.hessian(flesh.rest, a))
    return equilibrium.solve_equilibrium(flesh, solver, x, a, tolerance=EXACT).x


WAVES = np.array([[0.9, 1.2, -0.5], [-0.7, 0.8, 1.1], [1.3, -0.4, 0.6]]) / 10.0
AMPLITUDE_MM = 1.5
SIDE_MM = 20.0


def smooth_gradient(X: Floats) -> Floats:
    """Return F (k, 3, 3) of the deformation X + c sin(W X), which :func:`refinement` upholds."""
    waves = np.cos(X @ WAVES.T)
    return np.eye(3) + AMPLITUDE_MM * waves[:, :, None] * WAVES


def smooth_stress(X: Floats) -> Floats:
    """Return the first Piola-Kirchhoff stress (k, 3, 3) there, of Phace's flesh."""
    F = smooth_gradient(X)
    u, _, vt = np.linalg.svd(F)
    J = np.linalg.det(F)[:, None, None]
    cofactor = J * np.linalg.inv(F).transpose(0, 2, 1)
    material = COROTATED_DET
    return np.asarray(
        2.0 * material.mu * (F - u @ vt) + 2.0 * material.kappa * (J - 1.0) * cofactor
    )


def refinement(cells: int) -> float:
    """Return the error in mm, root mean square over the vertices, of a cube with so many cells.

    A body force -div P upholds the smooth deformation, which is given on the surface.
    """
    rest, tets = box((cells, cells, cells), (SIDE_MM, SIDE_MM, SIDE_MM))
    outside = ((rest == 0.0) | (rest == SIDE_MM)).any(axis=1)
    flesh = Flesh(rest, tets, np.flatnonzero(outside), COROTATED_DET)
    upheld = Inertia(flesh)
    step = 1e-4 * np.eye(3)
    force = -sum(
        (smooth_stress(rest + step[j])[:, :, j] - smooth_stress(rest - step[j])[:, :, j]) / 2e-4
        for j in range(3)
    )
    upheld.load = lumped_masses(flesh, np.ones(len(tets)))[:, None] * force
    goal = rest + AMPLITUDE_MM * np.sin(rest @ WAVES.T)
    x = settled(flesh.plus(upheld), goal)
    return float(np.sqrt(((x - goal)[~outside] ** 2).sum(axis=1).mean()))


def flying(model: SubjectModel) -> Figures:
    """Return energy growth and momentum drift of the face's flesh, stretched, spun and let go."""
    none = np.zeros(0, dtype=np.int64)
    free = replace(model, cranium=none, mandible=none, cut=none, sliding=none)
    face = Face(free, material=COROTATED_TRACE.in_pascal(STIFFNESS_PA))
    density = np.full(len(model.tets), DENSITY)
    steps = Simulator(
        face,
        [],
        [],
        dynamic=True,
        density=density,
        damping=0.0,
        tolerance=EXACT_STEP,
        settled_mm=0.0,
    )
    masses = lumped_masses(face.flesh, density)
    arms = model.rest - masses @ model.rest / masses.sum()
    v = np.cross([0.0, 2.0, 0.0], arms) + [200.0, 0.0, -50.0] + 100.0 * np.sin(arms / 20.0)
    motion = FleshMotion(model.rest + 0.02 * arms * [1.0, -1.0, 0.0], v, IDENTITY)
    drive = Drive(0.0, face.flesh.passive(), np.zeros(5), IDENTITY)
    momentum = masses @ v
    energies = [_energy(face.flesh, masses, motion)]
    for number in range(1, STEPS + 1):
        goal = replace(drive, time=number * STEP_SECONDS)
        motion = steps.step(motion, drive, goal).motion
        drive = goal
        energies.append(_energy(face.flesh, masses, motion))
    drift = float(np.linalg.norm(masses @ motion.v - momentum) / np.linalg.norm(momentum))
    return {
        "momentum_drift": drift,
        "energy_growth": max(0.0, float(np.diff(energies).max() / energies[0])),
        "energies": [energy / energies[0] for energy in energies],
    }


def _energy(flesh: Flesh, masses: Floats, motion: FleshMotion) -> float:
    kinetic = 0.5 * float(masses @ (motion.v**2).sum(axis=1))
    return kinetic + flesh.energy(motion.x, flesh.passive())


def plot(path: Path, figures: Figures) -> None:
    """Plot the error by the tets' size, and the energy of free flesh by time."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN), layout="constrained")
        errors, energy = figure.subplots(1, 2)
        sizes = [SIDE_MM / each["cells"] for each in figures["refinement"]]
        found = [each["error_mm"] for each in figures["refinement"]]
        slope, offset = power_law(sizes, found)
        errors.loglog(sizes, found, "o", color=COLOURS["A"])
        line = np.exp(offset) * np.asarray(sizes) ** slope
        errors.loglog(sizes, line, color=COLOURS["A"], label=f"order {slope:.2f}")
        errors.set(title="Error by the cells' size", xlabel="mm", ylabel="mm")
        errors.set_xticks(sizes, [f"{size:.3g}" for size in sizes])
        errors.set_yticks(found, [f"{error:.1g}" for error in found])
        errors.minorticks_off()
        errors.legend()
        times = STEP_SECONDS * np.arange(len(figures["energies"]))
        energy.plot(times, figures["energies"], color=COLOURS["P"])
        energy.set(title="Energy of free flesh, of its first", xlabel="s")
        energy.set_ylim(0.0, 1.05)
        save(figure, path)
