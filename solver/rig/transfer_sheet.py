"""A video beside the rig that plays it: frames that differ most, as filmed and as drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from solver.animation import Gaze
from solver.drawing.render import Pixels
from solver.drawing.sheet import MARGIN, Column, SheetLayout, draw_sheet
from solver.fitting.face import Face
from solver.model import SubjectModel
from solver.registration.detector import DetectorOptions, FaceDetector, landmarker_file
from solver.rig.frames import FRAMES, read_chunks
from solver.rig.frames.animation import Filming, MotionRecord
from solver.scans.film import decode_film
from solver.surface import Floats, Ints


@dataclass(frozen=True)
class TransferSheetOptions:
    """What the sheet shows."""

    shots: int = 10
    across: int = 5  # shots in a row
    cell: tuple[int, int] = (240, 290)  # px of a picture
    margin: float = 0.55  # about a face of the video, of its height


SHEET = TransferSheetOptions()


def draw_transfer(
    path: Path,
    video: Path,
    animation: Path,
    model: SubjectModel,
    start: int = 0,
    options: TransferSheetOptions = SHEET,
) -> None:
    """Draw frames of a ``video`` over those of the folder that ``animate`` left of it.

    ``start`` is the recording's first frame that was played. Raises as
    :func:`~solver.rig.frames.read_chunks` (``simulate.frames``) and
    :func:`~solver.scans.film.decode_film`.
    """
    frames = read_chunks(animation / FRAMES, MotionRecord, "simulate.frames", lambda _: True)
    with np.load(animation / "animation.npz") as data:
        weights, seen = data["weights"], data["seen"]
    shown = most_different(weights, np.flatnonzero(seen), options.shots)
    filmed = _filmed(video, (shown + start).tolist(), options)
    face, filming, gaze = Face(model), Filming(model), Gaze(model)
    columns = []
    for number in shown.tolist():
        frame = frames[number]
        whole = gaze.turn(face.whole_skin(model.rest + frame.moved, frame.jaw), frame.eyes)
        skin = frame.into_world(whole)
        drawn = filming.picture(skin, filming.light(skin), options.cell)
        columns.append(Column(f"{frame.time:.2f} s", [filmed[number + start], drawn]))
    layout = SheetLayout(options.cell, MARGIN, options.across, foot=MARGIN)
    detail = f"{len(frames)} frames; above as filmed, below as the rig plays it"
    draw_sheet(path, "Transfer", detail, ("", ""), columns, layout, scale_mm=None)


def most_different(weights: Floats, frames: Ints, count: int) -> Ints:
    """Return up to ``count`` of the ``frames``, in order, whose weights (f, e) are far apart.

    The first is the one nearest to rest, each next the one farthest from all before.
    """
    rows = weights[frames]
    chosen = [int(np.argmin(np.linalg.norm(rows, axis=1)))]
    while len(chosen) < min(count, len(frames)):
        away = np.linalg.norm(rows[:, None] - rows[chosen], axis=2).min(axis=1)
        chosen.append(int(np.argmax(away)))
    return np.unique(frames[chosen])


def _filmed(
    video: Path, numbers: Sequence[int], options: TransferSheetOptions
) -> dict[int, Pixels]:
    """Return number -> the frame's picture, cut out about its largest face."""
    file, cut = landmarker_file(), {}
    assert file is not None, "the video was read with it"
    with FaceDetector(file, DetectorOptions()) as detector:
        for number, picture in enumerate(decode_film(video, "video")):
            if number in numbers:
                pixels = picture.pixels()
                faces = detector.faces_in(pixels)
                height, width = pixels.shape[:2]
                box = (0.0, 0.0, float(width), float(height))
                if faces:
                    box = max(faces, key=lambda each: each.eyes_px).box
                cut[number] = _cut(pixels, box, options)
    return cut


def _cut(pixels: np.ndarray, box: Sequence[float], options: TransferSheetOptions) -> Pixels:
    left, top, right, bottom = box
    middle, (wide, high) = ((left + right) / 2, (top + bottom) / 2), options.cell
    tall = (bottom - top) * (1.0 + 2.0 * options.margin)
    half = np.array([tall * wide / high, tall]) / 2
    around = (*(middle - half), *(middle + half))
    image = Image.fromarray(pixels).crop(tuple(round(edge) for edge in around))
    return np.asarray(image.resize(options.cell), np.float32) / np.float32(255)
