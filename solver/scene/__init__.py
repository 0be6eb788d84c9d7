"""A person with all that a scene puts in, on and around them, ready to move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy.sparse as sp

from solver.animation import Drives, Gaze, PosedFrame
from solver.animation.lids import PlayedLids
from solver.contact import Gauge, Penetration, contact_potentials
from solver.edits import AnatomyChange, Edited, apply
from solver.edits.changes import Bone, Fat, Filler, Paralysis, Scaling, under_skin
from solver.edits.fat_compartments import FAT_MAP
from solver.errors import InputError
from solver.fitting.calibration import with_fibres
from solver.fitting.drives.fibre_contraction import fibre_activations, nearest_fibre
from solver.fitting.face import Face
from solver.fitting.strips import strip_names
from solver.kinds import scene as scenes
from solver.kinds import scene_edits
from solver.mechanics.boundary import Potential
from solver.mechanics.fibre_muscle import FibreMuscles
from solver.mechanics.flesh import IDENTITY, LAWS, MOONEY_RIVLIN
from solver.mechanics.linear import fastest
from solver.model import SubjectModel
from solver.progress import ProgressCallback, silent
from solver.scene.neck import CarriedHead
from solver.scene.places import Places, check_objects, objects_of
from solver.simulation import Simulator
from solver.simulation.forces import Drive, ExternalForce, Gravity, Pull, Wind, lumped_masses
from solver.surface import Floats, Surface
from solver.tracks.basis import MuscleTracks
from solver.tracks.springs import TrackedFlesh


def edit_of(entry: scene_edits.Edit, places: Places) -> AnatomyChange:
    """Return an edit that a scene describes; raises as :class:`Places`."""
    if isinstance(entry, scene_edits.FatEntry):
        painted = places.map_of(entry.map)
        depth = None
        if painted is None and places.without_compartments is None:
            painted = places.fat_map(gain=entry.f_min + entry.f_max >= 2.0, sex=entry.sex)
            depth = FAT_MAP.depth_mm
        return Fat(entry.f_min, entry.f_max, painted, entry.softening, depth)
    if isinstance(entry, scene_edits.FillerEntry):
        points = np.array([places.point(stop.at) for stop in entry.path])
        depths = np.array([stop.depth_mm for stop in entry.path])
        return Filler(under_skin(places.model, points, depths), entry.ml, entry.radius_mm)
    if isinstance(entry, scene_edits.BoneEntry):
        at = places.point(entry.at)
        move = np.array(entry.move_mm, np.float64)
        return Bone(entry.bone, at, entry.radius_mm, move)
    if isinstance(entry, scene_edits.StiffnessEntry):
        return Scaling("stiffness_factor", entry.factor, places.map_of(entry.map))
    if isinstance(entry, scene_edits.DensityEntry):
        return Scaling("density", entry.factor, places.map_of(entry.map))
    muscles = None if entry.muscles is None else tuple(entry.muscles)
    return Paralysis(muscles, entry.side, entry.strength)


def force_of(entry: scenes.Force, face: Face, masses: Floats, places: Places) -> ExternalForce:
    """Return a force that a scene describes; ``masses`` (p,) are in g.

    Raises as :meth:`Places.vertex`, and :class:`InputError` (``force.point``).
    """
    if isinstance(entry, scenes.GravityEntry):
        return Gravity(masses, entry.mm_s2)
    if isinstance(entry, scenes.WindEntry):
        return Wind(face, entry.m_s, entry.gusts, entry.seed)
    at = places.vertex(entry.at)
    radius = entry.radius_mm
    return Pull(face.model, at, entry.mn, radius_mm=radius, ramp=entry.ramp)


class Physics:
    """Flesh of a ``scene``, and what it meets, as its document says.

    Where ``fibres`` move it, strengths over the flesh's mu, it is of the law that they are
    calibrated in, where ``tracks`` do, of theirs, unless the document says another. Contact is
    ``firmer`` by what muscles press harder: what is pressed into teeth goes by their ratio.
    """

    def __init__(
        self,
        scene: scenes.FleshEntry,
        fibres: FibreMuscles | None = None,
        firmer: float = 1.0,
        tracks: MuscleTracks | None = None,
    ) -> None:
        self._scene = scene
        self._fibres = fibres
        self._firmer = firmer
        given = scene.material
        law = LAWS[given.law]
        if "law" not in given.model_fields_set:
            law = MOONEY_RIVLIN if fibres is not None else law
            law = LAWS[tracks.law] if tracks is not None else law
        self._material = law.in_pascal(given.stiffness_pa)

    def face(self, edited: Edited) -> Face:
        """Return an edited person's face."""
        plain = Face(
            edited.model,
            edited.S,
            material=self._material,
            linear=fastest(),
            pinned=not self._scene.sliding,
            stiffness_factor=edited.stiffness_factor,
            growth=edited.growth,
            bones=edited.bones,
        )
        if self._fibres is None:
            return plain
        return with_fibres(plain, _weaken(self._fibres, edited).scale(self._material.mu))

    def contacts(self, edited: Edited, objects: Sequence[Surface] = ()) -> list[Potential]:
        """Return what keeps the skin out of itself, of teeth, eyeballs and ``objects``."""
        contact = self._scene.contact
        return contact_potentials(
            edited.model,
            self._material.mu * self._firmer,
            unedited=edited.unedited,
            lips=contact.lips,
            teeth=contact.teeth,
            eyes=contact.eyes,
            objects=objects,
            friction=contact.friction,
        )

    def activations(self, edited: Edited, a: Floats) -> Floats:
        """Return what drives the flesh for the muscles' ``a``: activations (n, 6) if by S."""
        if self._fibres is not None:
            return a
        S = edited.S
        if self._scene.activation_model == "fibre":
            return fibre_activations(edited.model, S, nearest_fibre(edited.model, S, a))
        return np.ascontiguousarray(S @ np.vstack([IDENTITY, a]))


