"""ARKit's shapes of a person, each made by the muscles in flesh that meets teeth and eyeballs.

Some of the template's shapes are beyond living muscles: air blows up a cheek, and no lips meet
over a jaw as wide open as a sculptor has it. A studio's shape is about the skin, so that one which
muscles miss by more than :class:`FreedOptions` allow is made again by freed ones, which may push
and swell, at hardly any price. It is still flesh that moves and meets what it meets.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from solver.anatomy.template import CORRECTED, ShapeBasis
from solver.animation import Gaze, PosedFrame, RecordedDrives
from solver.animation.blendshapes import SHORT, DrivenShapes, ShapedPose, driven_motions, solved_at
from solver.animation.lids import Lids
from solver.errors import SolveError
from solver.fitting import activation
from solver.fitting.activation import UNSEEN_STOP
from solver.fitting.contact import terms
from solver.fitting.face import Face
from solver.fitting.objective import Regulariser, Target
from solver.kinds.scene import SimulateScene
from solver.mechanics.boundary import JAW_FREEDOM
from solver.mechanics.linear import fastest
from solver.model import SubjectModel
from solver.rig.rig import Rig
from solver.scans.live_link import ARKIT_NAMES, FaceTake
from solver.scene import Stage
from solver.scene.places import Places
from solver.surface import Floats
from solver.templates.ict_facekit import arkit_source


@dataclass(frozen=True)
class FreedOptions:
    """When muscles are freed, and how far."""

    near_mm: float = 0.25  # mean distance of the face to the template's shape that is good enough
    loosened: float = 0.5  # part of the way from living muscles' limits to none that matter
    w_a: float = 1e-5  # price of activations
    w_v: float = 1e-4  # and of their volume
    w_b: float = 1e-6  # and of the jaw, which leaves its tracks


FREED = FreedOptions()
MadeBy = Literal["muscles", "freed muscles", "template"]


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
    freed: tuple[str, ...] = ()  # made by muscles beyond the limits of living ones

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

    def __init__(
        self, rig: Rig, driven: DrivenShapes, places: Places, options: FreedOptions = FREED
    ) -> None:
        self.options = options
        self._rig = rig
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
        return self._play(self._driven.pose_of(np.array(values), self._limits))

    def reach(self, points: Floats) -> Played:
        """Return the skin whose face comes closest to ``points`` (k, 3), by freed muscles.

        Raises :class:`~solver.errors.SolveError` where the flesh finds no rest.
        """
        face = self._freed
        data = terms(face, {"shape": Target.from_points(points)})["shape"]
        options = self.options
        price = Regulariser(options.w_a, options.w_v, options.w_b, face.rest_pose())
        found = activation.fit(face, data, price, None, UNSEEN_STOP, descent=SHORT).state.pose
        return self._play(ShapedPose(found.a, face.five_jaw_numbers(found.b)))

    @cached_property
    def _freed(self) -> Face:
        """The person with freed muscles, and a jaw that is free as well."""
        drive = self._rig.drive
        face = self._rig.face(fastest())
        return face.driven_by(drive.loosen(self.options.loosened) or drive).with_free_jaw()

    def _play(self, shaped: ShapedPose) -> Played:
        pose = PosedFrame.of(shaped)
        goal = self._stage.drive(1.0, pose)
        y = self._stage.simulator.step(self._begin, self._drive, goal).y
        return Played(self._stage.skin(y, pose.jaw, pose.eyes, goal.time), pose.jaw)


def _rest() -> FaceTake:
    """Return a take of one frame in which nothing moves."""
    still = np.zeros((1, 3))
    weights = np.zeros((1, len(ARKIT_NAMES)))
    return FaceTake(still[:, 0], weights, still, np.zeros((1, 2, 3)), np.ones(1, bool), "live_link")


def shape_names(basis: ShapeBasis) -> tuple[str, ...]:
    """Return the names of ARKit's shapes that a template has, in ARKit's order."""
    driven = {arkit_source(name) for name in basis.expression_names}
    return tuple(name for name in ARKIT_NAMES if name in driven)


def solve_studio_shapes(
    model: SubjectModel,
    flesh: FleshShapes,
    basis: ShapeBasis,
    listen: Callable[[int, int], None] = lambda _done, _of: None,
) -> StudioShapes:
    """Play every shape of ARKit that the template has, alone and whole, a corrective half way.

    ``basis`` are the template's shapes. What muscles do not move, such as a tongue, moves as the
    template has it, and so does what they leave of lids; where they leave more of a face than the
    options of ``flesh`` allow, freed ones move it. ``listen`` gets the shapes that are done, and
    how many there are. Raises as :func:`~solver.animation.blendshapes.driven_motions`.
    """
    shapes = dict(zip(basis.expression_names, basis.expressions.astype(np.float64), strict=True))
    sculpted = _by_source(shapes)
    names = shape_names(basis)
    moved = _by_source(driven_motions(model, basis))
    neutral = model.skin.vertices
    gaze = Gaze(model)
    lids = Lids.of(model)
    turns = _eye_turns(gaze, neutral, [sculpted[name] for name in names])

    def make(name: str, eyes: Floats) -> Made:
        """Return the best that muscles make of a shape, else the template's own."""
        under = CORRECTED.get(name, name)
        under = under if under in sculpted else name
        share = solved_at(name)
        wanted = neutral + share * (sculpted[name] + (sculpted[under] if under != name else 0.0))

        def finish(played: Played, by: MadeBy) -> Made:
            skin = gaze.turn(played.skin, eyes) if by != "template" else played.skin
            for each in lids:
                if each.moves(name):
                    skin = each.finish(skin, wanted)
            away = np.linalg.norm((skin - wanted)[model.face], axis=1).mean()
            return Made((skin - neutral) / share, played.jaw / share, float(away) / share, by)

        ways = [
            lambda: finish(flesh.play({name: share, under: share}), "muscles"),
            lambda: finish(flesh.reach(wanted[model.face]), "freed muscles"),
        ]
        best = nearest(ways, flesh.options.near_mm) if name in moved else None
        return best or finish(Played(wanted, np.zeros(JAW_FREEDOM)), "template")

    found = {}
    for row, name in enumerate(names):
        found[name] = make(name, turns[row])
        listen(row + 1, len(names))
    motions = {name: each.motion for name, each in found.items()}
    jaws = {name: each.jaw for name, each in found.items()}
    for name, under in CORRECTED.items():
        if name in found and under in found:
            motions[name] = motions[name] - motions[under]
            jaws[name] = jaws[name] - jaws[under]
    return StudioShapes(
        names,
        np.array([motions[name] for name in names]),
        np.array([jaws[name] for name in names]),
        turns,
        np.array([each.off_mm for each in found.values()]),
        tuple(n for n, each in found.items() if n in moved and each.by == "template"),
        tuple(n for n, each in found.items() if each.by == "freed muscles"),
    )


@dataclass(frozen=True, eq=False)
class Made:
    """A shape at weight 1: its ``motion`` (V, 3), the ``jaw`` (5,), and what it was made by."""

    motion: Floats
    jaw: Floats
    off_mm: float
    by: MadeBy


def nearest(ways: Iterable[Callable[[], Made]], near_mm: float) -> Made | None:
    """Return the nearest of ``ways`` that come to rest, tried in turn until one is near enough."""
    best: Made | None = None
    for way in ways:
        if best is not None and best.off_mm <= near_mm:
            break
        with suppress(SolveError, np.linalg.LinAlgError):
            made = way()
            if best is None or made.off_mm < best.off_mm:
                best = made
    return best


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
