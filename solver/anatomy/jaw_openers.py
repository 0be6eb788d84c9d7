"""Openers of the jaw: how far digastric, geniohyoid and lateral pterygoid shorten in a pose of it.

They lie deeper than the flesh of a face, so that no model has their tets; what they do follows from
the bones. ``data/jaw_openers.csv`` has both ends of each on the left, as measured in BodyParts3D,
mm in the frame of the jaw: x from the middle of the condyles to the left, y up, z forward. The end
at the skull or the hyoid is held, which is taken to stay where it is; the other one goes with the
mandible. A muscle is straight, and a person's is as much larger as his condyles are further apart.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from solver.anatomy.data import read_table
from solver.anatomy.warp import MIRROR
from solver.model import JawFrame
from solver.surface import Floats

APART_MM = 84.1  # between the centres of BodyParts3D's condyles


def opener_contractions(jaw: JawFrame, mandible: Floats) -> dict[str, float]:
    """Return muscle, with its side -> the part of its length that it loses, below 0 if it gains.

    ``mandible`` (4, 4) is the jaw's motion from rest. The jaw of a model that was made before there
    were tracks counts as one of BodyParts3D's size.
    """
    size = jaw.tracks.apart / APART_MM if jaw.tracks else 1.0
    found = {}
    for name, ends in _ends().items():
        held, moved = jaw.origin + size * ends @ jaw.axes
        length = np.linalg.norm(moved - held)
        now = mandible[:3, :3] @ moved + mandible[:3, 3] - held
        found[name] = float(1.0 - np.linalg.norm(now) / length)
    return found


@cache
def _ends() -> dict[str, Floats]:
    """Return muscle, with its side -> the ends (2, 3) that are held and moved."""
    found = {}
    for row in read_table("jaw_openers"):
        left = np.array([[float(row[f"{end}_{axis}"]) for axis in "xyz"] for end in _ENDS])
        found[f"left {row['muscle']}"] = left
        found[f"right {row['muscle']}"] = left * MIRROR
    return found


_ENDS = ("held", "moved")
