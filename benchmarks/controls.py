"""Learned controls against exact solves of mixtures that they have not seen.

Mixtures are drawn by another seed than the pairs', fitted exactly, each from the neutral face, and
their skin is compared with that of the learned activations, simulated without contact; beside it
are the blend of the shapes alone and the published network (four layers of 100 ReLU, 17 action
units, pairs on six rays), and that network on the pairs that controls learn from. The parts, of
which ``--parts`` names some: ``au``: action units, both sides alike; ``shapes``: a few shapes, left
and right apart; ``dense``: six shapes or more; ``single``: each shape alone at four levels; and
``speed``. Rig and pairs are made unless ``--rig`` and ``--pairs`` are there; else they are left in
them, for the pieces of a run to share. ``played_mm`` counts frames in doubt, which an animation
fits exactly, as 0.
"""

from __future__ import annotations

import argparse
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks import report, subject_fits, subjects
from benchmarks.documents import Figures, Section, Table
from benchmarks.played_person import exact_fit
from benchmarks.subjects import EDGE_MM
from solver.animation.blendshapes import driven_motions
from solver.animation.controls import Controls
from solver.animation.controls.doubt import discrimination
from solver.animation.controls.learn import LearnOptions, blend_of, learn
from solver.animation.controls.maps import PUBLISHED, Network, NetworkOptions, ShapeSizes
from solver.animation.controls.metric import changes_of
from solver.animation.controls.mixtures import LEVELS, Mixtures
from solver.animation.controls.pairs import Pairs, Walks, solve_pairs
from solver.errors import SolveError
from solver.fitting.face import Face, Pose, PosedFace
from solver.mechanics.flesh import IDENTITY
from solver.scans.openface import UNITS
from solver.surface import Floats

PARTS = ("au", "shapes", "dense", "single", "speed")
COUNT = {"au": 100, "shapes": 100, "dense": 30}
SEED = 7919  # of the mixtures that nothing was learned from
QUICK = 2  # mixtures of a part
# action units of the six emotions, as EMFACS has them, of those that have an intensity
EMOTIONS = ((6, 12), (1, 4, 15), (1, 2, 5, 26), (1, 2, 4, 5, 7, 20, 26), (4, 5, 7, 23), (9, 15, 17))
log = logging.getLogger(__name__)


def main() -> None:
    """Run from the command line."""
    parser = report.parser(__doc__ or "")
    subjects.add_options(parser)
    subjects.add_controls(parser)
    parser.add_argument("--edge-mm", type=float, default=EDGE_MM, help="of the tets")
    parser.add_argument("--rig", type=Path, help="rig.npz: read if there, else left in it")
    parser.add_argument("--pairs", type=Path, help="control_pairs.npz, likewise")
    parser.add_argument("--count", type=int, default=6000, help="of the pairs")
    report.add_list(parser, "--parts", PARTS)
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    report.finish(run(options), options, section)


def run(options: argparse.Namespace) -> Figures:
    """Return the figures of the chosen subject."""
    bench = _Bench(options)
    parts = {part: getattr(bench, part)() for part in options.parts}
    return {**bench.told(), "parts": parts}


@dataclass(frozen=True)
class _Mixed:
    """A mixture, its exact fit and the skin (k, 3) of the face in it."""

    weights: Floats
    state: PosedFace
    points: Floats


