"""ARKit's shapes of a person, each made by the muscles in flesh that meets teeth and eyeballs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from solver.anatomy.template import CORRECTED, ShapeBasis
from solver.animation import Gaze, PosedFrame, RecordedDrives
from solver.animation.blendshapes import DrivenShapes, driven_motions, solved_at
from solver.errors import SolveError
from solver.kinds.scene import SimulateScene
from solver.mechanics.boundary import JAW_FREEDOM
from solver.model import SubjectModel
from solver.rig.rig import Rig
from solver.rig.studio.lids import Lids
from solver.scans.performance import ARKIT_NAMES, FaceTake
from solver.scene import Stage
from solver.scene.places import Places
from solver.surface import Floats
from solver.templates.ict_facekit import arkit_source


@dataclass(frozen=True, eq=False)
class StudioShapes:
    """Shapes of a person by ARKit's names, at weight 1.

    A corrective such as ``mouthClose`` is what it adds to the shape that it corrects.
    """

    names: tuple[str, ...]
    motions: Floats  # (s, V, 3) of the whole skin off the neutral, mm
    jaw: Floats  # (s, 5) of a free jaw, rad and mm
    eyes: Floats  # (s, 2, 3) rotation vectors, the subject's left eye first
    off_mm: Floats  # (s,) mean distance of the face to the template's shape
    unsettled: tuple[str, ...] = ()  # where the flesh found no rest: the template's own shapes

    @cached_property
    def number(self) -> Mapping[str, int]:
        """The row of each name."""
        return {name: row for row, name in enumerate(self.names)}


@dataclass(frozen=True, eq=False)
class Played:
    """A skin (V, 3) that the flesh makes of some shapes, and the jaw's numbers (5,) there."""

    skin: Floats
    jaw: Floats


class FleshShapes:
    """Plays shapes of a rig by their muscles, from rest, with contact.

    ``driven`` say what the muscles do: blendshapes, or learned controls. Raises as
    :class:`~solver.scene.Stage`.
    """

    def __init__(self, rig: Rig, driven: DrivenShapes, places: Places) -> None:
        self._driven = driven
        self._limits = rig.limits
        rest = RecordedDrives(_rest(), driven, rig.model, limits=rig.limits)
        self._stage = Stage(SimulateScene(), places, rig.weights, rest)
        self._drive = self._stage.drive(0.0, rest(0.0))
        self._begin = self._stage.simulator.rest(self._drive)

    def play(self, weights: Mapping[str, float]) -> Played:
        """Return the skin for weights by ARKit's names.

        Raises :class:`~solver.errors.SolveError` where the flesh finds no rest.
        """
        values = [weights.get(arkit_source(name), 0.0) for name in self._driven.names]
        pose = PosedFrame.of(self._driven.pose_of(np.array(values), self._limits))
        goal = self._stage.drive(1.0, pose)
        y = self._stage.simulator.step(self._begin, self._drive, goal).y
        return Played(self._stage.skin(y, pose.jaw, pose.eyes, goal.time), pose.jaw)


def _rest() -> FaceTake:
    """Return a take of one frame in which nothing moves."""
    still = np.zeros((1, 3))
    weights = np.zeros((1, len(ARKIT_NAMES)))
    return FaceTake(still[:, 0], weights, still, np.zeros((1, 2, 3)), np.ones(1, bool), "live_link")


def solve_studio_shapes(
    model: SubjectModel,
    flesh: FleshShapes,
    basis: ShapeBasis,
    listen: Callable[[int, int], None] = lambda _done, _of: None,
) -> StudioShapes:
    """Play every shape of ARKit that the template has, alone and whole, a corrective half way.

    ``basis`` are the template's shapes. What muscles do not move, such as a tongue, moves as the
    template has it, and so does what they leave of lids. ``listen`` gets the shapes that are done,
    and how many there are. Raises as :func:`~solver.animation.blendshapes.driven_motions`.
    """
    shapes = dict(zip(basis.expression_names, basis.expressions.astype(np.float64), strict=True))
    sculpted = _by_source(shapes)
    names = tuple(name for name in ARKIT_NAMES if name in sculpted)
    made = _by_source(driven_motions(model, basis))
    neutral = model.skin.vertices
    gaze = Gaze(model)
    eyes = _eye_turns(gaze, neutral, [sculpted[name] for name in names])
    motions = np.zeros((len(names), *neutral.shape))
    jaws = np.zeros((len(names), JAW_FREEDOM))
    off = np.zeros(len(names))
    unsettled = []
    lids = Lids.of(model)
    for row, name in enumerate(names):
        under = CORRECTED.get(name, name)
        share = solved_at(name)
        both = sculpted[name] + (sculpted[under] if under != name else 0.0)
        wanted = neutral + share * both
        skin = wanted
        if name in made:
            try:
                played = flesh.play({name: share, under: share})
                skin = gaze.turn(played.skin, eyes[row])
                jaws[row] = played.jaw / share
            except SolveError:
                unsettled.append(name)
        for each in lids:
            if each.moves(name):
                skin = each.finish(skin, wanted)
        motions[row] = (skin - neutral) / share
        off[row] = np.linalg.norm((skin - wanted)[model.face], axis=1).mean() / share
        listen(row + 1, len(names))
    for name, under in CORRECTED.items():
        if name in names and under in names:
            motions[names.index(name)] -= motions[names.index(under)]
            jaws[names.index(name)] -= jaws[names.index(under)]
    return StudioShapes(names, motions, jaws, eyes, off, tuple(unsettled))


def _by_source(motions: Mapping[str, Floats]) -> dict[str, Floats]:
    """Return what each of ARKit's shapes drives."""
    found: dict[str, Floats] = {}
    for name, motion in motions.items():
        source = arkit_source(name)
        found[source] = found[source] + motion if source in found else motion
    return found


def _eye_turns(gaze: Gaze, neutral: Floats, motions: Sequence[Floats]) -> Floats:
    """Return the turns (s, 2, 3) of the eyes in each of ``motions`` (V, 3) of a template."""
    turns = np.zeros((len(motions), 2, 3))
    for row, motion in enumerate(motions):
        for side, (ids, centre) in enumerate(gaze.balls):
            if len(ids) and np.abs(motion[ids]).max() > 0.0:
                before = neutral[ids] - centre
                turn, _ = Rotation.align_vectors(before + motion[ids], before)
                turns[row, side] = turn.as_rotvec()
    return turns
