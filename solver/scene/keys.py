"""A scene's ``keys`` and ``head``: what the face does, and where the head is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import scipy.sparse as sp

from solver.animation.keys import HeadKey, KeyedDrives, PoseKey, from_keys
from solver.errors import InputError
from solver.fitting.face import Pose
from solver.fitting.stretches import fibre_tensors, shorten
from solver.kinds.scene import Jaw, MotionKey, SimulateScene
from solver.mechanics.flesh import shape_gradients
from solver.model import SubjectModel
from solver.surface import Floats

# as far as a jaw gets, and a little more, as fits bite some degrees deep: beyond it flesh tears
JAW_LIMITS = {"open_deg": (-10.0, 45.0), "left_deg": (-15.0, 15.0), "move_mm": (-20.0, 20.0)}


def drives_of(
    scene: SimulateScene, poses: Mapping[str, Pose], model: SubjectModel, S: sp.csr_array
) -> KeyedDrives:
    """Return what the keys of a scene make a face do.

    ``poses`` are the rig's expressions. Frames come ``fps`` a second, from 0 on. Raises
    :class:`InputError`: as :func:`~solver.animation.keys.from_keys`, and ``scene.jaw`` where the
    jaw would be where no jaw can be.
    """
    muscles = _Muscles(model, S)
    keys = [
        PoseKey(
            entry.time,
            entry.expressions,
            {name: muscles.activation(name, how) for name, how in entry.muscles.items()},
            jaw_of(entry.jaw),
        )
        for entry in scene.keys
    ]
    last = max((key.time for key in keys), default=0.0)
    seconds, fps = last if scene.duration is None else scene.duration, scene.fps
    times = np.arange(int(seconds * fps + 1e-6) + 1) / fps
    drives = from_keys(
        keys, poses, model, times, head=head_of(scene.head), interpolation=scene.interpolation
    )
    for number, key in enumerate(keys):
        check_jaw(drives(key.time).jaw, f"keys[{number}]")
    return drives


def head_of(entries: Sequence[MotionKey]) -> list[HeadKey]:
    """Return where a scene's ``head`` is."""
    return [
        HeadKey(entry.time, np.radians(entry.rotation_deg), np.array(entry.move_mm, np.float64))
        for entry in entries
    ]


def jaw_of(jaw: Jaw) -> Floats:
    """Return b (5,), in rad and mm, of a key's ``jaw``."""
    return np.concatenate([np.radians([jaw.open_deg, jaw.left_deg]), jaw.move_mm])


def check_jaw(b: Floats, where: str) -> None:
    """Raise :class:`InputError` (``scene.jaw``) if no jaw can be at b (5,)."""
    found = {"open_deg": np.degrees(b[:1]), "left_deg": np.degrees(b[1:2]), "move_mm": b[2:]}
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
        return shorten(tensor, how)
