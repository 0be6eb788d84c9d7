"""The face as a function: activations a, jaw b and muscle geometry S give the skin."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np
import scipy.sparse as sp

from solver.anatomy.bones import skull_planes
from solver.anatomy.embedding import LooseSkin
from solver.errors import SolveError
from solver.fitting.controls import Joint, Layout, check_pose, free_jaw, jaw_block, jaw_on_tracks
from solver.fitting.drives import ContractionMap, MuscleDrive
from solver.fitting.drives.six_numbers import SixNumbers, activation_block
from solver.fitting.simplex import check_weights
from solver.fitting.tet_forces import TetForces
from solver.mechanics.boundary import JawMotion, five_numbers
from solver.mechanics.equilibrium import (
    Equilibrium,
    PredictorOptions,
    newton_predict,
    solve_equilibrium,
)
from solver.mechanics.flesh import COROTATED_TRACE, Flesh, Material
from solver.mechanics.jaw_tracks import JawTracks, nearest_jaw
from solver.mechanics.linear import LinearSolver, analyse, leave_threads_to_kernels
from solver.mechanics.newton import Factorization, NewtonOptions
from solver.mechanics.terms import EnergyTerm, check_entries, no_planes
from solver.model import SubjectModel
from solver.surface import Floats


@dataclass(frozen=True)
class ContinuationOptions:
    """The way from pose to pose."""

    guesses: tuple[float, ...] = (1.0, 0.7, 0.4, 0.0)  # parts of a predicted motion to start from
    min_ratio: float = 0.3  # by which a predicted motion may narrow a tet
    # smallest step, as a fraction of the way, before a pose is out of reach, or a fit's step
    smallest: float = 2.0**-6
    smallest_in_fit: float = 2.0**-3


@dataclass(frozen=True)
class Pose:
    """Controls of the face: its muscles by ``a``, its joints by ``b``.

    They are a vector in a layout: ``activations`` (m, 6) of S and ``jaw`` (5,) unless ``form`` is
    another one.
    """

    a: Floats
    b: Floats
    form: Layout | None = None

    @classmethod
    def of(cls, layout: Layout, q: Floats) -> Pose:
        """Return the pose of a vector q (size,) in a layout: the muscles' block, then joints."""
        drive = layout.drive
        return cls(layout.part(drive.name, q), q[drive.rest.size :], layout)

    @property
    def layout(self) -> Layout:
        """Return where a and b are in one vector."""
        return self.form or usual_layout(len(self.a))

    def vector(self) -> Floats:
        """Return (a, b) as one vector (size,)."""
        return self.layout.join([self.a, self.b])

    def add(self, change: Floats) -> Pose:
        """Return the pose with a ``change`` of (a, b), (size,), added to it, within its bounds."""
        layout = self.layout
        return Pose.of(layout, layout.bounds.clip(self.vector() + change))

    def toward(self, other: Pose, fraction: float) -> Pose:
        """Return the pose ``fraction`` of the way to another one."""
        a = self.a + fraction * (other.a - self.a)
        b = self.b + fraction * (other.b - self.b)
        return replace(self, a=a, b=b)


@cache
def usual_layout(muscles: int) -> Layout:
    """Return the layout of what rigs hold: ``activations`` (m, 6), and a free ``jaw`` (5,)."""
    return Layout((activation_block(muscles), jaw_block()))


@dataclass(frozen=True)
class PosedFace:
    """A pose with the equilibrium it leads to, settled or approached."""

    pose: Pose
    equilibrium: Equilibrium

    @property
    def x(self) -> Floats:
        """Return the vertices (p, 3)."""
        return self.equilibrium.x

    @property
    def estimate(self) -> Floats:
        """Return where the vertices (p, 3) come to rest, maybe with a tet inverted."""
        return self.equilibrium.estimate


@dataclass(frozen=True)
class HungSkin:
    """A ``skin`` (V, 3) placed without the flesh, and which of its vertices are ``loose``."""

    skin: Floats
    loose: LooseSkin


