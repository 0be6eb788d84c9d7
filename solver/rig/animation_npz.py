"""``animation.npz``: an animation as arrays; docs/simulation.md describes it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np

from solver.model import SubjectModel
from solver.rig.animation_basis import Singles
from solver.rig.motion import MotionFrame
from solver.similarity import small_motion
from solver.surface import Ints

FORMAT = 1
TRACKS = (
    *("time", "activations", "jaw", "head", "eyes"),
    *("penetration_mm", "behind_teeth", "inverted", "iterations", "seconds"),
)
"""What is taken of every frame, see :class:`~solver.rig.motion.MotionFrame`."""
FASTEST = 1
"""The level of compression: skins hardly shrink, however long one tries."""


def write_animation_npz(
    path: Path,
    model: SubjectModel,
    frames: Sequence[MotionFrame],
    skins: Singles,
    vertices: Ints,
) -> None:
    """Write what drove ``frames``, and ``vertices`` (k,) of their skins in the world, mm.

    ``skins`` (f, v, 3), in the head's frame, are read one by one, so that they may be mapped.
    """
    arrays = {name: np.array([getattr(frame, name) for frame in frames]) for name in TRACKS}
    arrays |= {
        "format": np.array(FORMAT),
        "muscles": np.array(model.muscle_names, dtype=np.str_),
        "vertices": vertices,
    }
    with ZipFile(path, "w", ZIP_DEFLATED, compresslevel=FASTEST) as archive:
        for name, values in arrays.items():
            with archive.open(f"{name}.npy", "w") as stream:
                np.lib.format.write_array(stream, values, allow_pickle=False)
        with archive.open("skin.npy", "w", force_zip64=True) as stream:
            header = {"descr": "<f4", "fortran_order": False}
            shape = (len(frames), len(vertices), 3)
            np.lib.format.write_array_header_1_0(stream, {**header, "shape": shape})
            for frame, skin in zip(frames, skins, strict=True):
                placed = small_motion(frame.head)(skin[vertices].astype(np.float64))
                stream.write(placed.astype("<f4").tobytes())
