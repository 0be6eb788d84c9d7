"""A video beside the rigs that play it: frames that differ most, as filmed and as drawn."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from solver.anatomy.skin_points import SkinPoints
from solver.animation import Gaze
from solver.drawing.render import Pixels
from solver.drawing.sheet import MARGIN, PAPER, Column, SheetLayout, draw_sheet
from solver.fitting.face import Face
from solver.landmarker import landmarker_file
from solver.model import SubjectModel
from solver.registration.detector import DetectedFace, DetectorOptions, FaceDetector
from solver.rig.frames import FRAMES, read_chunks
from solver.rig.frames.animation import Filming, MotionRecord
from solver.rig.painted_faces import PAINT, PaintedFaces
from solver.scans.film import decode_film
from solver.scans.live_link import read_live_link
from solver.scans.video import VIDEO, weights_of
from solver.storage import read_arrays
from solver.surface import Floats, Ints


@dataclass(frozen=True)
class TransferSheetOptions:
    """What the sheet shows."""

    shots: int = 10
    across: int = 5  # shots in a row
    cell: tuple[int, int] = (240, 290)  # px of a picture
    margin: float = 0.4  # about a face of the video, of its height
    span: float = 1.75  # of a picture of the rig, by its face's height


SHEET = TransferSheetOptions()


@dataclass(frozen=True)
class PlayedRig:
    """A rig in the folder that ``animate`` left of it."""

    name: str
    folder: Path
    model: SubjectModel


def draw_transfer(
    path: Path,
    video: Path,
    signals: Path,
    rigs: Sequence[PlayedRig],
    points: SkinPoints | None = None,
    start: int = 0,
    options: TransferSheetOptions = SHEET,
) -> None:
    """Draw frames of a ``video`` over the same ones of all ``rigs`` that play its ``signals``.

    The first rig's weights say which. ``start`` is the recording's first frame that was played;
    brows and lips are painted where a template's ``points`` are known. Where no frame that was
    played has a face, some are shown all the same. Raises as
    :func:`~solver.rig.frames.read_chunks` (``simulate.frames``) and
    :func:`~solver.scans.film.decode_film`.
    """
    played = read_arrays(rigs[0].folder / "animation.npz", names=("weights", "seen"))
    seen = played["seen"]
    with_face = np.flatnonzero(seen) if seen.any() else np.arange(len(seen))
    shown = most_different(played["weights"], with_face, options.shots)
    measured = read_live_link(signals).weights
    filmed = _cut_faces(video, {n: measured[n] for n in (shown + start).tolist()}, options)
    drawn = [_draw_rig(rig, shown.tolist(), points, options) for rig in rigs]
    columns = []
    for row, number in enumerate(shown.tolist()):
        pictures = [each[row].picture for each in drawn]
        columns.append(Column(f"{drawn[0][row].time:.2f} s", [filmed[number + start], *pictures]))
    layout = SheetLayout(options.cell, MARGIN, options.across, foot=MARGIN)
    below = "as the rig plays it" if len(rigs) == 1 else ", ".join(rig.name for rig in rigs)
    detail = f"{len(seen)} frames; above as filmed, below {below}"
    draw_sheet(path, "Transfer", detail, ("", *("" for _ in rigs)), columns, layout, scale_mm=None)


class _Drawn(NamedTuple):
    time: float  # s
    picture: Pixels


def _draw_rig(
    rig: PlayedRig, shown: Sequence[int], points: SkinPoints | None, options: TransferSheetOptions
) -> list[_Drawn]:
    """Return pictures of the frames that are shown."""
    frames = read_chunks(rig.folder / FRAMES, MotionRecord, "simulate.frames", lambda _: True)
    model = rig.model
    face = Face(model)
    gaze = Gaze(model)
    draw = _drawing(model, points, options)
    drawn = []
    for frame in (frames[number] for number in shown):
        whole = gaze.turn(face.whole_skin(model.rest + frame.moved, frame.jaw), frame.eyes)
        drawn.append(_Drawn(frame.time, draw(frame.into_world(whole))))
    return drawn


def _drawing(
    model: SubjectModel, points: SkinPoints | None, options: TransferSheetOptions
) -> Callable[[Floats], Pixels]:
    """Return what draws a skin (v, 3)."""
    if points is not None:
        painted = replace(PAINT, size=options.cell, span=options.span)
        return PaintedFaces(model, points, painted).picture
    filming = Filming(model)
    return lambda skin: filming.picture(skin, filming.light(skin), options.cell)


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


def _cut_faces(
    video: Path, measured: Mapping[int, Floats], options: TransferSheetOptions
) -> dict[int, Pixels]:
    """Return number -> the frame's picture, cut out about the face with the ``measured`` weights.

    These are (52,) of each frame that is shown; a frame without a face is shown whole.
    """
    file = landmarker_file()
    assert file is not None, "the video was read with it"
    cut: dict[int, Pixels] = {}
    with FaceDetector(file, DetectorOptions(VIDEO.most_faces, weights=True)) as detector:
        for number, picture in enumerate(decode_film(video, "video")):
            if number in measured:
                pixels = picture.pixels()
                height, width = pixels.shape[:2]
                box = (0.0, 0.0, float(width), float(height))
                if faces := detector.faces_in(pixels):
                    box = face_with(faces, measured[number]).box
                cut[number] = _cut(pixels, box, options)
            if len(cut) == len(measured):
                break
    return cut


def face_with(faces: Sequence[DetectedFace], weights: Floats) -> DetectedFace:
    """Return the face of a picture that measured ``weights`` (52,) are of."""
    return min(faces, key=lambda face: float(np.linalg.norm(weights_of(face) - weights)))


def _cut(pixels: np.ndarray, box: Sequence[float], options: TransferSheetOptions) -> Pixels:
    left, top, right, bottom = box
    middle = ((left + right) / 2, (top + bottom) / 2)
    wide, high = options.cell
    tall = (bottom - top) * (1.0 + 2.0 * options.margin)
    size = np.round([tall * wide / high, tall]).astype(int)
    corner = np.round(np.array(middle) - size / 2).astype(int)
    image = Image.new("RGB", (int(size[0]), int(size[1])), PAPER)
    image.paste(Image.fromarray(pixels), (-int(corner[0]), -int(corner[1])))
    return np.asarray(image.resize(options.cell), np.float32) / np.float32(255)
