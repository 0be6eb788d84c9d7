"""Learning controls from pairs, and how well they know mixtures that they were not learned from."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from solver.animation.blendshapes import Blend
from solver.animation.controls import Controls
from solver.animation.controls.doubt import Doubt, discrimination
from solver.animation.controls.maps import (
    PUBLISHED,
    Listen,
    Network,
    NetworkOptions,
    PolynomialMap,
    PolynomialOptions,
    ShapeSizes,
)
from solver.animation.controls.metric import Metric, changes_of
from solver.animation.controls.pairs import PairRows, Pairs
from solver.errors import SolveError
from solver.fitting.face import Face
from solver.mechanics.flesh import IDENTITY
from solver.surface import Floats

LEAST_PAIRS = 500  # to learn anything from


@dataclass(frozen=True)
class LearnOptions:
    """Options of learning: which maps, and from which part of the pairs.

    ``map`` names what is played; the polynomial and a network are both learned for any, as the
    doubt is that of both.
    """

    map: Literal["quadratic+network", "quadratic", "network", "published"] = "quadratic+network"
    modes: int = 128  # of muscles and jaw
    held_out: int = 6  # one walk of so many is not learned from at first, and judges the maps
    doubtful_mm: float = 0.2  # error that doubt should find
    exact_above_mm: float = 0.3  # doubt above which a frame is fitted exactly, as animate does it
    polynomial: PolynomialOptions = field(default_factory=PolynomialOptions)
    network: NetworkOptions = field(default_factory=NetworkOptions)

    @property
    def chosen_network(self) -> NetworkOptions:
        """The network's options: the published one's where that is to be played."""
        return PUBLISHED if self.map == "published" else self.network


@dataclass(frozen=True, eq=False)
class Learned:
    """Controls, and the pairs that they were judged by before they were learned from all."""

    controls: Controls
    unseen: PairRows
    off_mm: Floats  # (n,) of each of these, root mean squares over the face


def learn(
    face: Face,
    pairs: Pairs,
    sizes: ShapeSizes,
    seed: int = 0,
    options: LearnOptions = LearnOptions(),
    listen: Callable[[float], None] = lambda _done: None,
) -> Learned:
    """Learn the controls of a face from its pairs.

    Doubt and figures are those of maps that have not seen some of the walks; the maps that are
    kept are learned from all. Raises :class:`SolveError` (``controls.few``) for too few pairs.
    """
    if len(pairs) < LEAST_PAIRS:
        reason = f"{len(pairs)} pairs were solved in time, and controls need {LEAST_PAIRS}"
        raise SolveError("controls.few", reason, found=len(pairs), expected=LEAST_PAIRS)
    begin = time.perf_counter()
    rows = pairs.rows
    metric = Metric.of_face(face)
    main = metric.main_directions(rows.changes, options.modes)
    goals = np.hstack([main.coordinates, rows.skins, rows.off_mm[:, None]])
    numbers = np.unique(rows.walks)
    judging = np.isin(rows.walks, numbers[numbers > 0][:: options.held_out])

    def learn_maps(chosen: np.ndarray, listen: Listen) -> tuple[PolynomialMap, Network]:
        c = rows.weights[chosen]
        y = goals[chosen]
        polynomial = PolynomialMap.learn(c, y, sizes, options.polynomial)
        return polynomial, Network.learn(c, y, sizes, seed, options.chosen_network, listen)

    maps = learn_maps(~judging, lambda done: listen(0.5 * done))
    unseen = rows[judging]
    judged = _judge(maps, unseen, goals[judging], len(main.directions), options)
    blend = blend_of(pairs)
    whole = changes_of(blend.activations, blend.jaw)
    blended = np.linalg.norm((unseen.weights @ whole - unseen.changes) @ metric.root, axis=1)
    maps = learn_maps(np.ones(len(pairs), bool), lambda done: listen(0.5 + 0.5 * done))
    figures = {
        "pairs": len(pairs),
        "failed": pairs.failed,
        "shapes": len(pairs.names),
        "off_target_mm": _spread(rows.off_mm),
        "blended_mm": _spread(blended),
        **judged.figures,
        "learn_seconds": round(time.perf_counter() - begin, 1),
    }
    controls = Controls(
        pairs.names,
        face.model.muscle_names,
        face.drive,
        *maps,
        judged.share,
        main.directions,
        pairs.modes,
        judged.doubt,
        figures,
    )
    return Learned(controls, unseen, judged.off_mm)


@dataclass(frozen=True, eq=False)
class _Judged:
    """The polynomial's best share, and the doubt, of mixtures that maps have not seen."""

    share: float
    doubt: Doubt
    off_mm: Floats
    figures: dict[str, Any]


def _judge(
    maps: tuple[PolynomialMap, Network],
    unseen: PairRows,
    goals: Floats,
    directions: int,
    options: LearnOptions,
) -> _Judged:
    """Judge maps by ``goals`` (n, r), whose first ``directions`` are those of the controls."""
    ours = slice(directions)
    first, second = (each(unseen.weights).astype(float) for each in maps)
    if options.map == "quadratic+network":
        share = _best_share(first[:, ours], second[:, ours], goals[:, ours])
    else:
        share = float(options.map == "quadratic")
    between = second + share * (first - second)
    off = np.asarray(np.linalg.norm((between - goals)[:, ours], axis=1), float)
    told = np.asarray(np.linalg.norm((first - second)[:, ours], axis=1), float), between[:, -1]
    doubt = Doubt.calibrate(*told, off)
    figures = {"share": round(share, 3), "unseen_mm": _spread(off)}
    return _Judged(share, doubt, off, figures | _judge_doubt(doubt.of(*told), off, options))


def _best_share(first: Floats, second: Floats, goals: Floats) -> float:
    """Return the part of ``first`` in what lies between both and nearest to the ``goals``."""
    apart = first - second
    share = np.sum((goals - second) * apart) / max(float(np.sum(apart**2)), 1e-300)
    return float(np.clip(share, 0.0, 1.0))


def _spread(values: Floats) -> dict[str, float]:
    p95 = np.percentile(values, 95.0)
    figures = {"mean": values.mean(), "p95": p95, "max": values.max()}
    return {name: round(float(value), 4) for name, value in figures.items()}


def _judge_doubt(doubt: Floats, off: Floats, options: LearnOptions) -> dict[str, Any]:
    limit = options.exact_above_mm
    found = discrimination(doubt, off > options.doubtful_mm)
    return {
        "doubt_auroc": None if found is None else round(found, 4),
        "doubt_missed": round(float(np.mean((off > limit) & (doubt <= limit))), 4),
        "doubtful": round(float(np.mean(doubt > limit)), 4),
    }


def blend_of(pairs: Pairs) -> Blend:
    """Return the blend of the shapes that were solved alone, correctives on what they correct."""
    alone = pairs.rows[pairs.rows.walks == 0]
    whole = alone[alone.weights.max(axis=1) == 1.0]
    rows = np.asarray(np.linalg.lstsq(whole.weights, whole.changes, rcond=None)[0], float)
    return Blend(pairs.names, IDENTITY + rows[:, :-5].reshape(len(rows), -1, 6), rows[:, -5:])