class _Bench:
    def __init__(self, options: argparse.Namespace) -> None:
        self.options = options
        self.face: Face = subject_fits.face_of_rig(options, options.rig)
        self.motions = driven_motions(self.face.model, subjects.shapes(options))
        self.mixtures = Mixtures(tuple(self.motions))
        if options.quick:
            few = replace(self.mixtures.options, stops=80)
            self.mixtures = replace(self.mixtures, options=few)
        self.walks = Walks(self.face, self.mixtures, np.array([*self.motions.values()]))
        begin = time.perf_counter()
        self.pairs = self._pairs()
        self.seconds = time.perf_counter() - begin
        sizes = ShapeSizes.of(self.walks.motions)
        learning = LearnOptions()
        if options.quick:
            learning = replace(learning, network=replace(learning.network, epochs=5))
        self.learned = learn(self.face, self.pairs, sizes, options=learning)
        self.controls: Controls = self.learned.controls
        self.blend = blend_of(self.pairs)

    def _pairs(self) -> Pairs:
        path = self.options.pairs
        count = 500 if self.options.quick else self.options.count
        if path and path.is_file():
            return Pairs.load(path, self.face, self.mixtures.names)

        def keep(pairs: Pairs) -> None:
            log.info("%d pairs", len(pairs))
            if path:
                pairs.save(path, self.face)

        return solve_pairs(self.walks, count, keep=keep)

    def told(self) -> Figures:
        """Return what was learned from; the seconds of pairs that were read are not known."""
        read = self.seconds < 1.0
        figures = dict(self.controls.figures)
        return {"pairs_seconds": None if read else round(self.seconds, 1), **figures}

    def au(self) -> Figures:
        """Return the figures of mixtures of action units."""
        random = np.random.default_rng((SEED, 1))
        units = [self.mixtures.draw_units(random, 2) for _ in self._many("au")]
        return self._compare([self.mixtures.of_units(each) for each in units], units)

    def shapes(self) -> Figures:
        """Return the figures of a few shapes, left and right apart."""
        given = replace(self.mixtures.options, units=0.0, dense=0.0, rest=0.0, alike=0.2)
        return self._compare(self._draw(given, 2, "shapes"))

    def dense(self) -> Figures:
        """Return the figures of six shapes or more."""
        given = replace(self.mixtures.options, units=0.0, dense=1.0, rest=0.0)
        return self._compare(self._draw(given, 3, "dense"))

    def single(self) -> Figures:
        """Return the figures of each shape alone, and the greatest mean of a shape."""
        alone = self.mixtures.alone()
        chosen = alone[: QUICK * len(LEVELS)] if self.options.quick else alone
        figures = self._compare(chosen)
        means = np.reshape(figures.pop("each_mm"), (-1, len(LEVELS))).mean(axis=1)
        worst = int(np.argmax(means))
        named = {"worst_mm": round(float(means[worst]), 4), "worst": self.mixtures.names[worst]}
        return {**figures, **named}

    def speed(self) -> Figures:
        """Return frames a second, one at a time."""
        frames = self.pairs.rows.weights[:: max(len(self.pairs) // 500, 1)]

        def rate(ask: Any) -> float:
            begin = time.perf_counter()
            for weights in frames:
                ask(weights)
            return round(len(frames) / (time.perf_counter() - begin), 1)

        rate(self.controls.changes)
        rates = {"activations": self.controls.changes, "skins": self.controls.skin}
        count = len(self.face.model.skin.vertices)
        return {**{f"{name}_per_s": rate(ask) for name, ask in rates.items()}, "vertices": count}

    def _many(self, part: str) -> range:
        return range(QUICK if self.options.quick else COUNT[part])

    def _draw(self, given: Any, seed: int, part: str) -> list[Floats]:
        random = np.random.default_rng((SEED, seed))
        mixtures = replace(self.mixtures, options=given)
        return [mixtures.draw(random) for _ in self._many(part)]

    @cached_property
    def published(self) -> Network:
        """The published network of action units, on its pairs: six rays, and the jaw by itself."""
        random = np.random.default_rng(0)
        table = np.zeros((len(EMOTIONS), len(UNITS)))
        for row, units in enumerate(EMOTIONS):
            table[row, [UNITS.index(unit) for unit in units]] = 1.0
        jaw = UNITS.index(26)
        alone = np.eye(len(UNITS))[jaw]
        still = table.copy()
        still[:, jaw] = 0.0
        made = np.array(
            [self._changes(self.exact(self.mixtures.of_units(units)).state) for units in still]
        )
        opened = self._changes(self.exact(self.mixtures.of_units(alone)).state)
        rows = np.repeat(np.arange(len(EMOTIONS)), self.options.count // len(EMOTIONS))
        strength, open_ = random.random((2, len(rows), 1))
        units = strength * still[rows] + open_ * alone
        # printed pairs have hand-set muscles on each ray; here they are the emotion's exact solve
        goals = strength * np.array(made)[rows] + open_ * opened
        even = ShapeSizes(np.ones(len(UNITS)), np.eye(len(UNITS)))
        return Network.learn(units, goals, even, 0, self._epochs(PUBLISHED))

    @cached_property
    def published_here(self) -> Network:
        """The published network's layers and loss, on the pairs that controls learn from."""
        rows = self.pairs.rows
        even = ShapeSizes(np.ones(rows.weights.shape[1]), np.eye(rows.weights.shape[1]))
        return Network.learn(rows.weights, rows.changes, even, 0, self._epochs(PUBLISHED))

    def _epochs(self, options: NetworkOptions) -> NetworkOptions:
        return replace(options, epochs=2) if self.options.quick else options

    def exact(self, weights: Floats) -> _Mixed:
        """Return the exact fit of a mixture, from the neutral face."""
        state = exact_fit(self.face, self.walks.motions, weights)
        return _Mixed(weights, state, self.face.face_points(state.x))

    def _changes(self, state: PosedFace) -> Floats:
        jaw = self.face.five_jaw_numbers(state.pose.b)
        return changes_of(state.pose.a, jaw)

    def simulated(self, mixed: _Mixed, changes: Floats) -> tuple[Floats, int]:
        """Return the points (k, 3) of the face by changes of its controls, and inverted tets."""
        face = self.face
        a = IDENTITY + changes[:-5].reshape(-1, 6)
        state = face.continuation(mixed.state, face.pose_of(a, changes[-5:]))
        return face.face_points(state.x), face.flesh.count_inverted(state.x)

    def _compare(self, mixtures: list[Floats], units: list[Floats] | None = None) -> Figures:
        makers: dict[str, Callable[[Floats], NDArray[np.floating]]] = {
            "learned": self.controls.changes,
            "blend": lambda weights: _vector(self.blend.pose(weights)),
            "published_here": self.published_here,
        }
        errors: dict[str, list[Floats]] = {name: [] for name in (*makers, "published")}
        doubts = []
        inverted = 0
        failed = 0
        nan = 0
        for number, weights in enumerate(mixtures):
            mixed = self.exact(weights)
            asked = {name: make(weights) for name, make in makers.items()}
            if units is not None:
                asked["published"] = self.published(units[number])
            doubts.append(float(self.controls.doubt_mm(weights)))
            for name, changes in asked.items():
                nan += int(not np.isfinite(changes).all())
                try:
                    points, folded = self.simulated(mixed, np.asarray(changes, float))
                except SolveError:
                    failed += 1
                    continue
                inverted += folded
                errors[name].append(np.linalg.norm(points - mixed.points, axis=1))
            log.info("%d of %d: %.3f mm", number + 1, len(mixtures), errors["learned"][-1].mean())
        figures: Figures = {"mixtures": len(mixtures), "failed": failed, "nan": nan}
        figures["inverted"] = inverted
        for name, found in errors.items():
            if found:
                figures[f"{name}_mm"] = round(float(np.mean(found)), 4)
                p95 = np.mean([np.percentile(each, 95.0) for each in found])
                figures[f"{name}_p95_mm"] = round(float(p95), 4)
        off = np.array([each.mean() for each in errors["learned"]])
        for name in ("blend", "published", "published_here"):
            if errors[name]:
                ratio = figures[f"{name}_mm"] / figures["learned_mm"]
                figures[f"{name}_over_learned"] = round(ratio, 2)
        limit = LearnOptions().exact_above_mm
        judged = np.array(doubts)
        figures["played_mm"] = round(float(np.where(judged > limit, 0.0, off).mean()), 4)
        figures["doubt_auroc"] = discrimination(judged, off > LearnOptions().doubtful_mm)
        figures["doubt_missed"] = round(float(np.mean((off > limit) & (judged <= limit))), 4)
        figures["doubtful"] = round(float(np.mean(judged > limit)), 4)
        figures["each_mm"] = off.round(4).tolist()
        return figures


def _vector(pose: Pose) -> Floats:
    return changes_of(pose.a, pose.b)


def section(figures: Figures) -> Section:
    """Return the section of docs/science/benchmarks.md."""
    parts: dict[str, Figures] = figures["parts"]
    keys = ("mixtures", "learned_mm", "learned_p95_mm", "blend_mm", "blend_over_learned")
    more = ("published_here_mm", "doubtful", "played_mm", "doubt_missed", "inverted")
    rows = [
        [part, *(found[key] for key in (*keys, *more))]
        for part, found in parts.items()
        if part != "speed"
    ]
    heads = ["mixtures of", "number", "learned, mm", "95 %", "blended, mm", "blended by learned"]
    heads += ["published network, same pairs, mm", "in doubt"]
    heads += ["with these exact, mm", "missed", "inverted"]
    seconds = figures["pairs_seconds"]
    told = f"{figures['pairs']} pairs" + ("" if seconds is None else f" in {seconds:.0f} s")
    return Section(
        title="Learned controls",
        compared="The skin by learned activations, simulated, against exact solves of mixtures "
        f"that were not learned from; {told}, learned in {figures['learn_seconds']:.0f} s.",
        parts=[Table(heads, rows)] if rows else [],
    )


if __name__ == "__main__":
    main()
