"""Plain blendshapes with a jaw, which tracks and muscles are compared with.

The flesh goes where the shapes' morphs lead it: no muscle holds its volume, and nothing keeps lips
apart. The skin is the sum of the shapes before the jaw turns it, as :mod:`solver.tracks.shapes`
has it, but for what morphs miss of it (``MuscleTracks.off_mm``).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from solver.fitting.face import Face
from solver.model import SubjectModel
from solver.surface import Floats
from solver.tracks.basis import MuscleTracks, TrackPose, TrackTargets


@dataclass(frozen=True)
class PlainState:
    """A face of plain shapes under controls."""

    q: Floats  # (K + 5,) weights of the shapes and the jaw on top of theirs, rad and mm
    pose: TrackPose
    inverted: int  # tets

    @property
    def x(self) -> Floats:
        """Return the vertices (p, 3) of the flesh, as the morph has them."""
        return self.pose.target


class PlainFace:
    """A person's face as the sum of the shapes of its tracks, turned by the jaw.

    Raises :class:`~solver.errors.InputError` (``tracks.model``) for tracks of another model.
    """

    def __init__(self, model: SubjectModel, tracks: MuscleTracks) -> None:
        tracks.check(model)
        self.face = Face(model)
        self.tracks = tracks
        self._targets = TrackTargets(model, tracks)

    def rest(self) -> PlainState:
        """Return the neutral face."""
        return self._at(np.zeros(self.tracks.size))

    def move(self, state: PlainState, q: Floats) -> PlainState:
        """Go to controls q (K + 5,) from any ``state``.

        Raises as ``MuscleTracks.check_controls``.
        """
        del state
        self.tracks.check_controls(q)
        return self._at(q.copy())

    def skin(self, state: PlainState) -> Floats:
        """Return the whole skin (V, 3) of a state."""
        return self.face.whole_skin(state.x, state.pose.jaw)

    def columns(self, state: PlainState) -> Floats:
        """Return dx/dq (p, 3, K + 5)."""
        return self._targets.rates(state.q).target

    def skin_columns(self, state: PlainState) -> Floats:
        """Return the derivatives (V, 3, K + 5) of the whole skin."""
        rates = self._targets.rates(state.q)
        return self.face.skin_rates(rates.target, state.pose.jaw, rates.jaw)

    def _at(self, q: Floats) -> PlainState:
        pose = self._targets.at(q)
        return PlainState(q, pose, self.face.flesh.count_inverted(pose.target))
