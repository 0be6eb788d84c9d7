"""The result of a simulation: an animated face for tools, arrays, pictures and a film.

All files are documented in docs/simulation.md.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from solver.drawing.raster import Pixels
from solver.model import SubjectModel
from solver.rig.animation_basis import Singles
from solver.rig.animation_gltf import write_animation_glb
from solver.rig.animation_npz import write_animation_npz
from solver.rig.animation_picture import Filming, Shot, contact_sheet
from solver.rig.animation_video import write_video
from solver.rig.gltf import Solid
from solver.rig.motion import MotionFrame
from solver.scene.objects import Obstacle
from solver.surface import Floats, Ints

MOST_SHOTS = 8
"""Frames in the picture."""
FILM = (480, 576)
LIT_FRAMES = 6
"""Of so many frames, one is lit by itself."""
SLOWEST, USUAL_FPS = 1.0, 30.0


def write_animation(
    out: Path,
    model: SubjectModel,
    frames: Sequence[MotionFrame],
    skins: Singles,
    *,
    title: str,
    report: dict[str, Any],
    vertices: Ints,
    objects: Sequence[Obstacle] = (),
    video: bool = False,
) -> list[Path]:
    """Write ``frames``, whose ``skins`` (f, v, 3) are in the head's frame, mm; return the paths.

    ``animation.json`` is the ``report`` with what is to say of the other files, ``animation.npz``
    has the ``vertices`` (k,) of the skin. ``objects`` are what the face meets; ``video`` adds
    ``animation.mp4``, for which :func:`~solver.rig.animation_video.check_video` is to be asked.
    """
    names = ["animation.json", "animation.glb", "animation.npz", "animation.png"]
    table, glb, arrays, sheet = (out / name for name in names)
    times = np.array([frame.time for frame in frames])
    heads = np.array([frame.head for frame in frames])
    solids = [
        Solid(each.name, each.shape, np.array([each.path(time) for time in times]))
        for each in objects
    ]
    written = write_animation_glb(glb, model.skin, skins, heads, times - times[0], solids)
    write_animation_npz(arrays, model, frames, skins, vertices)
    figures = {**report, "glb": {**asdict(written), "bytes": glb.stat().st_size}}
    table.write_text(json.dumps(figures, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    filming = Filming(model)
    shown = np.unique(np.linspace(0, len(frames) - 1, MOST_SHOTS).round().astype(int))
    shots = [_shot(frames[number], skins[number], objects) for number in shown]
    contact_sheet(filming, shots, title, _detail(frames, times), sheet)
    files = [table, glb, arrays, sheet]
    film = out / "animation.mp4"
    film.unlink(missing_ok=True)  # one of another scene is not to stay beside the new files
    if video:
        files.append(film)
        write_video(film, _film(filming, frames, skins, objects), FILM, _fps(times))
    return files


def _shot(frame: MotionFrame, skin: Singles, objects: Sequence[Obstacle]) -> Shot:
    placed = frame.placed(skin.astype(np.float64))
    return Shot(f"{frame.time:.2f} s", placed, tuple(each.at(frame.time) for each in objects))


def _film(
    filming: Filming,
    frames: Sequence[MotionFrame],
    skins: Singles,
    objects: Sequence[Obstacle],
) -> Iterator[Pixels]:
    """Draw all frames; light, which takes longest, is interpolated between some of them."""

    def shot(number: int) -> Shot:
        return _shot(frames[number], skins[number], objects)

    light = filming.light(shot(0).skin)
    for first in range(0, len(frames), LIT_FRAMES):
        begin, end = light, min(first + LIT_FRAMES, len(frames) - 1)
        light = filming.light(shot(end).skin)
        for number in range(first, min(first + LIT_FRAMES, len(frames))):
            share = (number - first) / max(end - first, 1)
            now, here = shot(number), begin + share * (light - begin)
            yield filming.picture(now.skin, here, FILM, objects=now.objects)


def _detail(frames: Sequence[MotionFrame], times: Floats) -> str:
    inverted = sum(frame.inverted for frame in frames)
    deepest = max(frame.penetration_mm for frame in frames)
    return (
        f"{len(frames)} frames in {times[-1] - times[0]:.1f} s, {inverted} inverted tets, "
        f"skin at most {deepest:.2f} mm in what it meets"
    )


def _fps(times: Floats) -> float:
    """Return the usual number of frames a second."""
    if len(times) < 2:
        return USUAL_FPS
    return max(SLOWEST, round(1.0 / float(np.median(np.diff(times))), 2))
