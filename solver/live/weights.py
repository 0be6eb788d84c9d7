"""Take ARKit's weights as they come: values of the template's expressions, and the head's turn."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from typing_extensions import override

from solver.animation import neck, turn_about
from solver.fitting.prior import kept_part
from solver.live.source import FollowedFace, LiveSource
from solver.model import SubjectModel
from solver.scans.live_link import ANGLES, ARKIT_NAMES, head_turn
from solver.similarity import IDENTITY, Similarity
from solver.surface import Floats
from solver.templates.ict_facekit import arkit_source

ANGLE_NAMES = tuple(name for names in ANGLES.values() for name in names)
HEAD = slice(len(ARKIT_NAMES), len(ARKIT_NAMES) + 3)  # rows of its yaw, pitch and roll
FORGETTING = 1.0  # s in which a weight that is not told fades to 1/e


class LiveWeights(LiveSource):
    """Takes weights (61, 1): ARKit's 52 blendshapes from 0 to 1, then nine angles in rad.

    The angles are yaw, pitch and roll of the head and of both eyes as Live Link Face has them;
    those of the eyes move nothing. A weight that is NaN fades, an angle stays as it was.
    """

    labels = (*ARKIT_NAMES, *ANGLE_NAMES)
    rows = len(labels)
    width = 1
    clue_count = 0

    def __init__(
        self, model: SubjectModel, names: Sequence[str], forgetting: float = FORGETTING
    ) -> None:
        sources = [arkit_source(name) for name in names]
        self._driven = np.array([source in ARKIT_NAMES for source in sources])
        self._columns = np.array(
            [ARKIT_NAMES.index(each) if each in ARKIT_NAMES else 0 for each in sources]
        )
        self._neck = neck(model)
        self._forgetting = forgetting
        self._values: Floats = np.zeros(len(sources))
        self._head = IDENTITY

    @override
    def step(self, numbers: Floats, seconds: float) -> FollowedFace:
        column = numbers[:, 0]
        found = column[self._columns]
        told = np.isfinite(found) & self._driven
        faded = self._values * kept_part(seconds, self._forgetting)
        self._values = np.where(told, np.clip(np.nan_to_num(found), 0.0, 1.0), faded)
        angles = column[HEAD]
        turns = bool(np.isfinite(angles).all())
        if turns:
            self._head = turn_about(self._neck, head_turn(angles), np.zeros(3))
        return FollowedFace(self._values, self._head, np.zeros(0), not told.any() and not turns)

    @override
    def begin(self) -> None:
        self._values = np.zeros(len(self._columns))
        self._head = IDENTITY

    @override
    def resume(self, values: Floats, head: Similarity) -> None:
        self._values = values
        self._head = head