class Face:
    """A subject's flesh with its bones, skin and muscle geometry S; all fits talk to this.

    ``S`` (n, m + 1) is the model's geometric one if not given. ``linear`` names the linear solver
    (None: the fastest in double precision), ``tolerance`` is the equilibrium's residual. ``energy``
    are terms beside the law. Its ``drive`` and its ``joint`` say what the numbers of muscles and
    jaw are: six free ones a muscle and a free jaw, unless :meth:`driven_by` and :meth:`with_joint`
    give others. With ``pinned`` nothing slides on the skull. Edits are ``stiffness_factor`` and
    ``growth`` of :class:`~solver.mechanics.flesh.Flesh`, and ``bones`` (p, 3): how far what is held
    or slides is displaced from its rest, mm.
    """

    def __init__(
        self,
        model: SubjectModel,
        S: sp.csr_array | None = None,
        *,
        material: Material | None = None,
        linear: str | None = None,
        tolerance: float = NewtonOptions.tolerance,
        energy: Sequence[EnergyTerm] = (),
        pinned: bool = False,
        stiffness_factor: Floats | None = None,
        growth: Floats | None = None,
        bones: Floats | None = None,
        options: ContinuationOptions = ContinuationOptions(),
    ) -> None:
        leave_threads_to_kernels()
        self.model = model
        self.options = options
        self.tolerance = tolerance
        if S is not None:
            check_weights(S, model)
        for term in energy:
            check_entries(term, len(model.rest), model.tets)
        self.S: sp.csr_array = model.weights if S is None else S
        material = material or COROTATED_TRACE
        self.drive: MuscleDrive = SixNumbers()
        self.joint: Joint = free_jaw(model.jaw)
        self._held_rest = model.rest if bones is None else model.rest + bones
        pins = [model.sliding] if pinned else []
        held = np.concatenate([model.cranium, model.mandible, model.cut, *pins])
        mu = material.mu * (1.0 if stiffness_factor is None else stiffness_factor)
        self.flesh = Flesh(
            model.rest,
            model.tets,
            np.unique(held),
            material,
            sliding=no_planes() if pinned else skull_planes(model, self._held_rest, mu),
            stiffness_factor=stiffness_factor,
            growth=growth,
        ).plus(*energy)
        rest = self.flesh.hessian(model.rest, self.flesh.passive())
        self.linear: LinearSolver = analyse(rest, linear)
        row = np.full(len(model.skin.vertices), -1)
        row[model.embedded] = np.arange(len(model.embedded))
        self.face_embedding = sp.csr_array(model.embedding[row[model.face]])
        self.face_offset = model.offset[row[model.face]]

    def with_weights(self, S: sp.csr_array) -> Face:
        """Return this face with another muscle geometry ``S`` (n, m + 1).

        Raises as :func:`~solver.fitting.simplex.check_weights`.
        """
        check_weights(S, self.model)
        return self._with(S=S)

    def with_unchecked_weights(self, S: sp.csr_array) -> Face:
        """Return this face with the S of a fit's step, which keeps what :meth:`with_weights` asks.

        The fit of every tet has a column for each.
        """
        return self._with(S=S)

    def with_flesh(self, flesh: Flesh) -> Face:
        """Return this face with another flesh, whose tets join the same vertices."""
        return self._with(flesh=flesh)

    def driven_by(self, drive: MuscleDrive) -> Face:
        """Return this face with another drive of its muscles; it must be driven by S."""
        return self._with(drive=drive, flesh=drive.attach(self.flesh))

    def with_joint(self, joint: Joint) -> Face:
        """Return this face with a jaw that moves by the numbers of another joint."""
        return self._with(joint=joint)

    def with_free_jaw(self) -> Face:
        """Return this face with a jaw of five numbers, which is what rigs hold."""
        return self if self.joint.is_free else self.with_joint(free_jaw(self.model.jaw))

    def with_jaw_on_tracks(self) -> Face:
        """Return this face with its condyles on the model's tracks.

        The jaw stays as it is in models made before they had tracks.
        """
        tracks = JawTracks.of(self.model.jaw)
        return self.with_joint(jaw_on_tracks(tracks)) if tracks else self

    def driven_as(self, drive: MuscleDrive) -> Face:
        """Return this face with a drive, and with the jaw that goes with it.

        A jaw is free with muscles that have no bounds, else it is on the model's tracks.
        """
        driven = self.driven_by(drive)
        return driven if driven.layout.bounds.is_free else driven.with_jaw_on_tracks()

    def _with(self, **changes: sp.csr_array | Flesh | MuscleDrive | Joint) -> Face:
        other = copy.copy(self)
        for known in ("rest", "layout", "contractions"):
            other.__dict__.pop(known, None)
        other.__dict__.update(changes)
        return other

    @property
    def jaw(self) -> JawMotion:
        """The mandible's motion by b."""
        return self.joint.motion

    @cached_property
    def layout(self) -> Layout:
        """Places of the controls of the muscles and the jaw in one vector."""
        muscles = self.drive.block(self.model, self.flesh, self.S)
        return Layout((muscles, self.joint.block))

    @cached_property
    def contractions(self) -> ContractionMap | None:
        """The muscles' contractions by their values; None where these do not tell them."""
        return self.drive.contraction_map(self.model, self.flesh.volumes, self.S)

    def rest_pose(self) -> Pose:
        """Return the pose of the neutral face."""
        return Pose.of(self.layout, self.layout.rest.copy())

    @cached_property
    def rest(self) -> PosedFace:
        """The neutral face as an equilibrium; raises :class:`SolveError` if there is none."""
        return self.solve_equilibrium(self.rest_pose(), self.model.rest)

    def _check(self, pose: Pose) -> None:
        check_pose(pose.a, pose.b, self.layout, self.model.muscle_names)

    def flesh_controls(self, a: Floats) -> Floats:
        """Return what drives the flesh for the muscles' ``a``: A_i (n, 6) if they are blended."""
        return self.drive.controls(self.S, a)

    def tet_forces(self, pose: Pose, x: Floats) -> TetForces:
        """Return the derivative of the forces at x (p, 3), tet by tet."""
        return TetForces(self.flesh, self.S, pose.a, self.flesh_controls(pose.a), x)

    def solve_equilibrium(
        self,
        pose: Pose,
        x: Floats,
        near: Factorization | None = None,
        max_iterations: int = NewtonOptions.factorizations,
    ) -> PosedFace:
        """Find the equilibrium of a pose from ``x`` (p, 3), the mandible being put where b says.

        ``near`` is the Hessian of a state nearby, if there is one. Raises :class:`SolveError` if
        it is not found within so many Newton steps, a :class:`~solver.fitting.controls.PoseError`
        if the pose is not one of this face.
        """
        self._check(pose)
        x = x.copy()
        x[self.flesh.held] = self.held_positions(pose.b)
        found = solve_equilibrium(
            self.flesh,
            self.linear,
            x,
            self.flesh_controls(pose.a),
            tolerance=self.tolerance,
            max_iterations=max_iterations,
            near=near,
        )
        return PosedFace(pose, found)

    def settle(self, pose: Pose, x: Floats, near: Factorization | None = None) -> PosedFace | None:
        """Do as :meth:`solve_equilibrium`; return None where there is none near by."""
        if not np.isfinite(x).all():
            return None
        try:
            return self.solve_equilibrium(pose, x, near)
        except SolveError:
            return None

    def newton_predict(
        self,
        state: PosedFace,
        response: Floats,
        pose: Pose,
        settled_mm: float = PredictorOptions.settled_mm,
    ) -> PosedFace:
        """Go from ``state`` to a pose nearby, to within ``settled_mm`` of its equilibrium.

        ``response`` (size,) is the flesh's linear response to the change of pose (or of S). Raises
        as :func:`~solver.mechanics.equilibrium.newton_predict`.
        """
        a = self.flesh_controls(pose.a)
        x = self._guess(state, response, pose, a)
        options = PredictorOptions(settled_mm=settled_mm)
        return PosedFace(pose, newton_predict(self.flesh, self.linear, x, a, options))

    def predict_and_solve(self, state: PosedFace, response: Floats, pose: Pose) -> PosedFace:
        """Do as :meth:`newton_predict`, but solve to the end."""
        guess = self._guess(state, response, pose, self.flesh_controls(pose.a))
        return self.solve_equilibrium(pose, guess)

    def _guess(self, state: PosedFace, response: Floats, pose: Pose, a: Floats) -> Floats:
        """Return the x of least energy on the way from ``state`` that ``response`` predicts."""
        # the whole way often flattens a few tets, from where Newton takes long to come back
        motion = response + (state.estimate - state.x)[self.flesh.free].ravel()
        base = state.x.copy()
        base[self.model.mandible] = self.mandible(pose.b)
        best = base
        least = np.inf
        for fraction in self.options.guesses:
            x = self.flesh.add_motion(base, fraction * motion)
            energy = self.flesh.energy(x, a)
            if energy > least:
                break
            best = x
            least = energy
        return best

    def continuation(self, start: PosedFace, pose: Pose) -> PosedFace:
        """Go from a settled state to another pose along the straight line between them.

        Raises the last :class:`SolveError` if the pose cannot be reached.
        """
        self._check(pose)
        return self._along(start, pose, self.options.smallest, settled=True)

    def newton_continuation(self, state: PosedFace, response: Floats, pose: Pose) -> PosedFace:
        """Do as :meth:`newton_predict`, but step by step where the flesh would invert."""
        try:
            return self.newton_predict(state, response, pose)
        except SolveError as error:
            # where it buckles instead, steps are dear and lead no further
            if error.code != "solve.inverted":
                raise
            return self._along(state, pose, self.options.smallest_in_fit, settled=False)

    def _along(self, start: PosedFace, pose: Pose, smallest: float, *, settled: bool) -> PosedFace:
        """Approach poses on the way whose response flattens no tet, the last ``settled`` or not."""
        done = 0.0
        fraction = 1.0
        state = start
        narrow = self.options.min_ratio
        while done < 1.0:
            goal = min(1.0, done + fraction)
            target = start.pose.toward(pose, goal) if goal < 1.0 else pose
            x = self.predict(state, target)
            ratio = self.flesh.min_jacobian_ratio(state.x, x)
            least = fraction <= smallest
            if ratio >= narrow or least:
                try:
                    # a step that cannot be made shorter is solved to its end before it is given up
                    solve = settled and (goal == 1.0 or least)
                    state = self._reach(state, target, x, settled=solve)
                    done = goal
                except SolveError:
                    if least:
                        raise
                    ratio = -np.inf
            # as a tet narrows about linearly, this is the longest step that flattens none
            fit = 0.9 * (1.0 - narrow) / max(1.0 - ratio, 0.1)
            fraction = max(fraction * min(max(fit, 0.25), 2.0), smallest)
        return state

    def _reach(self, state: PosedFace, target: Pose, x: Floats, *, settled: bool) -> PosedFace:
        """Find the state of ``target`` from ``x`` (p, 3), near ``state``."""
        if settled:
            return self.solve_equilibrium(target, x, state.equilibrium.factor)
        rough = PredictorOptions(settled_mm=PredictorOptions.reach_mm)
        a = self.flesh_controls(target.a)
        reached = newton_predict(self.flesh, self.linear, x, a, rough)
        # where flesh buckles a linear response leads nowhere
        if reached.minimum:
            return PosedFace(target, reached)
        return self.solve_equilibrium(target, reached.x)

    def mandible(self, b: Floats) -> Floats:
        """Return where the mandible's vertices are for b, (k, 3)."""
        return self.jaw.move(self._held_rest[self.model.mandible], b)

    def five_jaw_numbers(self, b: Floats) -> Floats:
        """Return the free jaw (5,) that comes nearest to the mandible at b."""
        if self.joint.is_free:
            return b
        free = free_jaw(self.model.jaw)
        frame = self.model.jaw
        points = self._held_rest[self.model.mandible]
        start = five_numbers(frame, self.jaw.matrix(b))
        return nearest_jaw(free.motion, points, self.jaw.move(points, b), start)

    def pose_of(self, activations: Floats, jaw: Floats) -> Pose:
        """Return the pose of what a rig holds: activations (m, 6) and the free jaw (5,).

        The jaw is the nearest that the face's joint can make, both are brought within the bounds.
        """
        layout = self.layout
        b = jaw
        if not self.joint.is_free:
            points = self.model.rest[self.model.mandible]
            goal = free_jaw(self.model.jaw).motion.move(points, jaw)
            b = nearest_jaw(self.jaw, points, goal, self.joint.block.rest)
        return Pose.of(layout, layout.bounds.clip(layout.join([activations, b])))

    def held_positions(self, b: Floats, cut: Floats | None = None) -> Floats:
        """Return where the held vertices are for b, (h, 3) in the order of ``flesh.held``.

        ``cut`` (c, 3) is how far those on the cut planes are displaced, mm; None: not at all.
        """
        x = self._held_rest.copy()
        if cut is not None:
            x[self.model.cut] += cut
        x[self.model.mandible] = self.mandible(b)
        return x[self.flesh.held]

    def mandible_jacobian(self, b: Floats) -> Floats:
        """Return dx/db of all vertices as far as it is direct: (p, 3, k), zero off the mandible."""
        out = np.zeros((*self.model.rest.shape, len(b)))
        points = self._held_rest[self.model.mandible]
        out[self.model.mandible] = self.jaw.jacobian(points, b)
        return out

    def face_points(self, x: Floats) -> Floats:
        """Return the face skin's vertices (k, 3): M x."""
        return np.asarray(self.face_embedding @ x + self.face_offset)

    def whole_skin(self, x: Floats, b: Floats, hung: HungSkin | None = None) -> Floats:
        """Return every vertex of the scan topology (V, 3), what is rigid going with its bone.

        Beyond the flesh skin follows that on it, from where it is at rest or else ``hung``.
        """
        model = self.model
        hung = hung or HungSkin(model.skin.vertices, self._loose_skin)
        skin = hung.skin.copy()
        attached = model.attached_mandible
        skin[attached] = self.jaw.move(model.skin.vertices[attached], b)
        skin[model.embedded] = model.embedding @ x + model.offset
        skin[hung.loose.ids] += hung.loose.follow(skin - hung.skin)
        return skin

    def skin_rates(self, motion: Floats, b: Floats, b_rates: Floats) -> Floats:
        """Return the derivatives (V, 3, k) of :meth:`whole_skin` at b.

        The flesh moves by ``motion`` (p, 3, k), the jaw's numbers by ``b_rates`` (.., k).
        """
        model = self.model
        count = motion.shape[2]
        out = np.zeros((len(model.skin.vertices), 3, count))
        attached = model.attached_mandible
        out[attached] = self.jaw.jacobian(model.skin.vertices[attached], b) @ b_rates
        flat = model.embedding @ motion.reshape(len(motion), -1)
        out[model.embedded] = flat.reshape(-1, 3, count)
        loose = self._loose_skin.follow(out.reshape(len(out), -1))
        out[self._loose_skin.ids] += loose.reshape(-1, 3, count)
        return out

    def skin_adjoint(self, gradient: Floats, b: Floats) -> tuple[Floats, Floats]:
        """Return the transpose of :meth:`skin_rates` applied to g (V, 3): by x (p, 3) and by b."""
        model = self.model
        loose = self._loose_skin
        attached = model.attached_mandible
        pulled = gradient + loose.adjoint(gradient[loose.ids])
        jacobian = self.jaw.jacobian(model.skin.vertices[attached], b)
        by_b = np.einsum("vib,vi->b", jacobian, pulled[attached])
        return np.asarray(model.embedding.T @ pulled[model.embedded]), by_b

    @cached_property
    def _loose_skin(self) -> LooseSkin:
        return LooseSkin(self.model)

    def predict(self, state: PosedFace, target: Pose) -> Floats:
        """Predict x (p, 3) at ``target`` by the flesh's linear response to the change of pose."""
        x = state.x.copy()
        x[self.model.mandible] = self.mandible(target.b)
        before = self.flesh_controls(state.pose.a)
        # the held vertices are where they will be
        pull = self.flesh.coupling(state.x, before, (x - state.x)[:, :, None])[:, 0]
        change = self.flesh.gradient(state.x, self.flesh_controls(target.a))
        return self.flesh.add_motion(x, -state.equilibrium.factor.solve(pull + change))