def whole_weights(model: SubjectModel, least: float = 1e-6) -> sp.csr_array:
    """Return the model's weights with a ``least`` part of each muscle of their pattern.

    What edits of muscles multiply can then be told, also where a model has none of a muscle.
    """
    S = model.weights
    count = np.diff(S.indptr)
    even = np.repeat(1.0 / count, count)
    return sp.csr_array((S.data + least * (even - S.data), S.indices, S.indptr), shape=S.shape)


def _weaken(fibres: FibreMuscles, edited: Edited) -> FibreMuscles:
    """Return fibre muscles with what edits leave of them, by :func:`whole_weights`."""
    whole = whole_weights(edited.unedited)
    left = whole.copy()
    left.data = edited.S.data / whole.data
    columns = fibres.sources[fibres.muscles] + 1
    kept = np.asarray(left.tocsr()[fibres.tets, columns]).ravel()
    return replace(fibres, fractions=fibres.fractions * kept)


# of a scene: ten minutes at 30 a second, and a few gigabytes while its files are written
MOST_FRAMES = 20_000
STEPS = 4  # of a dynamic face in a frame: flesh swings some 15 times a second, long steps damp


def check_length(frames: float) -> None:
    """Raise :class:`InputError` (``scene.long``) for more frames than a job simulates."""
    if frames > MOST_FRAMES:
        reason = f"at most {MOST_FRAMES} can be simulated in one job"
        message = f"the scene has {frames:.0f} frames; {reason}"
        raise InputError("scene.long", message, found=round(frames), expected=MOST_FRAMES)


