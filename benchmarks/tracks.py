"""Muscle tracks: how near flesh comes to plain shapes, what it keeps of the lips, and how fast.

`shapes` goes from rest to every shape at weight 1. `recording` plays frames of a recording, each
from the one before. `lips` are the volumes of the tets within 5 mm of the lips' skin; those of
the morph are what plain shapes do to flesh. A frame's target is the sum of its shapes on the skin.
`derivatives` compares dx/dq with central differences of states, of flesh alone and of pressed lips;
where JAX is installed, JAX checks the gradients of the face as its own function.
"""

from __future__ import annotations

import argparse
import logging
import time
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from benchmarks import report, subjects
from benchmarks.documents import Figures, Section, Table
from benchmarks.subjects import COARSE_EDGE_MM, EDGE_MM
from solver.anatomy.template import CORRECTED
from solver.animation import shape_weights
from solver.contact import Gauge
from solver.contact.barrier import Barrier
from solver.errors import SolveError
from solver.mechanics.boundary import JAW_FREEDOM, Potential
from solver.mechanics.linear import fastest
from solver.mechanics.newton import Energy
from solver.model import SubjectModel
from solver.rig.report.systems import LipFlesh
from solver.scans.live_link import read_live_link
from solver.surface import Floats
from solver.tracks.autodiff import Mode, jax_function
from solver.tracks.basis import MuscleTracks, TrackOptions
from solver.tracks.face import TrackFace, track_potentials
from solver.tracks.response import TrackResponse, TrackState
from solver.tracks.shapes import template_shapes

PARTS = ("shapes", "recording", "derivatives")
FRAMES = 300
QUICK_FRAMES = 4
QUICK_SHAPES = 4
# weights of pressed lips; how far differences move the skin, for contact is stiff; and the steps,
# over that, whose distances from the linear prediction tell its order: with 20 pairs come and go
PRESSED = {"mouthPressLeft": 1.0, "mouthPressRight": 1.0, "mouthShrugLower": 0.9, "jawLeft": 0.1}
FREE_MM = 2e-3
TOUCHING_MM = 2e-4
TAYLOR = (5.0, 2.5)
# what JAX's own check, of another random direction, may be off: of the largest column, by contact
JAX_FREE = 1e-5
JAX_TOUCHING = 1e-4
TIMED = 7  # runs of what is timed
MOVES_MM = 0.05
"""Controls that move the skin by less, at most, are compared with nothing."""
LIP_MM = 5.0
"""Distance from the lips' skin within which flesh counts as lip."""

log = logging.getLogger(__name__)


def main() -> None:
    """Run from the command line."""
    parser = report.parser(__doc__ or "")
    subjects.add_folders(parser)
    subjects.default_to_data(parser)
    parser.set_defaults(faces=None, anatomy=None)
    parser.add_argument("--subjects", default="A", help="of --faces, joined by commas")
    parser.add_argument("--recording", type=Path, help="a CSV file of Live Link Face")
    parser.add_argument("--start", type=int, default=0, help="first frame of the recording")
    parser.add_argument("--every", type=int, default=1, help="play one of so many frames")
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--length-mm", type=float, default=TrackOptions.length_mm)
    parser.add_argument("--law", default=TrackOptions.law)
    report.add_list(parser, "--parts", PARTS)
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    report.finish(run(options), options, section)


def run(options: argparse.Namespace) -> Figures:
    """Return the figures of every subject."""
    names = options.subjects.split(",")[: 1 if options.quick else None]
    edge_mm = COARSE_EDGE_MM if options.quick else EDGE_MM
    people = {}
    for subject in subjects.each(options, names, edge_mm):
        person = _Person(subject.model, options)
        figures = person.figures()
        if "shapes" in options.parts:
            figures["shapes_at_one"] = person.at_one()
        if "recording" in options.parts and options.recording is not None:
            figures["recording"] = person.recorded()
        if "derivatives" in options.parts:
            figures["derivatives"] = person.derivatives()
        people[subject.name] = figures
        log.info("%s: %s", subject.name, figures)
    return {"length_mm": options.length_mm, "law": options.law, "subjects": people}


@dataclass
class _Frame:
    """A state of the flesh against what was asked for."""

    off: Floats  # (k,) mm of the face's points to the plain shapes
    moved: Floats  # (k,) mm of these
    off_target: Floats  # (k,) mm to the tracks' own target, which turns shapes with the jaw
    lips: float  # change of the lips' volume
    morph_lips: float
    penetration: float
    inverted: int
    seconds: float  # of this process


