"""Ranges of living muscles and jaws, with their sources; each room scales them."""

from __future__ import annotations

# Stretches of a muscle, by its best length.
SHORTEST = 0.5  # along its fibres, at the least
THICKEST = 2.0  # in any direction, at most

MUSCLE_SOURCE = (
    "A muscle makes force down to half its best length (Zajac 1989), and one that halves its "
    "length thickens to twice its size at most, as it keeps its volume."
)

# From rest, in degrees and mm.
JAW_RANGES = {
    "opening_deg": (-6.0, 51.0),
    "opening_mm": (-4.0, 67.0),
    "sideways_mm": (-18.0, 18.0),
    "condyles_forward_mm": (-2.0, 28.0),
    "condyles_down_mm": (-2.0, 15.0),
}

# Of the jaw's own numbers, in degrees and mm: rotation a standard deviation beyond the mean, 18 mm
# sideways about condyles some 70 mm behind, and the path of the condyles. Fits bite some degrees
# deep, as flesh gives way.
JAW_FREEDOM = {"open_deg": (-10.0, 45.0), "left_deg": (-15.0, 15.0), "move_mm": (-20.0, 20.0)}

# Way of the condyles per radian of opening, mm: 20.5 mm in 39.1 degrees.
CONDYLE_PATH_MM = 30.0

JAW_SOURCE = (
    "Mean and two standard deviations of adults: opening between the incisors 49.3 (9.1) mm and "
    "to the side 11.8 (3.1) mm (500 patients in Basel, Swiss Dental Journal), rotation 39.1 (5.9)° "
    "and path of the condyles 20.5 (4.0) mm (60 healthy students, Muto and Kanazawa 1996). Teeth, "
    "2 to 4 mm apart at rest, and sockets allow little the other way."
)
