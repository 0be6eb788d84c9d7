"""Scene documents: read from JSON, written back, and what their ``keys`` and ``head`` ask for."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
import scipy.sparse as sp
from pydantic import ValidationError

from solver.anatomy.physiology import JAW_FREEDOM
from solver.animation import Drives, HeadKey, KeyedDrives, PoseKey
from solver.animation.performance import FittedSequence, MixedPerformances, PlayedPerformance
from solver.animation.tracks import KeyedTracks, PlayedShapes, TrackedShapes
from solver.errors import InputError
from solver.fitting.face import Pose
from solver.fitting.interior_point import FeasibleSet
from solver.fitting.stretches import fibre_tensors, isochoric_activation
from solver.kinds.document import Document, find_faults
from solver.kinds.scene import AnimateScene, Jaw, Keyframe, MotionKey, Muscle, SimulateScene
from solver.mechanics.fibre_muscle import FibreMuscles
from solver.mechanics.flesh import shape_gradients
from solver.model import SubjectModel, by_muscle, find_muscles
from solver.scene import check_length
from solver.scene.places import Places
from solver.surface import Floats

Scene = TypeVar("Scene", bound=Document)


def read_scene(document: Any, kind: type[Scene]) -> Scene:
    """Return a scene of a kind.

    Raises :class:`InputError` (``scene.schema``) with ``where`` the first fault is, a JSON path.
    """
    try:
        return kind.model_validate(document)
    except ValidationError as error:
        fault = find_faults(error, document, "scene")[0]
        message = f"{fault.where}: {fault.message}"
        raise InputError("scene.schema", message, where=fault.where) from error


def document_of(scene: Document) -> Mapping[str, Any]:
    """Return what was given of a scene, as JSON values with whole numbers as such."""
    document: Mapping[str, Any] = _whole(scene.model_dump(mode="json", exclude_unset=True))
    return document


def _whole(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _whole(each) for name, each in value.items()}
    if isinstance(value, list):
        return [_whole(each) for each in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value


def without_neck_muscles(scene: AnimateScene) -> AnimateScene:
    """Return a scene whose neck moves at no cost: joints share out the turns of the head."""
    if scene.neck is None:
        return scene
    return scene.model_copy(update={"neck": scene.neck.model_copy(update={"muscles": False})})


def drives_of(
    scene: SimulateScene,
    poses: Mapping[str, Pose],
    model: SubjectModel,
    S: sp.csr_array,
    under: Drives | None = None,
    fibres: Sequence[str] | None = None,
    limits: FeasibleSet | None = None,
) -> KeyedDrives:
    """Return what the keys of a scene make a face do, on top of what its performances do.

    ``poses`` are the rig's expressions, ``under`` is from :func:`performances_of`, ``fibres`` are
    names of fibre muscles if they move the face, ``limits`` those of others. Frames come ``fps`` a
    second, from 0 on. Raises :class:`InputError`: as :class:`KeyedDrives`, and ``scene.jaw`` where
    no jaw can be.
    """
    for number, entry in enumerate(scene.keys):
        if entry.shapes:
            reason = 'shapes are those of tracks: set "drive" to "tracks", or name expressions'
            raise InputError("scene.shapes", f"keys[{number}] has shapes; {reason}", key=number)
    keys = _KeyReader(model, S)(scene.keys)
    ends = [float(under.times[-1])] if under else []
    times = _frame_times(scene, [*ends, *(key.time for key in keys)])
    head = head_of(scene.head)
    interpolation = scene.interpolation
    drives = KeyedDrives(
        keys,
        poses,
        model,
        times,
        head=head,
        interpolation=interpolation,
        under=under,
        fibres=fibres,
        limits=limits,
    )
    _check_jaws(drives, keys, plays=under is not None)
    return drives


def _check_jaws(
    drives: Drives, keys: Sequence[PoseKey], *, plays: bool, what: str = "keys"
) -> None:
    """Check the jaw at every key, and in every frame where something ``plays`` under the keys.

    The scene calls the list of keys ``what``.
    """
    for number, key in enumerate(keys):
        check_jaw(drives(key.time).jaw, f"{what}[{number}]")
    for time in drives.times.tolist() if plays and keys else []:
        check_jaw(drives(time).jaw, f"{what} and what they are added to at {time:.3f} s")


def _frame_times(scene: SimulateScene, ends: Sequence[float]) -> Floats:
    """Return when the frames of a scene are, in s; without a duration it lasts to the last end."""
    seconds = max(ends, default=0.0) if scene.duration is None else scene.duration
    fps = scene.fps
    check_length(seconds * fps)  # of a file's times, before there are so many
    return np.arange(int(seconds * fps + 1e-6) + 1) / fps


def track_drives_of(
    scene: SimulateScene, shapes: TrackedShapes, places: Places, played: PlayedShapes | None
) -> KeyedTracks:
    """Return what the keys of a scene make a face do that tracks drive, on top of what is played.

    ``played`` is from :func:`shape_performance_of`. Raises :class:`InputError`: as
    :class:`KeyedTracks`, and ``scene.jaw`` where no jaw can be.
    """
    model = places.model
    interpolation = scene.interpolation
    read = _KeyReader(model, model.weights)
    under = None
    if played is not None:
        own = read(played.entry.keys)
        under = KeyedTracks(
            own,
            shapes,
            model,
            played.times,
            interpolation=interpolation,
            under=played,
            what="performance.keys",
        )
    keys = read(scene.keys)
    ends = [] if under is None else [float(under.times[-1])]
    times = _frame_times(scene, [*ends, *(key.time for key in keys)])
    head = head_of(scene.head)
    drives = KeyedTracks(
        keys, shapes, model, times, head=head, interpolation=interpolation, under=under
    )
    _check_jaws(drives, keys, plays=under is not None)
    return drives


def shape_performance_of(
    scene: SimulateScene, shapes: TrackedShapes, places: Places
) -> PlayedShapes | None:
    """Return the one performance of a scene that tracks drive; None if it has none.

    Raises :class:`InputError`: as :class:`FittedSequence` and :class:`PlayedShapes`,
    ``scene.shapes`` for several, ``scene.jaw`` and ``scene.asset``.
    """
    given = scene.performance
    if given is None:
        return None
    entries = given if isinstance(given, list) else [given]
    if len(entries) > 1:
        reason = f"a scene that tracks drive plays one performance, not {len(entries)}"
        raise InputError("scene.shapes", f"{reason}: masks are of muscles")
    entry = entries[0]
    sequence = FittedSequence.load(places.asset(entry.asset), entry.asset)
    played = PlayedShapes(sequence, entry, shapes, places.model, scene.interpolation)
    for time in played.times:
        check_jaw(played(float(time)).jaw, f"the performance {entry.asset!r} at {time:.3f} s")
    return played


def moving_fibres(
    scene: SimulateScene, performances: MixedPerformances | None, fibres: FibreMuscles | None
) -> FibreMuscles | None:
    """Return the fibre muscles that move a scene, their curves scaled; None if others do.

    Raises :class:`InputError` (``scene.fibres``) for keys of fibre muscles that the rig lacks.
    """
    keyed = any(key.fibres for key in scene.keys)
    if performances is None:
        curve = np.ones(1) if keyed else None
    else:
        curve = performances.curve if performances.of_fibres else None
    if curve is None:
        return None
    if fibres is None:
        reason = "the scene has keys of fibre muscles, and the rig has none that are calibrated"
        raise InputError("scene.fibres", f"{reason}: run fit_fibres, or give its result")
    return fibres.scale(curve)


def performances_of(
    scene: SimulateScene,
    poses: Mapping[str, Pose],
    places: Places,
    S: sp.csr_array,
    fibres: FibreMuscles | None = None,
    limits: FeasibleSet | None = None,
) -> MixedPerformances | None:
    """Return a scene's performances with their own keys, mixed; None if it has none.

    Raises :class:`InputError`: as :class:`FittedSequence`, :class:`PlayedPerformance`,
    :class:`MixedPerformances` and :func:`drives_of`, and ``scene.asset``.
    """
    given = scene.performance
    if given is None:
        return None
    entries = given if isinstance(given, list) else [given]
    model = places.model
    read = _KeyReader(places.model, S)
    smooth = scene.interpolation
    files: dict[str, FittedSequence] = {}
    played: list[PlayedPerformance] = []
    layered: list[Drives] = []
    for number, entry in enumerate(entries):
        name = entry.asset
        what = f"performance[{number}].keys"
        keys = read(entry.keys)
        if name not in files:
            files[name] = FittedSequence.load(places.asset(name), name)
        played.append(PlayedPerformance(files[name], entry, model, smooth, fibres))
        for frame, b in zip(played[-1].frames, played[-1].jaw, strict=True):
            check_jaw(b, f"frame {frame} of the performance {name!r}")
        times = played[-1].times
        under = played[-1]
        layered.append(
            KeyedDrives(
                keys,
                poses,
                model,
                times,
                interpolation=smooth,
                under=under,
                what=what,
                fibres=under.muscles if under.of_fibres else None,
                limits=limits,
            )
        )
        _check_jaws(layered[-1], keys, plays=True, what=what)
    return MixedPerformances(played, layered)


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
        least, most = JAW_FREEDOM[name]  # beyond it flesh tears
        worst = float(values[np.argmax(np.abs(values))])
        if not least <= worst <= most:
            place = f"{where}: the jaw's {name} is {worst:.1f}, with all that moves it"
            reason = f"{place}; a jaw gets from {least:g} to {most:g}"
            raise InputError("scene.jaw", reason, found=worst, expected=[least, most])


class _KeyReader:
    """Reads a scene's keys of a person."""

    def __init__(self, model: SubjectModel, S: sp.csr_array) -> None:
        self._names = model.muscle_names
        self._tensors = fibre_tensors(model, shape_gradients(model.rest, model.tets)[1], S)

    def __call__(self, entries: Sequence[Keyframe]) -> list[PoseKey]:
        return [
            PoseKey(
                entry.time,
                entry.expressions,
                {name: self._activation(name, how) for name, how in self._each(entry.muscles)},
                jaw_of(entry.jaw),
                entry.fibres,
                entry.shapes,
            )
            for entry in entries
        ]

    def _each(self, muscles: Mapping[str, Muscle]) -> Iterable[tuple[str, Muscle]]:
        """Return every muscle that is moved, of a whole each compartment, and names of none."""
        unknown = {n: how for n, how in muscles.items() if not find_muscles(n, self._names)}
        return (by_muscle(muscles, self._names) | unknown).items()

    def _activation(self, name: str, how: Muscle) -> Floats:
        """Return a muscle's activation (6,): six numbers are one, one is its fibres' stretch."""
        if not isinstance(how, int | float):
            return np.array(how, np.float64)
        tensor = self._tensors[self._names.index(name)] if name in self._names else np.eye(3)
        if np.isnan(tensor).any():
            reason = f"the muscle {name!r} has no fibres in this rig: give six numbers instead"
            raise InputError("scene.muscle", reason, found=name)
        return isochoric_activation(tensor, how)