class _Person:
    """One subject's tracks, face and measures."""

    def __init__(self, model: SubjectModel, options: argparse.Namespace) -> None:
        self._model = model
        self._options = options
        self._shapes = template_shapes(model, subjects.shapes(options))
        begun = time.perf_counter()
        given = TrackOptions(length_mm=options.length_mm, law=options.law)
        self._tracks = MuscleTracks.of(model, self._shapes, given)
        self._precompute = time.perf_counter() - begun
        potentials = track_potentials(model)
        self._face = TrackFace(model, self._tracks, potentials, linear=fastest())
        self._rest = self._face.rest()
        self._start = time.perf_counter() - begun
        self._gauge = Gauge(model, potentials=potentials)
        lips = LipFlesh.of(model, LIP_MM)
        assert lips is not None, "models of benchmarks have lips"
        self._lips = lips
        self._motions = np.array([motion[model.face] for motion in self._shapes.values()])

    def figures(self) -> Figures:
        """Return what is known before anything moves."""
        tracks = self._tracks
        return {
            "vertices": len(self._model.rest),
            "tets": len(self._model.tets),
            "shapes": len(tracks.names),
            "superposition_error": self._superposition(),
            "teeth_residual_mm": float(tracks.teeth_mm.max()),
            "notices": list(tracks.notices),
        }

    def _superposition(self) -> float:
        """Return how far the morph of a random sum is off the sum of morphs, relative."""
        random = np.random.default_rng(1)
        without_jaw = np.flatnonzero(np.abs(self._tracks.jaw).max(axis=1) == 0.0)
        names = [self._tracks.names[number] for number in without_jaw]
        names = [name for name in names if name not in CORRECTED]
        weights = random.random(len(names))
        weights /= weights.sum()  # teeth that are still in each shape are still in the sum
        added = sum(w * self._shapes[name] for w, name in zip(weights, names, strict=True))
        whole = MuscleTracks.of(self._model, {"sum": np.asarray(added)}).morphs[0]
        rows = [self._tracks.names.index(name) for name in names]
        parts = np.tensordot(weights, self._tracks.morphs[rows], 1)
        return float(np.abs(whole - parts).max() / np.abs(whole).max())

    def at_one(self) -> Figures:
        """Go from rest to every shape; a corrective goes together with what it corrects."""
        names = list(self._tracks.names)[: QUICK_SHAPES if self._options.quick else None]
        found = []
        failed = []
        for name in names:
            weights = {name: 1.0} | ({CORRECTED[name]: 1.0} if name in CORRECTED else {})
            try:
                frame, _ = self._go(self._rest, self._tracks.controls(weights))
            except SolveError as error:
                failed.append(f"{name}: {error}")
                continue
            found.append(frame)
            log.info("%s: %.3f mm, lips %.2f %%", name, frame.off.mean(), 1e2 * frame.lips)
        times = {"precompute_s": self._precompute, "start_s": self._start}
        return {**_summary(found), **times, "failed": failed}

    def recorded(self) -> Figures:
        """Play frames of a recording."""
        take = read_live_link(self._options.recording)
        weights = shape_weights(take, self._tracks.names)
        jaw = np.zeros(JAW_FREEDOM)
        found = []
        failed = []
        state = self._rest
        for number in self._numbers(len(weights)):
            q = np.concatenate([weights[number], jaw])
            try:
                frame, state = self._go(state, q)
            except SolveError as error:
                failed.append(f"frame {number}: {error}")
                continue
            found.append(frame)
        return {**_summary(found), "failed": failed}

    def derivatives(self) -> Figures:
        """Compare derivatives with differences, with contact and without."""
        weights = {name: w for name, w in PRESSED.items() if name in self._tracks.names}
        q = self._tracks.controls(weights)
        potentials = track_potentials(self._model)
        return {"free": self._derivatives(q, []), "contact": self._derivatives(q, potentials)}

    def _derivatives(self, q: Floats, potentials: list[Potential]) -> Figures:
        face = TrackFace(self._model, self._tracks, potentials, tolerance=1e-12, settled_mm=0.0)
        state = face.move(face.move(face.rest(), q), q)  # the second settles what is left
        response = TrackResponse(face, state)
        timed = _times(face, state)
        columns = response.skin_columns()
        count = len(q) if not self._options.quick else QUICK_SHAPES
        asked = np.linspace(0, len(q) - 1, count).round().astype(int)
        step_mm = TOUCHING_MM if potentials else FREE_MM
        errors = [_error(face, state, int(number), columns, step_mm) for number in asked]
        random = np.random.default_rng(3)
        way = random.standard_normal(len(q)) * (np.arange(len(q)) < len(self._tracks.names))
        gradient = random.standard_normal(columns.shape[:2])
        moved = response.skin_product(way)
        pulled = response.skin_adjoint(gradient)
        norms = np.linalg.norm(gradient) * np.linalg.norm(moved)
        found: Figures = {
            "error": max((each for each in errors if each is not None), default=None),
            "controls": sum(each is not None for each in errors),
            "minimum": response.minimum,
            "contacts": sum(each.contacts(state.x) for each in potentials if _is_barrier(each)),
            "taylor_order": _taylor_order(face, state, response, way, step_mm),
            "adjoint_gap": float(abs((gradient * moved).sum() - pulled @ way) / norms),
            **timed,
        }
        if find_spec("jax") is not None:
            allowed = JAX_TOUCHING if potentials else JAX_FREE
            found["jax_check"] = _jax_agrees(face, state, columns, step_mm, allowed)
        if potentials:
            face.potentials = [_Projected(each) for each in potentials]
            rough = TrackResponse(face, state).skin_columns()
            size, off = (np.abs(each).max(axis=(0, 1)) for each in (columns, rough - columns))
            moving = asked[size[asked] > MOVES_MM]
            found["by_projected"] = float((off[moving] / size[moving]).max())
        log.info("derivatives: %s", found)
        return found

    def _numbers(self, count: int) -> Iterator[int]:
        frames = QUICK_FRAMES if self._options.quick else self._options.frames
        numbers = range(self._options.start, count, self._options.every)[:frames]
        yield from numbers

    def _go(self, state: TrackState, q: Floats) -> tuple[_Frame, TrackState]:
        model = self._model
        begun = time.process_time()
        now = self._face.move(state, q)
        seconds = time.process_time() - begun
        wanted = np.tensordot(q[: len(self._motions)], self._motions, 1)
        skin = self._face.skin(now)[model.face] - model.skin.vertices[model.face]
        frame = _Frame(
            np.linalg.norm(skin - wanted, axis=1),
            np.linalg.norm(wanted, axis=1),
            np.linalg.norm(self._face.face.face_embedding @ (now.x - now.pose.target), axis=1),
            self._lips.change(now.x),
            self._lips.change(now.pose.target),
            self._gauge.at(now.x, now.drive.jaw).most,
            now.inverted,
            seconds,
        )
        return frame, now


