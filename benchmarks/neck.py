"""A neck that holds the head: its mechanics, and how its control follows a head.

``--osim`` names an OpenSim file, ``--anatomy`` the folder of BodyParts3D, else the built-in neck is
taken; with ``--head``, a CSV of OpenFace, its head is followed as well. The parts, of which
``--parts`` names some: ``anatomy``: bodies and muscles, their lengths in 20 random poses beside
OpenSim's where it is installed, and moment arms by finite differences; ``laws``: derivatives of
both laws of muscles; ``energy``: its drift without muscles and damping; ``hold``: at rest and in 12
poses; ``conversation`` and ``wide``: sines of 25, 12, 10 and 40, 20, 15 degrees about the axes;
``push``: 30 N sideways on the forehead for 0.1 s, with the reflexes, without and with late ones;
``range``: goals far beyond the range; ``skin``: :mod:`benchmarks.neck_skin` of the built-in person.
"""

from __future__ import annotations

import argparse
import logging
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks import neck_skin, report, subjects
from benchmarks.documents import Figures, Section, Table
from solver.kinds.scene_recording import Recording
from solver.neck.anatomy import JOINTS, Neck, NeckPose
from solver.neck.body import DOFS, GRAVITY, Body
from solver.neck.bodyparts3d import read_neck
from solver.neck.builtin import builtin_neck
from solver.neck.dynamics import Dynamics
from solver.neck.hill import LAWS, HillOptions, Muscles
from solver.neck.motion import MotionOptions, NeckMotion, Push, follow, reachable
from solver.neck.osim import read_osim
from solver.neck.osim_joints import TO_OURS
from solver.neck.posture import within
from solver.neck.reflex import ReflexOptions
from solver.scans.openface import read_openface
from solver.surface import Floats
from solver.templates.bodyparts3d import read_parts

log = logging.getLogger(__name__)
PARTS = ("anatomy", "laws", "energy", "hold", "conversation", "wide", "push", "range", "skin")
SEED = 23
POSES = 20  # beside OpenSim
HELD_POSES = 12
FPS = 50.0
HZ = np.array([0.43, 0.30, 0.55])  # of nods, turns, tilts
PHASES = np.array([0.4, 0.0, 1.1])  # rad
BROW = np.array([0.0, 64.0, 105.0])  # mm, the middle of the forehead, from the head's joint


def main() -> None:
    """Write the figures of a neck as JSON."""
    parser = report.parser("a neck's mechanics, and how its control follows a head")
    necks = parser.add_mutually_exclusive_group()
    necks.add_argument("--osim", type=Path, help="a neck of OpenSim")
    necks.add_argument("--builtin", action="store_true", help="the built-in neck (the default)")
    necks.add_argument(
        "--anatomy", type=Path, help="BodyParts3D: joints and attachments of its man"
    )
    parser.add_argument("--head", type=Path, help="a CSV of OpenFace whose head is followed")
    parser.add_argument(
        "--fps", type=float, help="frames a second, in the place of the CSV's clock"
    )
    report.add_list(parser, "--parts", PARTS)
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    report.finish(run(options), options, section)


def run(options: argparse.Namespace) -> Figures:
    """Return the figures of the chosen neck."""
    bench = _Bench(options)
    figures: Figures = {"neck": bench.neck.source, "notices": list(bench.neck.notices)}
    for part in options.parts:
        begin = time.perf_counter()
        figures.update(getattr(bench, part)())
        log.info("%s: %.1f s", part, time.perf_counter() - begin)
    if options.head:
        figures["head"] = bench.head(options.head, options.fps)
    return figures


