"""A scene's ``keys`` and ``head``: what the face does, and where the head is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import scipy.sparse as sp

from solver.animation.keys import HeadKey, KeyedDrives, PoseKey, from_keys
from solver.errors import InputError
from solver.fitting.face import Pose
from solver.fitting.stretches import (
    fibre_tensors,
    shortened,
)
from solver.mechanics.flesh import shape_gradients
from solver.model import SubjectModel
from solver.surface import Floats

Entry = Mapping[str, Any]

DEFAULT_FPS = 30.0  # of a scene that does not say

# as far as a jaw gets, and a little more, as fits bite some degrees deep: beyond it flesh tears
JAW_LIMITS = {
    "open_deg": (-10.0, 45.0),
    "left_deg": (-15.0, 15.0),
    "move_mm": (-20.0, 20.0),
}
NO_MOVE = (0.0, 0.0, 0.0)  # of a key that does not say


def keyed(
    document: Mapping[str, Any],
    poses: Mapping[str, Pose],
    model: SubjectModel,
    S: sp.csr_array,
) -> KeyedDrives:
    """Return what the keys of a scene, that its schema has found good, make a face do.

    ``poses`` are the rig's expressions. Frames come ``fps`` a second, from 0 on. Raises
    :class:`InputError`: as :func:`~solver.animation.keys.from_keys`, and ``scene.jaw`` where the
    jaw would be where no jaw can be.
    """
    entries = document.get("keys", [])
    muscles = _Muscles(model, S)
    keys = [
        PoseKey(
            entry["time"],
            entry.get("expressions", {}),
            {name: muscles.activation(name, how) for name, how in entry.get("muscles", {}).items()},
            jaw_of(entry.get("jaw", {})),
        )
        for entry in entries
    ]
    last = max((key.time for key in keys), default=0.0)
    seconds, fps = document.get("duration", last), document.get("fps", DEFAULT_FPS)
    times = np.arange(int(seconds * fps + 1e-6) + 1) / fps
    drives = from_keys(
        keys,
        poses,
        model,
        times,
        head=head_of(document.get("head", [])),
        interpolation=document.get("interpolation", "smooth"),
    )
    for number, key in enumerate(keys):
        check_jaw(drives(key.time).jaw, f"keys[{number}]")
    return drives


def head_of(entries: Sequence[Entry]) -> list[HeadKey]:
    """Return where a scene's ``head`` is."""
    return [
        HeadKey(
            entry["time"],
            np.radians(entry.get("rotation_deg", NO_MOVE)),
            np.array(entry.get("move_mm", NO_MOVE), np.float64),
        )
        for entry in entries
    ]


def jaw_of(entry: Entry) -> Floats:
    """Return b (5,), in rad and mm, of a key's ``jaw``."""
    turns = np.radians([entry.get("open_deg", 0.0), entry.get("left_deg", 0.0)])
    return np.concatenate([turns, entry.get("move_mm", NO_MOVE)])


def check_jaw(b: Floats, where: str) -> None:
    """Raise :class:`InputError` (``scene.jaw``) if no jaw can be at b (5,)."""
    found = {
        "open_deg": np.degrees(b[:1]),
        "left_deg": np.degrees(b[1:2]),
        "move_mm": b[2:],
    }
    for name, values in found.items():
        least, most = JAW_LIMITS[name]
        worst = float(values[np.argmax(np.abs(values))])
        if not least <= worst <= most:
            raise InputError(
                "scene.jaw",
                f"{where}: the jaw's {name} is {worst:.1f}, with what its expressions do; a jaw "
                f"gets from {least:g} to {most:g}",
                found=worst,
                expected=[least, most],
            )


class _Muscles:
    """Activations (6,) of single muscles, as keys give them."""

    def __init__(self, model: SubjectModel, S: sp.csr_array) -> None:
        self._model = model
        volumes = shape_gradients(model.rest, model.tets)[1]
        self._tensors = fibre_tensors(model, volumes, S)

    def activation(self, name: str, how: float | Sequence[float]) -> Floats:
        """Return the activation of a muscle; six numbers are one, one is its fibres' stretch."""
        if not isinstance(how, int | float):
            return np.array(how, np.float64)
        names = self._model.muscle_names
        tensor = self._tensors[names.index(name)] if name in names else np.eye(3)
        if np.isnan(tensor).any():
            raise InputError(
                "scene.muscle",
                f"the muscle {name!r} has no fibres in this rig: give six numbers instead",
                found=name,
            )
        return shortened(tensor, how)
