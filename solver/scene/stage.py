"""A person with all that a scene puts in, on and around them, ready to move."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import scipy.sparse as sp

from solver.animation.frame import Drives, PosedFrame
from solver.animation.gaze import Gaze
from solver.contact.objects import check_objects
from solver.contact.penetration import Gauge, Penetration
from solver.edits.edit import apply
from solver.errors import InputError
from solver.scene.edits import edits_of
from solver.scene.forces import forces_of
from solver.scene.objects import objects_of
from solver.scene.physics import physics_of
from solver.scene.places import Places
from solver.simulation.inertia import lumped_masses
from solver.simulation.simulator import Simulator
from solver.simulation.state import Drive
from solver.surface import Floats, Surface

MOST_FRAMES = 20_000
"""Of a scene: ten minutes at 30 a second, and a few gigabytes while its files are written."""
DAMPING = 0.5
STEPS = 4
"""Of a dynamic face in a frame: flesh swings some 15 times a second, which long steps damp."""


class Stage:
    """What a scene, that its schema has found good, makes of a person with the S (n, m + 1).

    ``drives`` say what the face does; ``linear`` names the linear solver; ``objects`` are what the
    face meets. Raises
    :class:`~solver.errors.InputError` (``scene.*``, ``force.point``, ``contact.crossed``) for what
    the person does not have or can not be.
    """

    def __init__(
        self,
        document: Mapping[str, Any],
        places: Places,
        S: sp.csr_array,
        drives: Drives,
        linear: str | None = None,
    ) -> None:
        _check_length(drives)
        self.drives = drives
        self._physics = physics_of(document)
        self._edited = apply(edits_of(document.get("edits", []), places), places.model, S)
        self.model = self._edited.model
        self._face = self._physics.face(self._edited)
        interpolation = document.get("interpolation", "smooth")
        self.objects = objects_of(document.get("objects", []), places, interpolation)
        begin = self.drive(float(drives.times[0]), drives(float(drives.times[0])))
        objects = self._seen(begin)
        check_objects(
            self.model,
            {each.name: shape for each, shape in zip(self.objects, objects, strict=True)},
        )
        dynamic = document.get("mode", "quasi_static") == "dynamic"
        self.steps_per_frame: int = document.get("steps_per_frame", STEPS if dynamic else 1)
        masses = lumped_masses(self._face.flesh, self._edited.density)
        self.simulator = Simulator(
            self._face,
            self._physics.contacts(self._edited, objects),
            forces_of(document.get("forces", []), self._face, masses, places),
            dynamic=dynamic,
            density=self._edited.density,
            damping=document.get("damping", DAMPING),
            linear=linear,
        )
        self._gaze = Gaze(self.model)
        self.gauge = Gauge(self.model, self._edited.unedited)

    def drive(self, time: float, pose: PosedFrame) -> Drive:
        """Return what the flesh is asked for at ``time``, when the face does ``pose``."""
        A = self._physics.activations(self._edited, pose.a)
        objects = tuple(each.at(time).vertices for each in self.objects)
        return Drive(time, A, pose.jaw, pose.head, objects)

    def skin(self, y: Floats, jaw: Floats, eyes: Floats) -> Floats:
        """Return the whole skin (V, 3) of flesh y (p, 3), both in the head's frame."""
        return self._gaze.turn(self._face.whole_skin(y, jaw), eyes)

    def penetration(self, y: Floats, drive: Drive) -> Penetration:
        """Return how deep flesh y (p, 3), in the head's frame, is in what it meets."""
        return self.gauge.at(y, drive.jaw, self._seen(drive))

    def inverted(self, y: Floats) -> int:
        """Return the number of inverted tets of flesh y (p, 3)."""
        return self._face.flesh.inverted(y)

    def _seen(self, drive: Drive) -> list[Surface]:
        """Return the objects in the head's frame."""
        into = drive.head.inverse()
        return [
            each.shape.moved(into(vertices))
            for each, vertices in zip(self.objects, drive.objects, strict=True)
        ]


def _check_length(drives: Drives) -> None:
    frames = len(drives.times)
    if frames > MOST_FRAMES:
        raise InputError(
            "scene.long",
            f"the scene has {frames} frames; at most {MOST_FRAMES} can be simulated in one job",
            found=frames,
            expected=MOST_FRAMES,
        )