class Stage:
    """A person with the S (n, m + 1) in a scene, or with what else the ``drives`` are of.

    That are ``fibres`` or ``tracks``, whose muscles have the model's shares of the tets. ``drives``
    say what the face does; ``linear`` names the linear solver; ``objects`` are what the face meets,
    ``muscles`` what moves it; contact is ``firmer`` by a factor; ``lids`` lead those of the skin;
    ``progress`` is that of a neck.
    Raises :class:`~solver.errors.InputError` (``scene.*``, ``force.point``, ``contact.crossed``)
    for what the person does not have or cannot be.
    """

    def __init__(
        self,
        scene: scenes.PlayedScene,
        places: Places,
        S: sp.csr_array,
        drives: Drives,
        linear: str | None = None,
        fibres: FibreMuscles | None = None,
        firmer: float = 1.0,
        tracks: MuscleTracks | None = None,
        lids: PlayedLids | None = None,
        progress: ProgressCallback = silent,
    ) -> None:
        check_length(len(drives.times))
        self.drives = drives
        self.tracks = tracks
        self._physics = Physics(scene, fibres, firmer, tracks)
        edits = [edit_of(entry, places) for entry in scene.edits]
        if fibres is not None:
            S = whole_weights(places.model)
        elif tracks is not None:
            S = tracks.shares(places.model)
        self._edited = apply(edits, places.model, S)
        muscles = places.model.muscle_names
        self.muscles = muscles if fibres is None else strip_names(muscles, fibres)
        self.model = self._edited.model
        self._face = self._physics.face(self._edited)
        self._tracked: TrackedFlesh | None = None
        if tracks is not None:
            springs = self._edited.S, tracks.stiffness, tracks.length_mm
            self._tracked = TrackedFlesh.of(self._face.flesh, *springs)
            self._face = self._face.with_flesh(self._tracked.flesh)
        if isinstance(scene, scenes.SimulateScene):
            self.objects = objects_of(scene.objects, places, scene.interpolation)
        else:
            self.objects = objects_of(scene.objects, places)
        dynamic = scene.mode == "dynamic"
        self.steps_per_frame = scene.steps_per_frame or (STEPS if dynamic else 1)
        self.neck: CarriedHead | None = None
        if scene.neck is not None:
            self.neck = CarriedHead(
                scene.neck, places, self.model, drives, self.steps_per_frame, scene.forces, progress
            )
        begin = float(drives.times[0])
        objects = self._seen(self.drive(begin, drives(begin)))
        names = [each.name for each in self.objects]
        check_objects(self.model, dict(zip(names, objects, strict=True)))
        potentials = self._physics.contacts(self._edited, objects)
        masses = lumped_masses(self._face.flesh, self._edited.density)
        self.simulator = Simulator(
            self._face,
            potentials,
            [force_of(entry, self._face, masses, places) for entry in scene.forces],
            dynamic=dynamic,
            density=self._edited.density,
            damping=scene.damping,
            linear=linear,
            pull=None if self.neck is None else self.neck.pull,
        )
        self._gaze = Gaze(self.model)
        self._lids = lids
        self.gauge = Gauge(self.model, self._edited.unedited, potentials)

    def drive(self, time: float, pose: PosedFrame) -> Drive:
        """Return what the flesh is asked for at ``time``, when the face does ``pose``."""
        if self._tracked is not None and pose.target is not None:
            A = self._tracked.controls(pose.a, pose.target)
        else:
            A = self._physics.activations(self._edited, pose.a)
        objects = tuple(each.at(time).vertices for each in self.objects)
        if self.neck is None:
            return Drive(time, A, pose.jaw, pose.head, objects)
        return Drive(time, A, pose.jaw, self.neck.head(time), objects, self.neck.carried(time))

    def skin(self, y: Floats, jaw: Floats, eyes: Floats, time: float) -> Floats:
        """Return the whole skin (V, 3) of flesh y (p, 3) at ``time``, both in the head's frame."""
        skin = self.skin_of_flesh(y, jaw, time)
        if self._lids is not None:
            skin = self._lids.lead(skin, self.model.skin.vertices, time)
        return self._gaze.turn(skin, eyes)

    def skin_of_flesh(self, y: Floats, jaw: Floats, time: float) -> Floats:
        """Return :meth:`skin` as flesh alone has it: eyes at rest, and lids not led."""
        hung = None if self.neck is None else self.neck.hung(time)
        return self._face.whole_skin(y, jaw, hung)

    def penetration(self, y: Floats, drive: Drive) -> Penetration:
        """Return how deep flesh y (p, 3), in the head's frame, is in what it meets."""
        return self.gauge.at(y, drive.jaw, self._seen(drive))

    def count_inverted(self, y: Floats) -> int:
        """Return the number of inverted tets of flesh y (p, 3)."""
        return self._face.flesh.count_inverted(y)

    def _seen(self, drive: Drive) -> list[Surface]:
        """Return the objects in the head's frame."""
        into = drive.head.inverse()
        return [
            each.shape.with_vertices(into(vertices))
            for each, vertices in zip(self.objects, drive.objects, strict=True)
        ]
