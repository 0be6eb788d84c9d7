"""How far the live session that recorded a take was off the take's exact solution."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from solver.jobs import Task
from solver.jobs.sequences import distance_figures
from solver.live.sent import SentFaces
from solver.rig import Rig


class LiveOff:
    """Compares the face that a session sent of a ``take`` with the exact one, frame by frame.

    Without the session's file that is nothing. ``first`` is the number that the job gives the
    take's first frame. Raises as :meth:`SentFaces.open`: at once, not after the fit.
    """

    def __init__(self, task: Task[Any], rig: Rig, take: Path, first: int = 0) -> None:
        self._shown = rig.model.face
        self._first = first
        self._sent: SentFaces | None = None
        if "live_takes" in task.inputs:
            given = task.inputs["live_takes"]
            self._sent = SentFaces.open(given, rig.model, rig.weights, take)

    def report(self, skins: Iterable[tuple[int, NDArray[np.floating]]]) -> dict[str, Any]:
        """Return as ``live`` how far the session was off frames, given by number and skin (v, 3).

        Skins are in the head's frame, distances those of the face's vertices, their mean in each
        frame as full solves beside a session have it; what the session told then lies beside them.
        """
        if self._sent is None:
            return {}
        found = {}
        for number, skin in skins:
            off = self._sent.off_mm(number - self._first, skin[self._shown])
            if off is not None:
                found[number] = off
        every = np.array([*found.values()])
        live = {
            "take": self._sent.take.name,
            "frames": len(found),
            "p50_mm": round(float(np.median(every)), 4) if found else None,
            **distance_figures(every),
            "max_frame": max(found, key=lambda number: found[number], default=None),
            "told": self._sent.take.told,
        }
        return {"live": live}