class _Projected:
    """A potential whose exact second derivative is the projected one that Newton factorises."""

    def __init__(self, potential: Potential) -> None:
        self._potential = potential

    def __getattr__(self, name: str) -> Any:
        return getattr(self._potential, "hessian" if name == "curvature" else name)


def _is_barrier(potential: Potential) -> TypeGuard[Barrier]:
    return isinstance(potential, Barrier)


def _error(
    face: TrackFace, state: TrackState, number: int, columns: Floats, step_mm: float
) -> float | None:
    """Return how far a column is off central differences, relative; None if no skin moves."""
    column = columns[:, :, number]
    size = float(np.abs(column).max())
    if size < MOVES_MM:
        return None
    step = step_mm / size
    change = step * np.eye(len(state.q))[number]
    ahead, behind = (face.skin(face.move(state, state.q + sign * change)) for sign in (1, -1))
    return float(np.abs(column - (ahead - behind) / (2.0 * step)).max() / size)


def _taylor_order(
    face: TrackFace, state: TrackState, response: TrackResponse, way: Floats, step_mm: float
) -> float:
    """Return by which power of its length a step leaves the linear prediction."""
    rate = response.product(way)
    lengths = np.array(TAYLOR) * step_mm / np.abs(rate).max()
    off = [
        np.linalg.norm(face.move(state, state.q + length * way).x - state.x - length * rate)
        for length in lengths
    ]
    return float(np.log2(off[0] / off[1]) / np.log2(lengths[0] / lengths[1]))


def _jax_agrees(
    face: TrackFace, state: TrackState, columns: Floats, step_mm: float, allowed: float
) -> bool:
    """Tell whether JAX finds the derivatives of both modes where its own differences do."""
    import jax
    from jax.test_util import check_grads

    jax.config.update("jax_enable_x64", True)
    size = float(np.abs(columns).max())
    within = {"eps": step_mm / size, "rtol": allowed, "atol": allowed * size}
    try:
        for checked in ("rev", "fwd"):
            mode: Mode = "reverse" if checked == "rev" else "forward"
            function = jax_function(face, mode, start=state)
            check_grads(function, (jax.numpy.array(state.q),), 1, modes=[checked], **within)
    except AssertionError as error:
        log.warning("JAX finds other derivatives: %s", error)
        return False
    return True


