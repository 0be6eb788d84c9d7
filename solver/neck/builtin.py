"""The built-in neck, for people without a file: tables of our own, rounded, with sources a row.

``data/joints.csv`` has joints, masses, discs and ranges of motion of a man of middle size,
``data/muscles.csv`` the muscles of the left side, which are mirrored; ``data/sources.csv`` says
where numbers are from. Ranges of the joints are published one by one; together they are more than
a head does, so that tilts count ``tilt`` and turns ``turn`` of them. No row was checked against a
second person ("checked"). Hyoid muscles are left out, as is a hyoid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from solver.anatomy.data import read_table
from solver.neck.anatomy import BODIES, Neck, NeckMuscle, ball_inertia
from solver.surface import Floats

DATA = "solver.neck.data"
MIRRORED = np.array([-1.0, 1.0, 1.0])


@dataclass(frozen=True)
class BuiltinOptions:
    """What the tables leave open."""

    density: float = 1100.0  # kg/m^3, of vertebrae with their soft tissue, as balls
    head_inertia: tuple[float, float, float] = (0.022, 0.015, 0.020)  # kg m^2 (Beier et al. 1980)
    damping_s: float = 0.1  # x stiffness of the discs: no table has it
    turn: float = 0.9  # x the joints' ranges, so that the head turns by 70 degrees
    tilt: float = 0.65  # and tilts by 40
    landmarks: tuple[tuple[str, tuple[float, float, float]], ...] = (
        ("glabella", (0.0, 65.0, 103.0)),  # on bone, mm
        ("porion_l", (57.0, 22.0, 4.0)),
        ("porion_r", (-57.0, 22.0, 4.0)),
        ("mastoid_l", (52.0, -8.0, -6.0)),
        ("mastoid_r", (-52.0, -8.0, -6.0)),
        ("inion", (0.0, 22.0, -84.0)),
        ("menton", (0.0, -76.0, 78.0)),
    )


def builtin_neck(options: BuiltinOptions = BuiltinOptions()) -> Neck:
    """Return the built-in neck."""
    joints = read_table("joints", DATA)
    if [row["body"] for row in joints] != list(BODIES[1:]):
        raise ValueError("joints.csv has other bodies")
    zero = np.zeros(len(joints))
    centres = np.column_stack([zero, _numbers(joints, "y_mm"), _numbers(joints, "z_mm")])
    at = np.column_stack([zero, _numbers(joints, "mass_y_mm"), _numbers(joints, "mass_z_mm")])
    masses = _numbers(joints, "mass_kg")
    inertias = np.array([ball_inertia(mass, options.density) * np.eye(3) for mass in masses])
    inertias[-1] = np.diag(options.head_inertia)
    stiffness = np.column_stack([_numbers(joints, f"stiff_{way}") for way in _WAYS])
    ranges = np.column_stack([_numbers(joints, f"{way}_deg") for way in _WAYS])
    ranges = np.radians(ranges) * (1.0, options.turn, options.tilt)
    return Neck(
        centres,
        masses,
        at,
        inertias,
        stiffness,
        stiffness * options.damping_s,
        ranges,
        ranges / ranges.sum(axis=0),
        tuple(_muscle(row, side) for row in read_table("muscles", DATA) for side in "lr"),
        "built-in",
        {name: np.array(place) for name, place in options.landmarks},
    )


_WAYS = ("nod", "turn", "tilt")  # about x, y, z


def _muscle(row: dict[str, str], side: str) -> NeckMuscle:
    steps = [step.split() for step in row["path"].split(";")]
    points = np.array([[float(word) for word in step[1:]] for step in steps])
    return NeckMuscle(
        f"{row['muscle']}_{side}",
        np.array([BODIES.index(step[0]) for step in steps]),
        points if side == "l" else points * MIRRORED,
        float(row["strength_n"]),
        float(row["fibre_mm"]),
        float(row["tendon_mm"]),
        float(np.radians(float(row["pennation_deg"]))),
        row["source"],
    )


def _numbers(rows: list[dict[str, str]], column: str) -> Floats:
    return np.array([float(row[column]) for row in rows])
