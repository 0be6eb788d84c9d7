"""A recorded performance on an ICT-FaceKit subject: a real sequence of registered scans.

Weights of ARKit's blend shapes (Live Link Face) drive ICT-FaceKit's expressions:
frame = neutral + sum(weight_e E_e).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from solver.anatomy.ict_captures import ict_neutral
from solver.anatomy.ict_facekit import VERTEX_COUNT, FaceKit, arkit_name, read_facekit
from solver.errors import InputError
from solver.model import SubjectModel
from solver.scans.live_link import ARKIT_NAMES, LiveLinkTake, read_live_link
from solver.surface import Floats


@dataclass(frozen=True)
class IctPerformance:
    """Frames (V, 3) in mm, made when they are asked for.

    ``neutral`` is (V, 3), ``shapes`` (e, 3 V) are the displacements of the expressions that are
    driven, ``weights`` (f, e) drive them, ``times`` (f,) are in s.
    """

    neutral: Floats
    shapes: Floats
    weights: Floats
    times: Floats

    def __len__(self) -> int:
        return len(self.weights)

    def __iter__(self) -> Iterator[Floats]:
        return (self.frame(number) for number in range(len(self)))

    @property
    def fps(self) -> float:
        """Return the usual number of frames per second."""
        return round(1.0 / float(np.median(np.diff(self.times))), 3) if len(self) > 1 else 30.0

    def frame(self, number: int) -> Floats:
        """Return the skin (V, 3) in a frame, mm."""
        motion = self.weights[number] @ self.shapes
        return np.asarray(self.neutral + motion.reshape(-1, 3), np.float64)


def performance_frames(
    faces: Path, recording: Path, *, subject: str = "A", capture_sets: Path | None = None
) -> IctPerformance:
    """Return a Live Link Face recording as the skin of an ICT-FaceKit subject.

    ``faces`` is ICT-FaceKit's folder; ``subject`` and ``capture_sets`` are as in
    :func:`~solver.anatomy.ict_captures.ict_capture_set`, as are the errors; a recording that can
    not be used is :func:`~solver.scans.live_link.read_live_link`'s.
    """
    take = read_live_link(recording)
    kit = read_facekit(faces)
    return drive(kit, ict_neutral(kit, faces, subject, capture_sets).vertices, take)


def drive(kit: FaceKit, neutral: Floats, take: LiveLinkTake) -> IctPerformance:
    """Return the performance of a person with the skin ``neutral`` (V, 3), mm."""
    column = {name: number for number, name in enumerate(ARKIT_NAMES)}
    sources = {name: column.get(arkit_source(name)) for name in kit.deltas}
    driven = {name: source for name, source in sources.items() if source is not None}
    shapes = np.stack([kit.deltas[name].ravel() for name in driven])
    return IctPerformance(neutral, shapes, take.weights[:, list(driven.values())], take.times)


def model_performance(faces: Path, recording: Path, model: SubjectModel) -> IctPerformance:
    """Return a Live Link Face recording as the face's points (k, 3) of a subject's model.

    Raises as :func:`performance_frames`, and ``performance.topology`` if the model's skin does not
    have ICT-FaceKit's vertices.
    """
    skin = model.skin.vertices
    if len(skin) != VERTEX_COUNT:
        raise InputError(
            "performance.topology",
            f"the model's skin has {len(skin)} vertices, ICT-FaceKit's {VERTEX_COUNT}: a recording "
            "can drive models of that template alone",
            expected=VERTEX_COUNT,
            found=len(skin),
        )
    whole = drive(read_facekit(faces), skin, read_live_link(recording))
    coordinates = (3 * model.face[:, None] + np.arange(3)).ravel()
    return replace(whole, neutral=skin[model.face], shapes=whole.shapes[:, coordinates])


def arkit_source(expression: str) -> str:
    """Return the ARKit shape that drives an expression of ICT-FaceKit or of a template.

    ICT-FaceKit splits ``browInnerUp`` and ``cheekPuff`` in two halves. It has no tongue, and ARKit
    has no ``cheekRaiser`` and no ``PupilDilate``; names that ARKit does not have drive nothing.
    """
    name = arkit_name(expression)
    return name if name in ARKIT_NAMES else name.removesuffix("Left").removesuffix("Right")