def _times(face: TrackFace, state: TrackState) -> Figures:
    """Return processor's times of all columns and of a Newton step, ms, and their ratio.

    They are medians over some runs, which alternate.
    """
    # patterns are analysed before, as they are in frames that follow one another
    TrackResponse(face, state)
    energy = Energy(face.face.flesh, face.exact_solver, state.drive.A, face.potentials)
    energy.factorization(state.x, 0).solve(energy.gradient(state.x))
    newton = []
    columns = []
    for _ in range(TIMED):
        begun = time.process_time()
        energy.factorization(state.x, 0).solve(energy.gradient(state.x))
        newton.append(time.process_time() - begun)
        begun = time.process_time()
        TrackResponse(face, state).columns()
        columns.append(time.process_time() - begun)
    return {
        "newton_ms": 1e3 * float(np.median(newton)),
        "columns_ms": 1e3 * float(np.median(columns)),
        "jacobian_over_newton": float(np.median(columns) / np.median(newton)),
    }


def _summary(frames: list[_Frame]) -> dict[str, Any]:
    """Return the figures of frames: distances in mm, the worst changes in percent, times in ms."""
    if not frames:
        return {"frames": 0}
    moving = [frame.off[frame.moved > 1.0] for frame in frames]
    milliseconds = 1e3 * np.array([frame.seconds for frame in frames])
    return {
        "frames": len(frames),
        "off_mean_mm": float(np.mean([frame.off.mean() for frame in frames])),
        "off_moving_mm": float(np.concatenate(moving).mean()) if any(map(len, moving)) else None,
        "off_target_mean_mm": float(np.mean([frame.off_target.mean() for frame in frames])),
        "moved_mean_mm": float(np.mean([frame.moved.mean() for frame in frames])),
        "lip_volume_worst_percent": 1e2 * max(abs(frame.lips) for frame in frames),
        "morph_lip_volume_worst_percent": 1e2 * max(abs(frame.morph_lips) for frame in frames),
        "penetration_mm": max(frame.penetration for frame in frames),
        "inverted": max(frame.inverted for frame in frames),
        "frame_ms": float(np.median(milliseconds)),
        "frame_p95_ms": float(np.quantile(milliseconds, 0.95)),
    }


COLUMNS = {
    "frames": "moments",
    "off_mean_mm": "off, mm",
    "off_moving_mm": "off where it moves > 1 mm",
    "off_target_mean_mm": "off the tracks' own target, mm",
    "moved_mean_mm": "asked for, mm",
    "lip_volume_worst_percent": "lips, worst, %",
    "morph_lip_volume_worst_percent": "lips of plain shapes, worst, %",
    "penetration_mm": "penetration, mm",
    "inverted": "inverted tets",
    "frame_ms": "processor, median, ms",
    "frame_p95_ms": "p95, ms",
}


DERIVATIVES = {
    "controls": "controls",
    "error": "off differences, relative",
    "by_projected": "by the projected Hessian",
    "contacts": "pairs that touch",
    "minimum": "minimum",
    "taylor_order": "order of a step",
    "adjoint_gap": "adjoint off",
    "jax_check": "JAX's check",
    "columns_ms": "all columns, ms",
    "jacobian_over_newton": "over a Newton step",
}


def section(figures: Figures) -> Section:
    """Return the section of docs/science/benchmarks.md."""
    people: dict[str, Figures] = figures["subjects"]
    known = {
        "tets": "tets",
        "shapes": "shapes",
        "superposition_error": "sum of morphs off",
        "teeth_residual_mm": "teeth, mm",
    }
    times = {"precompute_s": "tracks, s", "start_s": "with the face at rest, s"}
    rows = [
        [name, *(each[key] for key in known)]
        + [each.get("shapes_at_one", {}).get(key) for key in times]
        for name, each in people.items()
    ]
    parts: list[Table] = [Table(["subject", *known.values(), *times.values()], rows)]
    captions = {"shapes_at_one": "Every shape at weight 1, from rest:", "recording": "A recording:"}
    for part, caption in captions.items():
        rows = [
            [name, *(each[part].get(key) for key in COLUMNS), len(each[part]["failed"])]
            for name, each in people.items()
            if part in each
        ]
        if rows:
            parts.append(Table(["subject", *COLUMNS.values(), "no rest"], rows, caption))
    rows = [
        [name, of, *(each["derivatives"][of].get(key) for key in DERIVATIVES)]
        for name, each in people.items()
        if "derivatives" in each
        for of in ("free", "contact")
    ]
    if rows:
        header = ["subject", "contact", *DERIVATIVES.values()]
        parts.append(Table(header, rows, "dx/dq, the worst control that moves skin:"))
    return Section(
        title="Muscle tracks",
        compared=(
            f"Flesh under muscle tracks (l = {figures['length_mm']:g} mm, {figures['law']}) "
            "against the plain shapes on the skin: distances over the whole face; `lips` is the "
            f"change of volume within {LIP_MM:g} mm of the lips, that of plain shapes by the "
            "morphs they induce. Times are those of one thread, contact included."
        ),
        parts=parts,
    )


if __name__ == "__main__":
    main()
