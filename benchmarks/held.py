"""Muscles of a cheek whose markers are gone for a second: whether they are held, and come back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.documents import Figures
from benchmarks.made_takes import Bench, MadeTake
from solver.fitting import prior
from solver.fitting.markers.observation import MarkerFit, Markers
from solver.fitting.prior import GaussianPrior
from solver.fitting.tracking import Tracker
from solver.surface import Floats

HELD_S = 1.0
LOST = 0.8  # part of what a muscle does to all markers, of those gone: no other sees it


def measure_held(bench: Bench) -> Figures:
    """Return what becomes of the left cheek without its markers for a second.

    The prior knows no expressions: by those markers elsewhere determine a cheek's muscles too.
    """
    face = bench.face
    truth = bench.truth
    take = bench.clean()
    known = prior.from_changes(face.layout, [], prior.LOOSE)
    bench = bench.refined(known, take)
    places = bench.places.at(face.rest.x)
    left, height = (places[:, axis] - np.median(places[:, axis]) for axis in (0, 1))
    cheek = (left > 15.0) & (np.abs(height) < 30.0)
    first = len(truth.numbers) // 3
    length = max(round(HELD_S / truth.seconds), 1)
    rows = range(first, min(first + length, len(truth.numbers) - 1))
    points = take.points.copy()
    points[rows.start : rows.stop, cheek] = np.nan
    clean = _fit(bench, known, take)
    gone = _fit(bench, known, MadeTake(points, take.wrong, take.swapped))
    by_marker = _pull_on_markers(bench)[:, face.layout.muscles].sum(axis=2)
    lost = by_marker[cheek].sum(axis=0) > LOST * by_marker.sum(axis=0)
    before = gone[first - 1].state.pose.a
    last = gone[rows.stop - 1].state.pose.a
    held = gone[rows.stop - 1].held
    faded = np.exp(-len(rows) * truth.seconds) * (before - face.rest_pose().a)
    drift = np.abs(last - face.rest_pose().a - faded)[held & lost]
    rest = face.model.skin.vertices[face.model.face]
    patch = np.linalg.norm(rest[:, None] - places[cheek], axis=2).min(axis=1) < 8.0

    def skin(fit: MarkerFit) -> Floats:
        return np.asarray(face.face_points(fit.state.x)[patch])

    def off(found: list[MarkerFit]) -> float:
        true = [truth.skin(row)[face.model.face][patch] for row in rows]
        pairs = zip(rows, true, strict=True)
        return float(np.mean([np.linalg.norm(skin(found[r]) - t, axis=1).mean() for r, t in pairs]))

    jumps = [
        np.linalg.norm(skin(found[rows.stop]) - skin(found[rows.stop - 1]), axis=1).mean()
        for found in (gone, clean)
    ]
    return {
        "markers_gone": int(cheek.sum()),
        "muscles_gone": int(lost.sum()),
        "recall": float(np.mean([gone[row].held[lost].mean() for row in rows])),
        "drift": float(drift.mean()) if drift.size else 0.0,
        "return_jump_mm": float(jumps[0] - jumps[1]),
        "face_over_clean": off(gone) / off(clean),
        "clean_mm": off(clean),
    }


def _fit(bench: Bench, known: GaussianPrior, take: MadeTake) -> list[MarkerFit]:
    fits = []

    def watch(_row: int, fit: MarkerFit) -> None:
        # without the factorised Hessian of its state
        slim = replace(fit.state.equilibrium, factor=None)  # type: ignore[arg-type]
        fits.append(replace(fit, state=replace(fit.state, equilibrium=slim)))

    bench.fit(known, take, watch)
    return fits


def _pull_on_markers(bench: Bench) -> Floats:
    """Return the squares (k, q) of how far a usual change of each control moves each marker."""
    unseen = np.ones(len(bench.markers))
    known = prior.from_changes(bench.face.layout, [])
    jacobian = Tracker(Markers(bench.face, bench.places, unseen, known, 1.0)).solver.jacobian
    assert jacobian is not None, "made when tracking began"
    moved = jacobian.motion(bench.places.jacobian(bench.face.rest.x))
    return np.asarray((moved.reshape(len(bench.places), 3, -1) ** 2).sum(axis=1))
