"""The plots of ``docs/science/benchmarks.md`` in one style; a solver has one colour in all.

Files are PNG or SVG by their suffix and the same for the same figures. Solvers known by name are
``A`` (activations with S), ``P`` (per tet), ``S`` (the muscle geometry) and ``IPOPT``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

STYLE: dict[Any, Any] = {
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e3e3e3",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "lines.linewidth": 1.6,
    "lines.markersize": 4.0,
    "figure.facecolor": "white",
    "savefig.dpi": 140,
    "svg.hashsalt": "myoface",
}
COLOURS = {"A": "#0072b2", "P": "#d55e00", "S": "#009e73", "IPOPT": "#7a7a7a"}
OTHERS = ("#cc79a7", "#e69f00", "#56b4e9", "#000000", "#b2a100", "#8a3ffc")
"""The palette of Okabe and Ito, which colour-blind readers can tell apart, and two more."""

WIDTH_IN = 7.2
HEIGHT_IN = 3.0


@dataclass(frozen=True)
class Curve:
    """The objective after every iteration, the start's first, and the seconds until then."""

    objective: Sequence[float]
    seconds: Sequence[float]


def convergence(path: Path, title: str, curves: Mapping[str, Curve]) -> None:
    """Plot how far each solver's objective is from its end, by iterations and by seconds.

    The last objective of a curve is its end, so that solvers of different problems share one axis;
    what the ends are belongs in a table. On its way IPOPT may be below, where it is not feasible.
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN), layout="constrained")
        by_iteration, by_seconds = figure.subplots(1, 2, sharey=True)
        for name, colour in _colours(curves).items():
            objective = np.asarray(curves[name].objective, dtype=float)
            away = np.abs(objective - objective[-1]) / abs(objective[-1])
            shown = np.flatnonzero(away)
            seconds = np.asarray(curves[name].seconds)[shown]
            by_iteration.plot(shown, away[shown], "o-", color=colour, label=name)
            by_seconds.plot(seconds, away[shown], "o-", color=colour, label=name)
        by_iteration.set(title=title, xlabel="iteration", yscale="log")
        by_iteration.set_ylabel("|f - f at the end| / f at the end")
        by_seconds.set(xlabel="seconds", xscale="log")
        by_seconds.legend()
        save(figure, path)


def descent(path: Path, title: str, y_label: str, lines: Mapping[str, Sequence[float]]) -> None:
    """Plot values after every round, as the mean distance of each expression in mm; 0 first."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN), layout="constrained")
        axes = figure.subplots()
        for name, colour in _colours(lines).items():
            axes.plot(np.asarray(lines[name], dtype=float), "o-", color=colour, label=name)
        axes.set(title=title, xlabel="round", ylabel=y_label)
        axes.set_ylim(bottom=0.0)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        _legend_beside(axes)
        save(figure, path)


def scaling(
    path: Path, title: str, vertices: Sequence[int], seconds: Mapping[str, Sequence[float]]
) -> None:
    """Plot seconds against the mesh's vertices with least-squares lines through the logarithms."""
    sizes = np.asarray(vertices, dtype=float)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN), layout="constrained")
        axes = figure.subplots()
        for name, colour in _colours(seconds).items():
            times = np.asarray(seconds[name], dtype=float)
            slope, offset = power_law(vertices, seconds[name])
            axes.plot(sizes, times, "o", color=colour, label=f"{name}: exponent {slope:.2f}")
            axes.plot(sizes, np.exp(offset) * sizes**slope, "-", color=colour, linewidth=1.0)
        axes.set(title=title, xlabel="vertices", ylabel="seconds", xscale="log", yscale="log")
        axes.set_xticks(sizes, [f"{size:,.0f}" for size in sizes])
        axes.minorticks_off()
        _legend_beside(axes)
        save(figure, path)


def power_law(sizes: Sequence[float], values: Sequence[float]) -> tuple[float, float]:
    """Return exponent and log factor of the least-squares line through the logarithms."""
    slope, offset = np.polyfit(np.log(sizes), np.log(values), 1)
    return float(slope), float(offset)