class _Bench:
    def __init__(self, options: argparse.Namespace) -> None:
        self.osim: Path | None = options.osim
        self.quick: bool = options.quick
        self.read = read_neck(read_parts(options.anatomy)) if options.anatomy else None
        if self.read:
            self.neck: Neck = self.read.neck
        else:
            self.neck = read_osim(self.osim) if self.osim else builtin_neck()

    def anatomy(self) -> Figures:
        """Return counts, and lengths and moment arms beside others'."""
        body = Body(self.neck)
        found: Figures = {"dof": len(body.v), "muscles": len(self.neck.muscles)}
        if self.read:
            found["builtin_scale"] = self.read.placed.scale
            found["builtin_joints_mm"] = float(self.read.joints_mm.max())
            found["builtin_ends_median_mm"] = self.read.median_mm
        if self.osim:
            found["length_vs_opensim_mm"] = length_vs_opensim(self.osim, body)
        random = np.random.default_rng(SEED)
        worst = 0.0
        step = 1e-6
        for _ in range(2 if self.quick else 5):
            turns = random.uniform(-1.0, 1.0, (JOINTS, 3)) * self.neck.ranges
            body.set_pose(turns)
            arms = body.arms
            moved = []
            for dof in range(DOFS):
                ends = []
                for sign in (1.0, -1.0):
                    more = np.zeros((JOINTS, 3))
                    more[dof // 3, dof % 3] = sign * step
                    turned = Rotation.from_rotvec(turns) * Rotation.from_rotvec(more)
                    body.set_pose(turned.as_rotvec())
                    ends.append(body.lengths.copy())
                moved.append((ends[0] - ends[1]) / (2.0 * step))
            worst = max(worst, _relative(arms, np.array(moved).T))
        return {**found, "moment_arm_fd": worst}

    def laws(self) -> Figures:
        """Return the greatest relative error of the laws' derivatives."""
        random = np.random.default_rng(SEED)
        worst = {}
        for law in LAWS:
            muscles = Muscles.of(self.neck, HillOptions(law=law))
            rest = np.array([each.length for each in self.neck.muscles]) * 1e-3
            lengths = rest * random.uniform(0.9, 1.15, len(rest))
            rates = rest * random.uniform(0.1, 2.0, len(rest)) * random.choice([-1, 1], len(rest))
            parts = muscles.parts(lengths, rates)
            step = 1e-7
            longer, shorter = (muscles.parts(lengths + s, rates) for s in (step, -step))
            faster, slower = (muscles.parts(lengths, rates + s) for s in (step, -step))
            by_length = (longer - shorter) / (2 * step)
            by_rate = (faster - slower) / (2 * step)
            exact = [(1, by_length, 0), (2, by_rate, 0), (4, by_length, 3), (5, by_rate, 3)]
            worst[law] = max(_relative(parts[:, k], moved[:, of]) for k, moved, of in exact)
        return {"law_fd": max(worst.values()), "law_fd_each": worst}

    def energy(self) -> Figures:
        """Return the drift of the energy by the greatest energy of motion, of discs and weight.

        It is that of the last tenth's mean from the first's.
        An upright head without muscles falls over, with joints far beyond their ranges; so the neck
        hangs, and what falls is told beside it.
        """
        hangs, falls = (self._drift(np.array([0.0, sign * GRAVITY, 0.0])) for sign in (1.0, -1.0))
        return {"energy_drift": hangs, "energy_drift_falling": falls}

    def _drift(self, gravity: Floats) -> float:
        weak = tuple(replace(each, strength=1e-12) for each in self.neck.muscles)
        free = replace(self.neck, damping=0.0 * self.neck.damping, muscles=weak, ligaments=0.0)
        dynamics = Dynamics(free, gravity=gravity)
        body = dynamics.body
        half = dynamics.reflex.step_s / 2.0
        body.set_pose(self.neck.shares * np.radians([10.0, 15.0, 8.0]))
        energies = []
        kinetic = 0.0
        for _ in range(100 if self.quick else 1000):
            fast = body.v.copy()  # of half a step before
            body.v += half * np.linalg.solve(body.inertia, dynamics.passive_torque())
            energies.append(body.energy + dynamics.joint_energy())
            kinetic = max(kinetic, float(body.v @ body.inertia @ body.v / 2.0))
            body.v[:] = fast
            dynamics.advance(40)
        tenth = len(energies) // 10  # over which what only swings is taken out
        drift = np.mean(energies[-tenth:]) - np.mean(energies[:tenth])
        return float(abs(drift) / kinetic)

    def hold(self) -> Figures:
        """Return how far the head goes from where it is held, in degrees."""
        poses = []
        random = np.random.default_rng(SEED)
        for _ in range(2 if self.quick else HELD_POSES):
            way = random.standard_normal(3)
            poses.append(0.6 * way / np.linalg.norm(way) * self.neck.head_range)
        rest = self._held(np.zeros(3), 5.0 if self.quick else 60.0)
        worst = max(self._held(pose, 2.0 if self.quick else 10.0) for pose in poses)
        return {"hold_deg": rest, "hold_poses_deg": worst}

    def _held(self, vector: Floats, seconds: float) -> float:
        times = np.arange(0.0, seconds, 0.1)
        goal = reachable(self.neck, times, np.tile(vector, (len(times), 1)))
        return float(follow(self.neck, goal).off_deg.max())

    def conversation(self) -> Figures:
        """Return how a conversation's motion is followed, with activations and speed."""
        self._sines((25.0, 12.0, 10.0), 0.2)  # compiles
        seconds = 5.0 if self.quick else 30.0
        begin = time.process_time()  # of one core, whoever else is on the machine
        motion = self._sines((25.0, 12.0, 10.0), seconds)
        taken = time.process_time() - begin
        a = motion.activations
        found = {"activation_min": a.min(), "activation_max": a.max(), "activation_mean": a.mean()}
        whole = seconds + MotionOptions().settle_s
        return {
            **_off("conversation", motion),
            **{name: float(value) for name, value in found.items()},
            "realtime": whole / taken,
        }

    def wide(self) -> Figures:
        """Return how a wide motion is followed."""
        return _off("wide", self._sines((40.0, 20.0, 15.0), 5.0 if self.quick else 30.0))

    def _sines(self, degrees: tuple[float, float, float], seconds: float) -> NeckMotion:
        turn, nod, tilt = np.radians(degrees)
        times = np.arange(0.0, seconds, 1.0 / FPS)
        rising = np.clip(times, 0.0, 1.0)
        ease = rising**3 * (10.0 - 15.0 * rising + 6.0 * rising**2)
        waves = np.sin(2.0 * np.pi * HZ * times[:, None] + PHASES)
        vectors = ease[:, None] * waves * (nod, turn, tilt)
        return follow(self.neck, reachable(self.neck, times, vectors))

    def push(self) -> Figures:
        """Return what a push does with reflexes, without, and with late ones."""
        off = ReflexOptions(strain=0.0, strain_rate=0.0)
        late = ReflexOptions(delay_s=0.025)
        without, with_, delayed = (self._pushed(each) for each in (off, ReflexOptions(), late))
        found = {
            "peak_deg": with_[0],
            "peak_without_deg": without[0],
            "peak_ratio": with_[0] / without[0],
            "settle_s": with_[1],
            "settle_delayed_s": delayed[1],
            "peak_delayed_deg": delayed[0],
        }
        return {"push": found, "delay_25ms_stable": bool(delayed[2] < 1.0)}

    def _pushed(self, reflex: ReflexOptions) -> tuple[float, float, float]:
        """Return the peak, the time from the push's begin until 1 degree, and the last second's."""
        times = np.arange(0.0, 4.0, 0.01)
        goal = reachable(self.neck, times, np.zeros((len(times), 3)))
        push = Push(1.0, 1.1, np.array([30.0, 0.0, 0.0]), self.neck.centres[-1] + BROW)
        off = follow(self.neck, goal, MotionOptions(reflex=reflex), pushes=[push]).off_deg
        far = np.flatnonzero(off > 1.0)
        return float(off.max()), float(times[far[-1]] + 0.01 - 1.0), float(off[-100:].max())

    def range(self) -> Figures:
        """Return how far the head goes beyond its range, by goals of 1.3 times it."""
        times = np.arange(0.0, 3.0 if self.quick else 12.0, 1.0 / FPS)
        waves = np.sin(np.outer(times, [2.0, 1.7, 1.1]) + PHASES)
        goal = reachable(self.neck, times, 1.3 * self.neck.head_range * waves)
        motion = follow(self.neck, goal)
        heads = [motion.pose(frame).head for frame in range(len(times))]
        beyond = [within(self.neck, Rotation.from_matrix(head).as_rotvec())[1] for head in heads]
        return {"beyond_range_deg": float(np.degrees(max(beyond)))}

    def skin(self) -> Figures:
        """Return the figures of the skin of the built-in person's neck."""
        plain = vars(subjects.builtin_options())
        given = argparse.Namespace(**plain, quick=self.quick, model=None, before=None)
        (figures,) = neck_skin.run(given)["people"].values()
        return {
            name: value for name, value in figures.items() if not isinstance(value, dict | list)
        }

    def head(self, file: Path, fps: float | None = None) -> Figures:
        """Return how the head of a recording is followed, over the frames within range."""
        take = read_openface(file, Recording(asset=file.name, fps=fps))
        vectors = np.where(take.seen[:, None], take.head, np.nan)
        begin = time.process_time()
        goal = reachable(self.neck, take.times, vectors)
        motion = follow(self.neck, goal)
        taken = time.process_time() - begin
        told = [each.as_dict() for each in goal.notices]
        seconds = float(take.times[-1])
        greatest = float(np.degrees(np.linalg.norm(goal.vectors, axis=1).max()))
        more = {"seconds": seconds, "greatest_deg": greatest, "realtime": seconds / taken}
        return {**motion.figures, **more, "notices": told}


def _off(name: str, motion: NeckMotion) -> Figures:
    figures = motion.figures
    return {f"{name}_{key}": figures[key] for key in ("rms_deg", "max_deg")}


def _relative(exact: Floats, moved: Floats) -> float:
    return float(np.abs(exact - moved).max() / max(float(np.abs(moved).max()), 1e-12))


def length_vs_opensim(file: Path, body: Body) -> float | None:
    """Return the greatest difference of muscles' lengths in mm; None without OpenSim."""
    try:
        import opensim
    except ImportError:
        return None
    opensim.Logger.setLevelString("off")
    model = opensim.Model(str(file))
    state = model.initSystem()
    random = np.random.default_rng(SEED)
    worst = 0.0
    bodies = _named_bodies(model)
    neck = body.neck
    for _ in range(POSES):
        for number in range(model.getCoordinateSet().getSize()):
            coordinate = model.getCoordinateSet().get(number)
            if coordinate.getMotionType() != 2:  # it turns
                coordinate.setValue(state, random.uniform(-0.2, 0.2), False)
        model.realizePosition(state)
        rotations = [TO_OURS @ _rotation(each, state) @ TO_OURS.T for each in bodies]
        seen = np.array([rotations[0].T @ each for each in rotations[1:]])
        body.set_pose(NeckPose(neck.centres, seen, np.zeros((JOINTS + 1, 3))).turns)
        for muscle, length in zip(neck.muscles, body.lengths, strict=True):
            theirs = opensim.Muscle.safeDownCast(model.getMuscles().get(muscle.name))
            worst = max(worst, abs(theirs.getLength(state) - float(length)) * 1e3)
    return worst


def _named_bodies(model: Any) -> list[Any]:
    """Return the torso's and the neck's bodies, from the skull down by the joints, bottom first."""
    parents = {}
    for number in range(model.getJointSet().getSize()):
        joint = model.getJointSet().get(number)
        ends = (joint.getParentFrame(), joint.getChildFrame())
        below, above = (end.findBaseFrame().getName() for end in ends)
        if joint.numCoordinates():
            parents[above] = below
    names = ["skull"]
    while len(names) <= JOINTS:
        names.append(parents[names[-1]])
    return [model.getBodySet().get(name) for name in reversed(names)]


def _rotation(body: Any, state: Any) -> Floats:
    R = body.getTransformInGround(state).R()
    return np.array([[R.get(i, j) for j in range(3)] for i in range(3)])


def section(figures: Figures) -> Section:
    """Return the section of docs/science/benchmarks.md."""
    flat = {
        **{name: value for name, value in figures.items() if isinstance(value, int | float)},
        **{f"push {name}": value for name, value in figures.get("push", {}).items()},
        **{f"head {name}": figures.get("head", {}).get(name) for name in ("rms_deg", "max_deg")},
    }
    rows = [[name.replace("_", " "), value] for name, value in flat.items()]
    return Section(
        title="Neck",
        compared=f"The neck '{figures['neck']}': its mechanics beside OpenSim's and finite "
        "differences, and how its muscles hold and turn the head.",
        parts=[Table(["figure", "value"], rows)],
    )


if __name__ == "__main__":
    main()