def frame_times(path: Path, title: str, milliseconds: Sequence[float], limit_ms: float) -> None:
    """Plot how long the frames of a sequence took: how many took what, and which ones."""
    times = np.asarray(milliseconds, dtype=float)
    middle, high = np.percentile(times, [50, 95])
    # a few slow frames share the last bar
    edge = max(1.5 * high, 1.1 * limit_ms)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN), layout="constrained")
        counts, frames = figure.subplots(1, 2)
        counts.hist(np.minimum(times, edge), bins=40, range=(0.0, edge), color=COLOURS["A"])
        counts.axvline(middle, color="#222222", label=f"median {middle:.0f} ms")
        counts.axvline(high, color="#222222", linestyle="--", label=f"95 % below {high:.0f} ms")
        counts.axvline(
            limit_ms, color=COLOURS["P"], linestyle=":", label=f"limit {limit_ms:.0f} ms"
        )
        counts.set(title=title, xlabel=f"ms a frame (last bar: {edge:.0f} and more)")
        counts.set(ylabel="frames", xlim=(0.0, edge))
        frames.plot(times, ".", color=COLOURS["A"], markersize=2.5)
        frames.axhline(limit_ms, color=COLOURS["P"], linestyle=":")
        frames.set(xlabel="frame", ylabel="ms", ylim=(0.0, 1.05 * max(times.max(), limit_ms)))
        figure.legend(loc="outside lower center", ncols=3)
        save(figure, path)


def bars(
    path: Path,
    title: str,
    y_label: str,
    names: Sequence[str],
    groups: Mapping[str, Sequence[float]],
    limit: float | None = None,
) -> None:
    """Plot one bar for each name and group, as the errors of every expression by S and by P."""
    places = np.arange(len(names))
    width = 0.8 / len(groups)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN), layout="constrained")
        axes = figure.subplots()
        for number, (group, colour) in enumerate(_colours(groups).items()):
            shift = (number + 0.5) * width - 0.4
            axes.bar(places + shift, groups[group], 0.92 * width, color=colour, label=group)
        if limit is not None:
            axes.axhline(limit, color="#222222", linestyle=":", label=f"limit {limit:g}")
        axes.set(title=title, ylabel=y_label)
        slant = 40.0 if len(names) > 6 else 0.0
        axes.set_xticks(places, names, rotation=slant, ha="right" if slant else "center")
        axes.grid(visible=False, axis="x")
        _legend_beside(axes)
        save(figure, path)


@dataclass(frozen=True)
class Tradeoff:
    """A value that falls, at every step of something that is given up for it."""

    y: Sequence[float]
    x: Mapping[str, Sequence[float]]  # what is given up by its words, a panel each


def tradeoff(
    path: Path, title: str, y_label: str, steps: Sequence[str], lines: Mapping[str, Tradeoff]
) -> None:
    """Plot the curves of a choice between two ends, its ``steps`` written beside the first line."""
    panels = list(next(iter(lines.values())).x)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN), layout="constrained")
        for place, words in zip(
            figure.subplots(1, len(panels), sharey=True, squeeze=False)[0], panels, strict=True
        ):
            for name, colour in _colours(lines).items():
                line = lines[name]
                place.plot(line.x[words], line.y, "o-", color=colour, label=name)
            first = next(iter(lines.values()))
            for step, x, y in zip(steps, first.x[words], first.y, strict=True):
                place.annotate(step, (x, y), (3, 4), textcoords="offset points", fontsize=7.0)
            place.set(xlabel=words)
        figure.axes[0].set(title=title, ylabel=y_label)
        figure.axes[0].set_ylim(bottom=0.0)
        _legend_beside(figure.axes[-1])
        save(figure, path)


def _colours(names: Mapping[str, object]) -> dict[str, str]:
    others = iter(OTHERS * len(names))
    return {name: COLOURS.get(name) or next(others) for name in names}


def _legend_beside(axes: Axes) -> None:
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))


def save(figure: Figure, path: Path) -> None:
    """Write a figure, the same bytes for the same figures."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # no version of the library and no date in the file: it changes with the figures only
    empty = {"Software": None} if path.suffix == ".png" else {"Date": None, "Creator": None}
    figure.savefig(path, metadata=empty)
